"""The `gapr` command: find the module of a subcommand, run it, turn errors into one line.

Other packages add commands with the entry-point group `gapr.commands`: modules with `add_arguments(parser)` and
`run(args) -> int`, whose docstring begins with `NAME: what it does`.
"""

from __future__ import annotations

import argparse
import ast
import logging
import re
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn

from gapr_core import __version__
from gapr_core.errors import GaprError
from gapr_core.runtime.console import printable

OK, BAD_INPUT, INTERRUPTED = 0, 1, 130
COMMANDS = {
    "register": "gapr_core.commands.register",
    "check-points": "gapr_core.commands.check_points",
    "evaluate": "gapr_core.commands.evaluate",
    "settings": "gapr_core.commands.settings",
    "pivot": "gapr_core.commands.pivot",
    "compile": "gapr_core.commands.compile",
    "benchmark": "gapr_core.commands.benchmark",
    "make-pairs": "gapr_core.data.make_pairs",
    "train": "gapr_core.training.cli",
    "ablate": "gapr_core.training.ablation.cli",
    "paper": "gapr_core.commands.paper",
}
EXTRAS = {  # top-level module -> the extra of setup.py that installs it
    "torch": "network", "safetensors": "network", "open3d": "data", "matplotlib": "reports", "jinja2": "reports",
    "PIL": "reports", "rich": "reports", "rclpy": "ros", "rosbags": "bags",
    "sensor_msgs": "ros", "std_msgs": "ros", "geometry_msgs": "ros", "diagnostic_msgs": "ros", "std_srvs": "ros",
    "builtin_interfaces": "ros", "lifecycle_msgs": "ros", "rcl_interfaces": "ros", "rosgraph_msgs": "ros",
    "SimpleITK": "medical", "skimage": "medical", "highdicom": "medical",
}  # fmt: skip
WHOLE = {"demo": "ros", "train": "training", "ablate": "training"}  # a command -> the extra that has all it needs
RESUMED = ("evaluate", "benchmark", "make-pairs", "train", "ablate", "paper")
NEGATIVE = re.compile(r"-[.\d].*[,:].*")  # X,Y,Z and FIRST:LAST; a single number argparse knows itself


def main(arguments: list[str] | None = None) -> int:
    """Run one command.

    Returns:
        0 for success, 2 for a refusal by the data, 1 for bad input (one line, no traceback), 130 when interrupted.
    """
    handler = logging.StreamHandler()
    handler.setFormatter(_Printable("gapr: %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
    arguments = sys.argv[1:] if arguments is None else arguments
    command = next(iter(arguments), "")
    try:
        args = _parser(arguments)
        return int(args.run(args))
    except GaprError as error:
        return _complain(str(error))
    except ModuleNotFoundError as error:
        return _complain(_which_extra(error, command))
    except BrokenPipeError:
        return OK
    except OSError as error:
        return _complain(f"{error.filename or 'a file'}: {error.strerror or error}")
    except MemoryError:
        return _complain("not enough memory: thin or crop the data, or raise the limit (ulimit -v)")
    except KeyboardInterrupt:
        _complain("stopped" + ("; the same command goes on where it was" if command in RESUMED else ""))
        return INTERRUPTED


class _Printable(logging.Formatter):
    """Formats a line of the log without control characters of a terminal."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record))


class _Parser(argparse.ArgumentParser):
    """Wrong usage is bad input: exit 1, since 2 means that the data refuse a pose."""

    def error(self, message: str) -> NoReturn:
        self.exit(_complain(f"{message}; {self.prog} --help shows the options"))


def _parser(arguments: list[str]) -> argparse.Namespace:
    parser = _Parser(prog="gapr", description="Partial-to-full registration of bones.")
    parser.add_argument("--version", action="version", version=f"gapr {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, module in modules().items():
        command = commands.add_parser(name, help=_first_line(module))
        if arguments[:1] == [name]:
            _load(command, module, {"-h", "--help"}.isdisjoint(arguments))
    return parser.parse_args(_joined(arguments))


def _joined(arguments: Sequence[str]) -> list[str]:
    """Values that begin with a minus as --NAME=VALUE: argparse takes the -1 of `--tip -1,2,3` for an option."""
    joined: list[str] = []
    for word in arguments:
        if joined and NEGATIVE.fullmatch(word) and joined[-1].startswith("--") and "=" not in joined[-1]:
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def modules() -> Mapping[str, str]:
    """Map every command to its module: ours, and those that other packages add."""
    others = {entry.name: entry.module for entry in entry_points(group="gapr.commands")}
    return COMMANDS | {name: others[name] for name in sorted(others.keys() - COMMANDS.keys())}


def _load(command: argparse.ArgumentParser, name: str, runs: bool) -> None:
    """Add the options of the called command; import no other module.

    Help for a command whose libraries are not installed says what it does, and how to install them.
    """
    command.formatter_class = argparse.RawDescriptionHelpFormatter
    try:
        module: Any = import_module(name)
    except ModuleNotFoundError as error:
        if runs:
            raise
        command.description = f"{_docstring(name)}\n\n{_which_extra(error, command.prog.rpartition(' ')[2])}"
        return
    command.description = module.__doc__
    module.add_arguments(command)
    command.set_defaults(run=module.run)


def _first_line(module: str) -> str:
    """Return a command's help in one line."""
    return _docstring(module).splitlines()[0].partition(": ")[2] or "not installed"


def _docstring(module: str) -> str:
    """Read the docstring of a module without running it."""
    try:
        spec = find_spec(module)
    except ModuleNotFoundError:
        spec = None
    text = ast.get_docstring(ast.parse(Path(spec.origin).read_text())) if spec and spec.origin else None
    return text or "not installed"


def _which_extra(error: ModuleNotFoundError, command: str) -> str:
    library = (error.name or str(error)).partition(".")[0]
    extra = EXTRAS.get(library) and WHOLE.get(command, EXTRAS[library])
    return f"this needs {library}, which is not installed; run: pip install " + (
        f"'gapr_ros[{extra}]'" if extra else library
    )


def _complain(text: str) -> int:
    sys.stderr.write(f"gapr: {printable(' '.join(text.split()))}\n")
    return BAD_INPUT


if __name__ == "__main__":
    raise SystemExit(main())
