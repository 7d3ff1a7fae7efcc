"""Where a cloud was seen from: what the halves of an image, and both ends of a line of sight, have to say together."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gapr_core.geometry import one_view, pinhole


@pytest.mark.parametrize(
    "half", [None, np.s_[:, :40], np.s_[:, 40:], np.s_[:30], np.s_[30:]], ids=["", "left", "right", "top", "bottom"]
)
def test_an_image_of_which_one_half_could_have_been_seen_from_anywhere_shows_no_camera(half):
    row, column = np.mgrid[:60, :80]
    x, y = (column - 36.0) / 90.0, (row - 33.0) / 90.0
    depth = 450.0 + 40.0 * np.sin(9.0 * x) * np.cos(7.0 * y)
    if half is not None:
        depth[half] = 450.0
    found = pinhole.centre_of(np.stack([x * depth, y * depth, depth], axis=2) + [100.0, 50.0, -400.0])
    assert found is None if half is not None else found == pytest.approx([100.0, 50.0, -400.0], abs=1e-6)


def test_a_surface_that_bulges_counts_for_more_than_points_that_are_hidden():
    """A dome next to a plate 60 mm above a denser one: from above more is hidden, from below the dome is hollow."""

    def square(half_mm, step_mm, z_mm):
        x, y = np.meshgrid(*[np.arange(-half_mm, half_mm + 1e-6, step_mm)] * 2)
        return np.stack([x.ravel(), y.ravel(), np.full(x.size, z_mm)], axis=1)

    dome = square(30.0, 1.5, 0.0)
    dome[:, 2] = np.sqrt(60.0**2 - (dome[:, :2] ** 2).sum(axis=1))
    dome = dome[dome[:, 2] > 60.0 * np.cos(np.radians(30.0))]
    plates = np.vstack([square(30.0, 1.5, 60.0), square(29.5, 1.0, 0.0)])
    points = np.vstack([plates, dome + [120.0, 0.0, -60.0]])
    normals = np.vstack([np.tile([0.0, 0.0, 1.0], (len(plates), 1)), dome / 60.0])
    around = cKDTree(points).query(points, k=20)[1]
    view = one_view.seen_from_one_place(points, normals, around, np.arange(len(points)), 1.5)
    above, below = view.viewpoints
    assert above[2] > 400.0 and below[2] < -400.0
    hidden = 1.0 - np.array([one_view.visible_share(points, normals, each, 1.5) for each in view.viewpoints])
    assert hidden[0] > hidden[1] + 0.2
