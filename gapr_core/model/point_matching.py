"""Fine matching within patch pairs (paper, section IV-D2): scores, optimal transport, mutual top-k."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from gapr_core.model.config import ModelConfig, choose
from gapr_core.model.pairs import gather
from gapr_core.model.types import Cloud, Matches, PatchPairs


class DotScores(nn.Module):
    """Eq. (8): F_p F_q^T / sqrt(d)."""

    dustbin = 1.0

    def prepare(self, f: Tensor) -> Tensor:
        """Features of all fine points, before patches are gathered."""
        return f * f.shape[-1] ** -0.25

    def forward(self, f_p: Tensor, f_q: Tensor) -> Tensor:
        """(P, a, b) from prepared features of the patches' points."""
        return f_p @ f_q.transpose(1, 2)


class CosineScores(nn.Module):
    """Cosine times a learnable temperature, which starts at 10."""

    dustbin = 5.0

    def __init__(self) -> None:
        super().__init__()
        self.temperature = nn.Parameter(torch.tensor(10.0))

    def prepare(self, f: Tensor) -> Tensor:
        """Features of all fine points, before patches are gathered."""
        return normalize(f, dim=-1)

    def forward(self, f_p: Tensor, f_q: Tensor) -> Tensor:
        """(P, a, b) from prepared features of the patches' points."""
        return f_p @ f_q.transpose(1, 2) * self.temperature


_NEVER, _TINY = -1e6, 1e-30
_LOWEST = -87.0  # below, exp underflows in float32, and is many times slower for it
FINE_SCORES: dict[str, type[nn.Module]] = {"dot": DotScores, "cosine": CosineScores}


@dataclass(frozen=True)
class FineAssignment:
    """Soft assignments of P patch pairs.

    Attributes:
        log_z: (P, a + 1, b + 1) log of Z_bar; the last row and column are the dustbins.
        source_index, target_index: (P, a), (P, b) rows of the fine points.
        source_valid, target_valid: (P, a), (P, b) bool.
    """

    log_z: Tensor
    source_index: Tensor
    target_index: Tensor
    source_valid: Tensor
    target_valid: Tensor


class FineMatching(nn.Module):
    """From fine features and patch pairs to soft assignments, and from these to correspondences."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.scores = choose("fine_scores", FINE_SCORES, config.fine_scores)()
        self.dustbin = nn.Parameter(torch.tensor(float(self.scores.dustbin)))  # alpha
        self.iterations, self.mutual_k = config.sinkhorn_iterations, config.mutual_k
        self.confidence = config.match_confidence

    def forward(self, source: Cloud, target: Cloud, f_p: Tensor, f_q: Tensor, chosen: PatchPairs) -> FineAssignment:
        """Assignments of the chosen patch pairs; f_p (N, C), f_q (M, C) are features of the fine points."""
        index_p, valid_p = _patches(source, chosen.source)
        index_q, valid_q = _patches(target, chosen.target)
        f_p, f_q = self.scores.prepare(f_p), self.scores.prepare(f_q)
        scores = self.scores(gather(f_p, index_p), gather(f_q, index_q)).float()
        log_z = log_optimal_transport(scores, self.dustbin.float(), valid_p, valid_q, self.iterations)
        return FineAssignment(log_z, index_p, index_q, valid_p, valid_q)

    def correspondences(self, source: Cloud, target: Cloud, fine: FineAssignment, chosen: PatchPairs) -> Matches:
        """Eq. (9): the union of the mutual top-k matches of all patch pairs."""
        z = fine.log_z[:, :-1, :-1].clamp(min=_LOWEST).exp()
        z = z * (fine.source_valid[:, :, None] & fine.target_valid[:, None])
        kept = mutual_top_k(z, self.mutual_k) & (z > self.confidence)
        patch, a, b = kept.nonzero(as_tuple=True)
        p = source.fine.points[fine.source_index[patch, a]]
        q = target.fine.points[fine.target_index[patch, b]]
        score = z[patch, a, b] * chosen.score[patch].sqrt()
        return Matches(p, q, score, patch, chosen.pair[patch])


def log_optimal_transport(scores: Tensor, dustbin: Tensor, valid_p: Tensor, valid_q: Tensor, rounds: int) -> Tensor:
    """Sinkhorn in log space with a dustbin row and column (SuperGlue, Sarlin et al. 2020), over masked points.

    Args:
        scores: (P, a, b). valid_p, valid_q: (P, a), (P, b) bool. dustbin: the scalar alpha.

    Returns:
        (P, a + 1, b + 1) log assignment: every existing point's row (column) sums to one.
    """
    mask_p, mask_q = (torch.nn.functional.pad(v, (0, 1), value=True) for v in (valid_p, valid_q))
    padded = torch.nn.functional.pad(scores, (0, 1, 0, 1))
    bins = torch.zeros_like(padded)
    bins[:, -1], bins[:, :, -1] = 1.0, 1.0
    exists = mask_p[:, :, None] & mask_q[:, None]
    couplings = (padded + bins * dustbin).masked_fill(~exists, _NEVER)
    count_p, count_q = valid_p.sum(1, keepdim=True).float(), valid_q.sum(1, keepdim=True).float()
    log_mu = _marginal(valid_p, count_q, count_p + count_q)
    log_nu = _marginal(valid_q, count_p, count_p + count_q)
    u = log_mu - couplings.logsumexp(2)
    v = log_nu - (couplings + u[:, :, None]).logsumexp(1)
    log_z = (couplings + u[:, :, None] + v[:, None]).masked_fill(~exists, _NEVER)
    return _scale(log_z, log_mu.exp(), log_nu.exp(), rounds - 1) + (count_p + count_q).log()[..., None]


def _scale(log_z: Tensor, mu: Tensor, nu: Tensor, rounds: int) -> Tensor:
    """Further rounds as plain scalings of exp(log_z): after one round in log space all its entries are at most 1.

    The same iteration as in log space, at a tenth of the cost; underflow is below 1e-38 of a point's mass.
    """
    kernel = log_z.clamp(min=_LOWEST).exp()
    transposed = kernel.transpose(1, 2).contiguous()
    a, b = torch.ones_like(mu), torch.ones_like(nu)
    for _ in range(rounds):
        a = mu / (b[:, None] @ transposed)[:, 0].clamp(min=_TINY)
        b = nu / (a[:, None] @ kernel)[:, 0].clamp(min=_TINY)
    return log_z + a.clamp(min=_TINY).log()[..., None] + b.clamp(min=_TINY).log()[:, None]


def _marginal(valid: Tensor, other: Tensor, total: Tensor) -> Tensor:
    """Log masses: one for every existing point, as many as the other side has for the dustbin, over the total."""
    ones = torch.zeros_like(valid, dtype=torch.float32).masked_fill(~valid, _NEVER)
    return torch.cat([ones, other.log()], dim=1) - total.log()


def mutual_top_k(z: Tensor, k: int) -> Tensor:
    """(P, a, b) bool: among the k best of its row and of its column."""
    rows = torch.zeros_like(z, dtype=torch.bool).scatter_(2, z.topk(min(k, z.shape[2]), dim=2).indices, True)
    columns = torch.zeros_like(z, dtype=torch.bool).scatter_(1, z.topk(min(k, z.shape[1]), dim=1).indices, True)
    return rows & columns


def _patches(cloud: Cloud, rows: Tensor) -> tuple[Tensor, Tensor]:
    """(P, a) fine points of the chosen patches, cut to the longest of them, and which exist."""
    index, valid = cloud.patches[rows], cloud.patches_valid[rows]
    longest = int(valid.sum(1).max()) if len(valid) else 1
    return index[:, :longest], valid[:, :longest]
