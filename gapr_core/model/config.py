"""Settings of the network: one frozen dataclass, whose defaults are the `best` configuration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import yaml

from gapr_core.errors import ConfigError


@dataclass(frozen=True)
class ModelConfig:
    """Everything that shapes the network; lengths are in voxels or in units of the target's half extent.

    Attributes:
        name: what the variant is called in tables.
        inputs: features of the points before the first layer: `ones` (paper) or `invariant`.
        backbone: blocks of an encoder stage: `kpconv`, `pga` or `kpconv+pga` (paper, table IV).
        kernel_frame: coordinates in which KPConv places its kernel: `world` (paper) or `surface` (rotation-invariant).
        encoding: geometry in local and global self-attention (paper, table V).
        values_encoded: the pair's geometry also enters the attention's values, not its weights alone.
        final_cross: encoding of the last cross-attention; `vanilla` is the standard one (paper, table IV).
        repositioning: `svd` (paper) or `none`, before the last cross-attention.
        fine_scores: `dot` (eq. 8) or `cosine` with a learnable temperature.
        norm: `group` (statistics over each cloud) or `layer` (each point by itself).
        centred_features: what all superpoints of the target have in common is taken off before features are compared.
        mlp_projections: a hidden layer before W^Q, W^K and W^V, as the paper's "separate MLP projections".
        pair_width: channels of the hidden layer between a pair's geometry and r_ij; 0 for as many as the features have.
        stages: encoder stages, the bottleneck included.
        width: channels of the first stage; doubled at each further one.
        global_width: channels of the global aggregation.
        heads: attention heads.
        global_layers: (self, cross) layers.
        superpoints: the first voxel is chosen so that the target keeps this many at the bottleneck.
        voxel_growth: voxel edge of a stage over that of the stage before.
        neighbors: cap on the neighbours, per stage.
        radius_voxels: radius of a neighbourhood in voxels of its stage.
        sigma_voxels: reach of a kernel point in voxels of its stage.
        small_ball: k_r, the radius of the PGF's second ball over that of the first.
        fine_stage: stage whose points are matched finely (0 is the densest).
        patch_size: most points of one patch.
        train_pairs, test_pairs: patch pairs that are matched finely.
        sinkhorn_iterations: rounds of the optimal transport.
        mutual_k: a match is among the k best of its row and of its column.
        match_confidence: matches below it are dropped.
        coarse_temperature: divides the squared feature distance of eq. (6); 1 is the paper's.
        reposition_temperature, reposition_top, reposition_condition: soft matches of the weighted SVD, how many of
            them, and how much longer than wide they may be before nothing is moved.
    """

    name: str = "best"
    inputs: str = "invariant"
    backbone: str = "kpconv+pga"
    kernel_frame: str = "surface"
    encoding: str = "pga"
    values_encoded: bool = True
    final_cross: str = "pga"
    repositioning: str = "svd"
    fine_scores: str = "cosine"
    norm: str = "group"
    centred_features: bool = False
    mlp_projections: bool = False
    pair_width: int = 32
    stages: int = 4
    width: int = 32
    global_width: int = 128
    heads: int = 4
    global_layers: int = 3
    superpoints: tuple[int, int] = (50, 75)
    voxel_growth: float = 1.6
    neighbors: tuple[int, ...] = (16, 16, 16, 16)
    radius_voxels: float = 2.5
    sigma_voxels: float = 2.0
    small_ball: float = 0.5
    fine_stage: int = 0
    patch_size: int = 32
    train_pairs: int = 32
    test_pairs: int = 128
    sinkhorn_iterations: int = 15
    mutual_k: int = 3
    match_confidence: float = 0.05
    coarse_temperature: float = 0.1
    reposition_temperature: float = 0.05
    reposition_top: int = 64
    reposition_condition: float = 30.0

    def __post_init__(self) -> None:
        if len(self.neighbors) != self.stages:
            raise ConfigError(f"{self.stages} entries in neighbors, one per stage", str(self.neighbors), "match stages")
        if not 0 <= self.fine_stage < self.stages - 1:
            raise ConfigError(f"fine_stage from 0 to {self.stages - 2}", str(self.fine_stage), "choose a denser stage")
        if self.global_width % self.heads or self.width % self.heads:
            raise ConfigError(f"widths divisible by {self.heads} heads", f"{self.width}, {self.global_width}", "round")

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> ModelConfig:
        """The defaults with `values` over them.

        Raises:
            ConfigError: for a key that does not exist.
        """
        known = {f.name for f in fields(cls)}
        unknown = sorted(set(values) - known)
        if unknown:
            raise ConfigError(f"keys of ModelConfig ({', '.join(sorted(known))})", ", ".join(unknown), "mend the names")
        given: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in values.items()}
        return cls(**given)

    @classmethod
    def from_yaml(cls, path: str | Path) -> ModelConfig:
        """The defaults with a yaml's entries over them (`config/model/*.yaml`)."""
        values = yaml.safe_load(Path(path).read_text()) or {}
        if not isinstance(values, dict):
            raise ConfigError(f"a mapping in {path}", type(values).__name__, "write `key: value` lines")
        return cls.from_dict(values)

    def to_dict(self) -> dict[str, Any]:
        """All entries, as `from_dict` takes them."""
        return asdict(self)

    @property
    def stage_widths(self) -> tuple[int, ...]:
        """Channels of each stage."""
        return tuple(self.width * 2**stage for stage in range(self.stages))


def choose(slot: str, options: Mapping[str, Any], name: str) -> Any:
    """The entry of a slot's dict.

    Raises:
        ConfigError: when the slot has no such option.
    """
    if name not in options:
        raise ConfigError(f"{slot} one of {', '.join(options)}", repr(name), "choose one of these")
    return options[name]
