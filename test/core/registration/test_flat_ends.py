"""Models that end in a plane: the border of a scan, a planned cut, a table. A saw cut must not be laid on it."""

import logging

import numpy as np
import pytest

from gapr_core import Registrar, RegistrarConfig, Surface
from gapr_core.config import TargetConfig
from gapr_core.data.specimen import Specimen
from gapr_core.geometry import se3
from gapr_core.geometry.flat_ends import OF_POINT, flat_ends
from gapr_core.registration.problem import target as targets

UP = np.array([0.0, 0.0, 1.0])
KEEP = TargetConfig(flat_end_mm2=0.0)


def cut(bone, z_mm):
    """The part of a bone below a plane, closed by it."""
    return Specimen(bone, "femur", "parametric-3").cut(UP, z_mm).surface


def spread(surface):
    """Points and outward normals as they are prepared, and the distance between neighbours."""
    prepared = targets.prepare(surface, config=KEEP)
    return prepared.points, prepared.normals, prepared.spacing_mm


@pytest.fixture(scope="module")
def middle_mm(femur):
    return float(np.quantile(femur.points[:, 2], 0.5))


@pytest.fixture(scope="module")
def cut_femur(femur, middle_mm):
    return cut(femur, middle_mm)


def test_a_cut_through_the_shaft_is_a_flat_end_and_its_edge_goes_with_it(cut_femur, middle_mm):
    points, normals, spacing_mm = spread(cut_femur)
    found = flat_ends(points, normals, spacing_mm, 200.0)
    height = points[:, 2]
    assert found[(height > middle_mm - 0.02) & (normals @ UP > 0.9)].all()
    assert height[found].min() > middle_mm - 2.5
    across = np.ptp(points[height > middle_mm - 0.02], axis=0)[:2]
    area = 0.25 * np.pi * across[0] * across[1]
    assert OF_POINT * spacing_mm**2 * found.sum() == pytest.approx(area, rel=0.35)


@pytest.mark.parametrize("least_mm2", [100.0, 200.0, 5000.0])
def test_an_end_smaller_than_asked_for_is_bone(cut_femur, least_mm2):
    points, normals, spacing_mm = spread(cut_femur)
    found = flat_ends(points, normals, spacing_mm, least_mm2)
    assert found.any() == (least_mm2 < 1000.0)


@pytest.mark.parametrize("turn", [[0.3, -0.2, 0.9], [1.2, 0.4, -2.0]])
def test_an_end_is_found_in_any_frame(cut_femur, turn):
    points, normals, spacing_mm = spread(cut_femur)
    expected = flat_ends(points, normals, spacing_mm, 200.0)
    T = se3.exp(np.array([100.0, -900.0, 40.0, *turn]), np.zeros(3))
    found = flat_ends(se3.apply(T, points), normals @ T[:3, :3].T, spacing_mm, 200.0)
    assert (found != expected).sum() <= 0.02 * expected.sum()


def test_two_ends_are_found(cut_femur, femur):
    low = float(np.quantile(femur.points[:, 2], 0.2))
    mirror = np.array([1.0, 1.0, -1.0])
    both = cut(Surface(cut_femur.points * mirror, cut_femur.faces[:, ::-1]), -low)
    points, normals, spacing_mm = spread(both)
    found = flat_ends(points, normals, spacing_mm, 200.0)
    for end in (points[:, 2] < points[:, 2].min() + 0.02, points[:, 2] > points[:, 2].max() - 0.02):
        assert end.sum() > 20 and found[end].all()
    assert found[np.abs(normals @ UP) < 0.5].mean() < 0.01


def test_bones_have_no_flat_end(anatomy_folder):
    from gapr_core.data.pool import specimens

    for bone in ("femur", "tibia", "pelvis", "thoracic"):
        for specimen in specimens(bone, "val", 3, anatomy_folder):
            assert not flat_ends(*spread(specimen.surface), 200.0).any(), specimen.person


def test_neither_a_sphere_nor_a_cylinder_is_flat_at_its_end():
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(8000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    assert not flat_ends(60.0 * ball, ball, 2.0, 100.0).any()
    round_wall = ball * [1.0, 1.0, 0.0]
    round_wall /= np.linalg.norm(round_wall, axis=1, keepdims=True)
    wall = 20.0 * round_wall + np.outer(rng.uniform(-60.0, 60.0, 8000), UP)
    assert not flat_ends(wall, round_wall, 1.3, 100.0).any()


def test_the_highest_step_of_voxels_is_no_end(monkeypatch):
    """1 mm voxels make a plane of 250 mm^2 on top of a ball of 40 mm; the next ones face the same way."""
    ball = np.random.default_rng(0).normal(size=(20_000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    steps = 40.0 * ball
    steps[:, 2] = np.floor(steps[:, 2] + 0.001)
    spacing_mm = np.sqrt(4.0 * np.pi * 40.0**2 / 20_000 / OF_POINT)
    assert not flat_ends(steps, ball, spacing_mm, 150.0).any()
    monkeypatch.setattr("gapr_core.geometry.flat_ends.MOST_STAIRS", np.inf)
    assert flat_ends(steps, ball, spacing_mm, 150.0).any(), "nothing else knows it"


def test_a_plane_with_the_noise_of_a_scanner_is_no_border_of_a_scan(cut_femur):
    points, normals, spacing_mm = spread(cut_femur)
    noisy = points + np.random.default_rng(1).normal(0.0, 0.1, points.shape)
    assert not flat_ends(noisy, normals, spacing_mm, 200.0).any()


@pytest.mark.parametrize("burr_mm", [0.12, 0.2])
def test_a_single_point_above_an_end_does_not_tilt_its_plane(cut_femur, burr_mm):
    points, normals, spacing_mm = spread(cut_femur)
    expected = flat_ends(points, normals, spacing_mm, 200.0)
    burr = np.flatnonzero(expected & (normals @ UP > 0.9))[20]
    points[burr] += burr_mm * UP
    assert np.array_equal(flat_ends(points, normals, spacing_mm, 200.0), expected)


def test_the_end_of_a_hollow_bone_is_left_out_of_both_its_targets(cut_femur, middle_mm):
    points, normals = cut_femur.sample(12_000, np.random.default_rng(1))
    inner = (np.arange(len(points)) % 5 < 2) & (normals @ UP < 0.9)
    prepared = targets.prepare(points - 4.0 * normals * inner[:, None])
    for each in (prepared, prepared.both_cortices):
        assert not (each.points[:, 2] > middle_mm - 0.02).any() and len(each.points) > 5000


def test_the_end_is_left_out_of_the_target_with_a_warning_that_says_how_to_keep_it(cut_femur, middle_mm, caplog):
    with caplog.at_level(logging.WARNING):
        prepared = targets.prepare(cut_femur)
    assert "flat ends" in caplog.text and "target.flat_end_mm2=0" in caplog.text
    assert not ((prepared.normals @ UP > 0.9) & (prepared.points[:, 2] > middle_mm - 0.02)).any()
    assert len(prepared.surface.points) == len(cut_femur.points), "what is drawn stays whole"
    caplog.clear()
    kept = targets.prepare(cut_femur, config=KEEP)
    assert "flat ends" not in caplog.text and len(kept.points) > len(prepared.points)


def test_a_table_below_the_bone_goes_face_by_face(femur):
    import open3d as o3d

    low, high = femur.points.min(axis=0), femur.points.max(axis=0)
    box = o3d.geometry.TriangleMesh.create_box(np.ptp(femur.points[:, 0]) + 80.0, 10.0, high[2] - low[2] + 40.0)
    corners = np.asarray(box.vertices) + [low[0] - 40.0, low[1] - 25.0, low[2] - 20.0]
    faces = np.vstack([femur.faces, np.asarray(box.triangles) + len(femur.points)])
    prepared = targets.prepare(Surface(np.vstack([femur.points, corners]), faces))
    assert (prepared.points[:, 1] > low[1] - 1.0).mean() > 0.99


def test_a_body_of_planes_keeps_them():
    """A calibration block has nothing else."""
    rng = np.random.default_rng(2)
    faces = rng.integers(0, 6, 9000)
    points = rng.uniform(-1.0, 1.0, (9000, 3))
    points[np.arange(9000), faces % 3] = np.where(faces < 3, 1.0, -1.0)
    prepared = targets.prepare(points * [40.0, 30.0, 20.0])
    assert len(prepared.points) > 5000
    assert np.abs(prepared.points).max(axis=0) == pytest.approx([40.0, 30.0, 20.0], abs=0.1)


def test_a_saw_cut_is_not_laid_on_the_border_of_the_scan(femur):
    """The cut lies 5 mm from the border. Only this rule keeps it off."""
    border_mm = float(np.quantile(femur.points[:, 2], 0.8))
    sawn = Specimen(femur, "femur", "parametric-3").cut(UP, border_mm - 5.0)
    rng = np.random.default_rng(5)
    points, normals = sawn.sample(60_000, rng)
    towards = np.array([0.5, -0.7, 0.5]) / np.linalg.norm([0.5, -0.7, 0.5])
    near = (points[:, 2] > border_mm - 40.0) & (normals @ towards > 0.2)
    seen = points[near][sawn.visible_from(points[near], towards)][:3000]
    source = seen + rng.normal(0.0, 0.2, seen.shape)
    answers = []
    for config in (RegistrarConfig(num_threads=1), RegistrarConfig(num_threads=1, target=KEEP)):
        registrar = Registrar.from_pretrained(config)
        answers.append(registrar.register(source, registrar.prepare(cut(femur, border_mm))))
    right, on_border = answers
    assert right.ok and se3.pose_error(right.T_target_source, np.eye(4), seen).rte_mm < 1.0
    assert on_border.ok and se3.pose_error(on_border.T_target_source, np.eye(4), seen).rte_mm > 4.0
