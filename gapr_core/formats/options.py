"""Options of a reader in addition to the path."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from numbers import Integral
from typing import Any

from gapr_core.errors import ConfigError
from gapr_core.formats.limits import FileLimits

LABEL = (str, Integral)


@dataclass(frozen=True)
class ReadOptions:
    """How to read a file; each format takes its own.

    Attributes:
        axes: axes of a mesh or cloud file: "lps", "ras" (turned to LPS), "as_is", "lps_to_ras" (a file in LPS, turned
            to RAS), or "auto": the file's `SPACE=` comment or columns l p s or r a s, as_is without them. Those of a
            tracker's points as well.
        labels: names or numbers of the segments of a label map that make up one rigid target, or one of them; none
            where it has one.
        tip_mm: (3,) the tip of a pointer in the frame of its marker, for recordings of tracked tools.
        tool: which of the tools of a recording, from 0; None where it has one.
        reference: the tool of a recording in whose frame the points are, from 0; None for the tracker's frame.
        topic: of the clouds in a bag; empty where it has one such topic.
        clouds: (first, last) of the clouds of that topic, as in a slice; all of them are joined.
        limits: how large the file may be.
    """

    axes: str = "auto"
    labels: tuple[str, ...] = ()
    tip_mm: tuple[float, float, float] | None = None
    tool: int | None = None
    reference: int | None = None
    topic: str = ""
    clouds: tuple[int | None, int | None] = (None, None)
    limits: FileLimits = field(default_factory=FileLimits.from_environment)

    def __post_init__(self) -> None:
        """Labels become texts; one by itself is no list of its letters.

        Raises:
            ConfigError: labels that are neither names nor whole numbers.
        """
        labels: Any = (self.labels,) if isinstance(self.labels, LABEL) else self.labels
        labels = tuple(labels) if isinstance(labels, Iterable) else (labels,)
        if not all(isinstance(label, LABEL) for label in labels):
            how = "pass labels=('Femur',), or numbers"
            raise ConfigError("labels that are names or whole numbers", repr(self.labels), how)
        object.__setattr__(self, "labels", tuple(map(str, labels)))
