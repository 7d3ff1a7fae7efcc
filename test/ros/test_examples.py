"""The ROS examples: run where they can be, and compared with the node where they need a full ROS installation."""

from __future__ import annotations

import importlib.util
import json
import re
import sys
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import bones
import numpy as np
import pytest
import yaml
from geometry_msgs.msg import Pose
from harness import Spinner, accepted, context, node_in_thread, pose_mm, wait_until
from rclpy.clock import ClockType
from rclpy.time import Time
from std_msgs.msg import Header

from gapr_core.results import RegistrationResult, RegistrationStatus
from gapr_ros.node.publish import TOPICS
from gapr_ros.parameters import FIELDS
from msg_adapters import matrix_to_pose

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


@dataclass
class Detection3DArray:
    header: Header = field(default_factory=Header)
    detections: list = field(default_factory=list)


@pytest.fixture
def consumer(monkeypatch):
    """The example's class, which notes what it does; `vision_msgs` is stood in for where it is not installed."""
    if find_spec("vision_msgs") is None:
        messages = SimpleNamespace(Detection3DArray=Detection3DArray)
        for name, module in {"vision_msgs": SimpleNamespace(msg=messages), "vision_msgs.msg": messages}.items():
            monkeypatch.setitem(sys.modules, name, module)
    module, done = loaded("trusted_pose", monkeypatch), []

    class Noting(module.TrustedPose):
        def act(self, bone, frame, pose, covariance):
            done.append((bone, frame, round(pose.position.x, 6)))

        def hold(self, why):
            done.append(why)

    return Noting, done


def detected(stamp_s, score=0.95, x=0.1):
    """A message of the node as the consumer reads it."""
    header = Header(frame_id="probe", stamp=Time(nanoseconds=int(stamp_s * 1e9)).to_msg())
    pose = SimpleNamespace(pose=Pose(), covariance=[1e-6] * 36)
    pose.pose.position.x = x
    result = SimpleNamespace(hypothesis=SimpleNamespace(class_id="femur", score=score), pose=pose)
    return Detection3DArray(header, [] if score is None else [SimpleNamespace(results=[result])])


@pytest.mark.parametrize(("age_s", "score", "max_age", "done"), [
    (0.0, 0.95, 1.0, ("femur", "probe", 0.1)), (0.0, 0.7, 1.0, "confidence 0.70"), (0.0, None, 1.0, "no pose"),
    (0.0, float("nan"), 1.0, "confidence nan"), (5.0, 0.95, 1.0, "confidence 0.95, 5.0 s old"),
    (5.0, 0.95, 0.0, ("femur", "probe", 0.1)),
])  # fmt: skip
def test_the_consumer_acts_on_a_pose_while_it_may(consumer, age_s, score, max_age, done):
    made, noted = consumer
    now_s = 1_700_000_000.0
    now = Time(nanoseconds=int(now_s * 1e9), clock_type=ClockType.ROS_TIME)
    node = SimpleNamespace(least=0.9, oldest=max_age, get_clock=lambda: SimpleNamespace(now=lambda: now))
    node.act, node.hold = partial(made.act, None), partial(made.hold, None)
    made.on_detection(node, detected(now_s - age_s, score))
    (found,) = noted
    assert found == done if isinstance(done, tuple) else found.startswith(done)


@pytest.mark.skipif(find_spec("vision_msgs") is None, reason="the messages come with a ROS installation")
def test_the_consumer_follows_the_node_through_five_clouds(blob_path, client, method, consumer):
    """Accepted, accepted below the consumer's gate, refused, stopped, late joined."""
    made, done = consumer
    spinner = Spinner(context())
    with node_in_thread(method, blob_path, pose_lifetime=0.5):
        client.wait_for_state("active")
        spinner.start(made(context=spinner.context))
        method.answer = accepted(confidence=0.95)
        wait_until(lambda: client.ask(GOOD) and any(isinstance(each, tuple) for each in done), what="discovery")
        done.clear()
        assert client.ask(GOOD)["level"] == 0
        method.answer = accepted(confidence=0.7)
        client.ask(GOOD)
        method.answer = RegistrationResult(RegistrationStatus.AMBIGUOUS, confidence=0.9)
        client.ask(GOOD)
        wait_until(lambda: len(done) >= 4, what=lambda: done)  # the last one: the pose was withdrawn
        late = []
        made.hold = made.act = lambda self, *given: late.append(given)
        second = Spinner(context())
        second.start(made(context=second.context))
        wait_until(lambda: late, what="what is latched")
        second.close()
    spinner.close()
    assert isinstance(done[0], tuple) and done[1].startswith("confidence 0.70") and done[2:4] == ["no pose"] * 2
    assert late[0] == ("no pose",)


@pytest.mark.parametrize("name", ["trusted_pose.py", "trusted_pose_cpp/trusted_pose.cpp"])
def test_the_consumers_use_no_file_of_the_node_and_one_subscription(name):
    text = (EXAMPLES / name).read_text()
    assert "gapr_ros" not in text.replace("ros2 run gapr_ros", "") and text.count("create_subscription") == 1
    if name.endswith("py"):
        assert len(text.splitlines()) <= 40


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

    @staticmethod
    def PlanningScene(is_diff):
        return SimpleNamespace(world=SimpleNamespace())


def test_the_obstacle_is_the_bone_in_metres_at_its_pose(tmp_path, monkeypatch, consumer):
    module = loaded("planning_scene", monkeypatch)
    bone = bones.bone()
    monkeypatch.setattr(module, "MOST_TRIANGLES", len(bone.faces))
    mesh = module.mesh_of(bones.save(bone, tmp_path / "bone.npz"), "mm")
    found = np.array([[p.x, p.y, p.z] for p in mesh.vertices])
    corners = found[np.array([t.vertex_indices for t in mesh.triangles])]
    np.testing.assert_allclose(corners, bone.points[bone.faces] / 1000.0, atol=1e-9)
    T = pose_mm([0.1, 0.2, 0.3], [0.5, 0.1, 0.2])  # metres
    sent, pose = [], matrix_to_pose(T)
    node = SimpleNamespace(mesh=mesh, types=MoveIt, scene=SimpleNamespace(publish=sent.append))
    module.BoneInScene.act(node, "femur", "tracker", pose, None)
    (made,) = sent[0].world.collision_objects
    assert (made.id, made.header.frame_id, made.meshes, made.pose) == ("femur", "tracker", [mesh], pose)
    monkeypatch.setattr(module, "MOST_TRIANGLES", 10)
    with pytest.raises(ValueError, match="decimate"):
        module.mesh_of(tmp_path / "bone.npz", "mm")


@pytest.mark.parametrize(("axes", "turn"), [("as_is", 1.0), ("auto", -1.0), ("ras", -1.0)])
def test_the_obstacle_has_the_axes_that_it_is_given(tmp_path, monkeypatch, consumer, axes, turn):
    module = loaded("planning_scene", monkeypatch)
    (tmp_path / "bone.obj").write_text("# SPACE=RAS\nv 30 20 0\nv 130 20 0\nv 30 20 200\nf 1 2 3\n")
    first = module.mesh_of(tmp_path / "bone.obj", "mm", axes).vertices[0]
    assert (first.x, first.y, first.z) == pytest.approx((0.03 * turn, 0.02 * turn, 0.0))


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
    shown = {name.split("/", 2)[2].split(".")[0] for name in names}
    assert shown <= {"detection", *TOPICS} and "debug/residuals" in shown and "status" in shown


def test_rviz_shows_topics_that_the_node_has(graph):
    text = (ROOT / "rviz" / "register.rviz").read_text()
    shown = re.findall(r"Topic:\n(?:.*\n)*?\s+Value: (\S+)", text)
    assert len(shown) >= 5 and set(shown) <= graph["publish"] | graph["subscribe"]


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
    consumers = {"topic", "max_age"}  # parameters of the examples
    others = {"use_sim_time", "NAME"}
    for path, text in texts.items():
        named = set(re.findall(r"(?:/register_node|\{source\}|[`\s>(]~)/([a-z_]+)\b(?!\.py|/)", text))
        assert named <= own | optional, (path.name, named - own - optional)
        given = set(re.findall(r"-p (\w+):=", text))
        assert given <= set(FIELDS) | consumers | others, (path.name, given - set(FIELDS))
