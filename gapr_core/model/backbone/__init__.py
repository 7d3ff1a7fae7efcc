"""KPConv-FPN with local self-attention (paper, Fig. 2): encoder of four stages, decoder with skips."""

from gapr_core.model.backbone.fpn import Backbone

__all__ = ["Backbone"]
