from __future__ import annotations

from dataclasses import asdict, fields, replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from gapr_core.data import parametric
from gapr_core.data.bones.femur import FemurParameters, femur_surface
from gapr_core.data.bones.pelvis import PelvisParameters, pelvis_surface
from gapr_core.data.bones.thoracic import ThoracicParameters, thoracic_surface
from gapr_core.data.bones.tibia import TibiaParameters, tibia_surface
from gapr_core.data.parameters import draw
from gapr_core.data.solid import is_closed, skeleton, volume_mm3
from gapr_core.errors import ConfigError

PARAMETERS = (FemurParameters, TibiaParameters, PelvisParameters, ThoracicParameters)
SIZES_MM = {  # low and high of the extents, sorted: generous limits for adults
    "femur": ((50, 85, 380), (95, 140, 510)),
    "tibia": ((45, 65, 310), (80, 100, 440)),
    "pelvis": ((130, 180, 235), (190, 245, 320)),
    "thoracic": ((70, 220, 230), (175, 350, 350)),
}


@pytest.fixture(scope="module")
def bones():
    return {name: parametric.make_bone(name, 5) for name in parametric.BONES}


def sphere_fit(points):
    """Centre and radius that fit points (N, 3) best."""
    start = np.append(points.mean(axis=0), 25.0)
    fit = least_squares(lambda s: np.linalg.norm(points - s[:3], axis=1) - s[3], start)
    return fit.x[:3], fit.x[3]


@pytest.mark.parametrize("name", list(SIZES_MM))
def test_every_bone_is_one_closed_outward_surface_of_an_adults_size(bones, name):
    surface = bones[name]
    assert is_closed(surface.faces)
    assert volume_mm3(surface) > 0.0
    low, high = SIZES_MM[name]
    extents = np.sort(np.ptp(surface.points, axis=0))
    assert (extents > low).all() and (extents < high).all()
    assert len(surface.faces) < 26_000


@pytest.mark.parametrize("name", list(SIZES_MM))
def test_every_bone_is_one_piece(bones, name):
    labels, _, _ = bones[name].to_open3d().cluster_connected_triangles()
    assert set(np.asarray(labels)) == {0}


@pytest.mark.parametrize("name", ["tibia", "thoracic"])
def test_the_same_seed_gives_the_same_bone_and_another_seed_another_one(bones, name):
    again, other = parametric.make_bone(name, 5), parametric.make_bone(name, 6)
    np.testing.assert_array_equal(bones[name].points, again.points)
    apart, _ = cKDTree(other.points - other.points.mean(axis=0)).query(again.points - again.points.mean(axis=0))
    assert apart.mean() > 1.0


@pytest.mark.parametrize("parameters", PARAMETERS)
def test_a_thousand_people_are_all_different_and_within_the_ranges(parameters):
    people = [draw(parameters, np.random.default_rng(seed)) for seed in range(1000)]
    assert len(set(people)) == 1000
    for field in fields(parameters):
        values, (low, high) = np.array([getattr(p, field.name) for p in people]), field.metadata["range"]
        assert values.min() >= low and values.max() <= high
        assert values.std() > 0.2 * (high - low)


def test_big_people_have_big_bones_in_all_dimensions():
    people = [asdict(draw(FemurParameters, np.random.default_rng(seed))) for seed in range(1000)]
    column = {key: np.array([p[key] for p in people]) for key in people[0]}
    assert np.corrcoef(column["length_mm"], column["head_diameter_mm"])[0, 1] > 0.3
    assert abs(np.corrcoef(column["length_mm"], column["anteversion_deg"])[0, 1]) < 0.1


@pytest.mark.parametrize("diameter", [42.0, 52.0])
def test_the_femoral_head_is_a_ball_of_the_named_diameter(diameter):
    p = replace(FemurParameters(), head_diameter_mm=diameter, bow_mm=0.0, lateral_bow_mm=0.0)
    points = femur_surface(p).points
    highest = points[points[:, 0] < -p.offset_mm + 5.0]
    head = highest[highest[:, 2] > p.length_mm - 0.6 * diameter]
    _, radius = sphere_fit(head)
    assert 2.0 * radius == pytest.approx(diameter, abs=1.5)


def test_anteversion_turns_the_head_forward_and_the_neck_shaft_angle_raises_the_neck():
    def head(**changes):
        p = replace(FemurParameters(), bow_mm=0.0, lateral_bow_mm=0.0, **changes)
        points = femur_surface(p).points
        near = points[(points[:, 2] > p.length_mm - 25.0) & (points[:, 0] < -p.offset_mm * 0.8)]
        return sphere_fit(near)[0]

    straight, turned = head(anteversion_deg=2.0), head(anteversion_deg=25.0)
    angle = np.degrees(np.arctan2(-turned[1], -turned[0]) - np.arctan2(-straight[1], -straight[0]))
    assert angle == pytest.approx(23.0, abs=3.0)


def test_the_lengths_are_the_named_ones():
    for length in (400.0, 490.0):
        femur = femur_surface(replace(FemurParameters(), length_mm=length)).points
        assert np.ptp(femur[:, 2]) == pytest.approx(length, abs=8.0)
        tibia = tibia_surface(replace(TibiaParameters(), length_mm=length - 80.0, malleolus_mm=12.0)).points
        assert np.ptp(tibia[:, 2]) == pytest.approx(length - 80.0 + 12.0 + 6.0, abs=10.0)


def test_torsion_turns_the_malleolus_forward():
    def malleolus(torsion):
        points = tibia_surface(replace(TibiaParameters(), torsion_deg=torsion, bow_mm=0.0, recurvature_mm=0.0)).points
        tip = points[points[:, 2] < points[:, 2].min() + 4.0].mean(axis=0)
        return np.degrees(np.arctan2(-tip[1], -tip[0]))

    assert malleolus(40.0) - malleolus(15.0) == pytest.approx(25.0, abs=4.0)


def test_the_section_of_the_tibia_is_a_triangle_with_its_crest_in_front():
    p = replace(TibiaParameters(), torsion_deg=0.0, bow_mm=0.0, recurvature_mm=0.0)
    points = tibia_surface(p).points
    middle = points[np.abs(points[:, 2] - 0.6 * p.length_mm) < 4.0]
    front, back = middle[middle[:, 1] < -9.0], middle[middle[:, 1] > 5.0]
    assert np.ptp(front[:, 0]) < 0.85 * np.ptp(back[:, 0])


@pytest.mark.parametrize("diameter", [48.0, 58.0])
def test_the_acetabula_are_hollow_balls_of_the_named_diameter_at_the_named_distance(diameter):
    p = replace(PelvisParameters(), acetabulum_diameter_mm=diameter, asymmetry_mm=0.0)
    surface = pelvis_surface(p, np.random.default_rng(0), spacing_mm=3.0)
    centre = np.array([p.hip_distance_mm / 2.0, -38.0 * p.depth_mm / 162.0, -56.0 * p.height_mm / 209.0])
    apart = surface.points - centre
    roof = apart[(np.linalg.norm(apart, axis=1) < diameter / 2.0 + 2.0) & (apart[:, 2] > 4.0) & (apart[:, 0] > -10.0)]
    offset, radius = sphere_fit(roof)
    assert 2.0 * radius == pytest.approx(diameter, abs=2.5)
    assert np.linalg.norm(offset) < 2.5


def test_the_pelvis_has_a_ring_and_two_obturator_foramina():
    surface = pelvis_surface(PelvisParameters(), np.random.default_rng(0), spacing_mm=3.0)
    edges = np.sort(np.concatenate([surface.faces[:, [i, (i + 1) % 3]] for i in range(3)]), axis=1)
    euler = len(surface.points) - len(np.unique(edges, axis=0)) + len(surface.faces)
    handles = 1 - euler // 2
    assert handles >= 3  # the ring and the two foramina; sacral foramina may add more


def test_without_asymmetry_the_pelvis_is_its_own_mirror_image_and_with_it_is_not():
    def asymmetry(sd_mm):
        p = replace(PelvisParameters(), asymmetry_mm=sd_mm)
        points = pelvis_surface(p, np.random.default_rng(0), spacing_mm=3.0).points
        return np.median(cKDTree(points).query(points * [-1.0, 1.0, 1.0])[0])

    assert asymmetry(2.0) > asymmetry(0.0) + 0.3


def test_ten_cartilages_a_side_stand_out_from_the_sternum():
    p = replace(ThoracicParameters(), asymmetry_mm=0.0)
    points = thoracic_surface(p, np.random.default_rng(0), spacing_mm=3.0).points
    for side in (-1.0, 1.0):
        outward = side * points[:, 0]
        seen = [outward[np.abs(points[:, 2] - z) < 3.0].max() for z in range(-150, -20, 2)]
        peaks = [z for z in range(1, len(seen) - 1) if seen[z - 1] < seen[z] >= seen[z + 1]]
        assert len(peaks) >= 3  # the upper ribs, seen as separate tips
    xiphoid = points[np.abs(points[:, 0]) < 5.0]
    assert xiphoid[:, 2].min() > points[:, 2].min() + 40.0  # the arch opens below it


def test_an_unknown_bone_is_refused():
    with pytest.raises(ConfigError, match="femur, tibia, pelvis, thoracic"):
        parametric.make_bone("humerus", 0)


def test_a_medial_sheet_is_seen_from_its_two_nearest_samples():
    rng = np.random.default_rng(0)
    centres, radii = rng.uniform(0.0, 30.0, (60, 3)), rng.uniform(1.0, 4.0, 60)
    x, y, z = (np.arange(-12.0, 45.0, step, dtype=np.float32) for step in (1.5, 1.7, 1.3))
    found = skeleton(centres, radii).distance(x[None, None], y[None, :, None], z[:, None, None])
    places = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).transpose(2, 1, 0, 3)
    limit = radii.max() + 8.0
    apart, nearest = cKDTree(centres).query(places, k=2, distance_upper_bound=limit)
    wanted = np.where(np.isfinite(apart), apart - np.append(radii, 0.0)[nearest], limit).min(axis=-1)
    assert (wanted == limit).any()
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-5)
