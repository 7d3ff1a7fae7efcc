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
LONGEST_M = {"max_tre": 0.1, "max_jump_translation": 1.0, "crop_min": 100.0, "crop_max": 100.0}  # more may be mm
MOST_LOOKS = 16  # of a camera that are registered as one, however many are asked for
TOGETHER = {"pointer": 500, "ultrasound": 50}  # clouds that are registered as one: each says little by itself
Triple = tuple[float, float, float]


class ParameterError(ValueError):
    """A parameter of the wrong type or out of range; the text says what to write instead."""


@dataclass(frozen=True)
class NodeParameters(Settings):
    """All parameters of register_node. Lengths in metres, times in seconds, angles in radians; 0 switches a limit off.

    `live=False`: read when configuring. `group`: heading in the parameter file, at its first parameter.
    """

    model_path: str = setting("", "file of the bone: a mesh, a cloud or a label map (docs/reference/formats.md)",
                              group="model: which bone")  # fmt: skip
    model_label: str = setting("", "name or number of the bone in a label map; several, with commas, are one bone")
    model_unit: str = setting("auto", "unit of the file; auto guesses mm or m from the extent and warns",
                              choices=("auto", "mm", "cm", "m"))  # fmt: skip
    model_axes: str = setting("as_is", "axes of a mesh file; auto: as the file states; ras is turned to LPS, "
                              "lps_to_ras to RAS", choices=("as_is", "auto", "lps", "ras", "lps_to_ras"))  # fmt: skip
    model_frame: str = setting("bone_preop", "frame of the bone, child of every pose", live=False)

    cloud_unit: str = setting("m", "unit of the clouds; never guessed", choices=("m", "cm", "mm"),
                              group="input: what measures, and where")  # fmt: skip
    sensor: str = setting("unknown", "kind of sensor; sets the errors to expect", choices=SENSOR_KINDS, live=False)
    output_frame: str = setting("", "frame of the poses; empty: the frame of the cloud", live=False)
    tf_timeout: float = setting(0.1, "longest wait for a transform", unit="s", low=0.0, high=60.0)
    crop_frame: str = setting("", "frame of the crop box; empty: the frame of the cloud", live=False)
    crop_min: Triple = setting((0.0, 0.0, 0.0), "lowest corner of the crop box; equal to crop_max: no box", unit="m")
    crop_max: Triple = setting((0.0, 0.0, 0.0), "highest corner of the crop box", unit="m")
    viewpoint: str = setting("auto", "place of the camera: auto (from its pixels or surface), none (all points are "
                             "bone), origin (of the cloud's frame), or a frame", live=False)  # fmt: skip
    max_cloud_age: float = setting(0.0, "clouds older than this are refused, also once registered; 0: off", unit="s",
                                   low=0.0)  # fmt: skip
    accumulate: int = setting(0, "clouds registered as one; the bone must rest in output_frame; 0: as the sensor needs",
                              low=0, high=10_000, live=False)  # fmt: skip

    min_confidence: float = setting(0.5, "poses below are refused", low=0.0, high=1.0,
                                    group="gates: which poses go out")  # fmt: skip
    max_tre: float = setting(0.0, "poses with a larger 95 % bound of the error over the bone are refused; 0: off",
                             unit="m", low=0.0)  # fmt: skip
    pose_lifetime: float = setting(2.0, "a pose that no newer one follows is withdrawn after this; 0: never", unit="s",
                                   low=0.0)  # fmt: skip
    error_after: int = setting(5, "so many refusals in a row are an ERROR in the diagnostics; 0: never", low=0)
    max_jump_translation: float = setting(0.0, "poses farther from the last one are refused; 0: off", unit="m", low=0.0)
    max_jump_rotation: float = setting(0.0, "poses turned farther from the last one are refused; 0: off", unit="rad",
                                       low=0.0, high=3.15)  # fmt: skip

    continuous: bool = setting(True, "register every cloud that time allows; false: only on ~/register",
                               group="behaviour: how clouds are registered")  # fmt: skip
    track: bool = setting(True, "start at the last pose; false: every cloud by itself", live=False)
    guide: bool = setting(False, "compute where to look next, for ~/debug/next_view; takes time", live=False)
    device: str = setting("auto", "where the network runs", choices=("auto", "cpu", "cuda"), live=False)
    weights: str = setting("", "file of a network of your own (gapr train); no confidence is fitted to it; empty: the "
                           "shipped one", live=False)  # fmt: skip
    settings_file: str = setting("", "YAML file as for `gapr register --config`; must not contradict a parameter",
                                 live=False)  # fmt: skip
    autostart: bool = setting(True, "configure and activate at the start; false: a lifecycle manager does", live=False)

    publish_tf: bool = setting(True, "send accepted poses to /tf", live=False, group="output")

    @property
    def collects(self) -> bool:
        """Whether several clouds are registered as one."""
        return self.accumulate > 1

    @property
    def names_a_place(self) -> bool:
        """Whether every cloud is registered as what a camera saw from a known place."""
        return self.viewpoint not in NO_FRAME and not (self.collects and self.sensor in TOGETHER)

    @property
    def collects_looks(self) -> bool:
        """Whether clouds that are registered as one are looks of a camera, each from its own place."""
        return self.collects and self.names_a_place

    @property
    def has_box(self) -> bool:
        """Whether clouds are cropped to a box."""
        return self.crop_min != self.crop_max


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
    """Read the node's parameters; an open `accumulate` becomes the sensor's."""
    given = NodeParameters(**{name: plain(node.get_parameter(name).value) for name in FIELDS})
    return given if given.accumulate else replace(given, accumulate=_together(given))


def plain(value: Any) -> Any:
    """Return a parameter's value as the dataclass holds it: arrays as tuples."""
    return tuple(value) if isinstance(value, list | array) else value


def remarks(parameters: NodeParameters) -> list[str]:
    """Write a sentence for each thing decided for the user, or not to be expected."""
    sensor, sentences = parameters.sensor, []
    if sensor == "unknown":
        sentences.append("sensor is not set, and tre95 allows for any: set it to what measures the clouds")
    if parameters.max_tre == 0.0:
        sentences.append("max_tre is 0: a pose goes out however large its tre95 is")
    if sensor in TOGETHER and not parameters.collects and not parameters.output_frame:
        why = "output_frame is empty: name the frame of the reference that is fixed to the bone"
        sentences.append(f"sensor {sensor}: every cloud is registered by itself, because {why}")
    if parameters.collects:
        kind = "looks of a camera" if parameters.collects_looks else "clouds"
        sentences.append(f"the last {parameters.accumulate} {kind} are registered as one")
        if not parameters.output_frame:
            sentences.append("output_frame is empty: the bone must rest in the frame of the clouds")
    return sentences


def doubts(parameters: NodeParameters) -> list[str]:
    """Write a sentence for each length that is probably in millimetres, and for a box without room."""
    found = [
        f"{name} is {getattr(parameters, name)}: lengths are in metres; is it in mm?"
        for name, longest_m in LONGEST_M.items()
        if any(longest_m < abs(length_m) < math.inf for length_m in _each(getattr(parameters, name)))
    ]
    low, high = parameters.crop_min, parameters.crop_max
    if parameters.has_box and any(start >= end for start, end in zip(low, high, strict=True)):
        found.append(f"crop_min {low} is not below crop_max {high}: every cloud is refused until it is")
    return found


def _each(value: float | Triple) -> Triple:
    return value if isinstance(value, tuple) else (value,) * 3


def _together(parameters: NodeParameters) -> int:
    return TOGETHER.get(parameters.sensor, 1) if parameters.output_frame else 1


def unknown_names(node: Node) -> list[str]:
    """Write a sentence for each given name that is no parameter, with the nearest one."""
    known, sentences = (*FIELDS, *NOT_OURS), []
    for name in node._parameter_overrides:
        if name not in known:
            near = difflib.get_close_matches(name, FIELDS, n=1)
            hint = f"; did you mean '{near[0]}'?" if near else ": see docs/reference/parameters.md, or settings_file"
            sentences.append(f"unknown parameter '{name}' is ignored{hint}")
    return sentences


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
    """Say why these changes cannot be made; empty when they can. rclpy has checked type and range already.

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
    """Say how a value is wrong, and what to write instead; empty if it is right."""
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
    """Write the parameter file: every default with its help."""
    lines = ["# Every parameter of register_node with its default; generated by `python -m gapr_ros.parameters`.",
             "# Lengths in metres, times in seconds, angles in radians. Doubles need a decimal point.",
             "/**:", "  ros__parameters:"]  # fmt: skip
    for name, setting_field in FIELDS.items():
        if group := setting_field.metadata.get("group"):
            lines.append(f"    # --- {group} ---")
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
