"""Parameters of register_node: one frozen dataclass is the one source for defaults, ranges, help and the YAML file.

`python -m gapr_ros.parameters > config/register_node.yaml` writes the file anew.
"""

from __future__ import annotations

import difflib
import sys
from collections.abc import Iterable, Mapping
from dataclasses import Field, dataclass, field, fields
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rcl_interfaces.msg import ParameterDescriptor
    from rclpy.node import Node
    from rclpy.parameter import Parameter

NOT_OURS = ("use_sim_time", "start_type_description_service", "qos_overrides")  # declared by rclpy itself
LARGE = 1e9
ROS_TYPES = {float: "double", int: "integer", str: "string", bool: "bool"}


def setting(default: Any, text: str, *, low: float | None = None, high: float = LARGE, choices: Iterable[str] = (),
            live: bool = True) -> Any:  # fmt: skip
    """A parameter: default, help, range or choices, and whether it may change while the node is configured."""
    return field(default=default, metadata={"text": text, "low": low, "high": high, "choices": tuple(choices),
                                            "live": live})  # fmt: skip


class ParameterError(ValueError):
    """A parameter of the wrong type or out of range; the text says what to write instead."""


@dataclass(frozen=True)
class NodeParameters:
    """Everything register_node can be told. Lengths in metres, times in seconds, angles in radians."""

    model_path: str = setting("", "file of the pre-operative bone: PLY PCD STL OBJ VTK VTP NPY NPZ")
    model_unit: str = setting("auto", "unit of that file; auto guesses from the extent and warns",
                              choices=("auto", "mm", "m"))  # fmt: skip
    model_scale: float = setting(1.0, "the bone is multiplied by this", low=1e-6)
    model_axes: str = setting("as_is", "axes of that file; lps_to_ras turns DICOM's axes into those of 3D Slicer",
                              choices=("as_is", "lps_to_ras"))  # fmt: skip
    model_frame: str = setting("bone_preop", "frame of the pre-operative bone, child of every pose", live=False)
    output_frame: str = setting("", "frame of the poses; empty: the frame of the cloud", live=False)
    tf_timeout: float = setting(0.1, "longest wait for a transform into output_frame, s", low=0.0, high=60.0)
    cloud_unit: str = setting("m", "unit of the clouds; never guessed", choices=("m", "mm"))
    cloud_reliability: str = setting("auto", "auto: reliable, and best effort once a publisher offers only that",
                                     choices=("auto", "reliable", "best_effort"), live=False)  # fmt: skip
    min_points: int = setting(200, "fewer usable points, of all clouds that are registered as one, are refused", low=3)
    max_points: int = setting(200_000, "larger clouds are thinned to this, seeded; 0: never", low=0)
    range_min: float = setting(0.0, "nearer points are left out, m; 0: off", low=0.0)
    range_max: float = setting(0.0, "farther points are left out, m; 0: off", low=0.0)
    max_cloud_age: float = setting(0.0, "older clouds are refused, s; 0: off", low=0.0)
    min_confidence: float = setting(0.5, "poses below are refused", low=0.0, high=1.0)
    require_consecutive: int = setting(1, "a pose goes out after this many good ones in a row", low=1, high=1000)
    max_jump_translation: float = setting(0.0, "farther from the last pose is refused, m; 0: off", low=0.0)
    max_jump_rotation: float = setting(0.0, "farther from the last pose is refused, rad; 0: off", low=0.0, high=3.15)
    continuous: bool = setting(True, "register every cloud that time allows; false: only on ~/register")
    track: bool = setting(True, "start where the last pose was; false: every cloud by itself", live=False)
    accumulate: int = setting(1, "clouds registered as one; the bone must rest in output_frame", low=1, high=10_000,
                              live=False)  # fmt: skip
    max_rate: float = setting(0.0, "most registrations a second; 0: as many as possible", low=0.0, high=1000.0)
    timeout: float = setting(5.0, "a registration that took longer is refused, s", low=1e-3)
    publish_tf: bool = setting(True, "send accepted poses to /tf", live=False)
    device: str = setting("auto", "where a network runs", choices=("auto", "cpu", "cuda"), live=False)
    num_threads: int = setting(0, "threads of a registration; 0: all cores", low=0, high=1024, live=False)
    seed: int = setting(0, "of every random choice", low=0, high=2**31 - 1, live=False)
    autostart: bool = setting(True, "configure and activate without a lifecycle manager; read when the node starts",
                              live=False)  # fmt: skip
    diagnostics_period: float = setting(1.0, "time between two diagnostics, s", low=0.01, high=3600.0)
    covariance_floor_translation: float = setting(1e-4, "smallest standard deviation of a translation, m", low=1e-9)
    covariance_floor_rotation: float = setting(1e-3, "smallest standard deviation of a rotation, rad", low=1e-9)


FIELDS: Mapping[str, Field] = {f.name: f for f in fields(NodeParameters)}


def declare(node: Node) -> NodeParameters:
    """Declare everything on the node and read what it was given.

    Raises:
        ParameterError: for a value of the wrong type or out of range; the text says what to write instead.
    """
    given = node._parameter_overrides  # rclpy has no public accessor for what came from files and the command line
    for name, setting_field in FIELDS.items():
        _check_override(setting_field, given.get(name))
        node.declare_parameter(name, setting_field.default, descriptor(setting_field))
    return read(node)


def read(node: Node) -> NodeParameters:
    """What the node's parameters say now."""
    return NodeParameters(**{name: node.get_parameter(name).value for name in FIELDS})


def unknown_names(node: Node) -> list[str]:
    """One sentence for each name that was given but does not exist, with the nearest one that does."""
    sentences = []
    for name in node._parameter_overrides:
        if name not in FIELDS and name.split(".")[0] not in NOT_OURS:
            near = difflib.get_close_matches(name, FIELDS, n=1)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            sentences.append(f"unknown parameter '{name}' is ignored{hint}")
    return sentences


def check_change(parameters: Iterable[Parameter], configured: bool) -> str:
    """Why these changes cannot be made; empty when they can. rclpy has checked type and range already."""
    for parameter in parameters:
        setting_field = FIELDS.get(parameter.name)
        if setting_field is None:
            continue
        if configured and not setting_field.metadata["live"]:
            return f"{parameter.name} is read when configuring: deactivate, clean up, set it, then configure again"
        why = problem(setting_field, parameter.value)
        if why:
            return why
    return ""


def problem(setting_field: Field, value: Any) -> str:
    """What is wrong with a value, and what to write instead; empty when nothing is."""
    name, default, metadata = setting_field.name, setting_field.default, setting_field.metadata
    if type(value) is not type(default):
        kind = ROS_TYPES[type(default)]
        return f"parameter '{name}' must be of type {kind}, got {value!r}: write {_example(default, value)}"
    if metadata["choices"] and value not in metadata["choices"]:
        return f"parameter '{name}' must be one of {', '.join(metadata['choices'])}, got '{value}'"
    if metadata["low"] is not None and not metadata["low"] <= value <= metadata["high"]:
        return f"parameter '{name}' must be within {metadata['low']:g} to {metadata['high']:g}, got {value!r}"
    return ""


def descriptor(setting_field: Field) -> ParameterDescriptor:
    """Help and range for `ros2 param describe`."""
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

    metadata, choices = setting_field.metadata, setting_field.metadata["choices"]
    message = ParameterDescriptor(description=metadata["text"])
    message.additional_constraints = f"one of: {', '.join(choices)}" if choices else ""
    if metadata["low"] is not None and isinstance(setting_field.default, float):
        message.floating_point_range = [FloatingPointRange(from_value=metadata["low"], to_value=metadata["high"])]
    elif metadata["low"] is not None:
        message.integer_range = [IntegerRange(from_value=int(metadata["low"]), to_value=int(metadata["high"]))]
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


def _example(default: Any, value: Any) -> str:
    if isinstance(default, float) and type(value) is int:
        return f"{value}.0"
    if isinstance(default, str):
        return f'"{value}"' if isinstance(value, int | float) else f'"{default}"'
    return _yaml(default)


def _yaml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else _number(value)


def _number(value: float) -> str:
    if isinstance(value, float) and abs(value) < 1e-2 and value:
        return f"{value:.1e}"  # YAML 1.1 reads 1e-4 as text
    return repr(value)


def _help(setting_field: Field) -> str:
    metadata = setting_field.metadata
    if metadata["choices"]:
        return f"{metadata['text']} [{' | '.join(choice for choice in metadata['choices'])}]"
    bounded = metadata["low"] is not None and metadata["high"] < LARGE
    return metadata["text"] + (f" [{metadata['low']:g} .. {metadata['high']:g}]" if bounded else "")


if __name__ == "__main__":
    sys.stdout.write(as_yaml())
