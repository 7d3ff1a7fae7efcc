"""Settings of a training run, `config/train.yaml` holds only what differs from these defaults; plan of an ablation."""

from __future__ import annotations

import os
import sysconfig
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gapr_core.errors import ConfigError
from gapr_core.model.config import ModelConfig
from gapr_core.runtime.settings import Settings, load, read_yaml, setting

ONE_SIDED = {"L1": 0.15, "L2": 0.25, "L3": 0.2, "L2-region": 0.05, "L3-region": 0.05, "sweep": 0.1}
MIX = ONE_SIDED | {"paper": 0.12, "incomplete": 0.08}


@dataclass(frozen=True)
class TrainConfig(Settings):
    """Everything that decides a run; two runs with the same entries on one CPU thread are equal bit by bit."""

    model: str = setting("", "path of a yaml in config/model; empty: the defaults (best)")
    initial: str = setting("", "weights (safetensors) of the same network to begin with; empty: random ones")
    model_settings: dict[str, Any] = setting({}, "settings of the network over those of its yaml")
    bones: tuple[str, ...] = setting(("femur", "tibia", "pelvis", "thoracic"), "bone types")
    mix: dict[str, float] = setting(MIX, "protocols and how often each is drawn", low=0)
    target_frame: str = setting(
        "random", "how targets lie: as scanned (paper: scan), or turned at random", choices=("random", "scan")
    )
    source_points: str = setting(
        "new", "of protocols that crop: the target's own points (paper: target), or sampled again (new)",
        choices=("new", "target"),
    )  # fmt: skip
    early_loss: float = setting(0.5, "weight of the coarse loss before repositioning; the paper has none: 0", low=0)
    pairs: int = setting(24_000, "length of the schedule, in pairs", low=1)
    batch: int = setting(8, "pairs per optimiser step, over all processes", low=1)
    micro_batch: int = setting(4, "pairs per forward pass; gradients add up to a batch", low=1)
    learning_rate: float = setting(5e-4, "of AdamW", low=0)
    weight_decay: float = setting(1e-4, "of AdamW", low=0)
    clip: float = setting(1.0, "limit on the gradient's norm", low=0)
    warmup: float = setting(0.02, "share of the schedule with a rising learning rate", low=0, high=1)
    final_rate: float = setting(0.01, "learning rate at the end of the cosine over that at its start", low=0, high=1)
    ema: float = setting(0.995, "decay of the averaged weights, which are validated and exported", low=0, high=1)
    coarse_first: float = setting(0.0, "first share of the schedule, with 0.6 of the superpoints", low=0, high=1)
    pool: int = setting(128, "bones in use at once", low=1)
    reuse: int = setting(16, "pairs that a bone serves before the next subject comes in", low=1)
    share: int = setting(2, "neighbouring pairs with one target, whose features are computed once", low=1)
    synthetic: float = setting(0.7, "share of bones drawn from the shape model, not from the split", low=0, high=1)
    seed: int = setting(0, "of weights, bones, pairs and patches", low=0)
    workers: int = setting(0, "processes that make pairs; 0: the training process makes them", low=0)
    precision: str = setting("float32", "of the forward pass", choices=("float32", "bfloat16"))
    device: str = setting("auto", "what computes; auto: a GPU if there is one", choices=("auto", "cpu", "cuda"))
    checkpoint_minutes: float = setting(3.0, "between two checkpoints", low=0, unit="min")
    validate_minutes: float = setting(10.0, "between two validations", low=0, unit="min")
    log_steps: int = setting(1, "steps between two lines of log.csv; on a GPU every line waits for it", low=1)
    validation_pairs: int = setting(8, "per protocol of the mix", low=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.batch % self.micro_batch:
            raise ConfigError("a batch of whole micro-batches", f"{self.batch} and {self.micro_batch}", "make them fit")
        if not self.bones:
            raise ConfigError("bones to train on", "none", "name some in `bones`")

    def network(self) -> ModelConfig:
        """Return the trained network: `model` with `model_settings` over it."""
        return network_of(self.model, self.model_settings)


def read_config(path: Path | None, assignments: Sequence[str] = ()) -> TrainConfig:
    """Read the settings of a yaml, with `name=value` over them.

    `model` and `initial` are paths from the working folder, or from a folder above the yaml: config/train_paper.yaml
    names config/model/NAME.yaml, and means it wherever it is called from.

    Raises:
        ConfigError: the file cannot be read, or has other settings.
    """
    config = load(TrainConfig, path, assignments)
    if path is None:
        return config
    return replace(config, model=_found(config.model, path), initial=_found(config.initial, path))


def _found(named: str, path: Path) -> str:
    """Resolve a yaml's path from the working folder, else from a folder above the yaml."""
    if not named or Path(named).exists():
        return named
    places = (folder / named for folder in path.resolve().parents)
    return next((os.path.relpath(place) for place in places if place.exists()), named)


def network_of(model: str | Path, settings: Mapping[str, Any]) -> ModelConfig:
    """Configure a yaml's network, or the default one, with settings over it."""
    return ModelConfig.from_dict((read_yaml(model) if model else {}) | dict(settings))


@dataclass(frozen=True)
class Variant:
    """One row of a table: its label, the yaml of its network, and the paper's recall in % where it has one."""

    table: str
    label: str
    model: Path
    paper: float | None


def default_plan() -> Path:
    """config/ablation.yaml of the source tree, or where the package was installed with its data.

    Raises:
        ConfigError: it was installed without.
    """
    places = [Path(__file__).resolve().parents[2], Path(sysconfig.get_path("data")) / "share" / "gapr_ros"]
    found = [place / "config" / "ablation.yaml" for place in places if (place / "config" / "ablation.yaml").is_file()]
    if not found:
        how = "install gapr_ros again, with its data; gapr ablate takes one as --plan, too"
        raise ConfigError("config/ablation.yaml", "none installed", how)
    return found[0]


def read_plan(path: Path) -> list[Variant]:
    """Read the rows of all tables; paths stay relative to the working folder, for other machines.

    Raises:
        ConfigError: the file cannot be read, or holds something else than lists of rows.
    """
    models = Path(os.path.relpath(path.resolve().parent / "model"))
    tables = read_yaml(path)
    return [_variant(table, row, models, path) for table in tables for row in _rows(table, tables[table], path)]


def _rows(table: str, rows: Any, path: Path) -> list[Any]:
    if not isinstance(rows, list | None):
        how = "write `- {label: NAME, model: NAME}` lines"
        raise ConfigError(f"a list of rows for each table in {path}", f"{rows!r} under {table}", how)
    return rows or []


def _variant(table: str, row: Any, models: Path, path: Path) -> Variant:
    if not isinstance(row, dict) or not {"label", "model"} <= row.keys():
        raise ConfigError(f"rows with label and model in {path}", f"{row!r} under {table}", "correct the row")
    return Variant(table, row["label"], models / f"{row['model']}.yaml", row.get("paper"))


def trained_as(plan: Sequence[Variant], settings: Mapping[str, Any] | None = None) -> dict[Path, Path]:
    """Map every yaml to the first one with the same network but for its name.

    `settings` are those that the run has over every yaml.
    """
    networks = {v.model: replace(network_of(v.model, settings or {}), name="") for v in plan}
    return {path: next(p for p, other in networks.items() if other == network) for path, network in networks.items()}
