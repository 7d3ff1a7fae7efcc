"""Parameters of register_node: one frozen dataclass is the one source for defaults, ranges, help and the YAML file.

`python -m gapr_ros.parameters > config/register_node.yaml` writes the file.
"""

from __future__ import annotations

import difflib
import math
import sys
from array import array
from collections.abc import Callable, Iterable, Mapping
from dataclasses import Field, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gapr_core.config import SENSOR_KINDS
from gapr_core.runtime.settings import Settings, range_text, setting, why_not
from msg_adapters import INPUTS

if TYPE_CHECKING:
    from rcl_interfaces.msg import ParameterDescriptor
    from rclpy.node import Node
    from rclpy.parameter import Parameter

NOT_OURS = ("use_sim_time", "start_type_description_service")  # declared by rclpy itself
LARGE = 1e9  # end of a range that has none: rclpy wants one
ROS_TYPES = {float: "double", int: "integer", str: "string", bool: "bool", tuple: "double_array"}
NO_FRAME = ("auto", "none")  # what `viewpoint` can be besides a place
READ_BY_LAUNCH = (  # needs no declaration
    "launch-prefix",
    "launch-prefix-filter",
    "emulate_tty",
    "sigterm_timeout",
    "sigkill_timeout",
    "ros_namespace",
)
TRE_M, BONE_M, ROOM_M = 0.1, 1.0, 100.0  # longer lengths are odd for a bound, for a limit at a bone, for one in a room
MOST_LOOKS = 16  # of a camera that are registered as one, however many are asked for
TOGETHER = {"pointer": 500, "ultrasound": 50}  # clouds that are registered as one: each says little by itself
Triple = tuple[float, float, float]


class ParameterError(ValueError):
    """A parameter of the wrong type or out of range; the text says what to write instead."""


@dataclass(frozen=True)
class NodeParameters(Settings):
    """All parameters of register_node. Lengths in metres, times in seconds, angles in radians.

    `live=False`: read when configuring.
    """

    model_path: str = setting(
        "",
        "file of the pre-operative bone: a mesh, a cloud or a label map (docs/reference/formats.md); "
        "model_... are read when configuring and by ~/reload_model",
    )
    model_label: str = setting("", "name or number of the bone in a label map; several, with commas, are one bone")
    model_unit: str = setting("auto", "unit of that file; auto guesses mm or m from the extent and warns",
                              choices=("auto", "mm", "cm", "m"))  # fmt: skip
    model_scale: float = setting(1.0, "the bone is multiplied by this", low=1e-6)
    model_axes: str = setting("as_is", "axes of a mesh file: auto is what it says of itself; ras is turned to LPS, "
                              "lps_to_ras to RAS", choices=("as_is", "auto", "lps", "ras", "lps_to_ras"))  # fmt: skip
    model_frame: str = setting("bone_preop", "frame of the pre-operative bone, child of every pose", live=False)
    output_frame: str = setting("", "frame of the poses; empty: the frame of the cloud", live=False)
    tf_timeout: float = setting(
        0.1, "longest wait for a transform: of output_frame, crop_frame, viewpoint, initialpose",
        unit="s", low=0.0, high=60.0,
    )  # fmt: skip
    max_tf_gap: float = setting(
        0.25, "where a frame was not heard for longer than this, nothing is interpolated; 0: off", unit="s", low=0.0
    )
    cloud_type: str = setting("PointCloud2", "message type of the clouds", choices=tuple(INPUTS), live=False)
    cloud_unit: str = setting("m", "unit of the clouds; never guessed", choices=("m", "cm", "mm"))
    cloud_reliability: str = setting("auto", "auto: reliable, and best effort once a publisher offers only that",
                                     choices=("auto", "reliable", "best_effort"), live=False)  # fmt: skip
    min_points: int = setting(
        200, "fewer usable points are refused; counted over all clouds that are registered as one", low=3
    )
    max_points: int = setting(200_000, "larger clouds are thinned to this; 0: never", low=0)
    range_min: float = setting(0.0, "nearer points are left out; 0: off", unit="m", low=0.0)
    range_max: float = setting(0.0, "farther points are left out; 0: off", unit="m", low=0.0)
    max_cloud_age: float = setting(0.0, "older clouds are refused; 0: off", unit="s", low=0.0)
    max_future: float = setting(0.5, "clouds stamped farther ahead of the clock are refused; 0: off", unit="s", low=0.0)
    crop_frame: str = setting("", "frame of the box that clouds are cropped to; empty: that of the cloud", live=False)
    crop_min: Triple = setting((0.0, 0.0, 0.0), "its lowest corner; the same as crop_max: no box", unit="m")
    crop_max: Triple = setting((0.0, 0.0, 0.0), "its highest corner", unit="m")
    crop_to_track: float = setting(0.0, "after a good pose, points farther from the bone there are left out; 0: off",
                                   unit="m", low=0.0)  # fmt: skip
    viewpoint: str = setting("auto", "where the camera is: auto (its pixels or its surface may show it), none (all is "
                             "bone), origin (of the cloud's frame), or a frame", live=False)  # fmt: skip
    sensor: str = setting("unknown", "what measures the clouds; says what errors to expect",
                          choices=SENSOR_KINDS, live=False)  # fmt: skip
    standoff: float = setting(0.0, "how far outside of the bone the points lie; 0: what is usual for the sensor",
                              unit="m", low=-0.01, high=0.01, live=False)  # fmt: skip
    model_error: float = setting(-1.0, "standard deviation of how much too thick or too thin the bone's model is; 0: "
                                 "it is exact; below 0: 0.0003, or what the file of settings says",
                                 unit="m", low=-1.0, high=0.01, live=False)  # fmt: skip
    min_confidence: float = setting(0.5, "poses below are refused", low=0.0, high=1.0)
    max_tre: float = setting(0.0, "poses whose 95 % bound of the error over the bone is larger are refused; 0: off",
                             unit="m", low=0.0)  # fmt: skip
    require_consecutive: int = setting(1, "a pose goes out after this many good ones in a row", low=1, high=1000)
    max_jump_translation: float = setting(0.0, "poses farther from the last one are refused; 0: off", unit="m", low=0.0)
    max_jump_rotation: float = setting(
        0.0, "poses turned farther from the last one are refused; 0: off", unit="rad", low=0.0, high=3.15
    )
    continuous: bool = setting(True, "register every cloud that time allows; false: only on ~/register")
    track: bool = setting(True, "start where the last pose was; false: every cloud by itself", live=False)
    assess_every: int = setting(1, "of so many clouds one is assessed; the others may go to ~/followed_pose alone",
                                low=1, high=1000)  # fmt: skip
    accumulate: int = setting(0, "clouds registered as one; the bone must rest in output_frame; 0: as the sensor needs",
                              low=0, high=10_000, live=False)  # fmt: skip
    max_rate: float = setting(0.0, "most registrations a second; 0: as many as possible", low=0.0, high=1000.0)
    timeout: float = setting(5.0, "a registration that took longer is refused", unit="s", low=1e-3)
    publish_tf: bool = setting(True, "send accepted poses to /tf", live=False)
    publish_hypotheses: bool = setting(False, "send poses that are not believed to ~/hypotheses, to look at")
    guide: bool = setting(False, "work out where to look next, for ~/guidance and ~/next_view; takes time", live=False)
    settings_file: str = setting("", "YAML file as for `gapr register --config`; it must not contradict a parameter",
                                 live=False)  # fmt: skip
    device: str = setting("auto", "where a network runs", choices=("auto", "cpu", "cuda"), live=False)
    num_threads: int = setting(0, "threads of a registration; 0: all cores", low=0, high=1024, live=False)
    seed: int = setting(
        0, "seed of the thinning to max_points, and of a proposer that draws", low=0, high=2**31 - 1, live=False
    )
    autostart: bool = setting(True, "configure and activate without a lifecycle manager; read when the node starts",
                              live=False)  # fmt: skip
    diagnostics_period: float = setting(1.0, "time between two diagnostics", unit="s", low=0.01, high=3600.0)
    covariance_floor_translation: float = setting(
        1e-4, "smallest standard deviation of a translation", unit="m", low=1e-9
    )
    covariance_floor_rotation: float = setting(1e-3, "smallest standard deviation of a rotation", unit="rad", low=1e-9)

    @property
    def collects(self) -> bool:
        """Whether several clouds are registered as one."""
        return self.accumulate > 1

    @property
    def names_a_place(self) -> bool:
        """Whether every cloud is registered as what a camera saw from a place that is known."""
        return self.viewpoint not in NO_FRAME and not (self.collects and self.sensor in TOGETHER)

    @property
    def collects_looks(self) -> bool:
        """Whether clouds that are registered as one are looks of a camera, each from a place of its own."""
        return self.collects and self.names_a_place


FIELDS: Mapping[str, Field] = {f.name: f for f in fields(NodeParameters)}


def declare(node: Node) -> NodeParameters:
    """Declare everything on the node and read what it was given.

    Raises:
        ParameterError: for a value of the wrong type or out of range; the text says what to write instead.
    """
    given = node._parameter_overrides  # rclpy has no public accessor for what came from files and the command line
    for name, setting_field in FIELDS.items():
        _check_override(setting_field, given.get(name))
        default = setting_field.default
        node.declare_parameter(name, list(default) if type(default) is tuple else default, descriptor(setting_field))
    return read(node)


def read(node: Node) -> NodeParameters:
    """What the node's parameters say now, `accumulate` as the sensor needs it where it was left open."""
    given = NodeParameters(**{name: plain(node.get_parameter(name).value) for name in FIELDS})
    return given if given.accumulate else replace(given, accumulate=_together(given))


def plain(value: Any) -> Any:
    """A parameter's value as the dataclass holds it: arrays as tuples."""
    return tuple(value) if isinstance(value, list | array) else value


def remarks(parameters: NodeParameters) -> list[str]:
    """One sentence for each thing that was decided for the user, or that they may not expect."""
    sensor, sentences = parameters.sensor, []
    if sensor == "unknown":
        sentences.append("sensor is not set, and tre95 allows for any: set it to what measures the clouds")
    if sensor != "structured_light":
        stated = "where settings_file states it (sensor: tracking_mm, tracking_deg)"
        sentences.append(f"an error of the whole cloud's place, such as a tracker's, is in tre95 only {stated}")
    if parameters.max_tre == 0.0:
        sentences.append("max_tre is 0: a pose goes out however large its tre95 over the bone is")
    if sensor in TOGETHER and parameters.collects:
        sentences.append(f"sensor {sensor}: the last {parameters.accumulate} clouds are registered as one")
    elif sensor in TOGETHER and not parameters.output_frame:
        why = "output_frame is empty: name the frame of the reference that is fixed to the bone"
        sentences.append(f"sensor {sensor}: every cloud is registered by itself, because {why}")
    if parameters.collects and not parameters.output_frame:
        sentences.append("output_frame is empty: clouds are collected in their own frames, in which the bone must rest")
    if parameters.collects_looks:
        count = min(parameters.accumulate, MOST_LOOKS)
        most = f", {MOST_LOOKS} at most" if parameters.accumulate > MOST_LOOKS else ""
        sentences.append(f"the last {count} looks are registered as one, each from another direction{most}")
    elif parameters.viewpoint not in NO_FRAME and parameters.collects:
        sentences.append(f"viewpoint is not used: sensor {sensor} sees nothing from afar")
    if parameters.assess_every > 1 and (why := why_all_assessed(parameters)):
        sentences.append(f"assess_every is not used: {why}")
    if 0 < parameters.max_points < parameters.min_points:
        limits = f"max_points {parameters.max_points} is below min_points {parameters.min_points}"
        sentences.append(f"{limits}: points are counted before a cloud is thinned, so fewer than min_points may decide")
    return sentences


def empty_limits(parameters: NodeParameters) -> list[str]:
    """One sentence for each pair of limits that no point can lie between."""
    least, most, pairs = parameters.range_min, parameters.range_max, []
    if 0.0 < most <= least:
        pairs.append(f"range_min {least} is not below range_max {most}")
    low, high = parameters.crop_min, parameters.crop_max
    if low != high and any(start >= end for start, end in zip(low, high, strict=True)):
        pairs.append(f"crop_min {low} is not below crop_max {high}")
    return [f"{pair}: every cloud is refused until it is" for pair in pairs]


def odd_lengths(parameters: NodeParameters) -> list[str]:
    """One sentence for each length with which a limit never holds, as of a bone or of a room: perhaps it is in mm."""
    of_bound = ("max_tre",), TRE_M
    at_bone = ("max_jump_translation", "crop_to_track"), BONE_M
    in_room = ("range_min", "range_max", "crop_min", "crop_max"), ROOM_M
    return [
        f"{name} is {getattr(parameters, name)}: lengths are in metres; is it in mm?"
        for names, longest_m in (of_bound, at_bone, in_room)
        for name in names
        if any(longest_m < abs(length_m) < math.inf for length_m in _each(getattr(parameters, name)))
    ]


def _each(value: float | Triple) -> Triple:
    return value if isinstance(value, tuple) else (value,) * 3


def why_all_assessed(parameters: NodeParameters) -> str:
    """Why no cloud can be followed with these parameters, whatever `assess_every` is; empty where some can."""
    if not parameters.track:
        return "track is off, so there is no pose to follow"
    if parameters.collects:
        return "a cloud that is registered with others says little alone"
    if parameters.viewpoint not in NO_FRAME:
        return "with a viewpoint nobody knows which part of a cloud is bone before it is assessed"
    return ""


def _together(parameters: NodeParameters) -> int:
    return TOGETHER.get(parameters.sensor, 1) if parameters.output_frame else 1


def unknown_names(node: Node) -> list[str]:
    """One sentence for each name that was given, has no effect, and resembles none that has one."""
    of_qos = [name for name in node._parameter_overrides if name.startswith("qos_overrides")]
    others = [f"unknown parameter '{name}' is ignored" for name, near in _not_ours(node).items() if not near]
    return [f"'{name}' is ignored: set cloud_reliability" for name in of_qos] + others


def misspelt_names(node: Node) -> list[str]:
    """One sentence for each name that was given, has no effect, and resembles one that has."""
    named = {name: near[0] for name, near in _not_ours(node).items() if near}
    return [f"unknown parameter '{name}' is ignored; did you mean '{near}'?" for name, near in named.items()]


def _not_ours(node: Node) -> dict[str, list[str]]:
    """The names that were given and are none of the node's, each with the nearest one that is, where one is near."""
    known = (*FIELDS, *NOT_OURS)
    given = [name for name in node._parameter_overrides if name not in known and not name.startswith("qos_overrides")]
    return {name: difflib.get_close_matches(name, FIELDS, n=1) for name in given}


def check_launch_names(
    context: Any, file: Path, declared: Iterable[str], hint: str, warn: Callable[[str], object]
) -> None:
    """Refuse an argument that a launch file does not declare, which launch would lose in silence.

    A launch file that includes this one has names of its own among `launch_configurations`, such as points_left. So a
    name is refused only if it was typed after `ros2 launch gapr_ros` and this file, where every argument is for this
    file. Anywhere else a name that resembles a declared one is warned of, and the others are left alone.

    Args:
        context: the LaunchContext.
        file: the launch file, resolved.
        declared: the names that it has.
        hint: what to do where no name is near.
        warn: logs a sentence.

    Raises:
        ValueError: the unknown name, with the nearest declared one.
    """
    names = tuple(declared)
    alone = {"gapr_ros", file.name} <= set(sys.argv) or file in [Path(word).resolve() for word in sys.argv]
    typed = [word.split(":=")[0] for word in context.argv] if alone else []
    for name in sorted({*context.launch_configurations} - {*names, *READ_BY_LAUNCH}):
        near = difflib.get_close_matches(name, names, n=1, cutoff=0.8)
        sentence = f"unknown launch argument {name}: " + (f"did you mean {near[0]}?" if near else hint)
        if name in typed:
            raise ValueError(sentence)
        if near:
            warn(sentence)


def check_change(node: Node, parameters: Iterable[Parameter], configured: bool) -> str:
    """Why these changes cannot be made; empty when they can. rclpy has checked type and range already.

    What is set to the value that it has is no change: `ros2 param load` sets all that `ros2 param dump` wrote.
    """
    for parameter in parameters:
        setting_field = FIELDS.get(parameter.name)
        if setting_field is None or plain(parameter.value) == plain(node.get_parameter(parameter.name).value):
            continue
        if configured and not setting_field.metadata.get("live", True):
            if parameter.name == "autostart":
                return "autostart is read when the node starts: give it there"
            return f"{parameter.name} is read when configuring: deactivate, clean up, set it, then configure again"
        why = problem(setting_field, parameter.value)
        if why:
            return why
    return ""


def problem(setting_field: Field, value: Any) -> str:
    """What is wrong with a value, and what to write instead; empty when nothing is."""
    name, default = setting_field.name, setting_field.default
    value = plain(value)
    if type(default) is tuple and not _is_triple(value):
        return f"parameter '{name}' must be three finite doubles, got {value!r}: write [0.0, 0.0, 0.1]"
    if type(value) is not type(default):
        kind = ROS_TYPES[type(default)]
        how = f"write {_example(default, value)}"
        if isinstance(default, str) and isinstance(value, int | float):
            how += f" in a file, -p '{name}:=\"{value}\"' in a shell"
        return f"parameter '{name}' must be of type {kind}, got {value!r}: {how}"
    why = why_not(setting_field, value)
    limits = range_text(setting_field)
    wanted = f"within {limits}" if " to " in limits else limits or why
    return f"parameter '{name}' must be {wanted}, got {value!r}" if why else ""


def descriptor(setting_field: Field) -> ParameterDescriptor:
    """Help and range for `ros2 param describe`."""
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

    metadata, choices, default = setting_field.metadata, setting_field.metadata["choices"], setting_field.default
    message = ParameterDescriptor(description=metadata["text"])
    message.additional_constraints = f"one of: {', '.join(choices)}" if choices else range_text(setting_field)
    if metadata["low"] is None or isinstance(default, tuple):
        return message
    low, high = metadata["low"], LARGE if metadata["high"] is None else metadata["high"]
    if isinstance(default, float):
        message.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
    else:
        message.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    return message


def as_yaml() -> str:
    """The parameter file with every default and its help."""
    lines = ["# Every parameter of register_node with its default; generated by `python -m gapr_ros.parameters`.",
             "# Lengths in metres, times in seconds, angles in radians. Doubles need a decimal point.",
             "/**:", "  ros__parameters:"]  # fmt: skip
    for name, setting_field in FIELDS.items():
        lines.append(f"    {f'{name}: {_yaml(setting_field.default)}':<42} # {_help(setting_field)}")
    return "\n".join(lines) + "\n"


def _check_override(setting_field: Field, given: Parameter | None) -> None:
    why = "" if given is None else problem(setting_field, given.value)
    if why:
        raise ParameterError(why)


def _is_triple(value: Any) -> bool:
    return isinstance(value, tuple) and len(value) == 3 and all(type(x) is float and math.isfinite(x) for x in value)


def _example(default: Any, value: Any) -> str:
    if isinstance(default, float) and type(value) is int:
        return f"{value}.0"
    if type(default) is int and type(value) is float and value.is_integer():
        return str(int(value))  # 1e5 is a double
    if isinstance(default, float) and not default:
        return "1.0"  # 0.0 switches a limit off
    if isinstance(default, str):
        return f'"{value}"' if isinstance(value, int | float) else f'"{default}"'
    return _yaml(default)


def _yaml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(map(_number, value))}]"
    return f'"{value}"' if isinstance(value, str) else _number(value)


def _number(value: float) -> str:
    if isinstance(value, float) and abs(value) < 1e-2 and value:
        return f"{value:.1e}"  # YAML 1.1 reads 1e-4 as text
    return repr(value)


def _help(setting_field: Field) -> str:
    metadata = setting_field.metadata
    limits = " | ".join(metadata["choices"]) or range_text(setting_field)
    return f"{metadata['text']} [{limits}]" if limits else metadata["text"]


if __name__ == "__main__":
    sys.stdout.write(as_yaml())
