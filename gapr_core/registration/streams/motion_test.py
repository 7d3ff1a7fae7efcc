"""Test for a motion of the bone while its sources were collected: steady, or one step, as after a knock.

A bone that creeps moves the pose with time. The evidence in the residuals: see `checks.unknowns`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gapr_core.registration.checks.unknowns import FEWEST_POINTS, NOTHING, Shown, blocks, motions, shown
from gapr_core.registration.fit.refinement import Fit

Array = NDArray[np.float64]

GROUPS = 6  # groups of sources in time, averaged apart


class Motion(NamedTuple):
    """Evidence of collected sources for a bone that moves.

    Attributes:
        shown: evidence of a steady motion or of a step, whichever is larger.
        rests_from: number of the first source since a step; None for a steady motion.
    """

    shown: Shown
    rests_from: int | None = None


def of_motion(fit: Fit, order: NDArray[np.int64]) -> Motion:
    """Test whether the bone moved during the collection: steadily, or once between two groups of sources.

    Args:
        fit: common pose of all points.
        order: (N,) number of each point's source in time: 0, 1, 2 and on.
    """
    inlier = fit.counts
    if np.count_nonzero(inlier) < FEWEST_POINTS or not order.max() > order.min():
        return Motion(NOTHING)
    time = ((order - order.min()) / (order.max() - order.min()))[inlier]
    steps = step_times(GROUPS)
    group = np.searchsorted(steps, time, side="right")
    moved = motions(fit)
    changes = [when[:, None] * moved for when in [time - 0.5, *(np.where(time < at, -0.5, 0.5) for at in steps)]]
    evidence = shown(blocks(fit, fit.jacobian[inlier], changes, group))
    any_of_steps = np.log(len(steps))  # all are equally likely before the residuals
    ratios = [evidence[0].log_ratio, *(each.log_ratio - any_of_steps for each in evidence[1:])]
    best = int(np.argmax(ratios))
    if best == 0:
        return Motion(evidence[0])
    # a step in the first half of a group is found at the edge before it
    at = 0.5 * np.append(steps, 1.0)[best - 1 : best + 1].sum()
    rests_from = int(np.ceil(order.min() + at * (order.max() - order.min())))
    return Motion(Shown(ratios[best], evidence[best].size_mm), rests_from)


def step_times(groups: int) -> Array:
    """Compute (groups,) times between groups, as shares: equal ones, the last halved, as the newest matter most."""
    return np.append(np.arange(1, groups), groups - 0.5) / groups
