from __future__ import annotations

import numpy as np
import pytest
from shapes import knob_specimen

from gapr_core.data import picture
from gapr_core.surface import Surface


def test_the_picture_shows_the_outline_at_scale_with_the_left_side_on_the_right():
    shown = np.isfinite(picture.draw(knob_specimen().surface, picture.VIEWS["anterior"], mm_per_pixel=1.0).light)
    assert shown.sum() == pytest.approx(np.pi * (50.0**2 + 20.0**2), rel=0.03)  # the two balls, in pixels of 1 mm
    across = np.flatnonzero(shown.any(axis=0))
    assert shown[:, across[0] : across[0] + 100].sum() > shown[:, across[-1] - 35 :].sum()  # the knob is at +x


def test_points_behind_the_bone_are_hidden():
    surface = knob_specimen().surface
    seen = picture.draw(surface, picture.VIEWS["anterior"]).sees(np.array([[0.0, -60.0, 0.0], [0.0, 60.0, 0.0]]))
    assert seen.tolist() == [True, False]  # in front of the ball of 50 mm, and behind it


def test_a_cloud_is_drawn_as_the_body_that_its_points_are_on():
    surface = knob_specimen().surface
    cloud = Surface(surface.sample(6000, np.random.default_rng(0))[0])
    solid, discs = (~np.isnan(picture.draw(s, picture.VIEWS["left"], 1.0).light) for s in (surface, cloud))
    assert discs.sum() == pytest.approx(solid.sum(), rel=0.1)


def test_values_of_vertices_are_shown_where_they_are():
    surface = knob_specimen().surface
    drawn = picture.draw(surface, picture.VIEWS["anterior"], values=surface.points[:, 2])
    height = [row[np.isfinite(row)].mean() for row in drawn.values if np.isfinite(row).any()]
    assert np.all(np.diff(height) < 0.0)  # rows go down, z goes up
