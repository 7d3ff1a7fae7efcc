"""A bag as the source of a registration: the topic that is meant, and one line for what cannot be read."""

import builtins
import json
import sys

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseArray, TransformStamped
from rclpy.serialization import serialize_message
from std_msgs.msg import Header

from gapr_core import clouds
from gapr_core.cli import main
from gapr_core.data.parametric import make_bone
from gapr_core.errors import InvalidPointCloudError, MethodUnavailableError
from gapr_core.formats.options import ReadOptions
from gapr_core.geometry import se3
from gapr_ros.bags.files import Bag
from gapr_ros.bags.writing import BagWriter
from msg_adapters import xyz_to_cloud

START_NS = 1_700_000_000_250_000_000
PIECES = np.random.default_rng(0).normal(size=(4, 50, 3)) * 0.05


@pytest.fixture(params=["mcap", "sqlite3"])
def bag(request, tmp_path):
    """Four clouds in metres, one digitiser's points, and transforms."""
    with BagWriter(tmp_path / "bag", request.param) as writer:
        for i, points in enumerate(PIECES):
            writer.write_cloud("/points", points, "probe", START_NS + i * 100_000_000)
        poses = [Pose(position=Point(x=float(x), y=float(y), z=float(z))) for x, y, z in PIECES[0]]
        writer.write("/tip", PoseArray(header=Header(frame_id="tracker"), poses=poses), START_NS)
        writer.write("/where", TransformStamped(child_frame_id="a"), START_NS)
    return tmp_path / "bag"


def read(path, **how):
    return clouds.load(path, "m", ReadOptions(**how)).points


def test_the_clouds_of_a_topic_are_joined_and_a_slice_of_them_chosen(bag, caplog):
    np.testing.assert_allclose(read(bag, topic="/points"), 1000.0 * PIECES.reshape(-1, 3), atol=1e-4)
    assert "4 clouds of /points (frame probe) are joined" in caplog.text
    np.testing.assert_allclose(
        read(bag, topic="/points", clouds=(1, 3)), 1000.0 * PIECES[1:3].reshape(-1, 3), atol=1e-4
    )
    np.testing.assert_allclose(read(bag, topic="/points", clouds=(-1, None)), 1000.0 * PIECES[3], atol=1e-4)
    np.testing.assert_allclose(read(bag, topic="/tip"), 1000.0 * PIECES[0], atol=1e-9)
    (file,) = [path for path in bag.iterdir() if path.suffix in (".mcap", ".db3")]
    np.testing.assert_allclose(read(file, topic="/tip"), 1000.0 * PIECES[0], atol=1e-9)


def test_a_bag_is_read_no_further_than_the_clouds_that_are_asked_for(bag, monkeypatch):
    """An hour of clouds for its first second; one more is taken to know that there are enough."""
    read_all, taken = Bag.messages, []

    def counted(self):
        for message in read_all(self):
            taken.append(message)
            yield message

    monkeypatch.setattr(Bag, "messages", counted)
    np.testing.assert_allclose(read(bag, topic="/points", clouds=(0, 2)), 1000.0 * PIECES[:2].reshape(-1, 3), atol=1e-4)
    assert len(taken) <= 3


@pytest.mark.parametrize(("how", "expected"), [
    ({"topic": "/cloud"}, "a topic of the bag (/points, /tip, /where); got bag: /cloud"),
    ({"topic": "/where"}, "the bag has /points, /tip; got bag: /where of geometry_msgs/msg/TransformStamped"),
    ({}, "got bag: 2 of them (/points, /tip); name one with --topic"),
    ({"topic": "/points", "clouds": (9, 12)}, "got bag: 4 of /points and a choice without any"),
])  # fmt: skip
def test_a_topic_that_cannot_be_meant_is_answered_with_those_that_can(bag, how, expected):
    with pytest.raises(InvalidPointCloudError) as caught:
        read(bag, **how)
    assert expected in str(caught.value) and "\n" not in str(caught.value)


def with_one_malformed(folder, number, is_cut):
    """Four clouds; one has no x, or is cut."""
    with BagWriter(folder) as writer:
        for i, points in enumerate(PIECES):
            cloud = xyz_to_cloud(points, Header(frame_id="probe", stamp=Time(sec=1_600_000_000, nanosec=i)))
            cloud.fields = cloud.fields[1:] if i == number else cloud.fields
            data = serialize_message(cloud)[: 40 if is_cut and i == number else None]
            writer.write_raw("/points", "sensor_msgs/msg/PointCloud2", data, START_NS + i)
    return folder


@pytest.mark.parametrize(("number", "clouds", "how"), [
    (0, (None, None), "--clouds 1:4"), (2, (None, None), "--clouds 0:2 or --clouds 3:4"),
    (3, (None, None), "--clouds 0:3"), (2, (1, 3), "--clouds 1:2"),
])  # fmt: skip
@pytest.mark.parametrize("is_cut", [False, True])
def test_a_malformed_cloud_among_others_is_named_and_others_are_suggested(tmp_path, number, clouds, how, is_cut):
    path = with_one_malformed(tmp_path / "bag", number, is_cut)
    with pytest.raises(InvalidPointCloudError) as caught:
        read(path, topic="/points", clouds=clouds)
    said = "received at 1700000000.25000000" if is_cut else "stamp 1600000000.00000000"
    assert f"got bag: cloud {number} of /points, {said}{number} s (" in str(caught.value)
    assert "need exactly one field x" in str(caught.value) or is_cut
    assert str(caught.value).endswith(f"; choose others: {how}") and "repair" not in str(caught.value)
    first, last = how.split()[1].split(":")
    assert len(read(path, topic="/points", clouds=(int(first), int(last)))) == 50 * (int(last) - int(first))


def test_the_only_topic_with_clouds_needs_no_name(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        writer.write_cloud("/points", PIECES[0], "probe", START_NS)
        writer.write("/where", TransformStamped(child_frame_id="a"), START_NS)
    assert len(read(tmp_path / "bag")) == 50


def test_a_single_cloud_that_is_an_image_brings_its_camera_and_joined_ones_have_none(tmp_path, image):
    with BagWriter(tmp_path / "bag") as writer:
        for i in range(2):
            writer.write_cloud("/points", image / 1000.0, "camera", START_NS + i)
    one, both = (clouds.load(tmp_path / "bag", "m", ReadOptions(clouds=(first, None))) for first in (1, 0))
    np.testing.assert_allclose(one.camera, [100.0, 50.0, -400.0], atol=0.01)
    assert both.camera is None and len(both.points) == 2 * len(one.points)


def test_clouds_of_two_frames_are_not_joined(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        for i, frame in enumerate(("left", "right")):
            writer.write_cloud("/points", PIECES[i], frame, START_NS + i)
    with pytest.raises(InvalidPointCloudError, match="in one frame; got bag: clouds in left, right"):
        read(tmp_path / "bag")
    assert len(read(tmp_path / "bag", clouds=(0, 1))) == 50


def empty(folder):
    with BagWriter(folder):
        pass


def damaged(folder):
    with BagWriter(folder) as writer:
        for i in range(20):
            writer.write_cloud("/points", np.random.default_rng(i).random((2000, 3)), "probe", START_NS + i)
    file = next(folder.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def no_message(folder):
    with BagWriter(folder) as writer:
        writer.write_raw("/points", "sensor_msgs/msg/PointCloud2", b"\x00\x01\x00\x00\xff\xff\xff\x7f", START_NS)


def millimetres(folder):
    with BagWriter(folder) as writer:
        writer.write_cloud("/points", 1000.0 * PIECES[0], "probe", START_NS)


def without_clouds(folder):
    with BagWriter(folder) as writer:
        writer.write("/where", TransformStamped(child_frame_id="a"), START_NS)


@pytest.mark.parametrize(("make", "expected"), [
    (empty, "no messages"), (damaged, "damaged|not a readable"), (no_message, "cloud 0 of /points"),
    (millimetres, "looks like mm"), (without_clouds, "0 of them"),
])  # fmt: skip
def test_a_bag_that_cannot_be_used_is_one_line_and_exit_code_1(tmp_path, capsys, make, expected):
    make(tmp_path / "bag")
    np.save(tmp_path / "bone.npy", 1000.0 * PIECES.reshape(-1, 3))
    named = ["--source", str(tmp_path / "bag"), "--target", str(tmp_path / "bone.npy"), "--method", "gapr_search"]
    assert main(["register", *named]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and any(word in error for word in expected.split("|")), error


def test_without_the_libraries_of_ros_it_says_what_to_install(bag, monkeypatch):
    real = builtins.__import__

    def without(name, *rest):
        if name.partition(".")[0] == "rosbags":
            raise ModuleNotFoundError("No module named 'rosbags'", name="rosbags")
        return real(name, *rest)

    for name in [name for name in sys.modules if name.startswith("gapr_ros.bags")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MethodUnavailableError, match=r"no rosbags; pip install 'gapr_ros\[ros\]'"):
        read(bag, topic="/points")


def test_a_registration_from_a_bag_finds_the_bone(tmp_path):
    bone, rng = make_bone("femur", 1), np.random.default_rng(0)
    points, normals = bone.sample(9000, rng)
    T_source_target = se3.exp([30.0, -20.0, 50.0, 0.5, -0.4, 1.0])
    seen = se3.apply(T_source_target, points[normals[:, 1] < -0.2])
    with BagWriter(tmp_path / "bag") as writer:
        for i, part in enumerate(np.array_split(seen, 3)):
            writer.write_cloud("/probe/points", part / 1000.0, "tracker", START_NS + i)
    np.savez(tmp_path / "femur.npz", points=bone.points, faces=bone.faces)
    named = ["--source", str(tmp_path / "bag"), "--topic", "/probe/points", "--target", str(tmp_path / "femur.npz")]
    assert main(["register", *named, "--method", "gapr_search", "--json", str(tmp_path / "out.json")]) == 0
    found = np.array(json.loads((tmp_path / "out.json").read_text())["transform"])
    assert np.linalg.norm(se3.apply(found, se3.apply(T_source_target, bone.points)) - bone.points, axis=1).max() < 1.0
