"""Point-wise Geometry-aware Attention (paper, section IV-B, Fig. 4): r_ij is an MLP of the PGF l_ij."""

from __future__ import annotations

from torch import Tensor, nn

from gapr_core.model import fused
from gapr_core.model.attention import FusedEncoder, PairEncoding, TransformerLayer
from gapr_core.model.config import ModelConfig
from gapr_core.model.encoding.relative import RelativeEncoder
from gapr_core.model.pairs import Pairs
from gapr_core.model.pgf import EMBEDDED


class PGAEncoder(FusedEncoder):
    """l_ij -> MLP -> r_ij; local, global and cross alike, since `Pairs` brings the right ball centroids."""

    def __init__(self, dim: int, hidden: int, in_values: bool) -> None:
        super().__init__()
        self.first = nn.Sequential(nn.Linear(EMBEDDED, hidden), nn.ReLU(inplace=True))
        self.relative = RelativeEncoder(hidden, dim, in_values)

    def forward(self, pairs: Pairs) -> PairEncoding:
        return self.relative(self.first(pairs.pgf))

    def fits(self, pairs: Pairs, x: Tensor) -> bool:
        return fused.fits(pairs, x)

    def attend(self, q: Tensor, k: Tensor, v: Tensor, pairs: Pairs, heads: int) -> Tensor:
        hq, hk, hv = (x.reshape(-1, heads, x.shape[-1] // heads) for x in (q, k, v))
        folded, first, scale = self.relative.folded(hq), dict(self.first[0].named_parameters()), hq.shape[2] ** -0.5
        out, mixed = fused.attend(hq, hk, hv, folded, first["weight"].T, first["bias"], pairs, scale)
        return self.relative.valued(out, mixed).reshape(q.shape)


def layer(dim: int, config: ModelConfig) -> nn.Module:
    """self-PGA, or cross-PGA when the pairs are across clouds."""
    encoder = PGAEncoder(dim, config.pair_width or dim, config.values_encoded)
    return TransformerLayer(dim, config.heads, encoder, config.mlp_projections)
