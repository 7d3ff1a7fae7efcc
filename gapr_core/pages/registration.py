"""One registration, as its page and its files show it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from gapr_core.formats.planning import TargetError
    from gapr_core.results import Patch, RegistrationResult
    from gapr_core.surface import Surface


@dataclass(frozen=True, eq=False)
class Registration:
    """What was registered, and what came of it.

    Attributes:
        target: the bone, mm.
        source: (N, 3) the source as read, source frame, mm.
        result: of registering them.
        errors: of the planned targets; none without a plan or a pose.
        spots: the patches to look at next, the best first; none without guidance.
    """

    target: Surface
    source: NDArray[np.float64]
    result: RegistrationResult
    errors: Sequence[TargetError] = ()
    spots: Sequence[Patch] = ()
