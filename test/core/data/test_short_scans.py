"""Scans that hold one end of a bone."""

import numpy as np
import pytest

from gapr_core.data.pool import parametric_specimen


@pytest.fixture(scope="module")
def tibia():
    return parametric_specimen("tibia", 2)


@pytest.mark.parametrize("upper", [False, True])
def test_an_end_of_a_bone_is_that_share_of_its_length_on_that_side_and_closed(tibia, upper):
    end = tibia.end(0.3, upper)
    whole, cut = tibia.surface.points[:, 2], end.surface.points[:, 2]
    assert np.ptp(cut) == pytest.approx(0.3 * np.ptp(whole), rel=0.1)
    assert (cut.max() == whole.max(), cut.min() == whole.min()) == (upper, not upper)
    assert end.surface.to_open3d().is_edge_manifold(allow_boundary_edges=False)
    assert (end.bone, end.person) == (tibia.bone, tibia.person)
