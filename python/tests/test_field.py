"""Fields in Python."""

import threading
import time

import numpy as np
import pytest

import plenoxel as px

#: Arguments of a training that takes about a second.
SMALL = {"steps": 20, "rays_per_step": 64, "samples": 24, "cells": 8, "progress": False}


class Ball:
    """A ball of one color, whose radius, density and color are learned."""

    def __init__(self):
        self.params = [px.Param("radius", 1.2, rate=0.02), px.Param("density", 2.0, rate=0.1), px.Param("color", np.zeros(3), rate=0.1)]

    def density(self, positions, params):
        distance = positions.norm(1)
        return ((params["radius"] - distance) * 8).sigmoid() * params["density"].softplus()

    def radiance(self, positions, directions, params):
        assert positions.shape == directions.shape and not positions.requires_grad
        color = params["color"].sigmoid().unsqueeze(0).broadcast_to(positions.shape)
        return self.density(positions, params), color


class Network(Ball):
    """An encoded network."""

    def __init__(self, hidden=32, octaves=4):
        random = np.random.default_rng(0)

        def layer(name, rows, columns):
            weights = random.normal(0, np.sqrt(2 / rows), (rows, columns))
            return [px.Param(f"{name}.weight", weights, rate=5e-3), px.Param(f"{name}.bias", np.zeros(columns), rate=5e-3)]

        self.octaves = octaves
        self.params = layer("first", 6 * octaves, hidden) + layer("second", hidden, hidden) + layer("last", hidden, 4)

    def outputs(self, positions, params):
        scaled = [positions * float(2**k) for k in range(self.octaves)]
        x = px.concat([f for s in scaled for f in (s.sin(), s.cos())], axis=1)
        for layer in ("first", "second"):
            x = (x @ params[f"{layer}.weight"] + params[f"{layer}.bias"]).relu()
        return x @ params["last.weight"] + params["last.bias"]

    def density(self, positions, params):
        return self.outputs(positions, params)[:, 0].softplus()

    def radiance(self, positions, directions, params):
        outputs = self.outputs(positions, params)
        return outputs[:, 0].softplus(), outputs[:, 1:].sigmoid()


def values(field):
    return {param.name: param.value.copy() for param in field.params}


def test_a_field_learns_a_scene(scene):
    empty = px.train_field(scene, Network(), **{**SMALL, "steps": 1})
    trained = px.train_field(scene, Network(), **{**SMALL, "steps": 300, "rays_per_step": 256})
    assert trained.psnr > empty.psnr + 3 and trained.psnr > 15
    assert trained.scores.psnr == pytest.approx(trained.evaluate().psnr, abs=1e-9)
    picture = trained.render(scene.cameras("test")[0])
    colors, alpha = np.split(scene.images("test")[0] / 255.0, [3], axis=-1)
    assert px.psnr(picture, colors * alpha + 1 - alpha) == pytest.approx(trained.scores.per_view[0]["psnr"], abs=1e-3)
    assert np.isfinite(picture.rgb).all() and picture.opacity.max() <= 1


def test_the_parameters_are_updated_and_resumed_to_the_same_bits(scene, tmp_path):
    whole = Ball()
    before = values(whole)
    px.train_field(scene, whole, **SMALL, test_views=0)
    assert all((before[name] != value).any() for name, value in values(whole).items())

    heard = threading.Event()

    def stop(event):
        if event["kind"] == "step" and event["step"] == 7:
            heard.set()
            raise InterruptedError

    class Waiting(Ball):
        calls = 0

        def radiance(self, positions, directions, params):
            self.calls += 1
            # Steps are faster than exceptions of a callback.
            if self.calls == 12:
                heard.wait()
                time.sleep(0.5)
            return super().radiance(positions, directions, params)

    file = tmp_path / "field.safetensors"
    waiting = Waiting()
    with pytest.raises(InterruptedError):
        px.train_field(scene, waiting, **SMALL, out=file, callback=stop)
    assert 8 <= waiting.calls <= 12
    cut = Ball()
    assert px.train_field(scene, cut, **SMALL, out=file, resume=True, test_views=0).steps == SMALL["steps"]
    again = Ball()
    px.train_field(scene, again, **SMALL, out=file, resume=True, test_views=0, threads=1)
    for name, value in values(whole).items():
        assert np.array_equal(values(cut)[name], value) and np.array_equal(values(again)[name], value)


def test_a_loss_of_ones_own_trains_a_field(scene):
    seen = []

    def loss(step):
        seen.append(len(step))
        return step.mean((step.rgb - step.target).square() * step.param("scale").exp())

    scale = px.Param("scale", 0.0, rate=0.1)
    px.train_field(scene, Ball(), **SMALL, loss=loss, params=[scale], test_views=0)
    assert seen == [64] * 20 and scale.value < 0


def test_gradients_of_a_field_are_those_of_finite_differences():
    field = Network(hidden=4, octaves=1)
    positions = px.Tensor(np.random.default_rng(1).normal(size=(5, 3)))
    names = [param.name for param in field.params]

    def total(*weights):
        sigma, rgb = field.radiance(positions, positions, dict(zip(names, weights)))
        return (sigma.unsqueeze(1) * rgb).sum()

    # Biases of 0 leave neurons at the kink of the ReLU.
    px.gradcheck(total, [param.value.astype(np.float64) + 0.3 * (param.value.ndim == 1) for param in field.params])


def returning(density=None, radiance=None):
    class Wrong(Ball):
        pass

    if density is not None:
        Wrong.density = lambda self, positions, params: density(positions)
    if radiance is not None:
        Wrong.radiance = lambda self, positions, directions, params: radiance(positions)
    return Wrong()


def named(name):
    field = Ball()
    field.params.append(px.Param(name, 0.0))
    return field


def colors(x):
    return x * 0.0


WRONG = {
    "no density": (lambda: returning(density=lambda x: None), px.DtypeError, "field.density: the function returned a NoneType"),
    "a density with an axis too many": (lambda: returning(density=lambda x: x), px.ArrayError, "expected [512]"),
    "a negative density": (lambda: returning(density=lambda x: x[:, 0] * 0 - 1), px.ArrayError, "field.density: a density is -1; expected 0 or more"),
    "a density of NaN": (lambda: returning(density=lambda x: x[:, 0] / 0.0 * 0.0), px.ArrayError, "field.density: a density is NaN"),
    "only a density": (lambda: returning(radiance=lambda x: x[:, 0] * 0), px.ArrayError, "field.radiance: the number of returned tensors is 1"),
    "an array": (lambda: returning(radiance=lambda x: (np.zeros(3), 1)), px.DtypeError, "field.radiance: the function returned a tuple"),
    "float64": (lambda: returning(radiance=lambda x: (x[:, 0].to("float64"), colors(x))), px.DtypeError, "is float64; expected float32"),
    "NaN": (lambda: returning(radiance=lambda x: (x[:, 0] * 0, colors(x) / 0.0)), px.NumericError, "the loss is NaN"),
    "an exception": (lambda: returning(radiance=lambda x: {}["key"]), KeyError, "key"),
    "no parameters": (lambda: type("Bare", (), {})(), px.SettingsError, "field.params: invalid value []"),
    "a name of the file": (lambda: named("occupancy.estimates"), px.SettingsError, "a parameter `occupancy.estimates`"),
    "a name of a loss": (lambda: named("loss.scale"), px.SettingsError, "a parameter `loss.scale`"),
    "a name of an optimizer": (lambda: named("x.optimizer.0"), px.SettingsError, "a parameter `x.optimizer.0`"),
    "two parameters of one name": (lambda: named("radius"), px.SettingsError, "two parameters `radius`"),
    "no functions": (lambda: type("Bare", (), {"params": Ball().params})(), AttributeError, "density"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_field_is_an_exception_in_the_first_step(scene, name):
    make, error, message = WRONG[name]
    steps = []
    with pytest.raises(error) as raised:
        px.train_field(scene, make(), **SMALL, callback=lambda event: steps.append(event["kind"]))
    assert message in str(raised.value) and "step" not in steps


ARGUMENTS = {
    "no steps": ({"steps": 0}, px.SettingsError, "steps: invalid value 0; expected 1 to"),
    "no rays": ({"rays_per_step": 0}, px.SettingsError, "rays_per_step: invalid value 0"),
    "too many samples": ({"samples": 5000}, px.SettingsError, "samples: invalid value 5000; expected 1 to 4096"),
    "too many cells": ({"cells": 1000}, px.SettingsError, "cells: invalid value 1000; expected 0 to 256"),
    "a box without volume": ({"half_width": 0.0}, px.SettingsError, "half_width: invalid value 0"),
    "a background out of range": ({"background": (2, 0, 0)}, px.SettingsError, "background: invalid value"),
    "a folder that does not exist": ({"out": "nowhere/field.safetensors"}, px.SettingsError, "expected a file in a folder that exists"),
    "a file that exists": ({"out": __file__}, px.SettingsError, "expected a file that does not exist, or resume=True or force=True"),
    "too many threads": ({"threads": 100000}, px.SettingsError, "threads: invalid value 100000"),
    "resume without a file": ({"resume": True}, px.SettingsError, "resume: invalid value True; expected out"),
    "a text for steps": ({"steps": "many"}, TypeError, "steps"),
    "negative steps": ({"steps": -1}, px.SettingsError, "steps: invalid value -1"),
}


@pytest.mark.parametrize("name", ARGUMENTS)
def test_a_wrong_argument_is_an_exception(scene, name):
    arguments, error, message = ARGUMENTS[name]
    with pytest.raises(error) as raised:
        px.train_field(scene, Ball(), **{**SMALL, **arguments})
    assert message in str(raised.value)


def test_a_field_of_the_same_low_density_everywhere_is_sampled(scene):
    class Fog(Ball):
        def density(self, positions, params):
            return params["density"].softplus() * 0.01 + positions[:, 0] * 0.0

    fog = Fog()
    fog.params[0] = px.Param("radius", 1.2, rate=0.0)
    before = values(fog)
    px.train_field(scene, fog, **SMALL, test_views=0)
    after = values(fog)
    assert after["density"] != before["density"] and (after["color"] != before["color"]).all()
    assert after["radius"] == before["radius"]


def test_an_exception_ends_the_evaluation(scene):
    class Failing(Ball):
        pictures = 0

        def radiance(self, positions, directions, params):
            # A training step has 64 rays of at most 42 samples, a picture has 576 rays.
            if len(positions) > 64 * 42:
                Failing.pictures += 1
                raise LookupError("in a picture")
            return super().radiance(positions, directions, params)

    with pytest.raises(LookupError, match="in a picture"):
        px.train_field(scene, Failing(), **SMALL)
    assert Failing.pictures == 1


def test_a_file_of_another_field_is_refused(scene, tmp_path):
    file = tmp_path / "field.safetensors"
    px.train_field(scene, Ball(), **SMALL, out=file, test_views=0)
    with pytest.raises(px.InputError, match="field.safetensors"):
        px.train_field(scene, Network(), **SMALL, out=file, resume=True)
    faster = Ball()
    faster.params[0] = px.Param("radius", 1.2, rate=0.03)
    for field, settings in ((Ball(), {**SMALL, "steps": 30}), (faster, SMALL)):
        with pytest.raises(px.InputError, match="other settings"):
            px.train_field(scene, field, **settings, out=file, resume=True)
    file.write_bytes(b"not a file of tensors")
    with pytest.raises(px.InputError, match="field.safetensors"):
        px.train_field(scene, Ball(), **SMALL, out=file, resume=True)
