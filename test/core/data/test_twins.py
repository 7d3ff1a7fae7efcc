"""Nobody of the train split is somebody of val or test under another name; and who is most like whom."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gapr_core.calibration.pairs import TWINS
from gapr_core.data import anatomy
from gapr_core.data.anatomy import Corresponded
from gapr_core.data.pool import parametric_specimen
from gapr_core.data.twins import most_similar, near_duplicates, without_size
from gapr_core.geometry import se3
from gapr_core.surface import Surface


def subjects(**changed):
    """Twelve made-up bones in correspondence, and what is made of the first one under another name."""
    rng = np.random.default_rng(0)
    mean = rng.normal(size=(300, 3)) * [80.0, 30.0, 20.0]
    points = [mean + 3.0 * rng.normal(size=mean.shape) for _ in range(12)]
    names = [f"p{i}" for i in range(12)]
    for name, change in changed.items():
        points.append(change(points[0]))
        names.append(name)
    return Corresponded(np.stack(points), np.zeros((1, 3), dtype=int), tuple(names), "femur", "made")


def test_a_copy_under_another_name_is_found_moved_mirrored_or_noisy():
    rng, turn = np.random.default_rng(1), Rotation.random(random_state=2)
    copies = {
        "moved": lambda p: turn.apply(p) + [50.0, -20.0, 300.0],
        "mirrored": lambda p: p * [-1.0, 1.0, 1.0],
        "noisy": lambda p: p + rng.normal(0.0, 0.5, p.shape),
    }
    for name, change in copies.items():
        assert [{t.first, t.second} for t in near_duplicates(subjects(**{name: change}))] == [{"p0", name}]


def test_different_subjects_are_no_duplicates_and_two_are_too_few_to_say():
    assert near_duplicates(subjects()) == []
    assert near_duplicates(subjects().of(["p0", "p1"])) == []


def test_no_real_subject_stands_in_two_splits_under_two_names(anatomy_folder):
    split_of = {person: split for split, people in anatomy.splits(anatomy_folder).items() for person in people}
    found = [
        t for bone in anatomy.BONES for c in anatomy.corresponded(anatomy_folder, bone) for t in near_duplicates(c)
    ]
    assert [t for t in found if split_of[t.first] != split_of[t.second]] == []
    assert found and all(any({t.first, t.second} <= known for known in TWINS) for t in found)


def test_the_most_similar_bones_are_of_others_and_grown_to_the_same_size():
    """Of tibiae that are wider by these factors, and then of another size."""
    tibia = parametric_specimen("tibia", 0)
    wider = {"own": 1.0, "near": 1.02, "far": 1.3, "farther": 1.5, "mesh": 1.01, "scan": 1.01, "femur": 1.01}
    sizes = dict.fromkeys(wider, 1.0) | {"near": 0.8, "far": 1.1}
    found = {}
    for person, factor in wider.items():
        points = sizes[person] * tibia.surface.points * [factor, 1.0, 1.0]
        found[person] = replace(tibia, surface=Surface(points, tibia.surface.faces), person=person, cohort="ct")
    more = np.vstack([found["mesh"].surface.points, [[0.0, 0.0, 0.0]]])
    found["mesh"] = replace(found["mesh"], surface=Surface(more, tibia.surface.faces))  # its vertices do not correspond
    found["scan"] = replace(found["scan"], cohort="another")
    found["femur"] = replace(found["femur"], bone="femur")
    alike = most_similar(found["own"], list(found.values()), 2)
    assert [other.person for other in alike] == ["near", "far"]
    for other in alike:
        assert np.ptp(other.surface.points[:, 2]) == pytest.approx(np.ptp(tibia.surface.points[:, 2]), rel=0.15)
    assert np.ptp(alike[0].surface.points[:, 2]) == pytest.approx(np.ptp(tibia.surface.points[:, 2]), rel=0.01)
    assert most_similar(found["scan"], list(found.values()), 2) == []


def test_a_similarity_leaves_what_neither_motion_nor_size_explains():
    points = np.random.default_rng(0).normal(size=(200, 3)) * [5.0, 3.0, 1.0]
    moved = se3.apply(se3.exp(np.array([9.0, 1.0, 2.0, 0.5, 1.0, -2.0])), 1.7 * points)
    off, size = without_size(points, moved)
    assert off == pytest.approx(0.0, abs=1e-6) and size == pytest.approx(1.7)
    centred = points - points.mean(axis=0)
    noise = np.random.default_rng(1).normal(size=points.shape) * 0.3
    noise -= noise.mean(axis=0)
    expected = np.sqrt((noise**2).sum() / ((centred + noise) ** 2).sum())
    assert without_size(centred, centred + noise)[0] == pytest.approx(expected, rel=0.05)
    assert without_size(points, points * [1.0, 1.0, -1.0])[0] > 0.2  # a mirror image is no motion
