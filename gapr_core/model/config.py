"""Settings of the network: one frozen dataclass, whose defaults are the `best` configuration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gapr_core.errors import ConfigError
from gapr_core.runtime.settings import Settings, setting


@dataclass(frozen=True)
class ModelConfig(Settings):
    """Everything that shapes the network; lengths are in voxels or in units of the target's half extent."""

    name: str = setting("best", "what the variant is called in tables")
    inputs: str = setting("invariant", "features of the points before the first layer: ones (paper) or invariant")
    backbone: str = setting("kpconv+pga", "blocks of an encoder stage: kpconv, pga or kpconv+pga (paper, table IV)")
    kernel_frame: str = setting(
        "surface", "where KPConv places its kernel: world (paper), or surface, which does not turn with the cloud"
    )
    encoding: str = setting("pga", "geometry in local and global self-attention (paper, table V)")
    values_encoded: bool = setting(True, "the pair's geometry enters the attention's values too, not its weights alone")
    final_cross: str = setting("pga", "encoding of the last cross-attention; vanilla: the standard one (table IV)")
    repositioning: str = setting("svd", "svd (paper) or none, before the last cross-attention")
    fine_scores: str = setting("cosine", "dot (eq. 8), or cosine with a learnable temperature")
    norm: str = setting("group", "group (statistics over each cloud) or layer (each point by itself)")
    mlp_projections: bool = setting(False, "a hidden layer before W^Q, W^K, W^V: the paper's separate MLP projections")
    pair_width: int = setting(32, "channels between a pair's geometry and r_ij; 0: as many as the features", low=0)
    stages: int = setting(4, "encoder stages, the bottleneck included", low=2, high=10)
    width: int = setting(32, "channels of the first stage; doubled at each further one", low=1)
    global_width: int = setting(128, "channels of the global aggregation", low=1)
    heads: int = setting(4, "attention heads", low=1)
    global_layers: int = setting(3, "layers of self- and cross-attention", low=1)
    superpoints: tuple[int, int] = setting(
        (50, 75), "kept of the target at the bottleneck; sets the first voxel", low=4
    )
    voxel_growth: float = setting(1.6, "voxel edge of a stage over that of the stage before", low=1.01, high=10)
    neighbors: tuple[int, ...] = setting((16, 16, 16, 16), "most neighbours, of each stage", low=1)
    radius_voxels: float = setting(2.5, "radius of a neighbourhood in voxels of its stage", low=0.1)
    sigma_voxels: float = setting(2.0, "reach of a kernel point in voxels of its stage", low=0.1)
    small_ball: float = setting(0.5, "k_r: radius of the PGF's second ball over the first", low=0.01, high=1)
    global_small_ball: str = setting(
        "part", "second ball of global self-attention: the bottleneck's whole ball (paper), or small_ball of it",
        choices=("part", "whole"),
    )  # fmt: skip
    early_features: str = setting(
        "projected", "what repositioning compares: the self-attention's output as it is (paper: plain), or projected",
        choices=("projected", "plain"),
    )  # fmt: skip
    fine_stage: int = setting(0, "stage whose points are matched finely; 0 is the densest", low=0)
    patch_size: int = setting(32, "most points of one patch", low=3)
    train_pairs: int = setting(32, "patch pairs that are matched finely in training", low=1)
    test_pairs: int = setting(128, "the same in use", low=1)
    sinkhorn_iterations: int = setting(15, "rounds of the optimal transport", low=1)
    mutual_k: int = setting(3, "a match is among the k best of its row and of its column", low=1)
    match_confidence: float = setting(0.05, "matches below are dropped", low=0, high=1)
    coarse_temperature: float = setting(0.1, "divides the squared feature distance of eq. (6); paper: 1", low=1e-6)
    reposition_temperature: float = setting(0.05, "of the soft matches of the weighted SVD", low=1e-6)
    reposition_top: int = setting(64, "how many soft matches there are", low=3)
    reposition_condition: float = setting(30.0, "matches longer than wide by more move nothing", low=1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.neighbors) != self.stages:
            raise ConfigError(f"{self.stages} entries in neighbors, one per stage", str(self.neighbors), "match stages")
        if not 0 <= self.fine_stage < self.stages - 1:
            raise ConfigError(f"fine_stage from 0 to {self.stages - 2}", str(self.fine_stage), "choose a denser stage")
        if self.global_width % self.heads or self.width % self.heads:
            raise ConfigError(f"widths divisible by {self.heads} heads", f"{self.width}, {self.global_width}", "round")

    @property
    def stage_widths(self) -> tuple[int, ...]:
        """Channels of each stage."""
        return tuple(self.width * 2**stage for stage in range(self.stages))


def choose(slot: str, options: Mapping[str, Any], name: str) -> Any:
    """Look up the entry of a slot's dict.

    Raises:
        ConfigError: when the slot has no such option.
    """
    if name not in options:
        raise ConfigError(f"{slot} one of {', '.join(options)}", repr(name), "choose one of these")
    return options[name]
