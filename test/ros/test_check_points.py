"""Points that a pointer touched, on `check_points`: the verdict on ~/check is of the pose that stands alone."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import bones
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point, Pose, PoseArray
from harness import NODE, StandIn, accepted, node_in_thread, pose_mm, wait_until
from rclpy.time import Time
from std_msgs.msg import Header

from gapr_core import Accumulator, Registrar, RegistrarConfig, Tracker
from gapr_core.config import CovarianceConfig, SensorConfig
from gapr_core.geometry import se3
from gapr_core.results import PointCheck, RegistrationResult, RegistrationStatus, Verdict
from gapr_ros.node import check_points
from gapr_ros.node.method import configured
from gapr_ros.node.model import Ready, load_model
from gapr_ros.parameters import NodeParameters

GOOD = np.random.default_rng(1).normal(size=(1000, 3)) * 0.02
T = pose_mm([0.3, -1.1, 0.7], [120.0, -40.0, 300.0])
OK, WARN, ERROR = (ord(level) for level in (DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR))


class Prepares(StandIn):
    """A stand-in whose bone is prepared as GAPR does it, and whose pose is known."""

    def __init__(self):
        super().__init__()
        self.answer = accepted(T, centre_mm=np.zeros(3))

    def prepare(self, target, units="mm"):
        return Registrar().prepare(target, units)


class Pointer:
    """Publishes touched points, metres, and waits for what the node says of them."""

    def __init__(self, client):
        self._client, self.heard = client, []
        listen = client.node.create_subscription
        client.do(lambda: listen(DiagnosticStatus, f"{NODE}/check", self.heard.append, 10))
        self._publisher = client.do(lambda: client.node.create_publisher(PoseArray, "check_points", 10))
        wait_until(self._publisher.get_subscription_count, what="the subscription to check_points")
        wait_until(lambda: client.node.count_publishers(f"{NODE}/check"), what="the publisher of ~/check")

    def touch(self, points, frame="probe"):
        """(level, message, values) of the answer."""
        before = len(self.heard)
        poses = [Pose(position=Point(x=float(x), y=float(y), z=float(z))) for x, y, z in points]
        self._publisher.publish(PoseArray(header=Header(frame_id=frame), poses=poses))
        wait_until(lambda: len(self.heard) > before, what="an answer on ~/check")
        found = self.heard[-1]
        return ord(found.level), found.message, {pair.key: pair.value for pair in found.values}


@pytest.fixture
def bone(tmp_path):
    """Points of a bone, mm, and their file."""
    points = bones.bone().sample(4000, np.random.default_rng(0))[0]
    np.save(tmp_path / "bone.npy", points)
    return points, tmp_path / "bone.npy"


def test_touched_points_check_the_pose_that_stands(client, bone):
    points, path = bone
    method = Prepares()
    touched = se3.apply(se3.inverse(T), points[::80]) * 1e-3

    with node_in_thread(method, path):
        client.wait_for_state("active")
        pointer = Pointer(client)
        level, text, values = pointer.touch(touched)
        assert (level, values["verdict"]) == (WARN, "") and "register first" in text
        assert (values["points"], values["pose_stamp"], values["pose_age"]) == ("0", "", "")

        answer = client.ask(GOOD)
        level, text, values = pointer.touch(np.vstack([touched, [[np.nan, 0.0, 0.0]]]))
        assert (level, values["verdict"], values["points"]) == (OK, "HOLDS", "50")
        assert text.endswith("not finite and left out: 1")
        assert values["pose_stamp"] == answer["cloud_stamp"] and 0.0 < float(values["pose_age"]) < 60.0
        assert text.startswith("HOLDS  50 points") and 0.0 < float(values["unseen"]) < 0.004
        assert len(values["next_point"].split()) == 3

        level, _, values = pointer.touch(touched[:3])
        assert (level, values["verdict"]) == (WARN, "SAYS_LITTLE")
        level, _, values = pointer.touch(touched + [0.0, 0.0, 0.02])
        assert (level, values["verdict"]) == (ERROR, "CONTRADICTED")
        level, text, values = pointer.touch(touched, frame="tracker")
        assert (level, values["verdict"]) == (WARN, "") and "in 'tracker', the pose is in 'probe'" in text
        for none in (np.empty((0, 3)), np.full((2, 3), np.nan)):
            level, text, _ = pointer.touch(none)
            assert level == WARN and text == check_points.NO_POINTS and "mm" not in text

        method.answer = RegistrationResult(RegistrationStatus.AMBIGUOUS, reason="for the test")
        client.ask(GOOD)
        assert pointer.touch(touched)[2]["verdict"] == "HOLDS"  # a refusal takes no pose away
        client.call("reset")
        assert "register first" in pointer.touch(touched)[1]


@pytest.mark.parametrize(("age_s", "end"), [(3.0, "mm"), (55.2, "  the pose is 55 s old"), (None, "mm")])
def test_the_verdict_says_which_pose_it_is_of_and_how_old_that_is(age_s, end):
    header = Header(frame_id="probe", stamp=Time(nanoseconds=100_500_000_000).to_msg())
    found = PointCheck(Verdict.HOLDS, 0.5, np.zeros((1, 3)), np.zeros(1), np.ones(1), 1.0, 1.0, *np.zeros((2, 3)))
    now_ns = 0 if age_s is None else int((100.5 + age_s) * 1e9)
    accepted = SimpleNamespace(header=header)
    said = check_points.status(PoseArray(poses=[Pose()]), found, accepted, now_ns, "node", "")
    values = {pair.key: pair.value for pair in said.values}
    assert said.message.endswith(end)
    assert values["pose_stamp"] == "100.500000000" and values["pose_age"] == ("" if age_s is None else f"{age_s:.4g}")


def test_points_far_from_the_bone_are_asked_about_in_the_words_of_the_topic():
    nowhere = np.full(1, np.nan)
    found = PointCheck(Verdict.CONTRADICTED, 0.0, np.zeros((1, 3)), nowhere, nowhere, 1.0, 1.0, *np.zeros((2, 3)))
    said = check_points.status(PoseArray(poses=[Pose()]), found, None, 0, "node", "").message
    assert check_points.NONE_NEAR in said and "source" not in said and "the unit of the source?" in str(found)


def test_a_method_that_says_no_covariance_or_prepares_nothing_is_named(client, blob_path, method, monkeypatch):
    with node_in_thread(method, blob_path) as node:
        client.wait_for_state("active")
        said = []
        monkeypatch.setattr(node.get_logger(), "warning", lambda text, **options: said.append((text, options)))
        pointer = Pointer(client)
        client.ask(GOOD)
        level, text, _ = pointer.touch(GOOD[:5])
        assert level == WARN and "expected a prepared target; got" in text
        assert said == [(f"nothing was checked: {text}", {"throttle_duration_sec": 5.0})], "a flood fills no log"


@pytest.mark.parametrize(("sensor", "standoff", "usual_mm"), [("pointer", 0.002, 2.0), ("pointer", 0.0, None),
                                                              ("laser", 0.002, None)])  # fmt: skip
def test_touched_points_are_a_pointers_whatever_the_clouds_are_and_a_stand_off_is_that_of_its_own_sensor(
    sensor, standoff, usual_mm
):
    """The node's stand-off is of its clouds: a laser's says nothing of the pointer."""
    parameters = NodeParameters(sensor=sensor, standoff=standoff)
    of_method = Registrar(configured(RegistrarConfig(), parameters))
    for method in (of_method, SimpleNamespace()):  # the other one has no settings
        config = check_points._config(method, parameters)
        assert (config.sensor.kind, config.sensor.standoff_mm) == ("pointer", usual_mm)


@pytest.mark.parametrize("of", [Registrar, lambda config: Tracker(Registrar(config)),
                                lambda config: Accumulator(Registrar(config), 3)])  # fmt: skip
def test_touched_points_err_by_what_the_settings_file_says_of_the_pointer_and_of_the_bone(of):
    """A right pose with a pointer that is known to be noisy was called contradicted."""
    said = RegistrarConfig(sensor=SensorConfig(kind="pointer", noise_mm=2.0), covariance=CovarianceConfig(model_mm=1.5))
    found = check_points._config(of(said), NodeParameters(sensor="pointer"))
    assert (found.sensor, found.covariance) == (said.sensor, said.covariance)
    lasers = replace(said, sensor=SensorConfig(kind="laser", noise_mm=0.1))
    found = check_points._config(of(lasers), NodeParameters(sensor="laser"))
    assert (found.sensor, found.covariance.model_mm) == (SensorConfig(kind="pointer"), 1.5)


def test_the_node_gives_check_points_the_settings_of_its_method(bone):
    points, path = bone
    noisy = RegistrarConfig(sensor=SensorConfig(kind="pointer", noise_mm=3.0))
    usual = RegistrarConfig(sensor=SensorConfig(kind="pointer"))
    touched = points[::20] + np.random.default_rng(0).normal(0.0, 3.0, (200, 3))
    poses = [Pose(position=Point(x=float(x), y=float(y), z=float(z))) for x, y, z in touched * 1e-3]
    message = PoseArray(header=Header(frame_id="probe"), poses=poses)
    parameters = NodeParameters(sensor="pointer", model_path=str(path))
    stands = SimpleNamespace(result=accepted(np.eye(4), centre_mm=np.zeros(3)), header=Header(frame_id="probe"))
    verdicts = []
    for config in (noisy, usual):
        method = Registrar(config)
        ready = Ready(method, load_model(method, parameters), parameters)
        verdicts.append(check_points.check(message, stands, ready, parameters).verdict)
    assert verdicts == ["HOLDS", "CONTRADICTED"]
