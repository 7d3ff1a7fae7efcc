"""Names of launch arguments: launch takes any name, and loses those that a launch file does not have."""

from __future__ import annotations

import difflib
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

READ_BY_LAUNCH = (  # needs no declaration
    "launch-prefix",
    "launch-prefix-filter",
    "emulate_tty",
    "sigterm_timeout",
    "sigkill_timeout",
    "ros_namespace",
)


def check_names(context: Any, file: Path, declared: Iterable[str], hint: str, warn: Callable[[str], object]) -> None:
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
