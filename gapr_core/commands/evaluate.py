"""`gapr evaluate`: register every pair of a folder; an interrupted run goes on where it stopped."""

from __future__ import annotations

import logging
import re
import time
from argparse import ArgumentParser, Namespace
from collections import Counter
from hashlib import sha256
from pathlib import Path
from typing import Any

from tqdm import tqdm

from gapr_core.baselines import RegistrationMethod
from gapr_core.baselines.base import uncalibrated
from gapr_core.benchmark import methods
from gapr_core.benchmark.record import ERROR
from gapr_core.commands import options
from gapr_core.commands.answer import made_by
from gapr_core.data.pair_files import load_clouds, pair_paths
from gapr_core.errors import ConfigError, InvalidPointCloudError, MethodUnavailableError, WeightsError
from gapr_core.results import RegistrationResult, RegistrationStatus
from gapr_core.runtime import files
from gapr_core.runtime.arguments import a_path, at_least_one
from gapr_core.runtime.console import say

log = logging.getLogger(__name__)
Answer = dict[str, Any]
WRITE_SECONDS = 5.0  # the file holds all answers, and grows: it is written again after so long,
WRITE_TIMES = 10.0  # and after so many times what the last writing took
INVALID_INPUT = "INVALID_INPUT"  # status of a pair that cannot be read
OF_PYTHON = re.compile(r"pass units='\w+', or ")  # the pairs are in mm, and no option says otherwise
OK, BAD_INPUT = 0, 1


def add_arguments(parser: ArgumentParser) -> None:
    """Add the options of `gapr evaluate`."""
    parser.add_argument("--pairs", required=True, type=a_path, help="folder of NAME.npz with source and target, mm")
    parser.add_argument(
        "--out", required=True, type=a_path, help="file for the answers, poses.json; keys: docs/reference/json.md"
    )
    parser.add_argument("--limit", type=at_least_one, help="register only the first LIMIT pairs")
    options.add_method(parser)


def run(args: Namespace) -> int:
    """Answer every pair with a pose or a refusal; never looks at the truth."""
    files.check_writable(args.out)
    args.method = options.method_name(args)
    paths = pair_paths(args.pairs)[: args.limit]
    answers = _answers_so_far(args.out)
    config = options.registrar_config(args)
    method = methods.make(args.method, config)
    by = made_by(args.method, config)
    made_of = {path: by | {"sha256": _digest(path)} for path in paths}
    waiting = [path for path, made in made_of.items() if not made.items() <= answers.get(path.stem, {}).items()]
    for path in waiting[:1]:
        _answer(path, method)  # compiled code loads with the first call, whose time is not the method's
    new: dict[str, Answer] = {}
    written, pause_s = time.monotonic(), WRITE_SECONDS
    try:
        for path in tqdm(waiting, unit="pair", disable=None):
            new[path.stem] = _answer(path, method) | made_of[path]
            if (start := time.monotonic()) - written > pause_s:
                answers |= _written(args.out, new)
                new, written = {}, time.monotonic()
                pause_s = max(WRITE_SECONDS, WRITE_TIMES * (written - start))
    finally:  # of an interrupted run, too
        answers |= _written(args.out, new) if new else {}
    if not methods.is_own(args.method) and ":" not in args.method:
        say(f"warning: {uncalibrated(args.method)}")
    return _say_counts(args.out, {path.name: answers[path.stem] for path in paths})


def _written(path: Path, new: dict[str, Answer]) -> dict[str, Answer]:
    """Write the new answers beside those of other runs, read again from the file."""
    with files.one_at_a_time(path):
        answers = _answers_so_far(path) | new
        files.write_json(path, answers)
    return answers


def _say_counts(path: Path, answers: dict[str, Answer]) -> int:
    """Count pairs by status, with the first invalid pair's error; exit code 1 if none is valid."""
    counts = Counter(str(answer["status"]) for answer in answers.values())
    say(f"{path}: {len(answers)} pairs" + "".join(f", {count} {status}" for status, count in counts.most_common()))
    invalid = [(name, answer["reason"]) for name, answer in answers.items() if answer["status"] == INVALID_INPUT]
    for name, reason in invalid[:1]:
        first = reason if name in reason else f"{name}: {reason}"
        log.warning("the first of %d pairs that cannot be read: %s", len(invalid), first)
    return BAD_INPUT if len(invalid) == len(answers) else OK


def _digest(path: Path) -> str:
    """Return a hash of a pair, for pairs of one name; empty for an unreadable one."""
    try:
        return sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""


def _answers_so_far(path: Path) -> dict[str, Answer]:
    """Read an earlier run's answers, by the name of the pair."""
    if not path.exists():
        return {}
    expected = "a file that `gapr evaluate` has written"
    answers = files.read_json(path, expected)
    if not isinstance(answers, dict) or not all(isinstance(answer, dict) for answer in answers.values()):
        raise ConfigError(expected, f"{path} (no answers in it)", "name another file with --out, or remove it")
    return answers


def _answer(path: Path, method: RegistrationMethod) -> Answer:
    """Answer one pair; refuse one that is unreadable or fails, so the others go on."""
    try:
        source, target, viewpoint = load_clouds(path)
        start = time.perf_counter()
        prepared = method.prepare(target)
        prepare_seconds = time.perf_counter() - start
        start = time.perf_counter()
        result = methods.register(method, source, prepared, viewpoint)
        seconds = time.perf_counter() - start
    except InvalidPointCloudError as error:
        reason = OF_PYTHON.sub("", str(error))
        refusal = RegistrationResult(RegistrationStatus.LOW_CONFIDENCE, reason=reason)
        return refusal.to_json() | {"status": INVALID_INPUT, "prepare_seconds": None}
    except (ConfigError, MethodUnavailableError, WeightsError):
        raise
    except Exception as error:
        log.warning("%s failed", path.name, exc_info=True)
        refusal = RegistrationResult(RegistrationStatus.LOW_CONFIDENCE, reason=f"{type(error).__name__}: {error}")
        return refusal.to_json() | {"status": ERROR, "prepare_seconds": None}
    return result.to_json() | {"seconds": seconds, "prepare_seconds": prepare_seconds}
