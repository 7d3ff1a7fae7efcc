"""What one look-up of the neighbours gives is what separate ones give."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gapr_core.config import SourceConfig
from gapr_core.geometry import quadrics, sampling
from gapr_core.geometry.planes import fit_planes
from gapr_core.registration.problem import source as sources

CONFIG = SourceConfig(isolated_mm=1.0)


def cloud(isolated=0, count=900):
    rng = np.random.default_rng(0)
    u, v = rng.uniform(0.0, 60.0, (2, count))
    far = rng.uniform(-20.0, 80.0, (isolated, 3)) * [1.0, 1.0, 0.0] + [0.0, 0.0, 15.0]
    return np.concatenate([np.column_stack([u, v, 0.01 * (u - 30.0) ** 2]), far])


@pytest.mark.parametrize("isolated", [0, 1, 40])
def test_neighbours_after_isolated_points_are_gone_are_those_of_a_new_look_up(isolated):
    prepared = sources.prepare(cloud(isolated), CONFIG)
    clean = sources.without_isolated(sampling.distinct(cloud(isolated)), CONFIG)
    assert np.array_equal(prepared.points, clean)
    assert (len(clean) < 900 + isolated) is (isolated > 0)
    again = sources.describe(clean, CONFIG)
    assert np.array_equal(prepared.around, cKDTree(clean).query(clean, k=36)[1])
    assert np.array_equal(prepared.around, again.around) and np.array_equal(prepared.order, again.order)
    assert prepared.spacing_mm == again.spacing_mm


def test_a_source_that_is_thinned_is_looked_up_afterwards():
    prepared = sources.prepare(cloud(), replace(CONFIG, most_points=500))
    assert len(prepared.points) <= 500
    assert np.array_equal(prepared.around, cKDTree(prepared.points).query(prepared.points, k=36)[1])


def test_of_many_points_some_are_fitted_and_all_give_their_normals():
    points = cloud(isolated=30) + np.where(np.arange(930) < 900, 0.0, 45.0)[:, None] * [0.0, 0.0, 1.0]
    prepared = sources.prepare(points, replace(CONFIG, fitted_points=600))
    whole = sampling.distinct(points)
    assert np.array_equal(prepared.whole, whole) and prepared.is_part and not sources.prepare(points, CONFIG).is_part
    rows = cKDTree(whole).query(prepared.points)[1]
    assert np.array_equal(whole[rows], prepared.points) and len(np.unique(rows)) == len(rows)
    assert 560 < len(rows) < 600 and (prepared.points[:, 2] < 12.0).all()  # isolated ones are gone
    assert np.array_equal(prepared.patches, cKDTree(whole).query(prepared.points, k=30)[1])
    assert np.array_equal(prepared.around, cKDTree(prepared.points).query(prepared.points, k=36)[1])
    normals, flatness_mm, _ = fit_planes(whole, prepared.patches)
    assert np.array_equal(prepared.normals, normals) and np.array_equal(prepared.flatness_mm, flatness_mm)
    assert np.array_equal(prepared.order[np.argsort(prepared.order)], np.arange(len(rows)))


@pytest.mark.parametrize("count", [700, 900])
def test_one_point_far_from_all_others_is_no_part_of_the_whole(count):
    """Whatever proposes poses takes the extent of the whole: of 600 fitted points, and of all where they are more."""
    points = np.vstack([cloud(count=count), [[900.0, 0.0, 0.0]]])
    for fitted in (600, 2000):
        prepared = sources.prepare(points, replace(CONFIG, fitted_points=fitted))
        assert len(prepared.whole) == count and np.ptp(prepared.whole, axis=0).max() < 100.0
    crowd = points[-1] + np.random.default_rng(2).normal(0.0, 0.5, (20, 3))
    with_crowd = sources.prepare(np.vstack([points, crowd]), replace(CONFIG, fitted_points=600))
    assert len(with_crowd.whole) == count + 21, "a point among others is kept: it is for the registration to say"


def test_what_is_fitted_is_drawn_at_random_and_always_the_same():
    config = replace(CONFIG, fitted_points=300)
    one, again = (sources.prepare(cloud(), config) for _ in range(2))
    assert np.array_equal(one.points, again.points) and len(one.points) == 300
    gaps = cKDTree(one.points).query(one.points, k=2)[0][:, 1]
    evenly = sources.prepare(cloud(), replace(CONFIG, most_points=300))
    assert gaps.min() < 0.5 * cKDTree(evenly.points).query(evenly.points, k=2)[0][:, 1].min()


def test_of_a_scene_all_points_are_fitted():
    config = replace(CONFIG, fitted_points=300)
    assert len(sources.prepare(cloud(), config, in_scene=True).points) == 900


def test_a_cloud_of_too_many_points_is_cleaned_and_thinned_before_some_are_drawn():
    config = replace(CONFIG, most_points=500, fitted_points=200)
    prepared = sources.prepare(cloud(isolated=30), config)
    clean = sources.without_isolated(sampling.distinct(cloud(isolated=30)), config)
    assert np.array_equal(prepared.whole, clean[sampling.thin(clean, 500)]) and len(prepared.points) == 200


def test_frames_are_the_principal_axes_and_face_the_viewpoint_where_that_is_known():
    prepared, chosen = sources.prepare(cloud(), CONFIG), np.array([5, 77, 301])
    wanted = quadrics.local_frames(prepared.points, prepared.neighbours).axes[chosen]
    assert np.array_equal(prepared.axes(chosen), wanted)
    for viewpoint in ([30.0, 30.0, 500.0], [30.0, 30.0, -500.0]):
        facing = prepared.facing(np.array(viewpoint))
        assert (np.einsum("ni,ni->n", facing.normals, viewpoint - facing.points) > 0.0).all()
        signs = np.sign(np.einsum("ni,ni->n", wanted[:, 2], viewpoint - facing.points[chosen]))
        assert np.array_equal(facing.axes(chosen), wanted * np.stack([signs**2, signs, signs], axis=1)[:, :, None])


@pytest.mark.parametrize("seed", range(60))
def test_a_straight_line_is_refused_however_its_sums_are_rounded(seed):
    """The smaller eigenvalues of its covariance are 0, or -1e-13: no number is its root."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=3)
    refused = sources.prepare(rng.uniform(0.0, 200.0, (500, 1)) * direction / np.linalg.norm(direction), CONFIG)
    assert "the source is a line" in refused.reason


@pytest.mark.parametrize(("count", "held"), [(60, 600), (200, 5000), (200, 10_000)])
def test_a_pointer_that_is_held_still_measures_one_contact(femur, registrar, target, count, held):
    """Its hundreds of samples of one place made all others isolated, and the source a line."""
    points = femur.sample(count, np.random.default_rng(3))[0]
    rests = points[0] + np.random.default_rng(4).normal(0.0, 0.15, (held, 3))
    prepared = sources.prepare(np.vstack([points, rests]))
    near = np.linalg.norm(prepared.whole - points[0], axis=1) < 1.5
    assert np.count_nonzero(~near) >= count - 5 and np.count_nonzero(near) < 200
    assert registrar.register(np.vstack([points, rests]), target).ok
