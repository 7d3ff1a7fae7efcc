"""Finds parameter files of the command line that say nothing of this node: rcl drops what is for others in silence."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml

PARAMETERS = "ros__parameters"
SHOWN = 5  # names of other nodes: a file of a whole robot has dozens


def without_entry(arguments: Sequence[str], node: str) -> list[str]:
    """One sentence for each file after `--params-file` that has no entry for a node; rcl refuses what is no such file.

    Args:
        arguments: the command line.
        node: fully qualified name, such as /femur/register_node.
    """
    sentences = []
    for file in files_in(arguments):
        names = names_in(file)
        if names is not None and not any(is_for(name, node) for name in names):
            has = ", ".join(names[:SHOWN]) + (", ..." if len(names) > SHOWN else "") or "none"
            sentences.append(f"no entry of {file} is for {node}: it has {has}; write that name, or /**, in it")
    return sentences


def files_in(arguments: Sequence[str]) -> Iterator[str]:
    """Every file after `--params-file`, where a command line is for ROS: from `--ros-args` to `--`."""
    is_for_ros, words = False, iter(arguments)
    for word in words:
        if word in ("--ros-args", "--"):
            is_for_ros = word == "--ros-args"
        elif is_for_ros and word == "--params-file" and (file := next(words, "")):
            yield file


def names_in(file: str) -> list[str] | None:
    """The names of nodes, and patterns of them, in a parameter file; None where it cannot be read."""
    try:
        root = yaml.compose(Path(file).read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
    except (OSError, UnicodeDecodeError, yaml.YAMLError):
        return None
    return list(_names_below(root))


def is_for(name: str, node: str) -> bool:
    """Whether a name of a parameter file is for a node: `*` is for one word between slashes, `**` for any number."""
    pattern = re.escape("/" + name.lstrip("/"))
    pattern = pattern.replace(r"/\*\*", r"(/\w+)*").replace(r"/\*", r"/\w+")
    return re.fullmatch(pattern, node) is not None


def _names_below(node: Any, above: str = "") -> Iterator[str]:
    """Keys above `ros__parameters`, with slashes between them; a tree of YAML keeps those that stand twice."""
    for key, value in node.value if isinstance(node, yaml.MappingNode) else ():
        if key.value == PARAMETERS:
            yield above
        else:
            yield from _names_below(value, f"{above.rstrip('/')}/{key.value}" if above else key.value)
