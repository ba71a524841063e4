"""What a user may do wrong: the exception and its message."""

import subprocess
import sys

import numpy as np
import pytest

import plenoxel as px

NAN = float("nan")


def changed(**changes):
    """Calls `px.dataset` with changed arguments; a change is a function of the argument."""

    def call(arrays):
        arguments = dict(arrays)
        for name, change in changes.items():
            arguments[name] = change(arguments[name].copy()) if name in arrays and callable(change) else change
        return px.dataset(**arguments)

    return call


def put(place, value):
    def change(array):
        array = array.astype(np.float64) if isinstance(value, float) and array.dtype != np.uint8 else array
        array[place] = value
        return array

    return change


DATASETS = {
    "channels first": (changed(images=lambda x: np.moveaxis(x, 3, 1)), px.ArrayError, "the channels must be the last axis"),
    "gray": (changed(images=lambda x: x[..., 0]), px.ArrayError, "images[0]: the image has the shape [24, 24]"),
    "floats to 255": (changed(images=lambda x: x.astype(np.float32)), px.ArrayError, "expected floats in [0, 1], or uint8"),
    "NaN in an image": (changed(images=lambda x: np.where(x == x[0, 0, 0, 0], NAN, 0.5)), px.ArrayError, "is NaN"),
    "int64 images": (changed(images=lambda x: x.astype(np.int64)), px.DtypeError, "dtype int64; expected uint8, or floats in [0, 1]"),
    "complex images": (changed(images=lambda x: x.astype(np.complex64)), px.DtypeError, "dtype complex64"),
    "a text for images": (changed(images="photos"), px.DtypeError, "images: this is a <class 'str'>; expected an array"),
    "no images": (changed(images=lambda x: x[:0]), px.ArrayError, "images: there is no entry"),
    "None for images": (changed(images=None), px.DtypeError, "images: this is a <class 'NoneType'>"),
    "too few poses": (changed(camera_to_world=lambda x: x[:3]), px.ArrayError, "camera_to_world: there are 3 for 12 images"),
    "one pose": (changed(camera_to_world=lambda x: x[0]), px.ArrayError, "camera_to_world: the array has the shape [4, 4]; expected [n, 4, 4]"),
    "quaternions": (changed(camera_to_world=lambda x: x[:, 0]), px.ArrayError, "expected [n, 4, 4] or [n, 3, 4]"),
    "NaN in a pose": (changed(camera_to_world=put((2, 0, 3), NAN)), px.ArrayError, "camera_to_world: the number at [2, 0, 3] is NaN"),
    "scaled axes": (changed(camera_to_world=lambda x: x * [2, 2, 2, 1]), px.ArrayError, "is not a rotation"),
    "left-handed axes": (changed(camera_to_world=lambda x: x * [1, 1, -1, 1]), px.ArrayError, "is a reflection: its determinant is -1"),
    "a projection": (changed(camera_to_world=put((0, 3, 2), 1.0)), px.ArrayError, "camera_to_world[0]: the matrix has the last row"),
    "texts for poses": (changed(camera_to_world=[["a"]]), px.DtypeError, "camera_to_world: the array has the dtype <U1"),
    "ragged poses": (changed(camera_to_world=[[1.0], [1.0, 2.0]]), px.Error, "camera_to_world"),
    "K of another shape": (changed(intrinsics=np.eye(4)), px.ArrayError, "intrinsics: the array has the shape [4, 4]; expected K [3, 3]"),
    "normalized K": (changed(intrinsics=[0.3, 0.3, 0.5, 0.5]), px.ArrayError, "in pixels, not relative to the size"),
    "a negative focal length": (changed(intrinsics=[-30, 30, 12, 12]), px.ArrayError, "the focal lengths are -30 and 30"),
    "skew": (changed(intrinsics=[[30, 2, 12], [0, 30, 12], [0, 0, 1]]), px.ArrayError, "K has the skew 2"),
    "a transposed K": (changed(intrinsics=lambda x: x.transpose(0, 2, 1)), px.ArrayError, "this is not a camera matrix"),
    "a mask of another size": (changed(masks=np.ones((12, 4, 4))), px.ArrayError, "masks[0]: the mask has the shape [4, 4]"),
    "an empty mask": (changed(masks=np.zeros((12, 24, 24), bool)), px.SettingsError, "ignores every pixel"),
    "too few masks": (changed(masks=np.ones((2, 24, 24))), px.ArrayError, "masks: there are 2 for 12 images"),
    "names twice": (changed(names=["a"] * 12), px.SettingsError, "two views have the name a"),
    "an unknown split": (changed(splits=["training"] * 12), px.SettingsError, 'split: invalid value "training"; expected train, val, test'),
    "no training view": (changed(splits=["test"] * 12), px.SettingsError, "there is no training view"),
    "unknown axes": (changed(axes="blender"), px.SettingsError, 'axes: invalid value "blender"; expected "opengl"'),
}


@pytest.mark.parametrize("name", DATASETS)
def test_a_wrong_array_is_named(arrays, name):
    call, error, message = DATASETS[name]
    with pytest.raises(error) as raised:
        call(arrays)
    assert message in str(raised.value), str(raised.value)


def test_cameras_that_look_away_are_warned_of(arrays):
    with pytest.warns(UserWarning, match='give axes="opencv"'):
        changed(camera_to_world=lambda x: x * [1, -1, -1, 1])(arrays)


TRAININGS = {
    "an unknown key": ({"resolution": 3}, px.SettingsError, "resolution: unknown key `resolution`; similar keys elsewhere: stages[*].resolution"),
    "a misspelled key": ({"rays_per_stp": 3}, px.SettingsError, "did you mean `rays_per_step`?"),
    "a misspelled table": ({"losses": {"msee": 1}}, px.SettingsError, "losses.msee"),
    "a value of the wrong type": ({"rays_per_step": "many"}, px.SettingsError, "rays_per_step"),
    "a value out of range": ({"sh_degree": 9}, px.SettingsError, "sh_degree"),
    "a huge number": ({"seed": 2**80}, px.SettingsError, "seed: invalid value"),
    "an object": ({"seed": object()}, px.DtypeError, "seed: this is a object; expected a number"),
    "an unknown preset": ({"preset": "fastest"}, px.SettingsError, "fastest"),
    "an unknown duration": ({"time": "soon"}, px.SettingsError, "time: invalid value soon; expected a duration above 0"),
    "no time": ({"time": 0}, px.SettingsError, "time: invalid value 0"),
    "no threads": ({"threads": 0}, px.SettingsError, "threads: invalid value 0; expected 1 to"),
    "no losses": ({"losses": {"mse": None, "tv_color_sampled": None}}, px.SettingsError, "losses: there is no loss"),
    "a missing file of settings": ({"config": "nowhere.toml"}, px.Error, "nowhere.toml"),
    "a number as a loss": ({"loss": 3}, px.DtypeError, "this is a int; expected a function of the step"),
    "a text as a weight": ({"loss": ("1", lambda step: 0)}, px.DtypeError, "the weight is a str; expected a number"),
    "an infinite weight": ({"loss": (float("inf"), lambda step: 0)}, px.SettingsError, "expected a finite weight"),
    "a loss that returns a number": ({"loss": lambda step: 1.0}, px.DtypeError, "loss loss: the function returned a float; return a Tensor"),
    "a loss that returns nothing": ({"loss": lambda step: None}, px.DtypeError, "the function returned a NoneType"),
    "a loss that is no scalar": ({"loss": lambda step: step.rgb}, px.ArrayError, "expected one number; take its mean or sum"),
    "a loss of float64": ({"loss": lambda step: px.Tensor(np.array(1.0))}, px.DtypeError, "the loss is float64"),
    "a loss that is NaN": ({"loss": lambda step: (step.rgb - 9).log().mean()}, px.NumericError, "step 0: the loss is NaN"),
    "a loss that fails": ({"loss": lambda step: step.rgb / 0 + {}["a"]}, KeyError, "a"),
    "shapes that do not fit": ({"loss": lambda step: (step.rgb * step.alpha).sum()}, px.ArrayError, "do not broadcast"),
    "an unknown column": ({"loss": lambda step: step.color}, AttributeError, "color"),
    "an unknown parameter": ({"loss": lambda step: step.param("a")}, px.SettingsError, "param: invalid value `a`"),
    "two parameters of a name": ({"params": [px.Param("a", 1), px.Param("a", 2)]}, px.SettingsError, "two parameters `a`"),
    "a text as a parameter": ({"params": ["a"]}, TypeError, ""),
}


@pytest.mark.parametrize("name", TRAININGS)
def test_a_wrong_training_is_named_and_writes_no_model(scene, small, tmp_path, name):
    arguments, error, message = TRAININGS[name]
    with pytest.raises(error) as raised:
        px.train(scene, out=tmp_path / "run", **{**small, **arguments})
    assert message in str(raised.value), str(raised.value)
    assert not (tmp_path / "run" / "checkpoint.safetensors").exists()


CALLS = {
    "a folder that does not exist": (lambda run: px.open("nowhere"), px.InputError, "nowhere: there is no such folder"),
    "a run that does not exist": (lambda run: px.load("nowhere"), px.InputError, "this run folder does not exist"),
    "a run that has ended": (lambda run: px.resume(run, progress=False), px.InputError, "this run is finished"),
    "no better checkpoint": (lambda run: px.load(run.folder, best=True), px.InputError, "best.safetensors"),
    "no pixels": (lambda run: px.procedural(size=0), px.SettingsError, "width: invalid value 0"),
    "an unknown split": (lambda run: run.evaluate("tests"), px.SettingsError, 'split: invalid value "tests"'),
    "a wrong background": (lambda run: run.render(px.Camera.look_at((1, 2, 3)), background=(0, 0, 2)), px.SettingsError, "background"),
    "a text as a camera": (lambda run: run.render("front"), TypeError, "Camera"),
    "a camera at its target": (lambda run: px.Camera.look_at((0, 0, 0)), px.SettingsError, "the camera is at its target"),
    "a camera of NaN": (lambda run: px.Camera.look_at((0, NAN, 0)), px.ArrayError, "eye: the number at [1] is NaN"),
    "a camera of no size": (lambda run: px.Camera(np.eye(4), [9, 9, 2, 2], 0, 4), px.SettingsError, "width: invalid value 0"),
    "a negative size": (lambda run: px.Camera(np.eye(4), [9, 9, 2, 2], -1, 4), OverflowError, ""),
    "an opacity of 2": (lambda run: run.points(min_alpha=2), px.SettingsError, "min_alpha: invalid value 2; expected 0 to"),
    "colors of a word": (lambda run: run.points(color="red"), px.SettingsError, 'color: invalid value "red"'),
    "no neighbours": (lambda run: run.points(sor_sigma=1, sor_neighbours=0), px.SettingsError, "neighbours"),
    "a level of 0": (lambda run: run.mesh(level=0), px.SettingsError, "level: invalid value 0"),
    "a level above all": (lambda run: run.mesh(level=1e9), px.Error, "level"),
    "a file of another kind": (lambda run: run.mesh(level=1).save("mesh.xyz"), px.SettingsError, 'format: invalid value "xyz"'),
    "a folder that cannot be written": (lambda run: run.mesh(level=1).save("/proc/nowhere/mesh.ply"), OSError, "/proc/nowhere"),
    "a cloud of another kind": (lambda run: run.points(color="mean").save("cloud.xyz"), px.SettingsError, "does not end in .ply"),
    "a folder that is not empty": (lambda run: px.carve(px.procedural(size=8), out=run.folder), px.SettingsError, "out:"),
    "an unknown column for torch": (lambda run: px.torch_loss(print, columns=("color",)), px.ArrayError, "unknown columns ['color']"),
}


@pytest.mark.parametrize("name", CALLS)
def test_a_wrong_call_is_named(run, name):
    call, error, message = CALLS[name]
    if "torch" in name:
        pytest.importorskip("torch")
    with pytest.raises(error) as raised:
        call(run)
    assert message in str(raised.value), str(raised.value)


X = px.Tensor(np.ones((2, 3)), requires_grad=True)

TENSORS = {
    "shapes that do not broadcast": (lambda: X + px.Tensor(np.ones(2)), px.ArrayError, "+: the shapes [2, 3] and [2] do not broadcast"),
    "two precisions": (lambda: X * px.Tensor([1.0, 2.0, 3.0]), px.DtypeError, "tensors of float64 and float32"),
    "a text": (lambda: X - "a", px.DtypeError, "-: this is a str"),
    "None": (lambda: X / None, px.DtypeError, "/: this is a NoneType"),
    "a product that does not fit": (lambda: X @ X, px.ArrayError, "@: the shapes [2, 3] and [2, 3] do not fit"),
    "an axis": (lambda: X.sum(axis=2), px.ArrayError, "sum: axis 2 is out of range for the shape [2, 3]; there are 2 axes"),
    "an axis twice": (lambda: X.mean(axis=(0, -2)), px.ArrayError, "axis 0 is given twice"),
    "a reshape": (lambda: X.reshape(4, 2), px.ArrayError, "has 6 elements, which do not fill the shape [4, 2]"),
    "a reshape with two gaps": (lambda: X.reshape(-1, -1), px.ArrayError, "impossible"),
    "a reshape of text": (lambda: X.reshape("a"), px.DtypeError, "the shape has no integers"),
    "an index": (lambda: X[2], px.ArrayError, "index: 2 is out of range; axis 0 has 2 entries"),
    "too many indices": (lambda: X[0, 0, 0], px.ArrayError, "3 indices for a tensor of shape [2, 3]"),
    "a step": (lambda: X[::2], px.ArrayError, "only slices of step 1"),
    "a float index": (lambda: X[0.5], px.DtypeError, "expected integers"),
    "a boolean mask": (lambda: X[np.ones(2, bool)], px.DtypeError, "the index has the dtype bool"),
    "a row": (lambda: X[[0, 2]], px.ArrayError, "the index 2 is out of range; there are 2 rows"),
    "an order of axes": (lambda: X.permute((0, 0)), px.ArrayError, "is not an order of the axes"),
    "a vector transposed": (lambda: X[0].T, px.ArrayError, "expected two axes or more"),
    "a broadcast": (lambda: X.broadcast_to((3, 2)), px.ArrayError, "do not broadcast"),
    "a tensor larger than the memory": (lambda: X.reshape(2, 3, 1).broadcast_to((2, 3, 1 << 50)), px.SettingsError, "does not fit into the memory"),
    "bounds in the wrong order": (lambda: X.clamp(1, 0), px.SettingsError, "clamp: invalid value 1, 0; expected low <= high"),
    "an item of many": (lambda: X.item(), px.ArrayError, "item: the tensor has the shape [2, 3]"),
    "a truth of many": (lambda: bool(X > 0), px.ArrayError, "expected one element"),
    "the maximum of nothing": (lambda: X[:0].max(), px.ArrayError, "has no elements"),
    "a dtype": (lambda: X.to("float16"), px.SettingsError, 'dtype: invalid value "float16"'),
    "complex numbers": (lambda: px.Tensor(np.ones(2, complex)), px.DtypeError, "dtype complex128; expected real numbers"),
    "nothing to join": (lambda: px.concat([]), px.ArrayError, "there are no tensors"),
    "shapes to join": (lambda: px.stack([X, X[0]]), px.ArrayError, "do not fit"),
    "no tensor": (lambda: px.maximum(1, 2), px.DtypeError, "there is no Tensor"),
    "a gradient of many": (lambda: px.grad(X, X), px.ArrayError, "expected a scalar; take its sum or mean"),
    "a gradient of a constant": (lambda: px.grad(X.sum(), px.Tensor([1.0])), px.StateError, "tensor 0 of wrt is a constant"),
    "a gradient of a number": (lambda: px.grad(X.sum(), 3), px.DtypeError, "wrt is not a Tensor"),
    "a check that returns a number": (lambda: px.gradcheck(lambda x: 1.0, [np.ones(2)]), px.DtypeError, "the function returned a float"),
    "a parameter without a name": (lambda: px.Param("", 1), px.SettingsError, "name: invalid value"),
    "a parameter of NaN": (lambda: px.Param("a", NAN), px.ArrayError, "a: a value is not finite"),
    "a rate below 0": (lambda: px.Param("a", 1, rate=-1), px.SettingsError, "rate: invalid value -1"),
}


@pytest.mark.parametrize("name", TENSORS)
def test_a_wrong_op_is_named(name):
    call, error, message = TENSORS[name]
    with pytest.raises(error) as raised:
        call()
    assert message in str(raised.value), str(raised.value)
    assert isinstance(raised.value, px.Error)


TORCH = {
    "a number": (lambda rgb, step: 1.0, px.DtypeError, "the function returned a float"),
    "a constant": (lambda rgb, step: rgb.detach().mean(), px.ArrayError, "does not depend on a column"),
    "many numbers": (lambda rgb, step: rgb, px.ArrayError, "expected one element"),
    "a change in place": (lambda rgb, step: rgb.mul_(2).mean(), RuntimeError, "in-place"),
}


@pytest.mark.parametrize("name", TORCH)
def test_a_wrong_loss_in_torch_is_named(scene, small, tmp_path, name):
    pytest.importorskip("torch")
    loss, error, message = TORCH[name]
    with pytest.raises(error, match=message):
        px.train(scene, out=tmp_path / "run", **small, loss=px.torch_loss(loss))


def test_torch_is_not_imported_otherwise():
    code = "import sys, plenoxel; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_exceptions_are_those_of_python_too():
    for error, base in [
        (px.SettingsError, ValueError),
        (px.InputError, ValueError),
        (px.ArrayError, ValueError),
        (px.DtypeError, TypeError),
        (px.NumericError, ArithmeticError),
        (px.FileError, OSError),
        (px.StateError, RuntimeError),
        (px.GradcheckError, AssertionError),
    ]:
        assert issubclass(error, px.Error) and issubclass(error, base)
    assert issubclass(px.Interrupted, KeyboardInterrupt)
