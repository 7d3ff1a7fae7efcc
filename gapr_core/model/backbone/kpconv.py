"""Kernel point convolution (Thomas et al., ICCV 2019) in plain PyTorch.

(F * g)(p_i) = 1/|N_i| sum_j sum_k max(0, 1 - |y_ij - x_k| / sigma) f_j W_k, with y_ij the neighbour's place seen from
p_i. The influences do not depend on features: they are made once per set of pairs, then one batched product weighs the
neighbours for all kernel points and one matrix product applies all W_k.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from gapr_core.model.config import ModelConfig, choose
from gapr_core.model.layers import SLOPE, Unary, activated, make_norm
from gapr_core.model.pairs import LocalPairs
from gapr_core.model.vectors import dot, minus, parts

KERNEL_POINTS = 15


def kernel_layout() -> Tensor:
    """(15, 3) kernel points in units of the radius: the centre, 6 axes and 8 corners at two thirds of the radius."""
    axes = torch.cat([torch.eye(3), -torch.eye(3)])
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3) / 3**0.5
    return torch.cat([torch.zeros(1, 3), axes, corners]) * 0.66


def world_places(pairs: LocalPairs) -> Tensor:
    """Offsets along the axes of the frame the cloud came in (the paper's KPConv): turns with the cloud."""
    return pairs.offset[:, 0] / pairs.reach


def surface_places(pairs: LocalPairs) -> Tensor:
    """Compute rotation-invariant places: height over the tangent plane, distance along it, bending.

    Height is signed where the normal's side is certain, and fades to zero elsewhere. Bending joins the unsigned height
    and the angle between the normals, which need no side.
    """
    p_i, p_j, n_i, n_j = (parts(v[:, 0]) for v in (pairs.p_i, pairs.p_j, pairs.n_i, pairs.n_j))
    offset = [x / pairs.reach[:, 0] for x in minus(p_j, p_i)]
    height = dot(offset, n_i)
    along = torch.sqrt((dot(offset, offset) - height * height).clamp(min=1e-12))
    bending = 2.0 * height.abs() + 1.0 - dot(n_i, n_j).abs()
    signed = 2.0 * height * pairs.centres.certainty[:, None]
    return torch.stack([signed, 2.0 * along - 1.0, bending - 0.5]).movedim(0, -1)


KERNEL_FRAMES: dict[str, Callable[[LocalPairs], Tensor]] = {"world": world_places, "surface": surface_places}


def influences(places: Tensor, valid: Tensor, kernel: Tensor, sigma: float) -> Tensor:
    """(N, 15, K) linear influence of each kernel point on each neighbour's place (N, K, 3); 0 on missing neighbours."""
    y = places.flatten(0, 1).T  # (3, N K)
    far = (y * y).sum(0).masked_fill(~valid.flatten(), float("inf"))
    squared = torch.addmm(far, kernel, y, alpha=-2.0).add_((kernel * kernel).sum(1, keepdim=True))  # |y - x_k|^2
    reach = squared.clamp_(min=1e-12).sqrt_().mul_(-1.0 / sigma).add_(1.0).clamp_(min=0.0)
    return reach.view(-1, *valid.shape).movedim(0, 1)


class KPConv(nn.Module):
    """The convolution alone, (M, C_in) at the support to (N, C_out) at the centres."""

    kernel: Tensor

    def __init__(self, width_in: int, width: int, config: ModelConfig) -> None:
        super().__init__()
        self.sigma = config.sigma_voxels / config.radius_voxels
        self.places = choose("kernel_frame", KERNEL_FRAMES, config.kernel_frame)
        self.weight = nn.Parameter(torch.empty(KERNEL_POINTS * width_in, width))
        nn.init.kaiming_uniform_(self.weight, a=math.sqrt(5.0))
        self.register_buffer("kernel", kernel_layout(), persistent=False)

    def forward(self, x: Tensor, pairs: LocalPairs) -> Tensor:
        with torch.no_grad(), torch.autocast(x.device.type, enabled=False):
            influence = influences(self.places(pairs), pairs.hood.valid, self.kernel, self.sigma)
        weighed = influence.to(x.dtype) @ pairs.keys(x)  # (M, 15, C_in)
        return weighed.flatten(1) @ self.weight / pairs.hood.valid.sum(1, keepdim=True)


class KPConvBlock(nn.Module):
    """Bottleneck residual block around a KPConv (KPConv-FPN), (M, C_in) at the support to (N, C_out) at the centres."""

    def __init__(self, width_in: int, width: int, config: ModelConfig) -> None:
        super().__init__()
        middle = width // 2
        self.enter = Unary(width_in, middle, config.norm)
        self.convolution = KPConv(middle, middle, config)
        self.norm = make_norm(config.norm, middle)
        self.leave = Unary(middle, width, config.norm, plain=True)
        self.skip = Unary(width_in, width, config.norm, plain=True)

    def forward(self, x: Tensor, pairs: LocalPairs) -> Tensor:
        here, there = pairs.centres.lengths, pairs.support.lengths
        y = self.convolution(self.enter(x, there), pairs)
        y = self.leave(self.norm(y, here, SLOPE), here)
        return activated(y + self.skip(pairs.at_centres(x), here), SLOPE)
