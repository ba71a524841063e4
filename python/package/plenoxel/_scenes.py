"""Scenes: from a folder, from arrays, or built in."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Sequence

from . import _plenoxel
from ._plenoxel import Scene

if TYPE_CHECKING:
    import os


def open(folder: str | os.PathLike[str]) -> Scene:
    """Open a dataset folder: NeRF-synthetic, transforms.json of nerfstudio, COLMAP, LLFF or NSVF.

    All metadata is checked now. Images are read when a run starts.

    Raises:
        InputError: The folder or a file in it is invalid; the message names the file.
    """
    return _plenoxel.open(folder)


def procedural(*, size: int | tuple[int, int] = 200, train: int = 100, val: int = 10, test: int = 25) -> Scene:
    """Return the built-in scene, a still life with exact depth. Its images are rendered when a run starts.

    Args:
        size: Pixels per side, or width and height.
        train: Number of training views.
        val: Number of validation views.
        test: Number of test views.
    """
    width, height = (size, size) if isinstance(size, int) else size
    return _plenoxel.procedural(width, height, train, val, test)


def dataset(
    images: Any,
    intrinsics: Any,
    camera_to_world: Any,
    masks: Any = None,
    *,
    names: Sequence[str] | None = None,
    splits: Sequence[str | None] | None = None,
    axes: str = "opengl",
    normalize: bool = False,
    name: str = "arrays",
) -> Scene:
    """Make a scene of arrays. The arrays are copied; they may have any strides.

    Args:
        images: ``[n, h, w, 3]`` or ``[n, h, w, 4]``, uint8 or floats in [0, 1], sRGB, with straight alpha; or a list of n images of several sizes.
        intrinsics: K, ``[3, 3]`` or ``[n, 3, 3]``, or (fx, fy, cx, cy), ``[4]`` or ``[n, 4]``, in pixels; the centre of the first pixel is at (0.5, 0.5).
            There is no lens: undistort images first.
        camera_to_world: ``[n, 4, 4]`` or ``[n, 3, 4]``, a rotation and the position of each camera. The axes must be right-handed.
        masks: ``[n, h, w]``, true where a pixel is used. Pixels that are not used train nothing, and count in no score.
        names: Names of the views.
        splits: "train", "val" or "test" for each view. The default is every eighth view for testing (the setting ``capture.test_every``).
        axes: Camera axes: "opengl" (x right, y up, z backwards) or "opencv" (x right, y down, z forwards, as of COLMAP).
        normalize: True turns, moves and scales the cameras as those of a capture, for scenes of any size and place; presets for captures, such as "photos",
            need it. False uses the coordinates as they are: the object must be around the origin, within the setting ``half_width``.
        name: Name of the scene.

    Raises:
        ArrayError: An array has the wrong shape, numbers that are not finite or out of range, or axes that are left-handed.
        DtypeError: An array has the wrong type of numbers.
    """
    names = None if names is None else list(names)
    splits = None if splits is None else list(splits)
    return _plenoxel.dataset(images, intrinsics, camera_to_world, masks, names, splits, axes, normalize, name)
