"""Steps of the network on a CPU as compiled loops that torch can go back through, in training and registration."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gapr_core.model import geometry_kernels, norm_kernels, transport_kernels
from gapr_core.model.pgf import EMBEDDED
from gapr_core.model.types import Level, Neighborhood


def can_take(*tensors: Tensor) -> bool:
    """Whether the loops can take these tensors: float32 on a CPU, not under autocast or export."""
    plain = all(t.device.type == "cpu" and t.dtype == torch.float32 for t in tensors)
    free = not torch.is_autocast_enabled("cpu") and not torch.compiler.is_compiling()
    return plain and free


def norm(x: Tensor, lengths: tuple[int, ...], groups: int, weight: Tensor, bias: Tensor, slope: float) -> Tensor:
    """Leaky ReLU (`slope`, 1: none) of the norm of x (N, C) over each cloud's points and each group's channels."""
    return _Norm.apply(x, lengths, groups, weight, bias, slope)  # type: ignore[no-any-return]


def embed(p_i: Tensor, p_j: Tensor, c_h: Tensor, c_k: Tensor, radius: Tensor) -> Tensor:
    """(B, n, m, 11) point-wise features of `Pairs` with these attributes; no gradient."""
    batch, n = p_i.shape[:2]
    i, h, k = (x.expand(batch, n, 1, 3).reshape(batch * n, 3) for x in (p_i, c_h, c_k))
    own, out = radius.expand(batch, n, 1).reshape(batch * n), p_i.new_empty(batch, n, p_j.shape[2], EMBEDDED)
    geometry_kernels.embed(*_arrays(i, p_j[:, 0].contiguous(), h, k, own, out.flatten(0, 1)))
    return out


def surface_influences(here: Level, there: Level, hood: Neighborhood, kernel: Tensor, sigma: float) -> Tensor:
    """(N, P, K) influence of the kernel points (P, 3) on neighbours in the frame of the surface; no gradient."""
    out = kernel.new_empty(len(here.points), len(kernel), hood.index.shape[1])
    own, other = (here.points, here.normals, here.certainty), (there.points, there.normals)
    given = _arrays(*(x.contiguous() for x in (*own, *other, hood.index, hood.valid, hood.radius)), kernel)
    geometry_kernels.surface_influences(*given, np.float32(sigma), out.numpy())
    return out


def transport(scores: Tensor, dustbin: Tensor, rows: Tensor, columns: Tensor, rounds: int) -> Tensor:
    """(P, a, b) log assignment of scores (P, a - 1, b - 1); which of the `rows` (P, a), `columns` (P, b) exist."""
    return _Transport.apply(scores, dustbin, rows, columns, rounds)  # type: ignore[no-any-return]


class _Norm(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, lengths: Any, groups: int, weight: Tensor, bias: Tensor, slope: float) -> Tensor:
        x = x.contiguous()
        starts, slope = np.cumsum([0, *lengths]), np.float32(slope)
        y, mean = torch.empty_like(x), x.new_empty(len(lengths), x.shape[1])
        rate = torch.empty_like(mean)
        given = _arrays(weight, bias)
        norm_kernels.norm(*_arrays(x), starts, groups, *given, slope, np.float32(1e-5), *_arrays(y, mean, rate))
        ctx.save_for_backward(x, y, weight, mean, rate)
        ctx.rest = starts, groups, slope
        return y

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor | None, ...]:
        (x, y, weight, mean, rate), (starts, groups, slope) = ctx.saved_tensors, ctx.rest
        g_x, g_weight, g_bias = torch.empty_like(x), torch.zeros_like(weight), torch.zeros_like(weight)
        came, scaled = _arrays(g.contiguous(), x, y), _arrays(weight, mean, rate)
        norm_kernels.norm_back(*came, starts, groups, *scaled, slope, *_arrays(g_x, g_weight, g_bias))
        return g_x, None, None, g_weight, g_bias, None


class _Transport(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, scores: Tensor, dustbin: Tensor, rows: Tensor, columns: Tensor, rounds: int) -> Tensor:
        scores, rows, columns = scores.contiguous(), rows.float(), columns.float()
        (count, a), b = rows.shape, columns.shape[1]
        log_z, plan, shares = (scores.new_empty(count, *size) for size in ((a, b), (a, b), (b,)))
        left, right = scores.new_empty(count, rounds, a), scores.new_empty(count, rounds, b)
        given = _arrays(scores, rows, columns)
        made = _arrays(log_z, plan, shares, left, right)
        transport_kernels.transport(given[0], np.float32(dustbin.item()), *given[1:], rounds, *made)
        ctx.save_for_backward(rows, columns, plan, shares, left, right)
        ctx.rounds = rounds
        return log_z

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor | None, ...]:
        rows, columns, *kept = ctx.saved_tensors
        g_scores = g.new_empty(len(g), g.shape[1] - 1, g.shape[2] - 1)
        came = _arrays(g.contiguous(), rows, columns)
        g_dustbin = transport_kernels.transport_back(*came, ctx.rounds, *_arrays(*kept, g_scores))
        return g_scores, g.new_tensor(g_dustbin), None, None, None


def _arrays(*tensors: Tensor) -> list[Any]:
    return [tensor.detach().numpy() for tensor in tensors]
