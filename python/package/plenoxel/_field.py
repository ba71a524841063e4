"""Fields that are written in Python."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Callable, Mapping, Protocol, Sequence

from . import _plenoxel
from ._plenoxel import Camera, Param, Picture, Scene, Tensor
from ._run import Scores, scores_of
from ._train import Losses, extras, with_bar

if TYPE_CHECKING:
    import os

    import numpy as np


class Field(Protocol):
    """What `train_field` needs of a field. A class need not inherit from this one."""

    @property
    def params(self) -> Sequence[Param]:
        """The parameters. Training begins with their values and updates them."""

    def density(self, positions: Tensor, params: Mapping[str, Tensor], /) -> Tensor:
        """Return the density at positions ``[n, 3]``: ``[n]``, 1 / length, 0 or more."""

    def radiance(self, positions: Tensor, directions: Tensor, params: Mapping[str, Tensor], /) -> tuple[Tensor, Tensor]:
        """Return the density ``[n]`` and the color ``[n, 3]``, sRGB, at positions that are seen along unit directions ``[n, 3]``."""


class TrainedField:
    """A trained field: `train_field` returns it. ``field.params`` have the trained values."""

    def __init__(self, inner: _plenoxel.TrainedField, field: Field):
        self._inner = inner
        #: The field.
        self.field = field
        #: Scores of the test views; None if they were not evaluated.
        self.scores: Scores | None = None if inner.scores is None else scores_of(inner.scores)
        #: Number of steps taken.
        self.steps: int = inner.steps
        #: The similarity from the coordinates of the dataset to the world of the field, ``[4, 4]``.
        self.to_world: np.ndarray = inner.to_world

    @property
    def psnr(self) -> float | None:
        """Mean PSNR of the test views in dB; None if they were not evaluated."""
        return None if self.scores is None else self.scores.psnr

    def render(self, camera: Camera, *, background: Sequence[float] | None = None) -> Picture:
        """Render the image of a camera over a background, sRGB in [0, 1]; the default is that of the training."""
        return self._inner.render(camera, None if background is None else list(background))

    def evaluate(self, split: str = "test", *, background: Sequence[float] | None = None) -> Scores:
        """Compare the field with the photographs of a split."""
        return scores_of(self._inner.evaluate(split, None if background is None else list(background)))

    def __repr__(self) -> str:
        score = "" if self.psnr is None else f", {self.psnr:.2f} dB"
        return f"TrainedField({type(self.field).__name__}, {self.steps} steps{score})"


def train_field(
    scene: Scene,
    field: Field,
    *,
    steps: int = 1000,
    rays_per_step: int = 1024,
    samples: int = 128,
    cells: int = 32,
    half_width: float = 1.5,
    seed: int = 42,
    background: Sequence[float] = (1.0, 1.0, 1.0),
    downscale: int = 1,
    loss: Losses | None = None,
    params: Sequence[Param] = (),
    out: str | os.PathLike[str] | None = None,
    force: bool = False,
    resume: bool = False,
    callback: Callable[[dict[str, Any]], Any] | None = None,
    progress: bool = True,
    checkpoint_every: float | str = "5m",
    test_views: int | None = None,
    threads: int | None = None,
) -> TrainedField:
    """Train a field that is written in Python, and evaluate it on the test views.

    ``field.density`` and ``field.radiance`` are called with tensors of all samples of a step, and their ops are recorded one by one. This is slow: a step takes
    many times as long as one of `train`, whose fields have kernels. Use it to try a representation, not to train large scenes.

    The field fills the cube ``[-half_width, half_width]³`` of its world; space outside is empty. The world is that of the dataset, but captures are turned, moved
    and scaled (``TrainedField.to_world``). Parameters are trained by Adam. Their rates fall exponentially to a tenth. Runs have the same bits for the same seed,
    functions and initial values.

    Args:
        scene: The views.
        field: An object with ``params``, ``density`` and ``radiance``; see `Field`.
        steps: Number of steps.
        rays_per_step: Number of rays per step.
        samples: Number of samples on the side of the cube.
        cells: Number of cells along each axis. Cells with a low density are not sampled. For this, ``density`` is called with random points of
            all cells. 0 samples all.
        half_width: Half of the side of the cube.
        seed: Seed of all random numbers.
        background: Background color, sRGB in [0, 1].
        downscale: Reduce images by this factor.
        loss: A loss or several, as for `train`. The default is the mean squared error of the colors.
        params: Parameters of the losses.
        out: File, such as "field.safetensors", to which the training is saved every ``checkpoint_every``, at its end, on Ctrl-C, and on an exception of the callback.
        force: Overwrite the file.
        resume: Resume from this file, with the same arguments and losses. If the training is complete, it is only loaded and evaluated.
        callback: Called with each event, a dict with its ``kind``: planned, step or saved.
        progress: Show a bar, if tqdm is installed.
        checkpoint_every: Checkpoint interval, seconds or such as "5m".
        test_views: Largest number of test views for the scores; 0 for no evaluation.
        threads: Number of threads; results do not depend on it.

    Raises:
        SettingsError: An argument is out of range; ``out`` exists already.
        ArrayError: A function of the field returned another shape, or a density that is NaN or below 0.
        NumericError: The loss or a parameter is not finite.
        InputError: Images cannot be read, or the file to resume has other parameters, settings or views.
        FileError: The file cannot be written.
        KeyboardInterrupt: Ctrl-C.
        Any exception of the functions.
    """
    options = {
        "params": list(getattr(field, "params", ())),
        "steps": steps,
        "rays_per_step": rays_per_step,
        "samples": samples,
        "cells": cells,
        "half_width": half_width,
        "seed": seed,
        "background": list(background),
        "downscale": downscale,
        "out": out,
        "force": force,
        "resume": resume,
    }
    inner = with_bar(
        progress,
        callback,
        lambda listener: _plenoxel.train_field(scene, field, options, extras(loss, params, listener, checkpoint_every, test_views, False, threads)),
    )
    return TrainedField(inner, field)
