"""The dataclass is the one source; wrong values are answered with what to write instead."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from harness import NodeProcess, StandIn, context, node_in_thread, wait_until
from rclpy.context import Context
from rclpy.parameter import Parameter

from gapr_core.registration.scenes.scene import MOST_PLACES
from gapr_ros import parameters
from gapr_ros.node.lifecycle import RegisterNode
from gapr_ros.parameters import FIELDS, NodeParameters, ParameterError

FILE = Path(__file__).parents[2] / "config" / "register_node.yaml"


def test_the_parameter_file_is_the_dataclass():
    assert FILE.read_text() == parameters.as_yaml(), "run: python -m gapr_ros.parameters > config/register_node.yaml"


def test_yaml_reads_the_defaults_back_with_their_types():
    values = yaml.safe_load(parameters.as_yaml())["/**"]["ros__parameters"]
    values = {name: parameters.plain(value) for name, value in values.items()}
    assert values == dataclasses.asdict(NodeParameters())
    assert {name: type(value) for name, value in values.items()} == {n: type(f.default) for n, f in FIELDS.items()}


def test_every_default_is_within_its_own_range_and_choices():
    assert [parameters.problem(f, f.default) for f in FIELDS.values()] == [""] * len(FIELDS)


@pytest.fixture
def ros():
    made = context()
    yield made
    made.try_shutdown()


@pytest.mark.parametrize(
    ("name", "value", "hint"),
    [
        ("min_confidence", 1, "'min_confidence' must be of type double, got 1: write 1.0"),
        ("pose_lifetime", 10, "write 10.0"),
        ("max_tre", "two", "write 1.0"),
        ("error_after", 3.5, "must be of type integer, got 3.5: write 5"),
        ("error_after", 1e5, "must be of type integer, got 100000.0: write 100000"),
        ("error_after", float("inf"), "must be of type integer, got inf: write 5"),
        ("model_path", 5, 'write "5"'),
        ("model_label", 75, """write "75" in a file, -p 'model_label:="75"' in a shell"""),
        ("continuous", "yes", "write true"),
        ("min_confidence", 1.5, "within 0 to 1"),
        ("pose_lifetime", float("nan"), "must be at least 0 s, got nan"),
        ("cloud_unit", "inch", "one of m, cm, mm, got 'inch'"),
        ("error_after", -1, "must be at least 0"),
        ("crop_min", [0.0, 1.0], "must be three finite doubles"),
        ("crop_max", [0.0, 1.0, float("nan")], "must be three finite doubles"),
        ("crop_max", [0, 0, 1], "write [0.0, 0.0, 0.1]"),
        ("sensor", "lidar", "one of unknown, pointer, ultrasound, depth_camera, laser"),
    ],
)
def test_a_wrong_value_is_refused_with_what_to_write(ros, name, value, hint):
    with pytest.raises(ParameterError) as caught:
        RegisterNode(lambda _: StandIn(), context=ros, parameter_overrides=[Parameter(name, value=value)])
    assert hint in str(caught.value)


def test_the_process_ends_with_one_line_that_says_write_1_0(tmp_path):
    node = NodeProcess(tmp_path, "--ros-args", "-p", "min_confidence:=1")
    assert node.wait() == 1
    expected = "register_node: parameter 'min_confidence' must be of type double, got 1: write 1.0\n"
    assert node.log == expected


def test_a_parameter_file_with_an_unknown_name_is_warned_about(tmp_path):
    path = tmp_path / "typo.yaml"
    path.write_text("/**:\n  ros__parameters:\n    min_confidnce: 0.9\n    use_sim_time: false\n    autostart: false\n")
    node = NodeProcess(tmp_path, "--ros-args", "--params-file", str(path))

    wait_until(lambda: "unknown parameter 'min_confidnce' is ignored; did you mean 'min_confidence'?" in node.log)
    assert "use_sim_time" not in node.log
    assert node.stop() == 0, node.log


def test_what_is_set_to_the_value_that_it_has_is_accepted_while_the_node_runs(blob_path, client, method):
    """`ros2 param load` sets all that `ros2 param dump` wrote, one after the other; others set all of it or nothing."""
    with node_in_thread(method, blob_path) as node:
        client.wait_for_state("active")
        same = [node.get_parameter(name) for name in FIELDS]
        other = [Parameter("output_frame", value="tracker")]
        ask = node.set_parameters, node.set_parameters_atomically
        each, together, refused = (client.do(lambda: ask[0](same)), client.do(lambda: ask[1](same)),
                                   client.do(lambda: ask[1](same + other)))  # fmt: skip
        assert [result.reason for result in each] == [""] * len(FIELDS)
        assert together.successful
        assert not refused.successful and refused.reason.startswith("output_frame is read when configuring")


def test_the_shipped_file_starts_the_node_without_a_warning(tmp_path):
    node = NodeProcess(tmp_path, "--ros-args", "--params-file", str(FILE), "-p", "autostart:=false")
    wait_until(lambda: list(tmp_path.glob("python*_*.log")), 60.0, "rclpy's log file")  # silent, but it runs
    time.sleep(2.0)
    assert node.stop() == 0, node.log
    assert "WARN" not in node.log and "unknown" not in node.log


@pytest.mark.parametrize("side", ["femur", "tibia"])
def test_the_shipped_file_of_two_bones_gives_each_node_its_own_parameters_and_those_of_all(side):
    ros = Context()
    ros.init(args=["--ros-args", "--params-file", str(FILE.parent / "two_bones.yaml"), "-r", f"__ns:=/{side}"])
    node = RegisterNode(lambda _: StandIn(), context=ros, parameter_overrides=[Parameter("autostart", value=False)])
    found = node.parameters
    assert node.get_fully_qualified_name() == f"/{side}/register_node"
    assert (found.model_frame, found.model_path) == (f"{side}_preop", f"/data/{side}.stl")
    assert (found.model_unit, found.min_confidence, found.max_tre) == ("mm", 0.9, 0.004)
    node.close()
    ros.try_shutdown()


def test_descriptions_ranges_and_choices_can_be_asked_for(ros):
    node = RegisterNode(lambda _: StandIn(), context=ros, parameter_overrides=[Parameter("autostart", value=False)])
    described = {name: node.describe_parameter(name) for name in FIELDS}
    assert all(d.description for d in described.values())
    assert described["min_confidence"].floating_point_range[0].to_value == 1.0
    assert described["error_after"].integer_range[0].from_value == 0
    assert described["cloud_unit"].additional_constraints == "one of: m, cm, mm"
    node.close()


def test_live_parameters_change_while_running_and_the_others_say_how(blob_path, client, method):
    with node_in_thread(method, blob_path) as node:
        client.wait_for_state("active")
        ask = node.set_parameters_atomically
        assert ask([Parameter("min_confidence", value=0.7)]).successful
        assert node.parameters.min_confidence == 0.7
        refused = ask([Parameter("accumulate", value=3)])
        assert not refused.successful and "deactivate" in refused.reason
        refused = ask([Parameter("cloud_unit", value="inch")])
        assert not refused.successful and "one of m, cm, mm" in refused.reason
        assert not ask([Parameter("pose_lifetime", value=5)]).successful
        assert node.parameters.accumulate == 1 and node.parameters.cloud_unit == "m"


@pytest.mark.parametrize(
    ("sensor", "output_frame", "accumulate", "together", "sentence"),
    [
        ("unknown", "", 0, 1, "sensor is not set, and tre95 allows for any"),
        ("depth_camera", "tracker", 0, 1, ""),
        ("ultrasound", "reference", 0, 50, "the last 50 clouds are registered as one"),
        ("pointer", "reference", 0, 500, "the last 500 clouds are registered as one"),
        ("ultrasound", "", 0, 1, "by itself, because output_frame is empty"),
        ("ultrasound", "reference", 7, 7, "the last 7 clouds"),
        ("ultrasound", "reference", 1, 1, ""),
        ("unknown", "", 5, 5, "the bone must rest in the frame of the clouds"),
    ],
)
def test_slices_and_touched_points_are_registered_together_where_the_bone_rests_and_the_node_says_so(
    ros, sensor, output_frame, accumulate, together, sentence
):
    given = {"sensor": sensor, "output_frame": output_frame, "accumulate": accumulate, "autostart": False}
    overrides = [Parameter(name, value=value) for name, value in given.items()]
    node = RegisterNode(lambda _: StandIn(), context=ros, parameter_overrides=overrides)
    assert node.parameters.accumulate == together
    others = "max_tre is 0"
    remarks = [remark for remark in parameters.remarks(node.parameters) if not remark.startswith(others)]
    assert sentence in " ".join(remarks)
    assert bool(sentence) == bool(remarks)
    node.close()


@pytest.mark.parametrize(
    ("low", "high", "said"),
    [
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), False),
        ((-0.1, -0.1, -0.1), (0.1, 0.1, 0.1), False),
        ((-0.1, 0.1, -0.1), (0.1, -0.1, 0.1), True),
        ((-0.1, 0.0, -0.1), (0.1, 0.0, 0.1), True),
    ],
    ids=["no box", "a box", "a corner above the other", "a box without a volume"],
)
def test_a_box_that_no_point_can_be_in_is_said_when_it_is_configured(low, high, said):
    remarks = parameters.doubts(parameters.NodeParameters(crop_min=low, crop_max=high))
    assert sum("crop_min" in remark for remark in remarks) == said


@pytest.mark.parametrize(("given", "named"), [
    ({"max_tre": 1.0}, "max_tre is 1.0"), ({"max_tre": 0.09}, ""), ({"crop_max": (300.0, 1.0, np.inf)}, "crop_max"),
    ({"max_jump_translation": 50.0}, "max_jump"),
    ({"crop_min": (-300.0, -3.0, -3.0)}, "crop_min is (-300.0, -3.0, -3.0)"),
    ({"crop_min": (-3.0,) * 3, "crop_max": (3.0,) * 3}, ""), ({}, ""),
])  # fmt: skip
def test_lengths_that_may_be_in_mm_are_warned_of(given, named):
    said = parameters.doubts(parameters.NodeParameters(**given))
    assert len(said) == bool(named) and all(named in sentence and "is it in mm?" in sentence for sentence in said)


def test_the_node_keeps_as_many_looks_as_the_library_takes():
    assert parameters.MOST_LOOKS == MOST_PLACES


def test_limits_that_refuse_every_cloud_are_warned_of_and_a_remark_is_not(blob_path, client, method, capfd):
    with node_in_thread(method, blob_path, crop_min=[0.0, 0.0, 1.0]):
        client.wait_for_state("active")
    lines = capfd.readouterr().err.splitlines()
    levels = {text: line for line in lines for text in ("crop_min (0.0, 0.0, 1.0)", "max_tre is 0") if text in line}
    assert "[WARN]" in levels["crop_min (0.0, 0.0, 1.0)"] and "[INFO]" in levels["max_tre is 0"]


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"viewpoint": "origin"}, "the last 5 looks of a camera are registered as one"),
        ({"viewpoint": "auto"}, ""),
        ({"viewpoint": "origin", "accumulate": 1}, ""),
    ],
)
def test_the_node_says_what_becomes_of_the_looks_of_a_camera(given, sentence):
    values = {"accumulate": 5, "output_frame": "reference", **given}
    said = [
        each for each in parameters.remarks(parameters.NodeParameters(**values)) if "look" in each or "view" in each
    ]
    assert len(said) == bool(sentence) and sentence in " ".join(said)
