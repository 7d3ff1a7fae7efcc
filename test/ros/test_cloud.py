"""Which points of a cloud are registered: a box in a frame, no table; and where the camera was."""

from __future__ import annotations

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from harness import Collecting, StandIn, node_in_thread, pose_mm
from rclpy.parameter import Parameter
from scipy.spatial import cKDTree

from gapr_core.geometry import se3
from gapr_ros.node import cloud, frames, units
from gapr_ros.node.outcome import Reason, RefusedError
from gapr_ros.parameters import NodeParameters
from msg_adapters import matrix_to_transform, xyz_to_cloud

GOOD = np.random.default_rng(1).normal(size=(1000, 3)) * 0.02
FAR = np.random.default_rng(2).normal(size=(800, 3)) * 0.02 + [3.0, 0.0, 0.0]
T_BOX_PROBE = pose_mm([0.0, 0.0, np.pi / 2], [0.1, 0.2, 0.3])  # metres


class Tf2:
    """What the node uses of tf2_ros, with one transform that is known."""

    class TransformException(Exception):
        pass

    srv = None

    @property
    def jump_handle(self):
        return self

    def TransformListener(self, buffer, node):
        return self

    def unregister(self):
        pass

    def Buffer(self, node):
        return self

    def can_transform(self, parent, child, stamp):
        return (parent, child) == ("table", "probe")

    def lookup_transform(self, parent, child, stamp):
        if not self.can_transform(parent, child, stamp):
            raise self.TransformException(f"{parent} does not exist")
        return TransformStamped(transform=matrix_to_transform(T_BOX_PROBE))


def test_the_box_keeps_what_is_inside_it_in_its_own_frame():
    parameters = NodeParameters(crop_min=(0.0, 0.1, 0.2), crop_max=(0.1, 0.3, 0.4))
    there_m = np.array([[0.05, 0.2, 0.3], [0.11, 0.2, 0.3], [0.05, 0.09, 0.3], [0.05, 0.2, 0.41], [0.01, 0.11, 0.21]])
    points_mm = se3.apply(se3.inverse(T_BOX_PROBE), there_m) * 1000.0
    kept = cloud.take_in(xyz_to_cloud(points_mm / 1000.0), 250.0, parameters, T_BOX_PROBE).points_mm
    np.testing.assert_allclose(kept, points_mm[[0, 4]], atol=1e-9)


@pytest.mark.parametrize("highest", [(0.1, 0.3, 0.2), (0.1, 0.0, 0.4)])
def test_a_box_that_no_point_fits_in_names_its_corners_in_metres(highest):
    parameters = NodeParameters(crop_min=(0.0, 0.1, 0.2), crop_max=highest)
    with pytest.raises(RefusedError) as refused:
        cloud.take_in(xyz_to_cloud(GOOD), 250.0, parameters, np.eye(4))
    assert refused.value.reason is Reason.TOO_FEW_POINTS
    assert f"crop_min [0.0, 0.1, 0.2] is not below crop_max {list(highest)}" in refused.value.text


def test_a_cloud_with_points_metres_away_is_registered_when_it_is_cropped(blob_path, client, method):
    with node_in_thread(method, blob_path) as node:
        client.wait_for_state("active")
        assert client.ask(np.vstack([GOOD, FAR]))["last_refusal"].startswith("unit_mismatch")
        box = [Parameter("crop_min", value=[-1.0, -1.0, -1.0]), Parameter("crop_max", value=[1.0, 1.0, 1.0])]
        assert node.set_parameters_atomically(box).successful
        values = client.ask(np.vstack([GOOD, FAR]))
        assert values["level"] == 0 and values["points_used"] == "1000"
        assert "too_few_points: none of" in client.ask(FAR)["last_refusal"], "as where the box is in the wrong place"


def test_the_box_is_looked_up_in_its_frame_and_a_missing_frame_is_a_refusal(blob_path, client, method, monkeypatch):
    monkeypatch.setattr(frames, "_import_tf2", Tf2)
    middle = se3.apply(T_BOX_PROBE, GOOD.mean(axis=0)[None])[0]
    options = {"crop_min": (middle - 1.0).tolist(), "crop_max": (middle + 1.0).tolist(), "tf_timeout": 0.0}
    with node_in_thread(method, blob_path, crop_frame="/table", **options):
        client.wait_for_state("active")
        values = client.ask(np.vstack([GOOD, FAR]), frame="probe")
        assert values["level"] == 0 and values["points_used"] == "1000"
        refused = client.ask(GOOD, frame="elsewhere")
        assert refused["last_refusal"].startswith("tf_missing: crop_frame: table <- elsewhere: nobody sends 'table'")


@pytest.mark.parametrize(
    ("viewpoint", "expected_mm"),
    [
        ("none", None),
        ("origin", [0.0, 0.0, 0.0]),
        ("table", se3.inverse(T_BOX_PROBE)[:3, 3] * 1000.0),
    ],
)
def test_the_camera_is_where_the_parameter_says(blob_path, client, method, monkeypatch, viewpoint, expected_mm):
    monkeypatch.setattr(frames, "_import_tf2", Tf2)
    with node_in_thread(method, blob_path, viewpoint=viewpoint):
        client.wait_for_state("active")
        assert client.ask(GOOD, frame="probe")["level"] == 0
    given = method.calls[-1]["viewpoint"]
    if expected_mm is None:
        assert given is None
    else:
        np.testing.assert_allclose(given, expected_mm, atol=1e-9)


def test_the_origin_of_the_cloud_is_given_in_the_frame_of_the_answer(blob_path, client, method, monkeypatch):
    monkeypatch.setattr(frames, "_import_tf2", Tf2)
    with node_in_thread(method, blob_path, viewpoint="origin", output_frame="table"):
        client.wait_for_state("active")
        client.ask(GOOD, frame="probe")
    np.testing.assert_allclose(method.calls[-1]["viewpoint"], T_BOX_PROBE[:3, 3] * 1000.0, atol=1e-9)


@pytest.mark.parametrize(
    ("given", "is_given"),
    [
        ({"viewpoint": "origin"}, True),
        ({"viewpoint": "origin", "sensor": "depth_camera"}, True),
        ({"viewpoint": "origin", "sensor": "pointer"}, False),
        ({"viewpoint": "auto"}, False),
        ({"viewpoint": "none"}, False),
    ],
)
def test_looks_that_are_registered_as_one_each_keep_their_place(blob_path, client, monkeypatch, given, is_given):
    monkeypatch.setattr(frames, "_import_tf2", Tf2)
    method = Collecting()
    with node_in_thread(method, blob_path, output_frame="table", accumulate=4, **given):
        client.wait_for_state("active")
        assert client.ask(GOOD[:150], frame="probe")["level"] == 0
        assert client.ask(GOOD, frame="probe")["level"] == 0
    of_model, *places = method.places
    assert len(places) == 2 and (of_model is None) is not is_given
    for place in places:
        if is_given:
            np.testing.assert_allclose(place, T_BOX_PROBE[:3, 3] * 1000.0, atol=1e-9)
        else:
            assert place is None


@pytest.mark.parametrize(
    ("given", "expected_mm"),
    [
        ({}, [100.0, 50.0, -400.0]),
        ({"output_frame": "table"}, se3.apply(units.in_mm(T_BOX_PROBE), np.array([[100.0, 50.0, -400.0]]))[0]),
        ({"cloud_unit": "mm"}, [100.0, 50.0, -400.0]),
        ({"viewpoint": "origin"}, [0.0, 0.0, 0.0]),
        ({"viewpoint": "none"}, None),
        ({"accumulate": 2, "output_frame": "table"}, None),
    ],
)
def test_the_pixels_of_an_organised_cloud_say_where_the_camera_was(
    blob_path, client, image, monkeypatch, given, expected_mm
):
    monkeypatch.setattr(frames, "_import_tf2", Tf2)
    method = Collecting() if "accumulate" in given else StandIn()
    with node_in_thread(method, blob_path, **given):
        client.wait_for_state("active")
        per_m = 1.0 if "cloud_unit" in given else 1000.0
        answer = client.ask(image / per_m, frame="probe")
        assert answer["level"] == 0 and answer["points_used"] == str(int(np.isfinite(image[..., 0]).sum()))
        assert answer["seen_from"] == ("" if len(given) == 2 or "viewpoint" in given else "0.100 0.050 -0.400")
        assert client.ask(GOOD * 1000.0 / per_m, frame="probe")["seen_from"] == ""
    seen, alone = method.calls[-2]["viewpoint"], method.calls[-1]["viewpoint"]
    if expected_mm is None:
        assert seen is None and alone is None
    else:
        np.testing.assert_allclose(seen, expected_mm, atol=0.01)
        assert (alone is None) is ("viewpoint" not in given), "a cloud that is no image says nothing"


def test_points_on_the_pixels_of_a_camera_in_the_origin_show_it_without_rows_and_columns(
    blob_path, client, method, image
):
    """As RealSense's driver sends them."""
    cloud = (image[np.isfinite(image[..., 0])] - [100.0, 50.0, -400.0]) / 1000.0
    with node_in_thread(method, blob_path):
        client.wait_for_state("active")
        assert client.ask(cloud)["seen_from"] == "0.000 0.000 0.000"
        assert client.ask(cloud + [0.01, 0.0, 0.0])["seen_from"] == ""
    seen, moved = (call["viewpoint"] for call in method.calls[-2:])
    np.testing.assert_array_equal(seen, np.zeros(3))
    assert moved is None


def test_a_method_that_knows_no_viewpoint_is_not_given_one(blob_path, client, image):
    class Plain(StandIn):
        def register(self, source, target, initial=None):
            return super().register(source, target, initial)

    with node_in_thread(Plain(), blob_path):
        client.wait_for_state("active")
        assert client.ask(GOOD)["level"] == 0
        answer = client.ask(image / 1000.0)
        assert answer["level"] == 0 and answer["seen_from"] == "", answer


def table_scene(rng, size_mm=1200.0, bone_mm=100.0, share=0.06):
    """(N, 3) mm: a noisy table of 20 000 points, and a bone and a cup on it."""
    count = int(share * 20_000)
    table = np.column_stack([rng.uniform(-0.5, 0.5, (20_000, 2)) * size_mm, np.zeros(20_000)])
    bone = rng.normal(size=(count, 3))
    bone = bone / np.linalg.norm(bone, axis=1, keepdims=True) * [bone_mm / 2, 15.0, 15.0] + [0.0, 0.0, 20.0]
    cup = rng.normal(size=(50, 3)) * 5.0 + [200.0, 100.0, 30.0]
    turned = pose_mm([0.4, 0.2, 0.1], [0.0, 0.0, 800.0])
    noisy = np.vstack([table, bone, cup]) + rng.normal(0.0, 1.0, (20_050 + count, 3))
    return se3.apply(turned, noisy), se3.apply(turned, bone)


def test_a_table_is_left_out_and_the_bone_on_it_stays():
    scene, bone = table_scene(np.random.default_rng(0))
    kept = cloud.without_table(scene, 110.0)
    distance_mm = cKDTree(bone).query(kept)[0]
    assert 0.6 * len(bone) < len(kept) < 1.1 * len(bone) and np.quantile(distance_mm, 0.99) < 10.0


@pytest.mark.parametrize("scene", ["no table", "a table smaller than the bone", "nothing on it"])
def test_where_no_plane_is_larger_than_the_bone_all_points_stay(scene):
    rng = np.random.default_rng(0)
    points = {
        "no table": GOOD * 1000.0,
        "a table smaller than the bone": table_scene(rng, size_mm=200.0)[0],
        "nothing on it": np.column_stack([rng.uniform(-600.0, 600.0, (5000, 2)), np.zeros(5000)]),
    }[scene]
    np.testing.assert_array_equal(cloud.without_table(points, 300.0), points)


def test_the_status_of_a_cloud_of_a_table_counts_what_was_left_out(blob_path, client, method):
    scene, _ = table_scene(np.random.default_rng(0), bone_mm=300.0)
    with node_in_thread(method, blob_path, viewpoint="none"):
        client.wait_for_state("active")
        values = client.ask(scene / 1000.0)
        assert values["level"] == 0 and 15_000 < int(values["points_on_table"])
        assert int(values["points_in"]) == int(values["points_on_table"]) + int(values["points_used"])
