"""While a bone is read, the node goes on: diagnostics, services, clouds; and it ends when it is asked to."""

from __future__ import annotations

import os
import signal
import threading
from dataclasses import replace

import bones
import numpy as np
import psutil
import pytest
from harness import PATIENCE_S, NodeProcess, StandIn, node_in_thread, wait_until
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import GetState
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from gapr_core import Accumulator, LookAccumulator
from gapr_core.config import ClutterConfig, CovarianceConfig, RegistrarConfig, SensorConfig
from gapr_core.errors import ConfigError, WeightsError
from gapr_core.model import weights
from gapr_core.model.config import ModelConfig
from gapr_core.model.network import GAPRNet
from gapr_core.runtime.settings import changes
from gapr_ros.node.model import ShippedMethod, check_file, configured, load_model
from gapr_ros.parameters import NodeParameters

LIMIT_S = 2.0  # of CPU time
SIGNALS = [  # one of them every day: each needs a node of its own, which takes seconds to start
    signal.SIGTERM,
    pytest.param(signal.SIGINT, marks=pytest.mark.slow),
    pytest.param(signal.SIGKILL, marks=pytest.mark.slow),
]
GOOD = np.random.default_rng(1).normal(size=(1000, 3)) * 0.02


class Slow(StandIn):
    """Prepares a bone when its gate is opened."""

    def prepare(self, target, units="mm"):
        assert self.gate.wait(PATIENCE_S)
        if self.error is not None:
            raise self.error
        return super().prepare(target, units)


@pytest.fixture
def slow():
    made = Slow()
    made.gate.clear()
    return made


@pytest.mark.parametrize(("scale", "is_odd"), [(1.0, False), (0.1, True)])
def test_a_bone_of_an_uncommon_size_is_warned_of(tmp_path, caplog, scale, is_odd):
    path = bones.save(bones.bone(), tmp_path / "bone.npz", 1.0 / scale)
    parameters = replace(NodeParameters(), model_path=str(path), model_unit="mm")
    load_model(StandIn(), parameters)
    assert ("as small as a patella" in caplog.text) is is_odd


@pytest.mark.parametrize(
    ("file", "given", "is_inferred"),
    [
        ({}, {}, True),
        ({}, {"viewpoint": "none"}, False),
        ({}, {"viewpoint": "origin"}, True),
        ({"infer_viewpoint": False}, {}, False),
    ],
)
def test_where_a_camera_was_is_inferred_unless_all_is_bone(file, given, is_inferred):
    settings = RegistrarConfig(clutter=ClutterConfig(**file))
    assert configured(settings, replace(NodeParameters(), **given)).clutter.infer_viewpoint is is_inferred


@pytest.mark.parametrize(
    ("file", "given", "parameter"),
    [
        (RegistrarConfig(min_confidence=0.99), {}, "min_confidence"),
        (RegistrarConfig(max_tre_mm=2.0), {"max_tre": 0.003}, "max_tre"),
        (RegistrarConfig(guide=True), {}, "guide"),
        (RegistrarConfig(sensor=SensorConfig("pointer", 0.0)), {}, "sensor"),
    ],
)
def test_a_file_must_not_say_otherwise_than_a_parameter_that_decides(file, given, parameter):
    """A limit in the file that the parameter's default takes back would be dropped in silence."""
    parameters = replace(NodeParameters(), **given)
    with pytest.raises(ConfigError, match=f"set the parameter '{parameter}' so"):
        check_file(file, parameters, named_in(file))
    check_file(file, parameters, ["refinement.rounds"])


def named_in(config):
    return [change.partition("=")[0] for change in changes(config)]


@pytest.mark.parametrize(
    ("text", "given", "parameter"),
    [
        ("min_confidence: 0.5", {"min_confidence": 0.1}, "min_confidence"),
        ("guide: false", {"guide": True}, "guide"),
        ("sensor: {kind: unknown}", {"sensor": "pointer"}, "sensor"),
        ("clutter: {infer_viewpoint: true}", {"viewpoint": "none"}, "viewpoint"),
    ],
)
def test_what_a_file_says_counts_where_it_is_the_default_too(tmp_path, text, given, parameter):
    (tmp_path / "settings.yaml").write_text(text)
    with pytest.raises(ConfigError, match=f"set the parameter '{parameter}' so"):
        ShippedMethod()(replace(NodeParameters(), settings_file=str(tmp_path / "settings.yaml"), **given))


def test_a_file_may_say_the_same_as_the_parameters_and_what_they_leave_open():
    file = RegistrarConfig(
        min_confidence=0.9,
        max_tre_mm=2.0,
        sensor=SensorConfig("pointer", 0.0),
        covariance=CovarianceConfig(model_mm=0.1),
        num_threads=1,
    )
    same = replace(NodeParameters(), min_confidence=0.9, max_tre=0.002, sensor="pointer")
    check_file(file, same, named_in(file))
    rounded = RegistrarConfig(max_tre_mm=4.1)
    check_file(rounded, replace(NodeParameters(), max_tre=0.0041), named_in(rounded))  # 4.1000000000000005 mm


def test_a_file_that_was_refused_is_refused_again(tmp_path):
    (tmp_path / "settings.yaml").write_text("min_confidence: 0.99\n")
    factory = ShippedMethod()
    for _ in range(2):
        with pytest.raises(ConfigError, match="min_confidence"):
            factory(replace(NodeParameters(), settings_file=str(tmp_path / "settings.yaml")))


def test_the_settings_file_is_read_when_configuring_and_limits_hold_whatever_has_become_of_it(tmp_path, client):
    path, factory = tmp_path / "settings.yaml", ShippedMethod()
    path.write_text("refinement: {rounds: 11}\n")
    bone = bones.save(bones.bone(), tmp_path / "bone.npz")
    with node_in_thread(None, bone, factory=factory, settings_file=str(path), track=False) as node:
        client.wait_for_state("active")
        assert node.session._ready.method.config.refinement.rounds == 11
        path.write_text("nonsense: [\n")
        assert node.set_parameters([Parameter("min_confidence", value=0.7)])[0].successful
        wait_until(lambda: node.session._ready.method.config.min_confidence == 0.7, PATIENCE_S, "the new limit")
        assert node.session._ready.method.config.refinement.rounds == 11
        assert client.call("reload_model").success
        for transition in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP):
            assert client.change_state(transition)
        assert not client.change_state(Transition.TRANSITION_CONFIGURE), "now it is read again"


def test_a_bone_whose_file_has_changed_is_reported_until_it_is_read_again(tmp_path, client, method):
    path = bones.save(bones.bone(), tmp_path / "bone.npz")
    with node_in_thread(method, path) as node:
        client.wait_for_state("active")
        assert not node.session.model.has_changed
        os.utime(path, ns=(0, 0))
        wait_until(lambda: f"{path} has changed since it was read" in client.values("input")["conflicts"])
        assert client.call("reload_model").success
        wait_until(lambda: "has changed" not in client.values("input")["conflicts"])
        path.unlink()
        assert not node.session.model.has_changed, "what was read is still there"


def test_the_tilde_of_a_settings_file_is_the_home_folder_which_a_shell_leaves_as_it_is(tmp_path, monkeypatch):
    (tmp_path / "settings.yaml").write_text("refinement: {rounds: 11}\nmin_confidence: 0.5\n")
    monkeypatch.setenv("HOME", str(tmp_path))
    method = ShippedMethod()(replace(NodeParameters(), settings_file="~/settings.yaml", track=False))
    assert method.config.refinement.rounds == 11
    with pytest.raises(ConfigError, match="min_confidence"):
        ShippedMethod()(replace(NodeParameters(), settings_file="~/settings.yaml", min_confidence=0.9))


def test_the_node_takes_weights_of_ones_own_and_refuses_a_file_that_is_not_there(tmp_path, monkeypatch):
    own = GAPRNet(ModelConfig(width=16, global_width=32, global_layers=1))
    weights.save(own, tmp_path / "own.safetensors", {})
    monkeypatch.setenv("HOME", str(tmp_path))
    registrar = ShippedMethod()(replace(NodeParameters(), weights="~/own.safetensors", track=False))
    assert registrar.proposers[0].network.config == own.config and not registrar.proposers[0].is_shipped
    with pytest.raises(WeightsError, match="another"):
        ShippedMethod()(replace(NodeParameters(), weights="~/another.safetensors"))


def test_a_node_that_was_shut_down_says_to_start_it_again(blob_path, client, method):
    with node_in_thread(method, blob_path):
        client.wait_for_state("active")
        assert client.change_state(Transition.TRANSITION_ACTIVE_SHUTDOWN)
        for service in ("register", "reset", "reload_model"):
            answer = client.call(service)
            assert (answer.success, answer.message) == (False, "the node is finalized: start it again")


def state_of(client):
    future = client.ready(GetState, "/register_node/get_state").call_async(GetState.Request())
    wait_until(future.done)
    return future.result().current_state.label


def test_while_it_configures_diagnostics_go_on_and_services_answer(blob_path, client, slow):
    with node_in_thread(slow, blob_path, autostart=False):
        wait_until(lambda: client.values().get("state") == "unconfigured")
        configured = client.ask_for(Transition.TRANSITION_CONFIGURE)
        wait_until(lambda: "loading" in client.values()["message"])
        count = len(client.diagnostics)
        wait_until(lambda: len(client.diagnostics) > count + 5)
        assert state_of(client) == "unconfigured" and not configured.done()
        answer = client.call("reload_model")
        assert not answer.success and "configure it" in answer.message
        second = client.ask_for(Transition.TRANSITION_CONFIGURE)
        wait_until(second.done)
        assert not second.result().success, "one bone at a time"
        slow.gate.set()
        wait_until(configured.done)
        assert configured.result().success and state_of(client) == "inactive"


def test_a_bone_that_cannot_be_prepared_fails_the_transition_with_its_reason(blob_path, client, slow):
    slow.error = RuntimeError("no such bone")
    with node_in_thread(slow, blob_path, autostart=False):
        wait_until(lambda: client.values().get("state") == "unconfigured")
        configured = client.ask_for(Transition.TRANSITION_CONFIGURE)
        slow.gate.set()
        wait_until(configured.done)
        assert not configured.result().success
        wait_until(lambda: client.values()["level"] == 2)
        assert client.values()["message"].startswith("configure failed: RuntimeError: no such bone")
        how = "it stays unconfigured: correct it, then ros2 lifecycle set /register_node configure, then activate"
        assert f"; {how}, or start again" in client.values()["message"]
        slow.error = None
        configured = client.ask_for(Transition.TRANSITION_CONFIGURE)
        wait_until(configured.done)
        assert configured.result().success


def test_while_it_reloads_clouds_are_registered_to_the_old_bone(blob_path, client, slow):
    slow.gate.set()
    with node_in_thread(slow, blob_path):
        client.wait_for_state("active")
        slow.gate.clear()
        slow.register = StandIn().register  # of clouds; only the bone waits
        reloaded = client.ready(Trigger, "/register_node/reload_model").call_async(Trigger.Request())
        for _ in range(3):
            assert client.ask(GOOD)["level"] == 0
        assert not reloaded.done()
        answer = client.call("reload_model")
        assert not answer.success and "one bone at a time" in answer.message
        slow.gate.set()
        wait_until(reloaded.done)
        assert reloaded.result().success and client.ask(GOOD)["level"] == 0


def test_a_limit_that_is_set_while_a_bone_is_read_holds_for_it(blob_path, client, slow):
    """The method was made with the limits of before: another one is made, as if they had been set afterwards."""
    made = []

    def factory(parameters):
        made.append(parameters.min_confidence)
        return slow

    slow.gate.set()
    with node_in_thread(slow, blob_path, factory=factory, min_confidence=0.9) as node:
        client.wait_for_state("active")
        slow.gate.clear()
        reloaded = client.ready(Trigger, "/register_node/reload_model").call_async(Trigger.Request())
        wait_until(lambda: len(made) == 2)
        assert node.set_parameters([Parameter("min_confidence", value=0.5)])[0].successful
        slow.gate.set()
        wait_until(reloaded.done)
        wait_until(lambda: made[-1] == 0.5, what=made)
    assert made[:2] == [0.9, 0.9]


def test_a_cloud_that_comes_after_a_limit_was_set_is_registered_by_it(blob_path, client):
    """Its method was made before it, and it went to the old one where the executor was busy: refused once more."""
    made, gate, busy = [StandIn(), StandIn()], threading.Event(), threading.Event()

    def factory(parameters):
        if parameters.max_tre == 0.0:
            return made[0]
        assert gate.wait(PATIENCE_S)
        return made[1]

    with node_in_thread(None, blob_path, factory=factory) as node:
        client.wait_for_state("active")
        made[0].calls.clear()  # its warm-up
        assert node.set_parameters([Parameter("max_tre", value=0.5)])[0].successful
        client.send(GOOD)
        wait_until(lambda: node.counters.received == 1, PATIENCE_S, "the cloud")
        node.call_soon(lambda: busy.wait(PATIENCE_S))
        gate.set()
        try:
            wait_until(lambda: made[0].calls or made[1].calls, PATIENCE_S, "the registration")
        finally:
            busy.set()
        assert not made[0].calls and len(made[1].calls) == 1


def test_a_parameter_that_is_set_just_as_the_bone_is_ready_does_not_miss_the_method(blob_path, client, method):
    """It was taken, and the method was made without it: between the end of the reading and the change of state."""
    with node_in_thread(method, blob_path, autostart=False) as node:
        finish, answers = node._loader._finish, []

        def finish_and_set(*args):
            finish(*args)
            answers.append(node.set_parameters([Parameter("accumulate", value=7)])[0])

        node._loader._finish = finish_and_set
        assert client.change_state(Transition.TRANSITION_CONFIGURE)
        assert not answers[0].successful and "read when configuring" in answers[0].reason
        assert node.session._ready.parameters.accumulate == node.parameters.accumulate == 1


def test_a_bone_that_is_ready_after_the_node_was_destroyed_raises_nothing(blob_path, client, slow):
    with node_in_thread(slow, blob_path) as node:
        wait_until(lambda: "loading" in client.values().get("message", ""))
        loading = node._loader._thread
    raised = []
    threading.excepthook, before = raised.append, threading.excepthook
    try:
        slow.gate.set()
        loading.join(PATIENCE_S)
    finally:
        threading.excepthook = before
    assert not loading.is_alive() and not raised


def test_a_transition_that_the_state_does_not_allow_is_refused_and_survived(blob_path, client, method):
    with node_in_thread(method, blob_path):
        client.wait_for_state("active")
        for transition in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE, 77):
            refused = client.ask_for(transition)
            wait_until(refused.done)
            assert not refused.result().success
        assert client.ask(GOOD)["level"] == 0


# --- signals, to the real node with the real library ---


@pytest.fixture(scope="module")
def huge_model(tmp_path_factory):
    """Eight million points: 15 s of CPU time to prepare, longer than any of these tests lasts."""
    path = tmp_path_factory.mktemp("model") / "huge.npy"
    np.save(path, bones.bone().sample(8_000_000, np.random.default_rng(0))[0])
    return path


def started(client, folder, model_path, **parameters):
    """A node process, as soon as it is heard."""
    node = NodeProcess(folder, model_path=model_path, model_unit="mm", **parameters)
    wait_until(lambda: client.values() or node.process.poll() is not None, PATIENCE_S, "the node's first word")
    return node


def cpu_s(node):
    return sum(psutil.Process(node.process.pid).cpu_times()[:2])


@pytest.mark.parametrize("after_s", [0.0, 6.0], ids=["while_it_imports", "while_it_prepares"])
@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_ends_the_node_within_two_seconds_while_it_loads(client, tmp_path, huge_model, number, after_s):
    node = started(client, tmp_path, huge_model)
    wait_until(lambda: "loading" in client.values()["message"], PATIENCE_S, "the word that it loads")
    begun_s = cpu_s(node)
    wait_until(lambda: cpu_s(node) >= begun_s + after_s, PATIENCE_S, f"{after_s:g} s of work")
    assert node.stop_cpu_s(number) < LIMIT_S
    assert "points" not in node.log, "the bone was ready before the signal came: this shows nothing"
    assert "Traceback" not in node.log


@pytest.mark.slow
@pytest.mark.parametrize("number", SIGNALS)
@pytest.mark.parametrize("autostart", [True, False], ids=["active", "unconfigured"])
def test_a_signal_ends_the_node_within_two_seconds_while_nothing_happens(client, tmp_path, number, autostart):
    model = bones.save(bones.bone(), tmp_path / "bone.npz")
    node = started(client, tmp_path, model, autostart=autostart)
    wait_until(lambda: client.values()["state"] == ("active" if autostart else "unconfigured"), PATIENCE_S, "its state")
    assert node.stop_cpu_s(number) < LIMIT_S
    assert "Traceback" not in node.log


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_ends_the_node_within_two_seconds_while_it_registers(client, tmp_path, number):
    """400 000 points take most of a second of CPU time and more."""
    bone = bones.bone()
    model = bones.save(bone, tmp_path / "bone.npz")
    node = started(client, tmp_path, model, track=False)
    client.wait_for_state("active")
    before = client.values()
    begun_s = cpu_s(node)
    client.send(bones.partial(bone, np.eye(4), count=400_000))
    wait_until(lambda: cpu_s(node) >= begun_s + 0.2, PATIENCE_S, "a fifth of a second of work")
    assert client.values()["frames_accepted"] == before["frames_accepted"] == "0", "it was ready before the signal"
    assert node.stop_cpu_s(number) < LIMIT_S
    assert "Traceback" not in node.log


@pytest.mark.parametrize(
    ("given", "kind", "most"),
    [
        ({"viewpoint": "origin"}, LookAccumulator, 5),
        ({"viewpoint": "origin", "accumulate": 40}, LookAccumulator, 16),
        ({"viewpoint": "auto"}, Accumulator, 5),
        ({"viewpoint": "origin", "sensor": "pointer"}, Accumulator, 5),
    ],
)
def test_clouds_of_a_camera_with_a_place_are_collected_as_looks(given, kind, most):
    method = ShippedMethod()(NodeParameters(**{"accumulate": 5, **given}))
    assert type(method) is kind and method.most == most
