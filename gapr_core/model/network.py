"""GAPR-Net: from two clouds to point correspondences (paper, Fig. 2)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn

from gapr_core.model.backbone import Backbone
from gapr_core.model.config import ModelConfig
from gapr_core.model.layers import pad
from gapr_core.model.point_matching import FineAssignment, FineMatching
from gapr_core.model.superpoint_matching import coarse_scores, patch_pairs
from gapr_core.model.transformer import Aggregated, GlobalAggregation
from gapr_core.model.types import Cloud, Features, Matches, PatchPairs


@dataclass(frozen=True)
class Output:
    """Everything one forward pass found; `coarse` is the log of eq. (7), (B, n, m)."""

    aggregated: Aggregated
    coarse: Tensor
    chosen: PatchPairs
    fine: FineAssignment
    matches: Matches


class GAPRNet(nn.Module):
    """The network, with every part taken from the slot that the configuration names.

    Shapes for one pair, default widths (C = 128, fine 64):
        source, target          N = 850, M = 1200 fine points; n = 40, m = 65 superpoints
        - backbone              fine (N, 64), (M, 64); coarse (n, 256), (m, 256)
        - aggregation           (1, n, 128), (1, m, 128), unit length; T_reposition (1, 3, 4)
        - coarse matching       (1, n, m) -> P = 128 patch pairs
        - fine matching         (P, a + 1, b + 1), a, b <= 32 -> C correspondences
    """

    def __init__(self, config: ModelConfig | None = None) -> None:
        super().__init__()
        self.config = config or ModelConfig()
        self.backbone = Backbone(self.config)
        self.aggregation = GlobalAggregation(self.config)
        self.fine_matching = FineMatching(self.config)

    def forward(self, source: Cloud, target: Cloud, target_features: Features | None = None) -> Output:
        """Correspondences of a batch of pairs; the truth is not needed, the target's features may be given."""
        f_p = self.backbone(source)  # sections IV-A and IV-B
        f_q = self.backbone(target) if target_features is None else target_features
        aggregated = self.aggregation(source, target, f_p.coarse, f_q.coarse)  # section IV-C, eq. (3) to (5)
        coarse = self.coarse_scores(source, target, aggregated)  # eq. (6), (7)
        chosen = patch_pairs(coarse, self.config.test_pairs, source.coarse.lengths, target.coarse.lengths)  # C'
        fine = self.fine_matching(source, target, f_p.fine, f_q.fine, chosen)  # eq. (8)
        matches = self.fine_matching.correspondences(source, target, fine, chosen)  # eq. (9)
        return Output(aggregated, coarse, chosen, fine, matches)

    def coarse_scores(self, source: Cloud, target: Cloud, aggregated: Aggregated) -> Tensor:
        """Log of eq. (7); superpoints without any fine point are out."""
        valid_p = aggregated.source_valid & pad(source.patches_valid.any(1), source.coarse.lengths)
        valid_q = aggregated.target_valid & pad(target.patches_valid.any(1), target.coarse.lengths)
        return coarse_scores(aggregated.source, aggregated.target, valid_p, valid_q, self.config.coarse_temperature)
