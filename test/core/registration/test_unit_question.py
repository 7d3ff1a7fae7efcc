"""A cloud in cm that is read as mm is refused, and the reason asks for its unit."""

from dataclasses import replace

import numpy as np
import pytest

from gapr_core import Registrar
from gapr_core.registration.checks import rules
from gapr_core.results import Refusal, RegistrationStatus

LINE = Refusal(RegistrationStatus.DEGENERATE, "the source is a line")


def cloud_of(extent_mm):
    return np.array([[0.0, 0.0, 0.0], [0.0, 0.0, extent_mm]])


@pytest.mark.parametrize(
    ("extent_mm", "unit"),
    [(40.0, "cm"), (6.0, "cm"), (0.4, "m"), (1.5, ""), (100.0, ""), (400.0, "")],
    ids=["whole bone in cm", "short scan in cm", "in m", "too small in cm", "too large in cm", "whole bone in mm"],
)
def test_a_unit_is_asked_for_where_the_cloud_would_have_the_size_of_the_bone_in_it(extent_mm, unit):
    refusal = rules.asking_the_unit(LINE, cloud_of(extent_mm), cloud_of(400.0))
    asks = f"; the cloud is {extent_mm:.3g} mm across, the bone 400 mm: is the cloud in {unit}?" if unit else ""
    assert refusal == Refusal(RegistrationStatus.DEGENERATE, f"the source is a line{asks}")


@pytest.mark.parametrize("status", [s for s in RegistrationStatus if s is not RegistrationStatus.DEGENERATE])
def test_other_refusals_are_left_alone(status):
    other = Refusal(status, "why")
    for source in (cloud_of(40.0), np.empty((0, 3))):
        assert rules.asking_the_unit(other, source, cloud_of(400.0)) is other


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_a_bone_in_cm_is_refused_with_the_question_and_the_same_bone_in_mm_is_not(registrar, femur, target, share):
    """A short piece is a line in cm, and a longer one is not: both are asked."""
    points, normals = femur.sample(12_000, np.random.default_rng(5))
    seen = points[normals @ [0.0, 1.0, 0.0] > 0.3]
    seen = seen[seen[:, 2] > np.quantile(seen[:, 2], 1.0 - share)]
    refused = registrar.register(seen / 10.0, target)
    assert refused.status is RegistrationStatus.DEGENERATE and refused.T_target_source is None
    assert refused.reason.endswith(": is the cloud in cm?")
    assert registrar.register(seen, target).ok


def test_both_ways_to_be_degenerate_are_asked(registrar, target):
    ball = np.random.default_rng(0).normal(size=(500, 3))
    line, blob = ball * [0.1, 0.1, 8.0], 12.0 * ball / np.linalg.norm(ball, axis=1)[:, None]
    reasons = [registrar.register(source, target).reason for source in (line, blob)]
    assert "a line" in reasons[0] and "the rotation about" in reasons[1]
    assert all("is the cloud in cm?" in reason for reason in reasons)


@pytest.mark.parametrize("is_scene", [False, True])
def test_a_part_found_in_a_scene_is_not_asked_for_its_unit(registrar, femur_cloud, target, monkeypatch, is_scene):
    answer = registrar.assess(femur_cloud, target)
    refused = replace(answer, refusal=LINE, seen=answer.source if is_scene else None)
    monkeypatch.setattr(Registrar, "_in_scene" if is_scene else "_as_bone", lambda *_: refused)
    monkeypatch.setattr(Registrar, "_of_one_view", lambda *_: None)
    viewpoint = [0.0, -500.0, 0.0] if is_scene else None
    found = registrar.register(femur_cloud / 10.0, target, viewpoint=viewpoint)
    assert found.status is RegistrationStatus.DEGENERATE
    assert ("is the cloud in cm?" in found.reason) is not is_scene
