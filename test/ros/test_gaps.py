"""Clouds that the middleware lost, detected from the numbers of their publishers."""

from __future__ import annotations

import pytest

from gapr_ros.node.diagnostics import Gaps


@pytest.mark.parametrize(
    ("numbers", "lost"),
    [
        ([1, 2, 3, 4], 0),
        ([7, 8, 9], 0),
        ([1, 2, 5], 2),
        ([1, 3, 5, 7], 3),
        ([100, 1, 101, 2, 102, 3], 0),
        ([100, 1, 103, 2, 104, 5], 4),
        ([50, 51, 1, 2, 3], 0),
        (list(range(1, 200)), 0),
    ],
    ids=["none", "joined late", "a gap", "every second", "two publishers", "two with gaps", "a new publisher", "many"],
)
def test_missing_numbers_are_counted_for_each_publisher(numbers, lost):
    gaps = Gaps()
    assert sum(gaps.note(number) for number in numbers) == lost


def test_publishers_that_came_and_went_are_forgotten():
    gaps = Gaps()
    for start in range(1000, 0, -10):
        gaps.note(start)
    assert len(gaps._last) == Gaps.MOST_PUBLISHERS
