"""The launch files, run with stand-ins for launch and launch_ros, which are part of a ROS installation."""

from __future__ import annotations

import importlib.util
import logging
import sys
import tempfile
import types
from pathlib import Path

import pytest
import yaml
from harness import DOMAIN
from rclpy.context import Context
from rclpy.node import Node

from gapr_ros.parameters import FIELDS, plain, problem

ROOT = Path(__file__).parents[2]
DEFAULTS = str(ROOT / "config" / "register_node.yaml")


class Recorded:
    """Whatever is made of a class of launch, with what it was made of."""

    def __init__(self, *given, **named):
        self.given, self.named = given, named


@pytest.fixture
def load(monkeypatch):
    names = {
        "launch": ["LaunchContext", "LaunchDescription"],
        "launch.actions": ["DeclareLaunchArgument", "OpaqueFunction"],
        "launch.conditions": ["IfCondition"],
        "launch.logging": [],
        "launch.substitutions": ["PathJoinSubstitution"],
        "launch_ros": [],
        "launch_ros.actions": ["Node"],
        "launch_ros.substitutions": ["FindPackageShare"],
    }
    for module, classes in names.items():
        made = types.ModuleType(module)
        for name in classes:
            setattr(made, name, type(name, (Recorded,), {}))
        monkeypatch.setitem(sys.modules, module, made)
    sys.modules["launch.logging"].get_logger = logging.getLogger

    def load(name):
        spec = importlib.util.spec_from_file_location(name.split(".")[0], ROOT / "launch" / name)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return load


def started(module, typed=(), others=None, **arguments):
    """The nodes that a launch file starts when it is given these arguments.

    `typed` is what stands on the command line, `others` are configurations of a launch file that includes this one.
    """
    *declared, opaque = module.generate_launch_description().given[0]
    values = {argument.given[0]: argument.named["default_value"] for argument in declared}
    assert set(arguments) <= set(values), "an argument that is not declared"
    values = {name: value if isinstance(value, str) else DEFAULTS for name, value in values.items()}
    values |= arguments | dict(word.split(":=") for word in typed) | (others or {})
    chosen = types.SimpleNamespace(launch_configurations=values, argv=list(typed))
    return opaque.named["function"](chosen, *opaque.named.get("args", []))


@pytest.fixture(autouse=True)
def scratch(monkeypatch, tmp_path):
    """Where a launch file writes the parameters that its arguments name."""
    (tmp_path / "scratch").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "scratch"))


def heard(files, namespace="/"):
    """The parameters that a node of this name gets from files, by name; rcl reads them."""
    ros = Context()
    given = [word for file in files for word in ("--params-file", str(file))]
    ros.init(args=["--ros-args", *given, "-r", f"__ns:={namespace}"], domain_id=DOMAIN)
    node = Node("register_node", context=ros, start_parameter_services=False)
    found = {name: plain(parameter.value) for name, parameter in node._parameter_overrides.items()}
    node.destroy_node()
    ros.try_shutdown()
    return found


def test_every_parameter_of_the_node_is_an_argument_and_none_is_given_unasked(load):
    module = load("register.launch.py")
    declared = {argument.given[0] for argument in module.generate_launch_description().given[0][:-1]}
    assert set(FIELDS) <= declared
    *_, register = started(module)
    assert register.named["parameters"] == [DEFAULTS]


def test_arguments_become_parameters_of_the_type_that_the_node_wants(load):
    arguments = {"min_confidence": "1", "accumulate": "50", "model_path": "007", "guide": "true", "max_tre": "0.002",
                 "crop_min": "[0, 0, -1]", "use_sim_time": "true"}  # fmt: skip
    rviz, _, register = started(load("register.launch.py"), points="/camera/points", namespace="/left", **arguments)
    given = heard(register.named["parameters"][1:], "/left")
    wanted = {"min_confidence": 1.0, "accumulate": 50, "model_path": "007", "guide": True, "use_sim_time": True,
              "crop_min": (0.0, 0.0, -1.0), "max_tre": 0.002}  # fmt: skip
    assert given == wanted
    assert [problem(FIELDS[name], value) for name, value in given.items() if name in FIELDS] == [""] * 6
    assert ("points", "/camera/points") in register.named["remappings"] and register.named["namespace"] == "/left"
    assert rviz.named["parameters"] == [{"use_sim_time": True}]


NUMBERS = ["1e3", "007", "0x10", "nan", ".inf"]
WORDS = ["yes", "y", "OFF", "null", "~", "a: b", "[1]", """a "b" 'c'""", "für 😀", "#"]


@pytest.mark.parametrize("text", NUMBERS + WORDS)
def test_an_argument_for_a_text_stays_a_text_whatever_yaml_takes_it_for(load, text):
    *_, register = started(load("register.launch.py"), output_frame=text, model_path=text)
    assert heard(register.named["parameters"][1:]) == {"output_frame": text, "model_path": text}


@pytest.mark.parametrize("order", [("/**", "/femur/register_node"), ("/femur/register_node", "/**")])
def test_an_argument_wins_over_every_entry_of_the_file(load, tmp_path, order):
    file = tmp_path / "mine.yaml"
    file.write_text("".join(f'"{name}": {{ros__parameters: {{max_tre: 0.005, error_after: 3}}}}\n' for name in order))
    *_, register = started(load("register.launch.py"), params_file=str(file), namespace="/femur", max_tre="0.002")
    assert heard(register.named["parameters"], "/femur") == {"max_tre": 0.002, "error_after": 3}


@pytest.mark.parametrize(("name", "count"), [("register", 1), ("bones", 2)])
def test_the_tilde_of_a_parameter_file_is_the_home_folder_which_a_shell_leaves_as_it_is(
    load, monkeypatch, tmp_path, name, count
):
    (tmp_path / "mine.yaml").write_text((ROOT / "config" / "two_bones.yaml").read_text())
    monkeypatch.setenv("HOME", str(tmp_path))
    nodes = started(load(f"{name}.launch.py"), params_file="~/mine.yaml")
    files = [node.named["parameters"] for node in nodes[-count:]]
    assert files == [[str(tmp_path / "mine.yaml")]] * count


def test_a_parameter_file_that_does_not_exist_is_refused(load):
    with pytest.raises(ValueError, match="expected a parameter file, got '/no/such.yaml'"):
        started(load("register.launch.py"), params_file="/no/such.yaml")


def test_the_manager_of_nav2_starts_the_node_where_it_is_asked_for(load):
    _, manager, register = started(load("register.launch.py"), manager="true")
    assert manager.named["parameters"] == [{"node_names": ["register_node"], "autostart": True, "bond_timeout": 0.0}]
    assert heard(register.named["parameters"])["autostart"] is False
    *_, register = started(load("register.launch.py"))
    assert heard(register.named["parameters"])["autostart"] is True


@pytest.mark.parametrize(("name", "text"), [
    ("min_confidence", "high"), ("crop_min", "1"), ("crop_min", "[1"),
    ("error_after", "1e3"), ("error_after", "2026-01-01"),
    ("continuous", "{a: 1}"),
])  # fmt: skip
def test_what_is_no_value_of_a_parameter_goes_to_the_node_which_says_what_it_wants(load, name, text):
    *_, register = started(load("register.launch.py"), **{name: text})
    assert f"parameter '{name}' must be" in problem(FIELDS[name], heard(register.named["parameters"][1:])[name])


def test_rviz_shows_what_the_node_hears_and_says(load):
    rviz, _, register = started(load("register.launch.py"), points="/camera/points", namespace="left")
    assert rviz.named["namespace"] == register.named["namespace"] == "left"
    displays = yaml.safe_load((ROOT / "rviz" / "register.rviz").read_text())["Visualization Manager"]["Displays"]
    shown = {display["Topic"]["Value"] for display in displays if "Topic" in display}
    assert shown <= {name for name, _ in rviz.named["remappings"]}
    assert ("/points", "/camera/points") in rviz.named["remappings"]


def test_a_use_sim_time_that_is_neither_true_nor_false_is_refused(load):
    with pytest.raises(ValueError, match="must be true or false, got 'maybe'"):
        started(load("register.launch.py"), use_sim_time="maybe")


def test_the_shipped_file_of_two_bones_starts_two_nodes_that_hear_one_topic(load):
    path = ROOT / "config" / "two_bones.yaml"
    nodes = started(load("bones.launch.py"), params_file=str(path), points="/camera/points")
    assert [node.named["namespace"] for node in nodes] == ["/femur", "/tibia"]
    assert all(node.named["remappings"] == [("points", "/camera/points")] for node in nodes)
    assert all(float(node.named["sigterm_timeout"]) > 5.0 for node in nodes), "launch's own patience"
    for entry in yaml.safe_load(path.read_text()).values():
        given = entry["ros__parameters"]
        assert [problem(FIELDS[name], value) for name, value in given.items()] == [""] * len(given)


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        (None, "expected a parameter file with one entry a bone, got .*copy share/gapr_ros/config/two_bones.yaml"),
        ("\0", "not a parameter file"),
        ("a: {", "bones.yaml: not a parameter file"),
        ("", "got NoneType"),
        ("- femur", "got list"),
        ("/**: {ros__parameters: {}}", "no entry such as /femur/register_node"),
        ("1: 2", "no entry such as /femur/register_node, got 1"),
        (
            "/a/register_node: {ros__parameters: {}}\n/b/register_node: {ros__parameters: {}}",
            "a model_frame of its own",
        ),
        ("/a/register_node:\n/b/register_node: [1]", "a model_frame of its own"),
    ],
)
def test_a_file_without_bones_and_one_frame_for_two_are_refused(load, tmp_path, text, hint):
    if text is not None:
        (tmp_path / "bones.yaml").write_text(text)
    with pytest.raises(ValueError, match=hint):
        started(load("bones.launch.py"), params_file=str(tmp_path / "bones.yaml"))


def test_bones_without_a_file_are_refused_with_what_to_pass(load):
    with pytest.raises(ValueError, match="got ''; copy .* pass params_file:=FILE"):
        started(load("bones.launch.py"))


@pytest.mark.parametrize("command", [["gapr_ros", "{}"], [str(ROOT / "launch" / "{}")]])
@pytest.mark.parametrize(
    ("name", "word", "hint"),
    [
        ("register", "max_tree:=0.002", "unknown launch argument max_tree: did you mean max_tre?"),
        ("register", "modelunit:=mm", "unknown launch argument modelunit: did you mean model_unit?"),
        ("register", "voxel:=1", "unknown launch argument voxel: --show-args lists those that there are"),
        ("bones", "point:=/x", "unknown launch argument point: did you mean points?"),
        ("bones", "model_unit:=mm", "unknown launch argument model_unit: parameters of a node belong in params_file"),
    ],
)
def test_an_argument_that_is_not_declared_is_refused_with_the_nearest(load, monkeypatch, name, word, hint, command):
    file = f"{name}.launch.py"
    monkeypatch.setattr(sys, "argv", ["ros2", "launch", *(part.format(file) for part in command), word])
    with pytest.raises(ValueError) as caught:
        started(load(file), [word], params_file=str(ROOT / "config" / "two_bones.yaml"))
    assert str(caught.value) == hint


@pytest.mark.parametrize("file", ["register.launch.py", "bones.launch.py"])
def test_what_launch_itself_reads_may_be_given(load, monkeypatch, file):
    typed = ["launch-prefix:=gdb", "emulate_tty:=true", "sigterm_timeout:=9", "sigkill_timeout:=9", "points:=/x"]
    monkeypatch.setattr(sys, "argv", ["ros2", "launch", "gapr_ros", file, *typed])
    assert len(started(load(file), typed, params_file=str(ROOT / "config" / "two_bones.yaml"))) >= 2


@pytest.mark.parametrize("file", ["register.launch.py", "bones.launch.py"])
@pytest.mark.parametrize("command", [["my_robot", "robot.launch.py"], ["my_robot", "{}"]])
def test_the_names_of_a_launch_file_that_includes_this_one_are_at_most_warned_of(
    load, monkeypatch, caplog, file, command
):
    typed = ["points_left:=/a", "robot:=arm", "point:=/x"]
    monkeypatch.setattr(sys, "argv", ["ros2", "launch", *(part.format(file) for part in command), *typed])
    others = {"ros_namespace": "left", "global_params": [("use_sim_time", True)], "rviz_config": "robot.rviz"}
    assert len(started(load(file), typed, others, params_file=str(ROOT / "config" / "two_bones.yaml"))) >= 2
    assert caplog.messages == ["unknown launch argument point: did you mean points?"]


NESTED = """
/**: {ros__parameters: {model_unit: mm}}
/femur/register_node: {ros__parameters: {model_frame: a}}
tibia/register_node: {ros__parameters: {model_frame: b}}
tibia2: {register_node: {ros__parameters: {model_frame: c}}}
/left/: {knee: {patella: {register_node: {ros__parameters: {model_frame: d}}}}, "*": {ros__parameters: {max_tre: 9.0}}}
tibia2/register_node: {ros__parameters: {model_label: "2"}}
"""


def test_a_bone_in_every_form_that_rcl_reads_gets_a_node_and_its_parameters(load, tmp_path):
    path = tmp_path / "bones.yaml"
    path.write_text(NESTED)
    namespaces = [node.named["namespace"] for node in started(load("bones.launch.py"), params_file=str(path))]
    assert namespaces == ["/femur", "/tibia", "/tibia2", "/left/knee/patella"]
    for namespace, frame in zip(namespaces, "abcd", strict=True):
        found = heard([path], namespace)
        assert (found["model_frame"], found["model_unit"]) == (frame, "mm")


@pytest.mark.parametrize(
    ("entry", "name"),
    [
        ("/femur/registernode: {ros__parameters: {model_frame: c}}", "/femur/registernode"),
        ("femur: {registernode: {ros__parameters: {model_frame: c}}}", "/femur/registernode"),
        ("tibia: {registernode: {ros__parameters: {}}, register_node: {ros__parameters: {}}}", "/tibia/registernode"),
        ("/tibia: {ros__parameters: {model_frame: c}}", "/tibia"),
        ("/femur/register_node: {ros_parameters: {model_frame: c}}", "/femur/register_node/ros_parameters"),
        ("register_node: {ros__parameters: {model_frame: c}}", "/register_node"),
        ("femur:", "/femur"),
        ("1: 2", "/1"),
    ],
)
def test_an_entry_that_would_start_no_node_is_refused_beside_good_ones(load, tmp_path, entry, name):
    path = tmp_path / "bones.yaml"
    path.write_text(f"/tibia/register_node: {{ros__parameters: {{model_frame: b}}}}\n{entry}\n")
    with pytest.raises(ValueError, match=f"bones.yaml: {name} would start no node: expected entries such as /femur/re"):
        started(load("bones.launch.py"), params_file=str(path))
