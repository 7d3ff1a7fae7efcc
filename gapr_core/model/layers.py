"""Small layers that know about several clouds in one tensor."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu

from gapr_core.model.config import choose

SLOPE = 0.1  # of every leaky ReLU


class GroupNorm(nn.Module):
    """GroupNorm of (N, C) features with statistics over each cloud, so that a cloud's answer is its own."""

    def __init__(self, width: int, groups: int = 8) -> None:
        super().__init__()
        self.groups = min(groups, width)
        self.weight, self.bias = nn.Parameter(torch.ones(width)), nn.Parameter(torch.zeros(width))

    def forward(self, x: Tensor, lengths: tuple[int, ...], slope: float = 1.0) -> Tensor:
        """Apply the norm, then a leaky ReLU of the given slope."""
        x = x.float()
        centred = x - self._mean(x, lengths)
        variance = self._mean(centred * centred, lengths)
        return activated(centred * (torch.rsqrt(variance + 1e-5) * self.weight) + self.bias, slope)

    def _mean(self, x: Tensor, lengths: tuple[int, ...]) -> Tensor:
        """Mean over each cloud's points and each group's channels, at its points and channels: (1 or N, C).

        Over the points first: a sum over whole rows is several times faster than one over a group's few channels.
        """
        if len(lengths) == 1:
            return self._of_groups(x.mean(0, keepdim=True))
        cloud, counts = segments(lengths, x.device)
        means = x.new_zeros(len(lengths), x.shape[1]).index_add(0, cloud, x) / counts
        return self._of_groups(means).index_select(0, cloud)

    def _of_groups(self, means: Tensor) -> Tensor:
        """(B, C) means of channels to those of their groups."""
        of_groups = means.view(len(means), self.groups, -1).mean(-1)
        return of_groups.repeat_interleave(means.shape[1] // self.groups, dim=1)


@lru_cache(maxsize=64)  # the norms of one level ask for the same segments, some twenty times a pass
def segments(lengths: tuple[int, ...], device: torch.device) -> tuple[Tensor, Tensor]:
    """Return for concatenated clouds the cloud of each of N points, and the sizes (B, 1)."""
    counts = torch.tensor(lengths, device=device)
    cloud = torch.repeat_interleave(torch.arange(len(lengths), device=device), counts, output_size=sum(lengths))
    return cloud, counts[:, None]


class LayerNorm(nn.LayerNorm):
    """Each point by itself; nothing depends on how much of the bone is seen."""

    def forward(self, x: Tensor, lengths: tuple[int, ...], slope: float = 1.0) -> Tensor:  # type: ignore[override]
        return activated(super().forward(x), slope)


def activated(x: Tensor, slope: float) -> Tensor:
    """Leaky ReLU; x itself where the slope is 1."""
    return x if slope == 1.0 else leaky_relu(x, slope)


NORMS = {"group": GroupNorm, "layer": LayerNorm}


def make_norm(name: str, width: int) -> nn.Module:
    """Make the configured norm; called with (N, C) and the lengths of the clouds."""
    return choose("norm", NORMS, name)(width)


class Unary(nn.Module):
    """Linear, norm and, unless `plain`, leaky ReLU, on every point: (N, C_in) to (N, C_out)."""

    def __init__(self, width_in: int, width: int, norm: str, plain: bool = False) -> None:
        super().__init__()
        self.linear = nn.Linear(width_in, width, bias=False)
        self.norm = make_norm(norm, width)
        self.slope = 1.0 if plain else SLOPE

    def forward(self, x: Tensor, lengths: tuple[int, ...]) -> Tensor:
        return self.norm(self.linear(x), lengths, self.slope)  # type: ignore[no-any-return]


def pad(x: Tensor, lengths: tuple[int, ...]) -> Tensor:
    """(N, ...) of clouds one after the other as (B, longest, ...), zeros behind."""
    if len(lengths) == 1:
        return x[None]
    return nn.utils.rnn.pad_sequence(list(torch.split(x, list(lengths))), batch_first=True)


def padding_mask(lengths: tuple[int, ...], device: torch.device) -> Tensor:
    """(B, longest) bool, True where there is a point."""
    return torch.arange(max(lengths), device=device) < torch.tensor(lengths, device=device)[:, None]
