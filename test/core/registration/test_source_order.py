"""In which order the points of a source are taken: those in the middle of their neighbours first."""

import numpy as np

from gapr_core.config import SourceConfig
from gapr_core.registration.problem import source as sources


def test_points_at_the_border_of_a_patch_are_none_of_the_first():
    """Their neighbours lie on one side, so that their normals are the worst."""
    across = np.random.default_rng(0).uniform(0.0, 60.0, (900, 2))
    described = sources.describe(np.column_stack([across, 0.01 * (across[:, 0] - 30.0) ** 2]), SourceConfig())
    inside_mm = np.minimum(across, 60.0 - across).min(axis=1)
    first, last = described.order[: sources.SPREAD_OUT], described.order[sources.SPREAD_OUT :]
    assert inside_mm[first].min() > 2.0 and np.count_nonzero(inside_mm[last] < 2.0) > 100
    assert np.ptp(described.points[first], axis=0)[:2].min() > 50.0, "and even so spread over the whole patch"
