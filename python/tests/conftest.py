"""Scenes and runs that several tests use. They are small: a run takes about a second."""

import numpy as np
import pytest

import plenoxel as px

#: Settings of a run of a few steps.
SMALL = {
    "hull": "off",
    "scout": None,
    "rays_per_step": 256,
    "stages": [{"resolution": 16, "steps": 30, "density_rate": 30.0, "color_rate": 0.05, "sampling": {"step": 0.5}}],
    "page": False,
    "progress": False,
}


@pytest.fixture(scope="session")
def scene():
    return px.procedural(size=24, train=12, val=2, test=2)


@pytest.fixture(scope="session")
def arrays(scene):
    """The training views of the scene as arrays: images, intrinsics, camera_to_world."""
    cameras = scene.cameras("train")
    return {
        "images": np.stack(scene.images("train")),
        "intrinsics": np.stack([camera.intrinsics for camera in cameras]),
        "camera_to_world": np.stack([camera.camera_to_world for camera in cameras]),
    }


@pytest.fixture(scope="session")
def small():
    return SMALL


@pytest.fixture(scope="session")
def run(scene, tmp_path_factory):
    return px.train(scene, out=tmp_path_factory.mktemp("runs") / "run", **SMALL)
