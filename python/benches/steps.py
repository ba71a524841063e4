"""Durations of a step of the preset `fast`, with the mean squared error in Rust, in `px.Tensor` and in PyTorch: `python benches/steps.py`. Needs torch."""

import resource
import tempfile
import time

import torch

import plenoxel as px

#: The steps between which the duration is measured.
FROM, TO = 40, 140


def in_python(step):
    return step.mean((step.rgb - step.target).square())


@px.torch_loss
def in_torch(rgb, step):
    return torch.nn.functional.mse_loss(rgb, torch.tensor(step.target.numpy()))


def milliseconds(scene, folder, loss):
    """Return CPU time and wall time of a step."""
    marks = []

    def callback(event):
        if event["kind"] == "step" and event["step"] in (FROM, TO):
            used = resource.getrusage(resource.RUSAGE_SELF)
            marks.append((used.ru_utime + used.ru_stime, time.monotonic()))
            if event["step"] == TO:
                raise InterruptedError

    losses = {} if loss is None else {"losses": {"mse": None}}
    try:
        px.train(scene, "fast", out=folder, loss=loss, callback=callback, progress=False, page=False, scout=None, hull="off", **losses)
    except InterruptedError:
        pass
    return [1e3 * (after - before) / (TO - FROM) for before, after in zip(*marks)]


scene = px.procedural(train=20, val=0, test=0)
with tempfile.TemporaryDirectory() as folder:
    for name, loss in (("Rust", None), ("px.Tensor", in_python), ("torch", in_torch)):
        cpu, wall = milliseconds(scene, f"{folder}/{name}", loss)
        print(f"{name}: {cpu:.1f} ms of CPU time, {wall:.1f} ms", flush=True)
