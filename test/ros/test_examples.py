"""The ROS examples: run where they can be, and compared with the node where they need a full ROS installation."""

from __future__ import annotations

import importlib.util
import json
import re
import signal
import sys
import xml.etree.ElementTree as ElementTree
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import bones
import numpy as np
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import Pose, PoseArray, TransformStamped
from harness import PATIENCE_S, NodeProcess, Spinner, accepted, context, node_in_thread, pose_mm, wait_until
from rclpy.parameter import Parameter
from std_msgs.msg import Header

from gapr_core.results import RegistrationResult, RegistrationStatus
from gapr_ros.node.heard import Heard
from gapr_ros.node.publishers import TOPICS
from gapr_ros.parameters import FIELDS
from msg_adapters import matrix_to_transform

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples" / "ros"
GOOD = np.random.default_rng(1).normal(size=(1000, 3)) * 0.02


def loaded(name, monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def consumer(monkeypatch):
    """The example as a node that notes what it does."""
    module, spinner = loaded("trusted_pose", monkeypatch), Spinner(context())
    done = []

    class Noting(module.TrustedPose):
        def act(self, transform, values):
            done.append((transform.header.stamp.sec, round(transform.transform.translation.x, 6)))

        def hold(self, why):
            done.append(why)

    given = [Parameter("min_confidence", value=0.8), Parameter("max_tre", value=0.002)]
    node = Noting(context=spinner.context, parameter_overrides=given)
    spinner.start(node)
    yield node, done
    spinner.close()


def test_the_consumer_acts_on_sure_and_bounded_poses_of_the_right_stamp_only(blob_path, client, method, consumer):
    node, done = consumer
    with node_in_thread(method, blob_path):
        client.wait_for_state("active")
        wait_until(lambda: node.count_publishers("/register_node/transform"))
        wait_until(lambda: client.node.count_subscribers("/register_node/status"))
        wait_until(lambda: client.ask(GOOD, stamp_s=10.0) and done, what="discovery")
        method.answer = accepted(confidence=0.9, tre95_mm=1.0)
        wait_until(lambda: client.ask(GOOD, stamp_s=20.0) and (20, 0.0) in done, what="the end of discovery")
        client.ask(GOOD, stamp_s=30.0)  # once, so that nothing asked before is still under way after it
        wait_until(lambda: (30, 0.0) in done, what=done)
        done.clear()
        answers = [
            accepted(pose_mm([0, 0, 0], [50.0, 0, 0]), confidence=0.9, tre95_mm=1.0),
            accepted(confidence=0.7, tre95_mm=1.0),
            accepted(confidence=0.9, tre95_mm=3.0),
            accepted(confidence=0.9),
            RegistrationResult(RegistrationStatus.AMBIGUOUS, confidence=0.9),
            accepted(pose_mm([0, 0, 0], [60.0, 0, 0]), confidence=0.9, tre95_mm=1.0),
        ]
        for second, method.answer in enumerate(answers, 100):
            client.ask(GOOD, stamp_s=float(second))
        wait_until(lambda: len(done) == 6, what=done)
    assert (done[0], done[5]) == ((100, -0.05), (105, -0.06))
    assert done[1].startswith("confidence 0.7") and "0.003 m only" in done[2] and "nothing" in done[3]
    assert done[4] == "ambiguous"


def status(second, confidence, reason=""):
    values = {"stamp": f"{second}.000000000", "confidence": str(confidence), "tre95": "0.001", "reason": reason}
    level = DiagnosticStatus.WARN if reason else DiagnosticStatus.OK
    return DiagnosticStatus(level=level, values=[KeyValue(key=key, value=value) for key, value in values.items()])


def transform_at(second, x, child="bone_preop"):
    stamped = TransformStamped(header=Header(frame_id="camera"), child_frame_id=child)
    stamped.header.stamp.sec, stamped.transform.translation.x = second, x
    return stamped


SURE, HELD = 0.97, 0.6


@pytest.mark.parametrize(
    ("messages", "acted"),
    [
        ([status(100, HELD), transform_at(100, 0.5), status(100, SURE), transform_at(100, 0.0)], [(100, 0.0)]),
        ([transform_at(100, 0.5), status(100, HELD), status(100, SURE), transform_at(100, 0.0)], [(100, 0.0)]),
        ([status(100, HELD), status(100, SURE), transform_at(100, 0.5), transform_at(100, 0.0)], [(100, 0.0)]),
        ([status(100, SURE), status(100, 0.0, "stale"), transform_at(100, 0.5)], []),
        ([status(100, HELD), transform_at(101, 0.1), status(101, SURE), transform_at(100, 0.5)], [(101, 0.1)]),
        ([transform_at(100, 0.5), status(101, HELD), status(100, SURE), transform_at(100, 0.0)], [(100, 0.0)]),
        ([status(100, SURE), transform_at(100, 0.5, "tibia")], []),
    ],
)
def test_the_consumer_never_pairs_a_status_with_the_transform_of_another(consumer, messages, acted):
    node, done = consumer
    node.bone = "bone_preop"
    for message in messages:
        (node._on_status if isinstance(message, DiagnosticStatus) else node._on_transform)(message)
    assert [each for each in done if isinstance(each, tuple)] == acted


@pytest.mark.parametrize(("max_age", "acted"), [(0.0, [-1000, -2, 0]), (1.0, [0]), (3.0, [-2, 0])])
def test_the_consumer_leaves_the_pose_of_a_cloud_that_is_too_old(consumer, max_age, acted):
    node, done = consumer
    node.max_age, now_s = max_age, node.get_clock().now().nanoseconds // 10**9
    for ago in (-1000, -2, 0):
        node._on_status(status(now_s + ago, SURE))
        node._on_transform(transform_at(now_s + ago, 0.5))
    assert [each[0] - now_s for each in done if isinstance(each, tuple)] == acted
    assert all(f"max_age is {max_age:g} s" in each for each in done if isinstance(each, str))


def test_the_pose_in_another_frame_is_that_of_the_status_whatever_tf2_has_of_the_bone(consumer):
    node, done = consumer
    asked = []

    class Buffer:
        def can_transform(self, target, source, stamp, return_debug_tuple):
            return True, ""

        def lookup_transform(self, target, source, stamp):
            asked.append((target, source, stamp.nanoseconds))
            return transform_at(0, 1.0)

    node.frame, node.buffer = "world", Buffer()
    node._on_transform(transform_at(100, 0.5))
    node._on_status(status(100, SURE))
    assert done == [(100, 1.5)] and set(asked) == {("world", "camera", 100 * 10**9)}


def test_where_stamps_go_back_the_consumer_forgets_the_frames_of_before(consumer):
    node, done = consumer
    cleared = []

    class Buffer:
        def can_transform(self, target, source, stamp, return_debug_tuple):
            return True, ""

        def lookup_transform(self, target, source, stamp):
            return transform_at(0, 1.0)

        def clear(self):
            cleared.append(len(done))

    node.frame, node.buffer = "world", Buffer()
    node.heard = Heard(node.buffer, lambda stamp: False, node)
    for stamp in (100, 101, 50, 51):
        node._on_status(status(stamp, SURE))
        node._on_transform(transform_at(stamp, 0.5))
    assert [each[0] for each in done] == [100, 101, 50, 51]
    assert cleared == [2], "before the pose at 50, and then no more"


def test_no_pose_is_taken_into_another_frame_over_a_time_in_which_that_was_not_heard(consumer):
    node, done = consumer

    class Buffer:
        def can_transform(self, target, source, stamp, return_debug_tuple):
            return True, ""

        def set_transform(self, transform, authority):
            """As tf2 does, it interpolates whatever comes."""

        def lookup_transform(self, target, source, stamp):
            return transform_at(0, 1.0)

    node.frame, node.buffer = "world", Buffer()
    node.heard = Heard(node.buffer, lambda stamp: False, node)
    for second in (99, 101, 102):
        heard = transform_at(second, 0.0, "camera")
        heard.header.frame_id = "world"
        node.heard.set_transform(heard, "the tracker")
    for second in (100, 101):
        node._on_transform(transform_at(second, 0.5))
        node._on_status(status(second, SURE))
    wait_until(lambda: node._meet() or len(done) == 2)
    assert (
        done[0]
        == "no transform world <- camera: 'camera' was not heard for 2 s around this stamp, max_tf_gap is 0.25 s"
    )
    assert done[1] == (101, 1.5)


@pytest.mark.parametrize("next_comes", [True, False])
def test_no_pose_is_taken_into_another_frame_before_it_is_clear_that_that_did_not_jump(consumer, next_comes):
    node, done = consumer

    class Buffer:
        def can_transform(self, target, source, stamp, return_debug_tuple):
            return True, ""

        def set_transform(self, transform, authority):
            """As tf2 does, it interpolates whatever comes."""

    node.frame, node.buffer = "world", Buffer()
    node.heard = Heard(node.buffer, lambda stamp: False, node)

    def hear(i, x):
        heard = transform_at(100, x, "camera")
        heard.header.frame_id, heard.header.stamp.nanosec = "world", i * 20_000_000
        node.heard.set_transform(heard, "the tracker")

    for i in range(5):
        hear(i, 0.02 * i + 0.12 * (i == 4))
    pose, sure = transform_at(100, 0.5), status(100, SURE)
    pose.header.stamp.nanosec = 70_000_000
    sure.values = [KeyValue(key=v.key, value="100.070000000" if v.key == "stamp" else v.value) for v in sure.values]
    node._on_transform(pose)
    node._on_status(sure)
    assert not done
    if next_comes:
        hear(5, 0.1)
    wait_until(lambda: node._meet() or done)
    assert ("for one transform alone" if next_comes else "is seen by the next one, which has not come") in done[0]


def test_the_consumer_runs_as_a_program_against_the_real_node(client, tmp_path):
    bone = bones.bone()
    node = NodeProcess(tmp_path, model_path=bones.save(bone, tmp_path / "bone.npz"), model_unit="mm", timeout=60.0)
    arguments = ("--ros-args", "-p", "min_confidence:=0.5", "-p", "max_tre:=0.01")
    program = NodeProcess(tmp_path, *arguments, script=EXAMPLES / "trusted_pose.py")
    try:
        client.wait_for_state("active")
        wait_until(lambda: client.node.count_subscribers("/register_node/status"))
        wait_until(lambda: client.ask(bones.partial(bone, np.eye(4))) and "bone at" in program.log, PATIENCE_S)
    finally:
        assert program.stop(signal.SIGINT) == 0, program.log
        node.stop()
    assert "Traceback" not in program.log


@pytest.mark.parametrize("stops", [True, False])
def test_a_message_that_comes_with_ctrl_c_is_no_failure_of_the_consumer_and_others_are(monkeypatch, stops):
    module = loaded("trusted_pose", monkeypatch)

    def interrupted(node):
        raise RuntimeError("Unable to convert call argument '0' to Python object")

    monkeypatch.setattr(sys, "argv", ["trusted_pose.py"])
    monkeypatch.setattr(module, "SHUTDOWN_S", 0.0)
    ended = []
    monkeypatch.setattr(module, "TrustedPose", lambda: SimpleNamespace(destroy_node=lambda: ended.append(True)))
    monkeypatch.setattr(module, "uninstall_signal_handlers", lambda: None)
    monkeypatch.setattr(module.rclpy, "init", lambda args: None)
    monkeypatch.setattr(module.rclpy, "try_shutdown", lambda: None)
    monkeypatch.setattr(module.rclpy, "spin", interrupted)
    monkeypatch.setattr(module.rclpy, "ok", lambda: not stops)
    with nullcontext() if stops else pytest.raises(RuntimeError):
        module.main()
    assert ended == [True] * stops


@pytest.mark.parametrize("name", ["trusted_pose", "planning_scene"])
def test_help_says_how_to_start_a_consumer_and_starts_none(capsys, monkeypatch, name):
    module = loaded("trusted_pose", monkeypatch)
    module = module if name == "trusted_pose" else loaded(name, monkeypatch)
    monkeypatch.setattr(module.rclpy, "init", lambda args: pytest.fail("a node was started"))
    monkeypatch.setattr("sys.argv", [f"{name}.py", "--help", "--ros-args", "-p", "max_tre:=0.002"])
    with pytest.raises(SystemExit) as end:
        module.main()
    assert end.value.code == 0 and f"python examples/ros/{name}.py" in capsys.readouterr().out


# --- MoveIt: moveit_msgs is part of a ROS installation, so its messages are stood in for here ---


@dataclass
class CollisionObject:
    header: Header
    id: str
    operation: bytes
    pose: Pose = field(default_factory=Pose)
    meshes: list = field(default_factory=list)
    mesh_poses: list = field(default_factory=list)


class MoveIt:
    CollisionObject = CollisionObject
    PlanningScene = PoseArray  # only advertised here


def test_the_obstacle_is_the_bone_in_metres_at_its_pose(tmp_path, monkeypatch):
    loaded("trusted_pose", monkeypatch)
    module = loaded("planning_scene", monkeypatch)
    bone = bones.bone()
    monkeypatch.setattr(module, "MOST_TRIANGLES", len(bone.faces))
    mesh = module.mesh_of(module.NodeParameters(model_path=str(bones.save(bone, tmp_path / "bone.npz"))))
    found = np.array([[p.x, p.y, p.z] for p in mesh.vertices])
    corners = found[np.array([t.vertex_indices for t in mesh.triangles])]
    np.testing.assert_allclose(corners, bone.points[bone.faces] / 1000.0, atol=1e-9)
    T = pose_mm([0.1, 0.2, 0.3], [0.5, 0.1, 0.2])  # metres
    transform = TransformStamped(header=Header(frame_id="tracker"), child_frame_id="femur")
    transform.transform = matrix_to_transform(T)
    made = module.obstacle(MoveIt, mesh, transform)
    assert (made.id, made.header.frame_id, made.meshes) == ("femur", "tracker", [mesh])
    assert (made.pose.position.x, made.pose.orientation) == (0.5, transform.transform.rotation)
    monkeypatch.setattr(module, "MOST_TRIANGLES", 10)
    with pytest.raises(ValueError, match="decimate"):
        module.mesh_of(module.NodeParameters(model_path=str(tmp_path / "bone.npz")))


@pytest.mark.parametrize(("axes", "turn"), [("as_is", 1.0), ("auto", -1.0), ("ras", -1.0)])
def test_the_obstacle_has_the_axes_that_the_node_has(tmp_path, monkeypatch, axes, turn):
    """A mesh that says SPACE=RAS was turned here, and by a node that was given nothing it was not."""
    loaded("trusted_pose", monkeypatch)
    module = loaded("planning_scene", monkeypatch)
    (tmp_path / "bone.obj").write_text("# SPACE=RAS\nv 30 20 0\nv 130 20 0\nv 30 20 200\nf 1 2 3\n")
    node = module.NodeParameters(model_path=str(tmp_path / "bone.obj"), model_axes=axes, model_unit="mm")
    first = module.mesh_of(node).vertices[0]
    assert (first.x, first.y, first.z) == pytest.approx((0.03 * turn, 0.02 * turn, 0.0))
    assert module.AS_THE_NODE["model_axes"] == "as_is", "given nothing, both read it as it is"


def test_the_filter_hears_the_pose_with_its_covariance_and_sends_the_frame_that_the_node_then_does_not():
    given = yaml.safe_load((EXAMPLES / "robot_localization.yaml").read_text())["ekf_filter_node"]["ros__parameters"]
    assert given["pose0"] == "/register_node/pose" and not given["pose0_differential"]
    assert given["pose0_config"] == [True] * 6 + [False] * 9
    assert given["world_frame"] == given["odom_frame"] != given["base_link_frame"]
    noise = np.reshape(given["process_noise_covariance"], (15, 15))
    assert (np.linalg.eigvalsh(noise) > 0.0).all()
    assert "publish_tf:=false" in (EXAMPLES / "robot_localization.yaml").read_text()


# --- what ships for the operating room ---


@pytest.fixture(scope="module")
def graph(blob_path):
    """Topics and services of a node, by what it does with them."""
    from harness import StandIn

    with node_in_thread(StandIn(), blob_path) as node:
        wait_until(lambda: node.state == "active")
        of = {"publish": node.get_publisher_names_and_types_by_node,
              "subscribe": node.get_subscriber_names_and_types_by_node,
              "reply": node.get_service_names_and_types_by_node}  # fmt: skip
        yield {kind: {name for name, _ in names("register_node", "/")} for kind, names in of.items()}


def test_the_security_policy_allows_what_the_node_does_and_names_nothing_else(graph):
    (profile,) = ElementTree.parse(ROOT / "deploy" / "sros2_policy.xml").getroot().iter("profile")
    optional = {"/tf", "/tf_static", "/clock", "/register_node/detection", "/diagnostics", "/parameter_events",
                "/register_node/get_type_description", "/tf2_frames"}  # fmt: skip
    for kind, does in graph.items():
        allowed = {
            entry.text.replace("~", "/register_node") if entry.text.startswith("~") else f"/{entry.text}"
            for group in profile if group.get(kind) == "ALLOW" for entry in group
        }  # fmt: skip
        assert does <= allowed, kind
        assert allowed - does <= optional, kind


def test_the_foxglove_layout_shows_topics_that_the_node_has():
    layout = json.loads((ROOT / "deploy" / "foxglove.json").read_text())
    text = json.dumps(layout["configById"])
    names = [part for part in text.split('"') if part.startswith("/register_node/")]
    shown = {name.split("/")[2].split(".")[0] for name in names}
    assert shown <= {"pose", *TOPICS} and "residuals" in shown and "status" in shown


def test_the_service_and_the_container_start_the_program_and_stop_it_in_time():
    unit = (ROOT / "deploy" / "register_node.service").read_text()
    assert "exec ros2 run gapr_ros register_node" in unit and "KillSignal=SIGTERM" in unit
    container = (ROOT / "deploy" / "Containerfile").read_text()
    assert "ros:jazzy" in container and "exec /gapr/venv/bin/register_node" in container


def test_topics_services_and_parameters_in_examples_and_deployment_are_those_of_the_node(graph):
    """Whatever they name under the node's own name, or give with -p, exists."""
    folders = ("examples/ros", "deploy", "docs/reference", "docs/how-to", "docs/tutorials", "README.md")
    texts = {path: path.read_text() for folder in folders
             for path in (sorted((ROOT / folder).glob("*.*")) if (ROOT / folder).is_dir() else [ROOT / folder])
             if path.is_file() and path.suffix != ".png"}  # fmt: skip
    own = {name.split("/")[2] for names in graph.values() for name in names if name.startswith("/register_node/")}
    optional = {"detection", "get_type_description"}
    consumers = {"frame", "bone_frame", "register_node", "max_age"}  # parameters of the examples
    others = {"use_sim_time", "NAME"}
    for path, text in texts.items():
        named = set(re.findall(r"(?:/register_node|\{source\}|[`\s>(]~)/([a-z_]+)\b(?!\.py|/)", text))
        assert named <= own | optional, (path.name, named - own - optional)
        given = set(re.findall(r"-p (\w+):=", text))
        assert given <= set(FIELDS) | consumers | others, (path.name, given - set(FIELDS))
