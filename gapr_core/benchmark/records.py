"""The files of a run: append-only records (JSONL, one line per pair and method), and the plan that they belong to."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from gapr_core.benchmark.record import Record
from gapr_core.errors import ConfigError
from gapr_core.runtime import files
from gapr_core.runtime.settings import from_dict

FILE = "records.jsonl"
PLAN = "plan.json"


@dataclass(frozen=True)
class Plan:
    """Request of the last run; its records name the machine.

    Attributes:
        command, started: how and when it was asked, in words.
        ours: the method that the others are compared with.
        methods: in the order of the tables.
        folder: of the pairs.
        pairs: name to sha256, of all shards.
    """

    command: str
    started: str
    ours: str
    methods: list[str]
    folder: str
    pairs: dict[str, str]


@dataclass(frozen=True)
class Inputs:
    """Inputs on which the records of a run depend.

    Attributes:
        pairs: name to sha256.
        settings, made_of: method to those of `Record`.
        facts: name of a pair to those of `Record`, of some pairs or all.
    """

    pairs: dict[str, str]
    settings: dict[str, str]
    made_of: dict[str, str]
    facts: dict[str, str] = field(default_factory=dict)


def append(path: Path, record: Record) -> None:
    """Add one line, which stays if the run is killed later; after a loss of power it may be lost.

    Raises:
        ConfigError: the file cannot be written.
    """
    try:
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(record.to_json(), allow_nan=False) + "\n")
    except OSError as error:
        raise files.unwritable(path, error) from error


def write(path: Path, records: Iterable[Record]) -> None:
    """Write all lines as one whole file."""
    with files.replacing(path) as scratch, scratch.open("w", encoding="utf-8") as file:
        file.writelines(json.dumps(record.to_json(), allow_nan=False) + "\n" for record in records)


def read(path: Path) -> list[Record]:
    """Read every whole record; ignore a last line that was cut off when the run was killed.

    Raises:
        ConfigError: a line in the middle that is no record.
    """
    return [_record(line, number, path) for number, line in enumerate(_whole_lines(path), 1)]


def discard_cut_line(path: Path) -> None:
    """Take a last line that was cut off out of the file, so that the next record begins a line."""
    if not path.is_file():
        return
    try:
        with path.open("r+b") as file:
            file.truncate(sum(len(line) for line in file if line.endswith(b"\n")))
    except OSError as error:
        raise files.unwritable(path, error) from error


def done(records: Iterable[Record], inputs: Inputs) -> set[tuple[str, str]]:
    """(pair, method) of every record of an earlier, interrupted run.

    Raises:
        ConfigError: a record of none of these pairs, or of a pair with other clouds or facts. A record of a method with
            other settings, weights or code.
    """
    found = set()
    for record in records:
        pair, method = record.pair, record.method
        if inputs.pairs.get(pair) != record.sha256:
            given = f"{'other clouds named' if pair in inputs.pairs else 'some of'} {pair}"
            raise _others("records of these pairs", given)
        if inputs.facts.get(pair, record.facts) != record.facts:
            raise _others("records of these pairs", f"{pair}, whose file said something else of it than now")
        wanted = inputs.settings.get(method, record.settings)
        if wanted != record.settings:
            given = f"records with {record.settings or 'the default settings'}"
            raise _others(f"{method} with {wanted or 'the default settings'}", given)
        if inputs.made_of.get(method, record.made_of) != record.made_of:
            raise _others(f"records of {method} as it is now", "some of other weights, or other code, of that name")
        found.add((pair, method))
    return found


def _others(expected: str, given: str) -> ConfigError:
    return ConfigError(expected, given, "choose another --out")


def conditions(records: Sequence[Record]) -> dict[str, list[str]]:
    """Collect every commit, number of threads and machine of the records."""
    return {name: sorted({str(getattr(r, name)) for r in records}) for name in ("commit", "threads", "machine")}


def sort(records: Iterable[Record], methods: Sequence[str]) -> list[Record]:
    """Keep the first record of each pair and method, by pair name, then in the order of `methods`."""
    first: dict[tuple[str, str], Record] = {}
    for record in records:
        first.setdefault((record.pair, record.method), record)
    order = {name: k for k, name in enumerate(methods)}
    return sorted(first.values(), key=lambda r: (r.pair, order.get(r.method, len(order)), r.method))


def write_plan(folder: Path, plan: Plan) -> None:
    """Write plan.json."""
    files.write_json(folder / PLAN, asdict(plan))


def read_plan(folder: Path) -> Plan:
    """Read the plan of a finished or interrupted run.

    Raises:
        ConfigError: the folder is no output of `gapr benchmark`, or its plan is damaged.
    """
    path = folder / PLAN
    if not path.is_file():
        raise ConfigError("a folder written by gapr benchmark", str(folder), "name one that holds plan.json")
    values = files.read_json(path, "a plan of gapr benchmark")
    try:
        return from_dict(Plan, values)
    except ConfigError as error:
        raise ConfigError("a plan of gapr benchmark", f"{path} ({error})", "run the benchmark again") from error


def _whole_lines(path: Path) -> Iterator[str]:
    """Read one line at a time: the text of a long run is as large as its records."""
    if path.is_file():
        with path.open(encoding="utf-8", errors="replace") as file:
            yield from (line[:-1] for line in file if line.endswith("\n"))


def _record(line: str, number: int, path: Path) -> Record:
    try:
        return from_dict(Record, json.loads(line))
    except (json.JSONDecodeError, ConfigError) as error:
        given = f"{path}, line {number}: {error}"
        raise ConfigError("one record of gapr benchmark per line", given, "remove the damaged line") from error
