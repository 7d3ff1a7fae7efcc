"""Attention without geometry (Vaswani et al., NeurIPS 2017): the paper's "standard attention", eq. (4)."""

from __future__ import annotations

from torch import nn

from gapr_core.model.attention import TransformerLayer, VanillaEncoder
from gapr_core.model.config import ModelConfig


def layer(dim: int, config: ModelConfig) -> nn.Module:
    """Make a transformer layer whose pair encoding is the identity."""
    return TransformerLayer(dim, config.heads, VanillaEncoder(), config.mlp_projections)
