"""The two losses of the paper, section IV-E."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import softplus

from gapr_core.model.network import GAPRNet
from gapr_core.model.transformer import Aggregated
from gapr_core.model.types import Features, collate
from gapr_core.training.targets import POSITIVE_OVERLAP, TrainingPair, fine_labels, true_patch_pairs

MARGIN_POSITIVE = 0.1  # Delta_p
MARGIN_NEGATIVE = 1.4  # Delta_n
LOG_SCALE = 24.0


@dataclass(frozen=True)
class Losses:
    """Losses of a batch, and the weight of the one that the paper does not have.

    Attributes:
        coarse, fine: of the superpoints and of the points in patches: the paper's.
        early: the coarse loss where repositioning takes its features.
        early_weight: what it counts.
    """

    coarse: Tensor
    fine: Tensor
    early: Tensor
    early_weight: float = 0.5

    @property
    def total(self) -> Tensor:
        """Eq. (10), with the auxiliary loss at its weight; the paper has none."""
        return self.coarse + self.fine + self.early_weight * self.early


def circle_loss(f_p: Tensor, f_q: Tensor, overlaps: Tensor, valid_p: Tensor, valid_q: Tensor) -> Tensor:
    """Overlap-aware circle loss, eq. (11) and (12), mean over both directions.

    Args:
        f_p, f_q: (B, n, C), (B, m, C) unit features.
        overlaps: (B, n, m) of the patches.
        valid_p, valid_q: (B, n), (B, m) bool.
    """
    squared = 2.0 - 2.0 * f_p.float() @ f_q.float().transpose(1, 2)
    distance = torch.sqrt(squared.clamp(min=0.0) + 1e-9)
    valid = valid_p[:, :, None] & valid_q[:, None]
    positive, negative = (overlaps > POSITIVE_OVERLAP) & valid, (overlaps == 0) & valid
    with torch.no_grad():
        weight_p = (distance - MARGIN_POSITIVE).clamp(min=0.0) * overlaps.sqrt()  # lambda beta_p
        weight_n = (MARGIN_NEGATIVE - distance).clamp(min=0.0)  # beta_n
    pull = (LOG_SCALE * weight_p * (distance - MARGIN_POSITIVE)).masked_fill(~positive, float("-inf"))
    push = (LOG_SCALE * weight_n * (MARGIN_NEGATIVE - distance)).masked_fill(~negative, float("-inf"))
    rows = _mean_circle(pull, push, positive, negative, 2)
    columns = _mean_circle(pull, push, positive, negative, 1)
    return 0.5 * (rows + columns)  # eq. (11)


def _mean_circle(pull: Tensor, push: Tensor, positive: Tensor, negative: Tensor, axis: int) -> Tensor:
    """Mean of log(1 + sum e^pull x sum e^push) over the patches that have both kinds of partners (the set A)."""
    chosen = positive.any(axis) & negative.any(axis)
    if not bool(chosen.any()):
        return 0.0 * pull.masked_fill(pull.isneginf(), 0.0).sum()  # nothing to learn, and still a gradient: zero
    pull, push = pull.movedim(axis, -1)[chosen], push.movedim(axis, -1)[chosen]
    return softplus(pull.logsumexp(-1) + push.logsumexp(-1)).mean() / LOG_SCALE  # eq. (12)


def assignment_loss(log_z: Tensor, labels: Tensor) -> Tensor:
    """Eq. (13) and (14): mean negative log-likelihood of the labelled entries of (P, a + 1, b + 1)."""
    return -log_z[labels].mean() if bool(labels.any()) else 0.0 * log_z.sum()


def features(network: GAPRNet, pair: TrainingPair) -> tuple[Features, Features]:
    """Run the backbone on sources and targets in one pass, each different target once."""
    targets = pair.target if pair.distinct is None else pair.distinct
    which = tuple(range(len(targets))) if pair.distinct is None else pair.which
    clouds, sources = collate([pair.source, targets]), len(pair.source)
    found = network.backbone(clouds)
    return found.chosen(clouds, tuple(range(sources))), found.chosen(clouds, tuple(sources + row for row in which))


def compute_losses(
    network: GAPRNet, pair: TrainingPair, generator: torch.Generator, early_weight: float = 0.5
) -> tuple[Losses, Aggregated]:
    """Run a batch with the truth: the fine loss uses true patch pairs from the first step."""
    f_p, f_q = features(network, pair)
    a = network.aggregation(pair.source, pair.target, f_p.coarse, f_q.coarse)
    coarse = circle_loss(a.source, a.target, pair.overlaps, a.source_valid, a.target_valid)
    early = circle_loss(a.early_source, a.early_target, pair.overlaps, a.source_valid, a.target_valid)
    chosen = true_patch_pairs(pair, network.config.train_pairs, generator)
    fine = network.fine_matching(pair.source, pair.target, f_p.fine, f_q.fine, chosen)
    labels = fine_labels(pair, fine.source_index, fine.target_index, fine.source_valid, fine.target_valid, chosen.pair)
    return Losses(coarse, assignment_loss(fine.log_z, labels), early, early_weight), a
