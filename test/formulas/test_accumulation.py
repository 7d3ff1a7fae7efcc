"""How far a collected source lies off the bone."""

import numpy as np
import pytest
import tiny

from gapr_core.registration.streams.accumulator import _typical_distance_mm


def test_what_lies_beyond_the_end_of_the_surface_is_as_far_off_it_as_what_lies_above():
    target = tiny.plane()
    inside = np.zeros((50, 3))
    assert _typical_distance_mm(np.eye(4), inside + [0.0, 0.0, 3.0], target) == pytest.approx(3.0, abs=0.05)
    edge = target.points[:, 0].max()
    beyond = [_typical_distance_mm(np.eye(4), inside + [edge + mm, 0.0, 0.0], target) for mm in (5.0, 6.0)]
    assert beyond[1] - beyond[0] == pytest.approx(1.0, abs=0.05)  # an element reaches a little beyond its point
