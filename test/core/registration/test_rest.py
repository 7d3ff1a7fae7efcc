"""A bone that creeps while its sources are collected: its first and last sources lie in two poses."""

from dataclasses import replace

import numpy as np
import pytest

from gapr_core import Accumulator, Registrar
from gapr_core.geometry import se3
from gapr_core.registration import rest

LIMIT = 22.5
MOVED = se3.exp([0.0, 2.0, 0.0, 0.0, 0.0, np.radians(3.0)])


@pytest.fixture(scope="module")
def seen(femur):
    """Points from all around the upper half of the bone with .3 mm of noise, another sample each time."""
    half = np.median(femur.points[:, 2])

    def of(seed, count=900):
        rng = np.random.default_rng(seed)
        points = femur.sample(3 * count, rng)[0]
        points = points[points[:, 2] > half][:count]
        return points + rng.normal(0.0, 0.3, points.shape)

    return of


def test_sources_of_a_bone_at_rest_lie_together(registrar, target, seen):
    found = [rest.apart(seen(n), seen(n + 50), np.eye(4), target, registrar.config) for n in range(6)]
    assert max(each.nees for each in found) < LIMIT
    assert max(each.shift_mm for each in found) < 0.5 and max(each.turn_deg for each in found) < 0.5


def test_sources_of_a_bone_that_moved_lie_as_far_apart_as_it_moved(registrar, target, seen):
    source = seen(2)
    away = se3.apply(MOVED, source) - source
    found = rest.apart(seen(1), source + away, np.eye(4), target, registrar.config)
    assert found.nees > 10.0 * LIMIT
    assert found.turn_deg == pytest.approx(3.0, abs=0.4)
    shift = se3.apply(MOVED, source.mean(axis=0)[None])[0] - source.mean(axis=0)
    assert found.shift_mm == pytest.approx(np.linalg.norm(shift), abs=0.6)


def test_the_distance_is_in_standard_deviations_of_both(registrar, target, seen):
    """With an uncertain stand-off the same two poses are nearer to each other."""
    sure, unsure = (
        replace(registrar.config, sensor=replace(registrar.config.sensor, standoff_mm=0.0, known_standoff_mm=mm))
        for mm in (0.001, 0.5)
    )
    first, last = seen(1), se3.apply(MOVED, seen(2))
    nearer, farther = (rest.apart(first, last, np.eye(4), target, config).nees for config in (unsure, sure))
    assert nearer < farther


def creeping(registrar, target, seen, step_mm, **settings):
    """Nine sources, each so much farther along y; the last answer."""
    accumulation = replace(registrar.config.accumulation, most_off=100, off=100.0, **settings)
    config = replace(registrar.config, accumulation=accumulation)
    accumulator = Accumulator(Registrar(config, registrar.proposers, registrar.calibrations), 9)
    for number in range(8):
        accumulator.collect(seen(number, 150) + [0.0, step_mm * number, 0.0])
    return accumulator, accumulator.register(seen(8, 150) + [0.0, step_mm * 8, 0.0], target)


@pytest.mark.parametrize(
    ("step_mm", "settings", "is_refused"),
    [
        (0.3, {"creep": LIMIT}, True),
        (0.0, {"creep": LIMIT}, False),
        (0.3, {}, False),
        (0.3, {"creep": LIMIT, "creep_points": 1000}, False),
    ],
)
def test_a_bone_that_creeps_is_refused_and_only_the_last_sources_stay(
    registrar, target, seen, step_mm, settings, is_refused
):
    accumulator, result = creeping(registrar, target, seen, step_mm, **settings)
    assert ("the bone moves; only the last are kept" in result.reason) is is_refused
    assert result.ok is not is_refused
    assert len(accumulator.collected) == (450 if is_refused else 1350)


@pytest.mark.parametrize(("share", "is_known"), [(1.0, True), (0.03, False)])
def test_a_part_whose_pose_is_hardly_known_says_nothing(registrar, target, seen, share, is_known):
    """A slab of 3 % of the length does not know how it is turned."""
    last = seen(2, 3000)
    last = last[last[:, 2] < np.quantile(last[:, 2], share)]
    found = rest.apart(seen(1), se3.apply(MOVED, last), np.eye(4), target, registrar.config)
    assert (found.nees > 0.0) is is_known
