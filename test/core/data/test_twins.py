"""Nobody of the train split is somebody of val or test under another name."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from gapr_core.calibration.pairs import TWINS
from gapr_core.data import anatomy
from gapr_core.data.anatomy import Corresponded
from gapr_core.data.twins import near_duplicates


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
    assert all(any({t.first, t.second} <= known for known in TWINS) for t in found)
