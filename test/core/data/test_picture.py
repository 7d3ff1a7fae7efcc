from __future__ import annotations

import numpy as np
import pytest
from shapes import knob_specimen

from gapr_core.data import picture


def test_the_picture_shows_the_outline_at_scale_with_the_left_side_on_the_right():
    image = picture.shade(knob_specimen().surface, "anterior", mm_per_pixel=1.0)
    shown = (image < 250).any(axis=2)
    assert shown.sum() == pytest.approx(np.pi * (50.0**2 + 20.0**2), rel=0.03)  # the two balls, in pixels of 1 mm
    across = np.flatnonzero(shown.any(axis=0))
    assert shown[:, across[0] : across[0] + 100].sum() > shown[:, across[-1] - 35 :].sum()  # the knob is at +x


def test_views_stand_side_by_side():
    one, two = (
        picture.strip(knob_specimen().surface, ("anterior",)),
        picture.strip(knob_specimen().surface, ("anterior", "superior")),
    )
    assert two.shape[1] > one.shape[1] and two.shape[0] == one.shape[0]
