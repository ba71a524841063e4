"""Losses in Python and in PyTorch."""

import numpy as np
import pytest

import plenoxel as px

#: Without the losses of the settings.
ALONE = {"losses": {"mse": None, "tv_color_sampled": None}}


def mse(step):
    return step.mean((step.rgb - step.target).square())


def tables(run):
    return {name: np.array(values) for name, values in run.parameters().items()}


def test_a_loss_trains_like_the_same_loss_of_the_settings(scene, small, tmp_path):
    named = px.train(scene, out=tmp_path / "named", **small, losses={"tv_color_sampled": None})
    mine = px.train(scene, out=tmp_path / "mine", **small, **ALONE, loss=mse)
    for name, values in tables(named).items():
        np.testing.assert_allclose(tables(mine)[name], values, rtol=1e-4, atol=1e-5)
    assert mine.metrics()[-1]["losses"].keys() == {"mse"}


def test_every_column_has_a_gradient(scene, small, tmp_path):
    seen = {}

    def loss(step):
        n = len(step)
        assert step.rgb.shape == step.target.shape == (n, 3) and step.view.shape == (n,) and step.pixel.shape == (n, 2)
        assert step.origins.shape == step.directions.shape == (n, 3) and step.alpha.shape == (n,) and step.extent > 0
        assert step.coarse is None and not step.target.requires_grad
        total = 0
        for column in (step.opacity, step.log_transmittance, step.depth, step.sparsity, step.distortion, step.prediction):
            assert column.requires_grad and len(column) == n
            total = total + column.mean()
        seen[step.number] = step
        return 1e-3 * total

    run = px.train(scene, out=tmp_path / "run", **small, loss={"all": (0.5, loss)})
    assert list(seen) == list(range(30)) and {"all", "mse"} <= run.metrics()[-1]["losses"].keys()
    with pytest.raises(px.StateError, match="the call of the loss is over"):
        seen[0].rgb


def test_a_loss_trains_another_model(scene, tmp_path):
    tensorf = {"tensorf.stages": [{"resolution": 8, "steps": 2, "rays": 64}], "tensorf.short": None}
    run = px.train(scene, "quality", out=tmp_path / "run", **tensorf, page=False, progress=False, loss={"mine": mse})
    assert run.model == "tensorf" and "mine" in run.metrics()[-1]["losses"]


def test_a_parameter_is_trained_and_resumed(scene, small, tmp_path):
    def params():
        return [px.Param("scale", np.full(3, 0.5), rate=0.05)]

    def loss(step):
        return step.mean((step.rgb * step.param("scale") - step.target).square())

    scale = params()
    whole = px.train(scene, out=tmp_path / "whole", **small, **ALONE, loss=loss, params=scale)
    assert (scale[0].value > 0.55).all()

    def stop(event):
        if event["kind"] == "step" and event["step"] == 9:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        px.train(scene, out=tmp_path / "cut", **small, **ALONE, loss=loss, params=params(), callback=stop)
    cut = px.resume(tmp_path / "cut", loss=loss, params=params(), page=False, progress=False)
    for name, values in tables(whole).items():
        assert np.array_equal(values, tables(cut)[name])


def test_time_is_planned_with_the_loss(scene, small, tmp_path):
    calls = []

    def loss(step):
        calls.append(step.number)
        return 0.0 * step.rgb.sum()

    px.train(scene, out=tmp_path / "run", **small, loss=loss, time="2s")
    # The steps that measure the machine begin at 0, as those of the run do.
    assert calls.count(0) == 2


def test_a_loss_in_torch_trains_like_the_same_loss_in_python(scene, small, tmp_path):
    torch = pytest.importorskip("torch")

    @px.torch_loss
    def in_torch(rgb, step):
        return ((rgb - torch.tensor(step.target.numpy())) ** 2).mean()

    def in_python(step):
        return (step.rgb - step.target).square().mean()

    losses = [px.train(scene, out=tmp_path / str(k), **small, **ALONE, loss=loss) for k, loss in enumerate((in_torch, in_python))]
    first, second = map(tables, losses)
    for name, values in first.items():
        np.testing.assert_allclose(values, second[name], rtol=1e-3, atol=1e-4)


def test_a_network_of_torch_and_several_columns(scene, small, tmp_path):
    torch = pytest.importorskip("torch")
    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.Linear(3, 8), torch.nn.ReLU(), torch.nn.Linear(8, 4)).requires_grad_(False)

    def features(rgb, opacity, step):
        return (network(rgb) - network(torch.tensor(step.target.numpy()))).square().mean() + 1e-3 * opacity.mean()

    run = px.train(scene, out=tmp_path / "run", **small, **ALONE, loss=px.torch_loss(features, columns=("rgb", "opacity")))
    values = [line["losses"]["features"] for line in run.metrics()]
    assert values[-1] < 0.7 * values[0]
