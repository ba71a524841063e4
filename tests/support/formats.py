"""Writes ckpt.npz and tree.npz, with NumPy and the conventions of svox2 and svox. tests/formats.rs reads them.

    python formats.py        # in this folder
"""
import numpy as np

# svox2: SparseGrid.save. Rows are in reverse order of the voxels; -2 is a hint for skipping, as in files saved after training on a GPU.
n = 4
x, y, z = np.meshgrid(*[np.arange(n)] * 3, indexing="ij")
present = (x + y + z) % 3 > 0
links = np.where(x == 0, -2, -1).astype(np.int32)
rows = int(present.sum())
links[present] = np.arange(rows)[::-1]
density = np.zeros((rows, 1), np.float32)
density[links[present], 0] = (100 * x + 10 * y + z)[present] / 64 - 1
sh = np.zeros((rows, 12), np.float32)
sh[links[present]] = np.stack([x, y, z, x - y, y - z, z - x, x + y, y + z, z + x, x * y, y * z, z * x], -1)[present] / 16
np.savez(
    "ckpt.npz",
    radius=np.full(3, 1.0, np.float32),
    center=np.zeros(3, np.float32),
    links=links,
    density_data=density,
    sh_data=sh.astype(np.float16),
    basis_type=1,
)

# svox: N3Tree.save. The root has a large leaf and a child with smaller leaves.
child = np.zeros((2, 2, 2, 2), np.int32)
child[0, 1, 0, 1] = 1
data = np.zeros((2, 2, 2, 2, 4), np.float16)
data[0, 0, 1, 1] = [1, -2, 0.5, 3]
data[1, 0, 0, 1] = [-1, 0, 4, 0.25]
data[1, 1, 1, 1] = [0, 0, 0, -5]
np.savez_compressed(
    "tree.npz",
    data_dim=4,
    child=child,
    parent_depth=np.array([[0, 0], [5, 1]], np.int32),
    n_internal=2,
    n_free=0,
    invradius3=np.full(3, 0.25, np.float32),
    offset=np.full(3, 0.5, np.float32),
    depth_limit=10,
    geom_resize_fact=1.5,
    data=data,
    data_format="SH1",
)
