"""Resident memory before and after the tables of a grid of 448 voxels a side are taken as arrays: `python benches/memory.py`."""

import gc
import tempfile

import numpy as np

import plenoxel as px


def resident():
    gc.collect()
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096 / 1e6


stage = {"resolution": 448, "steps": 2, "density_rate": 30.0, "color_rate": 0.05, "sampling": {"step": 0.5}}
scene = px.procedural(train=20, val=0, test=1)
with tempfile.TemporaryDirectory() as folder:
    settings = {"stages": [stage], "rays_per_step": 64, "pixels_per_voxel": 0}
    grid = px.train(scene, "voxels", out=f"{folder}/run", page=False, progress=False, test_views=0, **settings).grid()
    before = resident()
    arrays = [grid.density, grid.color, grid.harmonics]
    print(f"{grid}: {before:.1f} MB before, {resident():.1f} MB after taking {sum(a.nbytes for a in arrays) / 1e6:.0f} MB")
    print("sum of the densities", float(np.sum(arrays[0])), f"{resident():.1f} MB after reading them")
