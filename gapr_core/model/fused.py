"""PGA on a CPU: one compiled loop instead of a tensor of every pair's keys, values and hidden layer."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from gapr_core.model import attention_kernels
from gapr_core.model.pairs import Pairs

Arrays = list[NDArray[Any]]


def fits(pairs: Pairs, *tensors: Tensor) -> bool:
    """Tell whether the loops take these tensors and pairs: float32 on a CPU, not autocast."""
    plain = all(t.device.type == "cpu" and t.dtype == torch.float32 for t in (*tensors, pairs.p_i))
    return plain and not torch.is_autocast_enabled("cpu")


def attend(
    q: Tensor, k: Tensor, v: Tensor, folded: Tensor, first: Tensor, bias: Tensor, pairs: Pairs, scale: float
) -> tuple[Tensor, Tensor]:
    """Softmax over the neighbours of (q k + folded hidden) scale, hidden = ReLU(pgf first + bias); two sums under it.

    Args:
        q: (N, H, D) queries. k, v: (M, H, D) keys and values.
        folded: (N, H, E), factors of the hidden layer in the logits. first, bias: (G, E), (E,) of the hidden layer.

    Returns:
        (N, H, D) sums of values, (N, H, E) sums of hidden layers.
    """
    index, valid = pairs.table()
    geometry = pairs.pgf.flatten(0, 1)
    return _Attend.apply(q, k, v, folded, first, bias, index, valid, geometry, scale)  # type: ignore[no-any-return]


class _Attend(torch.autograd.Function):
    """The loops as a step that torch can go back through, for q, k, v, folded, first and bias."""

    @staticmethod
    def forward(ctx: Any, *given: Any) -> tuple[Tensor, Tensor]:
        *tensors, scale = given
        q, _, _, folded, *_, valid, _ = tensors = [tensor.contiguous() for tensor in tensors]
        out, mixed = torch.zeros_like(q), torch.zeros_like(folded)
        weights = q.new_zeros(len(q), q.shape[1], valid.shape[1])
        ctx.scale = scale = np.float32(scale)  # a float would make all of it float64
        ctx.save_for_backward(*tensors, weights)
        attention_kernels.forward(*_arrays(tensors), scale, *_arrays([out, mixed, weights]))
        return out, mixed

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *g: Tensor) -> tuple[Tensor | None, ...]:
        *tensors, weights = ctx.saved_tensors
        made = [torch.zeros_like(tensor) for tensor in tensors[:6]]
        came = _arrays([weights, *(one.contiguous() for one in g)])
        attention_kernels.backward(*_arrays(tensors), ctx.scale, *came, *_arrays(made))
        return (*made, None, None, None, None)


def _arrays(tensors: list[Tensor]) -> Arrays:
    return [tensor.detach().numpy() for tensor in tensors]
