"""The interface of every proposer of pose hypotheses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Proposals:
    """Pose hypotheses, best first.

    Attributes:
        poses: (K, 4, 4) float64 T_target_source, mm.
        scores: (K,) the proposer's own measure, larger is better; comparable within one proposer only.
    """

    poses: Array
    scores: Array


class Proposer(Protocol):
    """Suggests poses; verification decides. A right one among many wrong ones is a success."""

    @property
    def name(self) -> str:
        """Name in tables and logs."""
        ...

    def prepare(self, target: PreparedTarget) -> object:
        """Prepare a target, so that the first `propose` is as fast as later ones; kept in its `cache`."""
        ...

    def propose(self, source: PreparedSource, target: PreparedTarget, rng: np.random.Generator) -> Proposals:
        """Propose hypotheses for one pair; may be empty."""
        ...
