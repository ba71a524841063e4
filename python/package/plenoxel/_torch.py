"""Losses in PyTorch. This file imports torch when such a loss is made, and never before."""

from __future__ import annotations

from typing import Any, Callable, Sequence

import numpy as np

from . import _plenoxel
from ._errors import ArrayError, DtypeError
from ._plenoxel import Step, Tensor

#: Columns of a step through which gradients flow.
COLUMNS = ("rgb", "opacity", "log_transmittance", "depth", "sparsity", "distortion", "coarse", "prediction")


def torch_loss(function: Callable[..., Any], columns: Sequence[str] = ("rgb",)) -> Callable[[Step], Tensor]:
    """Return a loss that PyTorch differentiates.

    ``function(*columns, step)`` is called with a torch tensor for each column, which needs a gradient and shares the memory of the rendered column, and with the
    `Step`, whose constants become tensors with ``torch.tensor(step.target)``. It returns a scalar torch tensor. The gradient that torch computes goes back to the
    field. Networks may be used; parameters of torch that need gradients accumulate them in ``.grad``, for an optimizer of torch to use.

    Args:
        function: The loss, of tensors on the CPU. Columns must not be changed in place.
        columns: Names of the columns: rgb, opacity, log_transmittance, depth, sparsity, distortion, coarse or prediction.

    Raises:
        ImportError: torch is not installed.
    """
    import torch

    unknown = [name for name in columns if name not in COLUMNS]
    if unknown or not columns:
        raise ArrayError(f"torch_loss: unknown columns {unknown}; expected some of {', '.join(COLUMNS)}")

    def loss(step: Step) -> Tensor:
        rendered = [getattr(step, name) for name in columns]
        inputs = [_shared(torch, column).requires_grad_() for column in rendered]
        with torch.enable_grad():
            value = function(*inputs, step)
            if not isinstance(value, torch.Tensor):
                raise DtypeError(f"torch_loss: the function returned a {type(value).__name__}; return a torch.Tensor of one element")
            if value.numel() != 1:
                raise ArrayError(f"torch_loss: the loss has the shape {list(value.shape)}; expected one element; take its mean or sum")
            if not value.requires_grad:
                raise ArrayError("torch_loss: the loss does not depend on a column; compute it from the columns, without detach")
            value.backward()
        gradients = [np.zeros(x.shape, np.float32) if x.grad is None else x.grad.numpy() for x in inputs]
        return _plenoxel.external(value.item(), rendered, gradients)

    loss.__name__ = getattr(function, "__name__", "torch_loss")
    return loss


def _shared(torch: Any, column: Tensor) -> Any:
    """Return a column as a tensor of torch, without a copy."""
    values = column.numpy()
    # torch warns of memory that must not be written. A leaf that needs a gradient refuses changes in place.
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return torch.from_numpy(values)
