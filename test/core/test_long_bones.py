"""Several long bones in one mesh file: said where two bodies are read as one, and nowhere else."""

import numpy as np
import pytest

from gapr_core import clouds
from gapr_core.data.parametric import make_bone
from gapr_core.geometry import long_bones
from gapr_core.surface import Surface


def joined(*surfaces):
    starts = np.cumsum([0, *(len(each.points) for each in surfaces)])
    faces = [each.faces + start for each, start in zip(surfaces, starts, strict=False)]
    return Surface(np.vstack([each.points for each in surfaces]), np.vstack(faces))


def moved(surface, by=(0.0, 0.0, 0.0), sizes=(1.0, 1.0, 1.0)):
    middle = surface.points.mean(axis=0)
    return Surface((surface.points - middle) * sizes + middle + by, surface.faces)


def lengths_of(surface):
    return long_bones.separate_long_bones(surface.points, surface.faces, surface.face_areas_mm2)


FEMUR, TIBIA, PELVIS = make_bone("femur", 0), make_bone("tibia", 0), make_bone("pelvis", 0)
DEBRIS = moved(FEMUR, (120.0, 0.0, 0.0), (0.1, 0.1, 0.1))


@pytest.mark.parametrize(
    "surface",
    [
        joined(FEMUR, moved(TIBIA, (150.0, 0.0, -400.0))),
        joined(FEMUR, moved(TIBIA, (150.0, 0.0, -400.0)), DEBRIS),
        joined(moved(TIBIA, (45.0, 0.0, 0.0), (0.4, 0.4, 0.95)), moved(TIBIA, (0.0, 0.0, 0.0), (0.4, 0.4, 1.0))),
    ],
    ids=["a knee", "with debris", "a forearm"],
)
def test_two_long_bones_are_found_with_their_lengths(surface):
    lengths = lengths_of(surface)
    assert len(lengths) == 2 and all(300.0 < length < 520.0 for length in lengths)


@pytest.mark.parametrize(("count", "found"), [(3, 3), (4, 4), (5, 0)])
def test_up_to_four_long_bones_are_found_and_more_are_a_hand_or_a_foot(count, found):
    lengths = lengths_of(joined(*(moved(TIBIA, (90.0 * number, 0.0, 0.0)) for number in range(count))))
    assert len(lengths) == found and np.ptp([350.0, *lengths]) < 2.0


@pytest.mark.parametrize(
    "surface",
    [
        FEMUR,
        joined(FEMUR, DEBRIS, moved(DEBRIS, (0.0, 60.0, 0.0))),
        joined(FEMUR, moved(FEMUR, sizes=(0.7, 0.7, 0.9))),
        joined(PELVIS, moved(PELVIS, (300.0, 0.0, 0.0))),
        joined(*(moved(PELVIS, (0.0, 300.0 * side, 0.0), (1.0, 0.2, 1.0)) for side in (0, 1))),
        joined(*(moved(PELVIS, (150.0 * side, 0.0, 0.0), (0.5, 1.0, 1.0)) for side in (-1, 0, 1))),
        joined(*(moved(TIBIA, (0.0, 40.0 * rib, 0.0), (0.1, 0.1, 0.4)) for rib in range(24))),
        joined(FEMUR, moved(FEMUR, (150.0, 0.0, 0.0), (0.3, 0.3, 0.3))),
    ],
    ids=["one bone", "debris", "inner cortex", "two hips", "two plates", "pelvis in parts", "rib cage", "small bone"],
)
def test_what_is_one_body_is_left_alone(surface):
    assert lengths_of(surface) == []


@pytest.mark.parametrize(("bodies", "warned"), [([FEMUR], False), ([FEMUR, moved(TIBIA, (150, 0, -400))], True)])
def test_a_mesh_file_of_two_bones_is_read_with_one_warning_that_says_what_to_do(tmp_path, caplog, bodies, warned):
    surface = joined(*bodies)
    np.savez(tmp_path / "knee.npz", points=surface.points / 1000.0, faces=surface.faces)
    assert len(clouds.load(tmp_path / "knee.npz", units="m").points) == len(surface.points)
    assert (
        "knee.npz holds 2 separate long parts, of 497 mm and 350 mm: they are registered as one" in caplog.text
    ) is warned
    assert ("a file of its own" in caplog.text) is warned and len(caplog.records) == warned
