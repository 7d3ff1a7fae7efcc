"""Coarse matching (paper, section IV-D1): Gaussian correlation, dual normalisation, top patch pairs."""

from __future__ import annotations

import torch
from torch import Tensor

from gapr_core.model.types import PatchPairs


def coarse_scores(f_p: Tensor, f_q: Tensor, valid_p: Tensor, valid_q: Tensor, temperature: float = 1.0) -> Tensor:
    """Eq. (6) and (7) in log space: log of the dual-normalised correlation.

    Args:
        f_p, f_q: (B, n, C), (B, m, C) superpoint features.
        valid_p, valid_q: (B, n), (B, m) bool.
        temperature: divides the squared distance; 1 is the paper's.

    Returns:
        (B, n, m) log of s_bar; -inf where a superpoint does not exist.
    """
    f_p, f_q = f_p.float(), f_q.float()
    squared = (f_p * f_p).sum(-1)[..., None] + (f_q * f_q).sum(-1)[:, None] - 2.0 * f_p @ f_q.transpose(1, 2)
    valid = valid_p[..., None] & valid_q[:, None]
    log_s = (-squared.clamp(min=0.0) / temperature).masked_fill(~valid, -1e4)  # eq. (6)
    log_bar = 2.0 * log_s - log_s.logsumexp(2, keepdim=True) - log_s.logsumexp(1, keepdim=True)  # eq. (7)
    return log_bar.masked_fill(~valid, float("-inf"))


def top_pairs(log_scores: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Take the `count` highest entries of each (n, m): rows, columns (B, count), scores, 0 where missing."""
    batch, n, m = log_scores.shape
    best = log_scores.reshape(batch, n * m).topk(min(count, n * m), dim=1)
    return best.indices // m, best.indices % m, best.values.exp()


def patch_pairs(log_scores: Tensor, count: int, lengths_p: tuple[int, ...], lengths_q: tuple[int, ...]) -> PatchPairs:
    """Select C': top patch pairs of every pair of clouds, as rows of the concatenated superpoints."""
    rows, columns, score = top_pairs(log_scores, count)
    start_p, start_q = (_starts(lengths, rows.device) for lengths in (lengths_p, lengths_q))
    pair = torch.arange(len(rows), device=rows.device)[:, None].expand_as(rows)
    kept = score > 0
    return PatchPairs(pair[kept], (rows + start_p)[kept], (columns + start_q)[kept], score[kept])


def _starts(lengths: tuple[int, ...], device: torch.device) -> Tensor:
    ends = torch.tensor(lengths, device=device).cumsum(0)
    return (ends - torch.tensor(lengths, device=device))[:, None]
