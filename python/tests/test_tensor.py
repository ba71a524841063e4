"""Tensors and their gradients."""

import numpy as np
import pytest

import plenoxel as px

RANDOM = np.random.default_rng(1)


def values(*shape, low=0.3, high=2.0):
    return RANDOM.uniform(low, high, shape)


#: Functions of one or two tensors, with the shapes of their inputs. Inputs are positive.
OPS = {
    "add": (lambda x, y: 2 + x + y, (3, 2), (2,)),
    "subtract": (lambda x, y: 1 - (x - y), (3, 2), (3, 1)),
    "multiply": (lambda x, y: x * y * 3, (3, 2), (2,)),
    "divide": (lambda x, y: 1 / x + x / y, (2, 3), (2, 1)),
    "power": (lambda x, y: x**y + x**3 + x**0.5 + 2.0**x, (4,), (4,)),
    "matmul": (lambda x, y: x @ y, (2, 3), (3, 4)),
    "array": (lambda x: np.array([1.0, 2.0]) * x - np.ones((3, 1)), (3, 2)),
    "exp": (lambda x: x.exp() + x.expm1() + x.log() + x.sqrt(), (5,)),
    "squares": (lambda x: x.square() + abs(-x) + (-x).abs(), (5,)),
    "sigmoid": (lambda x: x.sigmoid() + x.softplus() + x.tanh() + x.relu() + x.leaky_relu(0.1), (5,)),
    "sin": (lambda x: x.sin() + x.cos() + x.clamp(0.0, 9.0) * x, (5,)),
    "sum": (lambda x: x.sum() * x.sum(axis=0) + x.sum(axis=(0, 1), keepdims=True), (2, 3)),
    "mean": (lambda x: x.mean() * x.mean(axis=-1, keepdims=True) * x, (2, 3)),
    "max": (lambda x: x.max() * x.min(axis=0) * x.max(axis=1, keepdims=True), (2, 3)),
    "softmax": (lambda x: x.softmax(1) * x.logsumexp(0) * x, (2, 3)),
    "norm": (lambda x: x.norm(1, ).unsqueeze(1) * x.normalize(0), (2, 3)),
    "shape": (lambda x: x.reshape(3, -1).T.permute((1, 0)) * x.reshape((3, 2)), (2, 3)),
    "index": (lambda x: x[0, 1:] * x[..., -1] + x[[1, 0, 1]][2, :2] * x[None, 1, :2][0], (2, 3)),
    "cumsum": (lambda x: x.cumsum(0) * x.broadcast_to((2, 2, 3)), (2, 3)),
    "join": (lambda x, y: px.concat([x, y * y], axis=1).sum(axis=1) * px.stack([x, x], axis=0).sum(), (2, 3), (2, 1)),
    "select": (lambda x, y: px.maximum(x, y) * px.minimum(x, 1.0) * px.where(x > y, x * x, y), (4,), (4,)),
}


@pytest.mark.parametrize("name", OPS)
def test_first_and_second_derivatives_equal_finite_differences(name):
    f, *shapes = OPS[name]
    assert px.gradcheck(f, [values(*shape) for shape in shapes]) < 1e-7


def test_operators_agree_with_numpy():
    x, y = values(4, 3), values(3)
    a, b = px.Tensor(x), px.Tensor(y)
    for found, expected in [
        (a + b, x + y),
        (y - a, y - x),
        (x * b, x * y),
        (a / 2, x / 2),
        (2 / a, 2 / x),
        (a**2, x**2),
        (a @ b[:, None], x @ y[:, None]),
        (a > 1, x > 1),
        (a <= b, x <= y),
        (a.max(axis=0), x.max(axis=0)),
        (a[1:3, ..., None], x[1:3, ..., None]),
        (a[np.array([-1, 0])], x[[-1, 0]]),
        (a.T, x.T),
        (px.where(x > 1, a, 0.0), np.where(x > 1, x, 0)),
    ]:
        np.testing.assert_allclose(np.asarray(found), expected, rtol=1e-12)
        assert found.dtype == "float64"
    assert (px.Tensor([1, 2]) + 0.5).dtype == "float32" and len(a) == 4 and a.shape == (4, 3) and a.size == 12


def test_values_are_shown_without_a_copy():
    x = px.Tensor(np.arange(6, dtype=np.float32).reshape(2, 3))
    array = x.numpy()
    assert not array.flags.writeable and array.base is x
    del x
    assert array.sum() == 15


def test_gradients_of_gradients():
    x = px.Tensor(np.array([1.0, 2.0]), requires_grad=True)
    slope = px.grad((x**3).sum(), x, create_graph=True)
    np.testing.assert_allclose(px.grad(slope.sum(), x).numpy(), [6, 12])
    y = px.Tensor(np.array(2.0), requires_grad=True)
    both = px.grad((x * y).sum(), [x, y])
    assert both[1].item() == 3 and not both[0].requires_grad
    assert px.grad((x * x.detach()).sum(), x).numpy().tolist() == [1, 2]


def test_a_wrong_derivative_is_found():
    with pytest.raises(px.GradcheckError, match="wrong derivative of order 1"):
        px.gradcheck(lambda x: x * x.detach(), [values(3)])
    with pytest.raises(px.GradcheckError, match="order 2"):
        px.gradcheck(lambda x: x.detach() ** 2 + 2 * x.detach() * (x - x.detach()), [values(3)])
    with pytest.raises(ZeroDivisionError):
        px.gradcheck(lambda x: x * (1 / 0), [values(3)])


def test_values_of_another_program_are_differentiated_once():
    x = px.Tensor(np.array([1.0, 2.0]), requires_grad=True)
    y = px._plenoxel.external(5.0, [x], [np.array([3.0, 4.0])])
    assert px.grad(2 * y, x).numpy().tolist() == [6, 8]
    with pytest.raises(px.StateError, match="no second derivative"):
        px.grad(y, x, create_graph=True)
