"""Settings of a training run, `config/train.yaml` holds only what differs from these defaults; plan of an ablation."""

from __future__ import annotations

import os
import sysconfig
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import yaml

from gapr_core.errors import ConfigError
from gapr_core.model.config import ModelConfig


def _default_mix() -> dict[str, float]:
    one_sided = {"L1": 0.15, "L2": 0.25, "L3": 0.2, "L2-region": 0.05, "L3-region": 0.05, "sweep": 0.1}
    return one_sided | {"paper": 0.12, "incomplete": 0.08}


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides a run; two runs with the same entries on one CPU thread are equal bit by bit.

    Attributes:
        model: path of a yaml in `config/model`; empty for the defaults (`best`).
        initial: weights (safetensors) of the same network to begin with; empty for random ones.
        bones: bone types.
        mix: protocols and how often each is drawn.
        pairs: length of the schedule, in pairs.
        batch: pairs per optimiser step, over all processes.
        micro_batch: pairs per forward pass, by concatenation; gradients accumulate up to `batch`.
        learning_rate, weight_decay, clip: AdamW, and the limit on the gradient's norm.
        warmup: share of the schedule with a rising learning rate; a cosine falls from there to `final_rate` of it.
        ema: decay of the averaged weights, which are what is validated and exported.
        pool: how many bones are in use at once; each serves `reuse` pairs before the next person comes in.
        share: neighbouring pairs that look at the same target, whose features are then computed once.
        synthetic: share of bones that are drawn from the shape model instead of being a person of the split.
        seed: of weights, bones, pairs and patches.
        workers: processes that make pairs; 0 makes them in the training process.
        precision: `float32` or `bfloat16` (autocast).
        device: `auto`, `cpu` or `cuda`.
        checkpoint_minutes, validate_minutes: how often.
        validation_pairs: per protocol of the mix.
    """

    model: str = ""
    initial: str = ""
    bones: tuple[str, ...] = ("femur", "tibia", "pelvis", "thoracic")
    mix: dict[str, float] = field(default_factory=_default_mix)
    pairs: int = 24_000
    batch: int = 8
    micro_batch: int = 4
    learning_rate: float = 5e-4
    weight_decay: float = 1e-4
    clip: float = 1.0
    warmup: float = 0.02
    final_rate: float = 0.01
    ema: float = 0.995
    pool: int = 128
    reuse: int = 16
    share: int = 2
    synthetic: float = 0.7
    seed: int = 0
    workers: int = 0
    precision: str = "float32"
    device: str = "auto"
    checkpoint_minutes: float = 3.0
    validate_minutes: float = 10.0
    validation_pairs: int = 8

    def __post_init__(self) -> None:
        if self.batch % self.micro_batch:
            raise ConfigError("a batch of whole micro-batches", f"{self.batch} and {self.micro_batch}", "make them fit")
        if self.precision not in ("float32", "bfloat16"):
            raise ConfigError("precision float32 or bfloat16", self.precision, "choose one")

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> TrainConfig:
        """The defaults with `values` over them.

        Raises:
            ConfigError: for a key that does not exist.
        """
        unknown = sorted(set(values) - {f.name for f in fields(cls)})
        if unknown:
            raise ConfigError("keys of TrainConfig", ", ".join(unknown), "mend the names")
        given: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in values.items()}
        return cls(**given)

    @classmethod
    def from_yaml(cls, path: str | Path) -> TrainConfig:
        """The defaults with a yaml's entries over them."""
        return cls.from_dict(yaml.safe_load(Path(path).read_text()) or {})

    def to_dict(self) -> dict[str, Any]:
        """All entries, as `from_dict` takes them."""
        return asdict(self)


@dataclass(frozen=True)
class Variant:
    """One row of a table: its label, the yaml of its network, and the paper's recall in % where it has one."""

    table: str
    label: str
    model: Path
    paper: float | None


def default_plan() -> Path:
    """config/ablation.yaml of the source tree, or where the package was installed with its data."""
    places = [Path(__file__).resolve().parents[2], Path(sysconfig.get_path("data")) / "share" / "gapr_ros"]
    found = [place / "config" / "ablation.yaml" for place in places if (place / "config" / "ablation.yaml").is_file()]
    if not found:
        raise ConfigError("config/ablation.yaml", "none installed", "name one with --plan")
    return found[0]


def read_plan(path: Path) -> list[Variant]:
    """The rows of all tables; paths relative to the working folder, so that they mean the same on another machine."""
    models = Path(os.path.relpath(path.resolve().parent / "model"))
    tables = yaml.safe_load(path.read_text())
    return [
        Variant(table, row["label"], models / f"{row['model']}.yaml", row.get("paper"))
        for table, rows in tables.items() for row in rows
    ]  # fmt: skip


def trained_as(plan: Sequence[Variant]) -> dict[Path, Path]:
    """For every yaml the first one with the same network: what is equal but for its name is trained once."""
    networks = {v.model: replace(ModelConfig.from_yaml(v.model), name="") for v in plan}
    return {path: next(p for p, other in networks.items() if other == network) for path, network in networks.items()}
