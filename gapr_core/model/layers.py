"""Small layers that know about several clouds in one tensor."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from gapr_core.model.config import choose


class GroupNorm(nn.Module):
    """GroupNorm of (N, C) features with statistics over each cloud, so that a cloud's answer is its own."""

    def __init__(self, width: int, groups: int = 8) -> None:
        super().__init__()
        self.groups = min(groups, width)
        self.weight, self.bias = nn.Parameter(torch.ones(width)), nn.Parameter(torch.zeros(width))

    def forward(self, x: Tensor, lengths: tuple[int, ...]) -> Tensor:
        grouped = x.float().view(len(x), self.groups, -1)
        centred = grouped - _cloud_mean(grouped, lengths)
        variance = _cloud_mean(centred * centred, lengths)
        return (centred * torch.rsqrt(variance + 1e-5)).view(x.shape).to(x.dtype) * self.weight + self.bias


class LayerNorm(nn.LayerNorm):
    """Each point by itself; nothing depends on how much of the bone is seen."""

    def forward(self, x: Tensor, lengths: tuple[int, ...]) -> Tensor:  # type: ignore[override]
        return super().forward(x)


NORMS = {"group": GroupNorm, "layer": LayerNorm}


def make_norm(name: str, width: int) -> nn.Module:
    """The norm of the configuration; called with (N, C) and the lengths of the clouds."""
    return choose("norm", NORMS, name)(width)


class Unary(nn.Module):
    """Linear, norm and, unless `plain`, leaky ReLU, on every point."""

    def __init__(self, width_in: int, width: int, norm: str, plain: bool = False) -> None:
        super().__init__()
        self.linear = nn.Linear(width_in, width, bias=False)
        self.norm = make_norm(norm, width)
        self.activation = nn.Identity() if plain else nn.LeakyReLU(0.1)

    def forward(self, x: Tensor, lengths: tuple[int, ...]) -> Tensor:
        return self.activation(self.norm(self.linear(x), lengths))


def pad(x: Tensor, lengths: tuple[int, ...]) -> Tensor:
    """(N, ...) of clouds one after the other as (B, longest, ...), zeros behind."""
    if len(lengths) == 1:
        return x[None]
    return nn.utils.rnn.pad_sequence(list(torch.split(x, list(lengths))), batch_first=True)


def padding_mask(lengths: tuple[int, ...], device: torch.device) -> Tensor:
    """(B, longest) bool, True where there is a point."""
    return torch.arange(max(lengths), device=device) < torch.tensor(lengths, device=device)[:, None]


def _cloud_mean(x: Tensor, lengths: tuple[int, ...]) -> Tensor:
    """Mean over each cloud's points and channels of a group: (1 or N, groups, 1)."""
    x = x.mean(-1)
    if len(lengths) == 1:
        return x.mean(0)[None, :, None]
    count = torch.tensor(lengths, device=x.device)
    cloud = torch.repeat_interleave(torch.arange(len(lengths), device=x.device), count, output_size=len(x))
    sums = torch.zeros(len(lengths), x.shape[1], device=x.device, dtype=x.dtype).index_add(0, cloud, x)
    return (sums / count[:, None])[cloud][..., None]
