"""Radiance fields trained on the CPU.

A scene is opened with `open`, `procedural` or `dataset`, trained with `train`, and looked at as a `Run`::

    import plenoxel as px

    run = px.train(px.open("data/lego"), preset="fast", time="60s")
    print(run.psnr)
    picture = run.render(px.Camera.look_at((3, -3, 2)))

Coordinates are those of the dataset, lengths are in its unit, colors are sRGB in [0, 1]. Camera axes are those of OpenGL (x right, y up, z backwards), unless
``axes="opencv"`` is given. The centre of the first pixel is at (0.5, 0.5).
"""

import os as _os

from . import _plenoxel
from ._errors import (
    ArrayError,
    DtypeError,
    Error,
    FileError,
    GradcheckError,
    InputError,
    Interrupted,
    NumericError,
    SettingsError,
    StateError,
)
from ._plenoxel import (
    Camera,
    Grid,
    Mesh,
    Param,
    Picture,
    PointCloud,
    Scene,
    Step,
    Tensor,
    concat,
    grad,
    gradcheck,
    maximum,
    minimum,
    psnr,
    stack,
    where,
)
from ._plenoxel import VERSION as __version__
from ._field import Field, TrainedField, train_field
from ._run import Run, Scores, load
from ._scenes import dataset, open, procedural
from ._torch import torch_loss
from ._train import carve, presets, resume, train

if hasattr(_os, "register_at_fork"):
    _os.register_at_fork(after_in_child=_plenoxel.after_fork)

__all__ = [
    "ArrayError",
    "Camera",
    "DtypeError",
    "Error",
    "Field",
    "FileError",
    "GradcheckError",
    "Grid",
    "InputError",
    "Interrupted",
    "Mesh",
    "NumericError",
    "Param",
    "Picture",
    "PointCloud",
    "Run",
    "Scene",
    "Scores",
    "SettingsError",
    "StateError",
    "Step",
    "Tensor",
    "TrainedField",
    "carve",
    "concat",
    "dataset",
    "grad",
    "gradcheck",
    "load",
    "maximum",
    "minimum",
    "open",
    "presets",
    "procedural",
    "psnr",
    "resume",
    "stack",
    "torch_loss",
    "train",
    "train_field",
    "where",
]
