"""register_node, the program: it checks where it runs, starts the node and ends it."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

if TYPE_CHECKING:
    from rclpy.executors import Executor

    from gapr_ros.node.lifecycle import RegisterNode


USAGE = """usage: register_node [--ros-args [-p NAME:=VALUE ...] [--params-file FILE] [-r points:=TOPIC] ...]

Registers the partial clouds of a topic to a pre-operative bone, and publishes poses or the reasons why there are none.

  register_node --ros-args -p model_path:=/data/femur_ct.stl -p model_unit:=mm -r points:=/probe/points

`python -m gapr_ros.parameters` prints every parameter with its default, range and meaning. Topics, services
and reasons: docs/reference/ros.md.
"""
WORKS = ("jazzy", "kilted", "rolling")  # older ones lack what the node needs of rclpy; tested is jazzy
PARAMETERS = "ros__parameters"
SHOWN = 5  # names of other nodes: a file of a whole robot has dozens
PATIENCE_S = 0.3  # for the registration that is on its way when the program is asked to stop


def main(args: list[str] | None = None) -> int:
    """`ros2 run gapr_ros register_node`; `--help` says how; 1 when a parameter or the sourced ROS cannot be used."""
    if {"-h", "--help"} & set(sys.argv[1:] if args is None else args):
        sys.stdout.write(USAGE)
        return 0
    why = distribution_problem(os.environ)
    if why:
        return _fail(why)
    try:
        return _started(args)
    except KeyboardInterrupt:  # while it imports
        return 0


def _started(args: list[str] | None) -> int:
    try:
        import rclpy
    except ModuleNotFoundError as error:
        return _fail(f"{error}: source a ROS 2, or install the wheels with pip install '.[ros]'")
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.utilities import remove_ros_args

    from gapr_ros.node.host import describe
    from gapr_ros.node.lifecycle import RegisterNode
    from gapr_ros.parameters import ParameterError

    given = sys.argv if args is None else ["register_node", *args]
    is_begun = False
    try:
        unused = remove_ros_args(given)[1:]
        if unused:
            return _fail(f"{' '.join(unused)} is not used: write --ros-args before -p, -r and --params-file")
        rclpy.init(args=args)
        is_begun = True
        node = RegisterNode()
        for sentence in without_entry(given, node.get_fully_qualified_name()):
            node.get_logger().warning(sentence)
        executor = SingleThreadedExecutor()
    except Exception as error:
        if is_begun and not rclpy.ok():  # asked to stop while starting: whatever is made then fails
            return 0
        rclpy.try_shutdown()
        return _fail(str(error) if isinstance(error, ParameterError) else describe(error))
    return _run(node, executor)


def spin(node: RegisterNode, executor: Executor) -> None:
    """Run the node until it is asked to stop; no exception of a callback ends it."""
    from rclpy.executors import ExternalShutdownException

    from gapr_ros.node.host import THROTTLE_S, describe

    executor.add_node(node)
    while node.context.ok():
        try:
            executor.spin()
        except (KeyboardInterrupt, ExternalShutdownException):
            break
        except Exception as error:
            node.get_logger().error(f"a callback failed: {describe(error)}", throttle_duration_sec=THROTTLE_S)


def _run(node: RegisterNode, executor: Executor) -> int:
    import rclpy
    from rclpy.signals import uninstall_signal_handlers

    ended = False
    try:
        spin(node, executor)
        ended = node.close(PATIENCE_S)
    except KeyboardInterrupt:
        pass
    uninstall_signal_handlers()  # first: their thread shuts down as well, and uses the executor's guard condition
    rclpy.try_shutdown()
    executor.shutdown(timeout_sec=0.0)
    if not ended:  # a thread in native code does not survive the end of the interpreter: leave it no time to crash
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)
    return 0


def distribution_problem(environment: Mapping[str, str]) -> str:
    """Say why the sourced distribution cannot be used; empty when it can, or when none is sourced."""
    name = environment.get("ROS_DISTRO", "")
    if not name or name in WORKS:
        return ""
    return f"expected a sourced ROS 2 {' or '.join(WORKS)}, got {name}: source another one, or none and use the wheels"


def without_entry(arguments: Sequence[str], node: str) -> list[str]:
    """List one sentence for each file after `--params-file` that has no entry for a node.

    rcl refuses a file that is no parameter file.

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
    """Find the files after `--params-file` between `--ros-args` and `--`."""
    is_for_ros, words = False, iter(arguments)
    for word in words:
        if word in ("--ros-args", "--"):
            is_for_ros = word == "--ros-args"
        elif is_for_ros and word == "--params-file" and (file := next(words, "")):
            yield file


def names_in(file: str) -> list[str] | None:
    """Read the names and patterns of nodes in a parameter file; None where it cannot be read."""
    try:
        root = yaml.compose(Path(file).read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
    except (OSError, UnicodeDecodeError, yaml.YAMLError):
        return None
    return list(_names_below(root))


def is_for(name: str, node: str) -> bool:
    """Match a name of a parameter file with a node: `*` is one word between slashes, `**` any number."""
    pattern = re.escape("/" + name.lstrip("/"))
    pattern = pattern.replace(r"/\*\*", r"(/\w+)*").replace(r"/\*", r"/\w+")
    return re.fullmatch(pattern, node) is not None


def _names_below(node: Any, above: str = "") -> Iterator[str]:
    """Join the keys above `ros__parameters` with slashes; a tree of YAML keeps keys that stand twice."""
    for key, value in node.value if isinstance(node, yaml.MappingNode) else ():
        if key.value == PARAMETERS:
            yield above
        else:
            yield from _names_below(value, f"{above.rstrip('/')}/{key.value}" if above else key.value)


def _fail(why: str) -> int:
    sys.stderr.write(f"register_node: {why}\n")
    return 1


if __name__ == "__main__":
    sys.exit(main())
