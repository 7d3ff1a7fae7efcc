"""Variants of the transformer (paper, table V), each after its own paper: one file, one line here, one yaml."""

from __future__ import annotations

from collections.abc import Callable

from torch import nn

from gapr_core.model.config import ModelConfig, choose
from gapr_core.model.encoding import gcn, geotransformer, pga, ppf, ptv3, rotary, vanilla

TRANSFORMERS: dict[str, Callable[[int, ModelConfig], nn.Module]] = {
    "pga": pga.layer,
    "vanilla": vanilla.layer,
    "geotransformer": geotransformer.layer,
    "ppf": ppf.layer,
    "rotary": rotary.layer,
    "gcn": gcn.layer,
    "ptv3": ptv3.layer,
}


def make_transformer(name: str, dim: int, config: ModelConfig) -> nn.Module:
    """Make a layer `(x_q, x_s, pairs) -> x_q`, for local and for dense pairs alike."""
    return choose("encoding", TRANSFORMERS, name)(dim, config)
