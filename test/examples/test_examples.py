"""examples/openigtlink/bridge.py between a real pyigtl server (the tracker) and a real client (3D Slicer)."""

import importlib.util
import socket
import time
from pathlib import Path

import numpy as np
import pytest

from gapr_core import Accumulator, Registrar, RegistrarConfig
from gapr_core.errors import InvalidPointCloudError
from gapr_core.geometry import se3
from gapr_core.results import RegistrationResult, RegistrationStatus

pyigtl = pytest.importorskip("pyigtl", reason="the other end of the OpenIGTLink bridge: pip install pyigtl")
BRIDGE = Path(__file__).parents[2] / "examples" / "openigtlink" / "bridge.py"
DEVICE = "StylusTipToTracker"
WAIT_S = 60.0


@pytest.fixture(scope="module")
def bridge():
    spec = importlib.util.spec_from_file_location("bridge", BRIDGE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def free_port():
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


@pytest.fixture
def linked():
    """The tracker's server with the bridge's client of it, and the bridge's server with Slicer's client of it."""
    pairs = []
    for _ in range(2):
        port = free_port()
        server = pyigtl.OpenIGTLinkServer(port)
        client = pyigtl.OpenIGTLinkClient("127.0.0.1", port)
        deadline = time.monotonic() + WAIT_S
        while not (server.is_connected() and client.is_connected()):
            assert time.monotonic() < deadline
            time.sleep(0.01)
        pairs += [server, client]
    yield pairs
    for end in (pairs[1], pairs[3], pairs[0], pairs[2]):
        end.stop()


def touch(tracker, point):
    matrix = np.eye(4)
    matrix[:3, 3] = point
    tracker.send_message(pyigtl.TransformMessage(matrix, device_name=DEVICE))


class Fixed:
    """Answers with the results that it was given."""

    def __init__(self, *results):
        self.results, self.sources = list(results), []

    def register(self, points, target):
        self.sources.append(points)
        result = self.results.pop(0)
        if isinstance(result, Exception):
            raise result
        return result


T = se3.exp([10.0, -70.0, 200.0, 0.3, -1.2, 0.7])


def test_a_pose_reaches_slicer_in_ras_and_a_refusal_as_a_status_alone(bridge, linked):
    tracker, client, server, slicer = linked
    good = RegistrationResult(RegistrationStatus.OK, T, np.eye(6), 0.99)
    refused = RegistrationResult(RegistrationStatus.AMBIGUOUS, reason="two poses fit")
    registrar = Fixed(refused, good)
    made = bridge.Bridge(registrar, None, client, server, DEVICE, every=3)
    points = np.random.default_rng(0).uniform(-100.0, 100.0, (6, 3))
    answers = []
    for point in points:
        for _ in range(2):  # a pointer that rests: the same point does not count twice
            touch(tracker, point)
            answers.append(made.step(WAIT_S))
    assert [answer for answer in answers if answer is not None] == [refused, good]
    np.testing.assert_allclose(registrar.sources[0], points[:3], atol=1e-4)
    np.testing.assert_allclose(registrar.sources[1], points[3:], atol=1e-4)

    matrix = slicer.wait_for_message("TrackerToCT", WAIT_S).matrix
    np.testing.assert_allclose(
        matrix[:3, :3] @ points[0] + matrix[:3, 3], se3.apply(T, points)[0] * [-1, -1, 1], atol=1e-3
    )
    deadline = time.monotonic() + WAIT_S
    while (status := slicer.wait_for_message("Registration", WAIT_S)).code != bridge.OK:
        assert status.code == bridge.NOT_FOUND and "AMBIGUOUS" in status.text and time.monotonic() < deadline
    assert status.text.startswith("OK")


def test_points_that_cannot_be_of_one_bone_are_a_status_and_the_bridge_goes_on(bridge, linked):
    tracker, client, server, slicer = linked
    good = RegistrationResult(RegistrationStatus.OK, T, np.eye(6), 0.99)
    real, target = Accumulator(Registrar(RegistrarConfig(num_threads=1)), most=bridge.GROUPS), None
    with pytest.raises(InvalidPointCloudError) as refusal:
        real.collect([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [5000.0, 0.0, 0.0]])
    made = bridge.Bridge(Fixed(refusal.value, good), target, client, server, DEVICE, every=3)
    answers = []
    for point in ([0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [5000.0, 0.0, 0.0]):
        touch(tracker, point)
        answers.append(made.step(WAIT_S))
    assert answers == [None] * 3 and not made.points
    status = slicer.wait_for_message("Registration", WAIT_S)
    assert status.code == bridge.NOT_FOUND and "5e+03 mm" in status.text
    for point in ([20.0, 0.0, 0.0], [30.0, 0.0, 0.0], [40.0, 0.0, 0.0]):
        touch(tracker, point)
        answers.append(made.step(WAIT_S))
    assert answers[-1] is good


def test_the_codes_of_a_status_are_those_of_openigtlink(bridge):
    assert (bridge.OK, bridge.NOT_FOUND) == (1, 4)  # igtlStatusMessage.h: STATUS_OK, STATUS_NOT_FOUND


def test_a_pointer_that_sends_no_numbers_or_nothing_is_waited_for(bridge, linked):
    tracker, client, server, _ = linked
    made = bridge.Bridge(Fixed(), None, client, server, DEVICE, every=1)
    assert made.step(0.05) is None
    touch(tracker, [np.nan, 0.0, 0.0])
    assert made.step(WAIT_S) is None and not made.points


def test_a_pointer_on_a_femur_gives_its_pose(bridge, linked):
    from gapr_core.data.parametric import make_bone

    tracker, client, server, slicer = linked
    bone, registrar = make_bone("femur", 1), Registrar(RegistrarConfig(num_threads=1))
    surface, normals = bone.sample(3000, np.random.default_rng(0))
    seen = surface[normals[:, 1] < 0.2][:150]
    together = Accumulator(registrar, most=bridge.GROUPS)
    made = bridge.Bridge(together, registrar.prepare(bone), client, server, DEVICE, every=50)
    for point in se3.apply(se3.inverse(T), seen):
        touch(tracker, point)
        result = made.step(WAIT_S)
    assert result.ok and len(together.collected) == 150, result
    found = slicer.wait_for_message("TrackerToCT", WAIT_S).matrix
    off = se3.apply(found.astype(float), se3.apply(se3.inverse(T), bone.points)) - bone.points * [-1, -1, 1]
    assert np.linalg.norm(off, axis=1).max() < 2.0
