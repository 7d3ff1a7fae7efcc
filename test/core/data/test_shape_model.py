from __future__ import annotations

import json

import numpy as np
import open3d as o3d
import pytest
from scipy.spatial.transform import Rotation
from shapes import ball_specimen

from gapr_core.data import anatomy, sampler, shape_model
from gapr_core.data.deformation import smooth_field
from gapr_core.data.protocols import make_pair
from gapr_core.data.shape_model import ShapeModel
from gapr_core.data.solid import volume_mm3
from gapr_core.errors import ConfigError
from gapr_core.geometry import se3

BALL = ball_specimen(60.0).surface


def ellipsoids(count=30, seed=0):
    """Balls stretched along z by a normal factor and moved rigidly: one true mode."""
    rng = np.random.default_rng(seed)
    centred = BALL.points - BALL.points.mean(axis=0)
    stretch = 1.3 + 0.1 * rng.normal(size=count)
    rotations = Rotation.random(count, random_state=rng).as_matrix()
    motions = [se3.from_rotation_translation(R, rng.normal(0.0, 100.0, 3)) for R in rotations]
    return np.stack([se3.apply(T, centred * [1, 1, s]) for T, s in zip(motions, stretch, strict=True)]), stretch


def test_one_cause_of_variation_gives_one_mode_of_its_size_whatever_the_frames():
    shapes, stretch = ellipsoids()
    model = ShapeModel.fit(shapes, BALL.faces)
    assert len(model.deviations) == 1
    height = np.abs((BALL.points - BALL.points.mean(axis=0))[:, 2])
    assert model.deviations[0] == pytest.approx(stretch.std(ddof=1) * np.linalg.norm(height), rel=0.05)


def test_the_model_describes_the_people_it_was_built_from():
    shapes, stretch = ellipsoids()
    model = ShapeModel.fit(shapes, BALL.faces, explained=0.999)
    coefficients = np.array([model.coefficients(shape)[0] for shape in shapes])
    assert abs(np.corrcoef(coefficients, stretch)[0, 1]) > 0.999
    rebuilt = model.shape(model.coefficients(shapes[3])).points
    aligned = se3.apply(se3.kabsch(shapes[3], rebuilt), shapes[3])
    assert np.abs(rebuilt - aligned).max() < 0.5


def test_new_bones_stay_within_two_standard_deviations_of_the_data():
    model = ShapeModel.fit(ellipsoids()[0], BALL.faces)
    rng = np.random.default_rng(0)
    drawn = [model.coefficients(model.sample(rng, large_mm=0.0, small_mm=0.0).points)[0] for _ in range(200)]
    assert np.abs(drawn).max() < 2.05
    assert np.std(drawn) > 0.7


def test_local_variation_has_the_named_size_and_is_smooth():
    rng = np.random.default_rng(0)
    points = BALL.points
    sizes = [np.sqrt((smooth_field(points, rng, 1.5, (80.0, 250.0)) ** 2).sum(axis=1).mean()) for _ in range(60)]
    assert np.mean(sizes) == pytest.approx(1.5, rel=0.15)
    field = smooth_field(points, rng, 1.5, (80.0, 250.0))
    edge = np.linalg.norm(points[BALL.faces[:, 0]] - points[BALL.faces[:, 1]], axis=1)
    step = np.linalg.norm(field[BALL.faces[:, 0]] - field[BALL.faces[:, 1]], axis=1)
    assert (step <= 0.5 * edge + 1e-9).all()


def test_too_few_meshes_are_refused():
    with pytest.raises(ConfigError, match="three meshes"):
        ShapeModel.fit(np.zeros((2, 10, 3)), [[0, 1, 2]])


def write_anatomy(folder):
    shapes, _ = ellipsoids(10)
    people = [f"p{i}" for i in range(10)]
    np.savez(folder / "femur_made.npz", points=shapes.astype(np.float32), faces=BALL.faces, person=np.array(people))
    (folder / "splits.json").write_text(json.dumps({"train": people[:6], "val": people[6:8], "test": people[8:]}))


def test_models_are_of_train_people_only(tmp_path):
    write_anatomy(tmp_path)
    (model,) = shape_model.from_anatomy(tmp_path, "femur")
    assert model.people == ("p0", "p1", "p2", "p3", "p4", "p5")


def test_held_out_meshes_leave_no_trace_in_the_model(tmp_path):
    write_anatomy(tmp_path)
    (before,) = shape_model.from_anatomy(tmp_path, "femur")
    data = dict(np.load(tmp_path / "femur_made.npz"))
    data["points"][6:] = 0.0
    np.savez(tmp_path / "femur_made.npz", **data)
    (after,) = shape_model.from_anatomy(tmp_path, "femur")
    np.testing.assert_array_equal(before.mean, after.mean)
    np.testing.assert_array_equal(before.modes, after.modes)


def test_the_sampler_draws_both_sides_with_faces_outward(tmp_path):
    write_anatomy(tmp_path)
    draw = sampler.anatomy_sampler(tmp_path, "femur")
    rng = np.random.default_rng(0)
    bones = [draw(rng) for _ in range(12)]
    flipped = [not np.array_equal(b.surface.faces, BALL.faces) for b in bones]
    assert 2 <= sum(flipped) <= 10
    assert all(volume_mm3(b.surface) > 0.0 for b in bones)
    again = sampler.anatomy_sampler(tmp_path, "femur")(np.random.default_rng(0))
    np.testing.assert_array_equal(again.surface.points, bones[0].surface.points)


def test_a_sampler_of_a_bone_that_the_folder_lacks_is_refused(tmp_path):
    write_anatomy(tmp_path)
    with pytest.raises(ConfigError, match="source of tibia"):
        sampler.anatomy_sampler(tmp_path, "tibia")


@pytest.mark.parametrize("corresponded", [True, False])
def test_a_users_own_meshes_are_varied_with_or_without_correspondence(tmp_path, corresponded):
    for i in range(10):
        around = 24 if corresponded else 24 + i
        mesh = o3d.geometry.TriangleMesh.create_cone(30.0 + i, 120.0, resolution=around, split=4)
        o3d.io.write_triangle_mesh(str(tmp_path / f"person{i}.ply"), mesh)
    draw = sampler.mesh_sampler(tmp_path, "radius")
    people = anatomy.meshes(tmp_path, "radius", "train")
    assert set(draw.people) == {s.person for s in people} and len(draw.people) == 6
    first, second = draw(np.random.default_rng(0)), draw(np.random.default_rng(1))
    assert first.bone == "radius"
    assert first.surface.points.shape != second.surface.points.shape or not np.allclose(
        first.surface.points, second.surface.points
    )


def test_drawn_bones_make_pairs(tmp_path):
    write_anatomy(tmp_path)
    bone = sampler.anatomy_sampler(tmp_path, "femur")(np.random.default_rng(3))
    pair = make_pair("L1", bone, 0)
    on_bone = se3.apply(pair.T_target_source, pair.source) + pair.metadata["origin_mm"]
    assert np.median(bone.distance(on_bone)) < 2.0


@pytest.mark.parametrize("bone", ["femur", "tibia", "pelvis"])
def test_no_real_person_of_val_or_test_is_in_a_model(anatomy_folder, bone):
    people = anatomy.splits(anatomy_folder)
    models = shape_model.from_anatomy(anatomy_folder, bone)
    assert models
    for model in models:
        assert model.people and set(model.people) <= set(people["train"])
        assert not set(model.people) & (set(people["val"]) | set(people["test"]))


def test_a_shape_model_of_real_femurs_makes_femurs(anatomy_folder):
    (model,) = shape_model.from_anatomy(anatomy_folder, "femur")
    rng = np.random.default_rng(0)
    lengths = [np.ptp(model.sample(rng).points, axis=0).max() for _ in range(30)]
    assert 380.0 < min(lengths) and max(lengths) < 510.0 and np.std(lengths) > 5.0
