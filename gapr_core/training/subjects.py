"""Whose bones a run really drew: counted while it trains, and an error as soon as one is held out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from gapr_core.data import anatomy
from gapr_core.data.pool import parametric_split
from gapr_core.errors import ConfigError
from gapr_core.runtime import files

RECORDS = "subjects_*.json"
WHAT = "subjects of a training run"


@dataclass
class Drawn:
    """Pairs for every subject who contributed to them; a shape model counts for everybody that it is made of.

    Attributes:
        path: of the record, JSON; one a process, of the names `RECORDS`.
        held_out: subjects of val and test.
        pairs: subject to how many pairs.
    """

    path: Path
    held_out: frozenset[str] = frozenset()
    pairs: Counter[str] = field(default_factory=Counter)

    @classmethod
    def of(cls, folder: Path | None, path: Path) -> Drawn:
        """Read an earlier call's record in `path`, or begin one; `folder` has the bones and splits.json."""
        people = anatomy.splits(folder) if folder else {"val": [], "test": []}
        known = files.read_json(path, WHAT) if path.exists() else {}
        return cls(path, frozenset([*people["val"], *people["test"]]), Counter(known))

    def add(self, subjects: Iterable[str]) -> None:
        """Count one batch.

        Raises:
            ConfigError: a subject of val or test is among them: the training would leak.
        """
        subjects = list(subjects)
        leaked = sorted({name for name in subjects if name in self.held_out or parametric_split(name) in HELD_OUT})
        if leaked:
            wanted = "subjects of the train split only"
            raise ConfigError(wanted, ", ".join(leaked), "the training pairs draw from held-out subjects: fix that")
        self.pairs.update(subjects)

    def write(self) -> None:
        """Write the record."""
        files.write_json(self.path, dict(sorted(self.pairs.items())))

    def count(self) -> int:
        """Count the subjects so far, by the files of the run's other processes as well."""
        others = (path for path in self.path.parent.glob(RECORDS) if path != self.path)
        return len(set(self.pairs).union(*(files.read_json(path, WHAT) for path in others)))


HELD_OUT = ("val", "test")


def check_validate(names: Iterable[str], folder: Path | None) -> None:
    """Raise `ConfigError` where somebody to validate on is not in the split val: a choice by test subjects leaks."""
    val = anatomy.splits(folder)["val"] if folder else []
    others = sorted({name for name in names if name not in val and parametric_split(name) != "val"})
    if others:
        raise ConfigError("subjects of the split val only", ", ".join(others), "the validation draws others: fix that")
