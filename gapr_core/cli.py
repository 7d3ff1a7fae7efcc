"""The `gapr` command: register one pair, evaluate a folder of pairs, and what other packages add.

Further commands come from the entry-point group `gapr.commands`; each is a module with `add_arguments(parser)` and
`run(args) -> int`.
"""

from __future__ import annotations

import argparse
import ast
import json
import logging
import sys
import time
from hashlib import sha256
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from gapr_core.console import say
from gapr_core.errors import ConfigError, GaprError, InvalidPointCloudError
from gapr_core.results import RegistrationResult

OK, BAD_INPUT, REFUSED, INTERRUPTED = 0, 1, 2, 130


def main(arguments: list[str] | None = None) -> int:
    """Run one command; 0 for success, 2 for a refusal by the data, 1 for bad input (one line, no traceback)."""
    logging.basicConfig(format="gapr: %(message)s", level=logging.WARNING)
    try:
        args = _parser(sys.argv[1:] if arguments is None else arguments)
        return int(args.run(args))
    except GaprError as error:
        return _complain(str(error))
    except BrokenPipeError:
        return OK
    except KeyboardInterrupt:
        _complain("stopped; what was finished is kept")
        return INTERRUPTED


class _Parser(argparse.ArgumentParser):
    """Wrong usage is bad input: exit 1, since 2 means that the data refuse a pose."""

    def error(self, message: str) -> NoReturn:
        self.print_usage(sys.stderr)
        self.exit(_complain(message))


def _parser(arguments: list[str]) -> argparse.Namespace:
    parser = _Parser(prog="gapr", description="Partial-to-full registration of bones.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_register(commands.add_parser("register", help="lay one partial cloud on one full bone"))
    _add_evaluate(commands.add_parser("evaluate", help="register every pair of a folder"))
    for entry in sorted(entry_points(group="gapr.commands"), key=lambda e: e.name):
        _add_command(commands, entry, arguments)
    return parser.parse_args(arguments)


def _add_command(commands: Any, entry: Any, arguments: list[str]) -> None:
    """A command of another module, which is imported only when it is the one called."""
    command = commands.add_parser(entry.name, help=_first_line(entry.module))
    if arguments[:1] != [entry.name]:
        return
    try:
        module = entry.load()
    except ImportError as error:
        raise ConfigError(f"what `gapr {entry.name}` needs", str(error), "pip install 'gapr_ros[ros]'") from error
    command.description, command.formatter_class = module.__doc__, argparse.RawDescriptionHelpFormatter
    module.add_arguments(command)
    command.set_defaults(run=module.run)


def _first_line(module: str) -> str:
    """What a module says of itself, read without running it."""
    spec = find_spec(module)
    text = ast.get_docstring(ast.parse(Path(spec.origin).read_text())) if spec and spec.origin else None
    return (text or "not installed").splitlines()[0].partition(": ")[2] or "not installed"


def _add_register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--source", required=True, type=Path, help="partial cloud (PLY, PCD, STL, OBJ, VTK, VTP, NPY, NPZ)"
    )
    parser.add_argument("--target", required=True, type=Path, help="full bone, mesh or cloud")
    parser.add_argument("--units", default="mm", choices=("mm", "m"), help="of both files (mm)")
    parser.add_argument("--json", type=Path, help="write the result here as well")
    parser.add_argument("--method", default="gapr", help="gapr or a baseline such as kiss4")
    parser.set_defaults(run=register)


def register(args: argparse.Namespace) -> int:
    """`gapr register`: prints the result; exit 0 with a pose, 2 when the data refuse one."""
    from gapr_core import clouds

    method = _method(args.method)
    source = clouds.load(args.source, args.units).points
    result = method.register(source, method.prepare(args.target, args.units))
    if args.json:
        _write(args.json, _as_json(result))
    say(str(result))
    if result.T_target_source is None:
        return REFUSED
    say(np.array2string(result.T_target_source, precision=6, suppress_small=True))
    return OK


def _add_evaluate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--pairs", required=True, type=Path, help="folder of NAME.npz with source and target, mm")
    parser.add_argument("--out", required=True, type=Path, help="poses.json")
    parser.add_argument("--method", default="gapr", help="gapr or a baseline such as kiss4")
    parser.add_argument("--limit", type=int, help="only the first so many")
    parser.set_defaults(run=evaluate)


def evaluate(args: argparse.Namespace) -> int:
    """`gapr evaluate`: a pose or a refusal for every pair; never looks at the truth; goes on where it stopped."""
    from tqdm import tqdm

    files = sorted(args.pairs.glob("*.npz")) if args.pairs.is_dir() else []
    if not files:
        raise ConfigError("a folder with NAME.npz files", str(args.pairs), "check the path")
    answers = _answers_so_far(args.out)
    method = _method(args.method)
    made_of = {file: {"method": args.method, "sha256": _digest(file)} for file in files[: args.limit]}
    waiting = [file for file, made in made_of.items() if not made.items() <= answers.get(file.stem, {}).items()]
    for file in waiting[:1]:
        _answer(file, method)  # compiled code loads with the first call, whose time is not the method's
    for file in tqdm(waiting, unit="pair", disable=None):
        answers[file.stem] = _answer(file, method) | made_of[file]
        _write(args.out, answers)
    return OK


def _digest(file: Path) -> str:
    """What tells a pair from another one of the same name; empty when it cannot be read."""
    try:
        return sha256(file.read_bytes()).hexdigest()
    except OSError:
        return ""


def _answers_so_far(path: Path) -> dict[str, Any]:
    """What an earlier run has written, by the name of the pair."""
    if not path.is_file():
        return {}
    try:
        answers = json.loads(path.read_text())
        if not all(isinstance(answer, dict) for answer in answers.values()):
            raise ValueError("no answers in it")
    except (OSError, ValueError, AttributeError) as error:
        mend = "name another file with --out, or remove it"
        raise ConfigError("a file that `gapr evaluate` has written", f"{path} ({error})", mend) from error
    return dict(answers)


def _answer(file: Path, method: Any) -> dict[str, Any]:
    """The answer to one pair; a pair that cannot be read is refused, the others go on."""
    try:
        source, target = _pair(file)
        start = time.perf_counter()
        prepared = method.prepare(target)
        prepare_seconds = time.perf_counter() - start
        start = time.perf_counter()
        result = method.register(source, prepared)
        seconds = time.perf_counter() - start
    except InvalidPointCloudError as error:
        return {"transform": None, "confidence": 0.0, "status": "INVALID_INPUT", "reason": str(error), "seconds": 0.0}
    return _as_json(result) | {"seconds": seconds, "prepare_seconds": prepare_seconds}


def _pair(file: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    try:
        with np.load(file, allow_pickle=False) as data:
            return data["source"], data["target"]
    except Exception as error:  # NumPy and zipfile raise many kinds
        raise InvalidPointCloudError(
            "an .npz with source and target", f"{file.name} ({error})", "make it anew"
        ) from error


def _as_json(result: RegistrationResult) -> dict[str, Any]:
    """The contract of the JSON output: transform is 4x4 row-major, source -> target, mm."""
    pose, covariance = result.T_target_source, result.covariance
    return {
        "transform": None if pose is None else pose.tolist(),
        "confidence": result.confidence,
        "status": str(result.status),
        "covariance": None if covariance is None else covariance.tolist(),
        "seconds": result.seconds,
        "tre_mm": result.tre_mm,
        "inlier_ratio": result.inlier_ratio,
        "reason": result.reason,
    }


def _method(name: str) -> Any:
    from gapr_core.evaluation import methods

    return methods.make(name)


def _write(path: Path, content: dict[str, Any]) -> None:
    """Whole or not at all, so that an interrupted run leaves a readable file."""
    scratch = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch.write_text(json.dumps(content, indent=1) + "\n")
        scratch.replace(path)
    except OSError as error:
        raise ConfigError("a file that can be written", f"{path} ({error.strerror})", "choose another path") from error


def _complain(text: str) -> int:
    sys.stderr.write(f"gapr: {text}\n")
    return BAD_INPUT


if __name__ == "__main__":
    raise SystemExit(main())
