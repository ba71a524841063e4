"""A perceptual loss in PyTorch and its measure on the test views of the built-in scene, without and with it: `python benches/perceptual.py [WEIGHT]`. Needs torch.

The distance of LPIPS (Zhang et al. 2018) on features of three convolutions with random weights.
"""

import sys
import tempfile

import numpy as np
import torch

import plenoxel as px

SIDE = 16
WEIGHT = float(sys.argv[1]) if len(sys.argv) > 1 else 0.02

torch.manual_seed(0)
layers = [torch.nn.Conv2d(a, b, 3, stride).requires_grad_(False) for a, b, stride in ((3, 16, 1), (16, 32, 2), (32, 32, 1))]


def distance(a, b):
    """Return the distance of images `[n, 3, h, w]`."""
    total = 0
    for layer in layers:
        a, b = layer(a).relu(), layer(b).relu()
        unit = [x / (x.norm(dim=1, keepdim=True) + 1e-6) for x in (a, b)]
        total = total + (unit[0] - unit[1]).square().sum(1).mean()
    return total


def patches(colors):
    return colors.reshape(-1, SIDE, SIDE, 3).permute(0, 3, 1, 2)


@px.torch_loss
def perceptual(rgb, step):
    return distance(patches(rgb), patches(torch.tensor(step.target.numpy())))


def as_batch(image):
    return torch.tensor(np.asarray(image, dtype=np.float32)).permute(2, 0, 1)[None]


def over_white(image):
    colors, alpha = np.split(image / 255, [3], axis=-1)
    return colors * alpha + 1 - alpha


scene = px.procedural()
views = list(zip(scene.cameras("test"), map(over_white, scene.images("test"))))
with tempfile.TemporaryDirectory() as folder:
    for weight in (0.0, WEIGHT):
        loss = {"perceptual": (weight, perceptual)} if weight else None
        run = px.train(scene, "fast", out=f"{folder}/{weight}", page=False, progress=False, patch_size=SIDE, loss=loss)
        pairs = [(as_batch(np.clip(run.render(camera), 0, 1)), as_batch(image)) for camera, image in views]
        mean = np.mean([float(distance(*pair)) for pair in pairs])
        print(f"weight {weight}: distance {mean:.5f}, {run.psnr:.2f} dB", flush=True)
