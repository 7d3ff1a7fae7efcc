"""Did a bone move against the frame of its sources while they were collected: steadily, or once, as after a knock?

A bone that creeps moves the pose with time. How much the residuals speak for it: see `checks.unknowns`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gapr_core.registration.checks.unknowns import FEWEST_POINTS, NOTHING, Shown, blocks, motions, shown
from gapr_core.registration.fit.refinement import Fit

Array = NDArray[np.float64]

GROUPS = 6  # of sources in time, whose residuals are averaged apart


class Motion(NamedTuple):
    """Evidence of collected sources for a bone that moves.

    Attributes:
        shown: evidence of a steady motion or of a step, whichever is larger.
        rests_from: number of the first source since a step; None for a steady motion.
    """

    shown: Shown
    rests_from: int | None = None


def of_motion(fit: Fit, order: NDArray[np.int64]) -> Motion:
    """Test whether the bone moved while the points were collected: steadily, or once between two groups of sources.

    The size of a steady motion is that from the first source to the last.

    Args:
        fit: the pose that all points have in common.
        order: (N,) when each point was measured, as the number of its source: 0, 1, 2 and on.
    """
    inlier = fit.counts
    if np.count_nonzero(inlier) < FEWEST_POINTS or not order.max() > order.min():
        return Motion(NOTHING)
    time = ((order - order.min()) / (order.max() - order.min()))[inlier]
    steps = step_times(GROUPS)
    group = np.searchsorted(steps, time, side="right")
    moved = motions(fit)
    changes = [when[:, None] * moved for when in [time - 0.5, *(np.where(time < at, -0.5, 0.5) for at in steps)]]
    found = shown(blocks(fit, fit.jacobian[inlier], changes, group))
    any_of_steps = np.log(len(steps))  # each of them is as likely as the others, before the residuals
    ratios = [found[0].log_ratio, *(each.log_ratio - any_of_steps for each in found[1:])]
    best = int(np.argmax(ratios))
    if best == 0:
        return Motion(found[0])
    # a step in the first half of a group is found at the edge before it
    at = 0.5 * np.append(steps, 1.0)[best - 1 : best + 1].sum()
    rests_from = int(np.ceil(order.min() + at * (order.max() - order.min())))
    return Motion(Shown(ratios[best], found[best].size_mm), rests_from)


def step_times(groups: int) -> Array:
    """(groups,) shares of the time between groups: equal ones, the last of them halved, as the newest matter most."""
    return np.append(np.arange(1, groups), groups - 0.5) / groups
