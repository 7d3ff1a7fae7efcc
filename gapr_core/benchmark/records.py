"""The append-only JSONL file of a run: one line per pair and method, torn last line forgiven."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from gapr_core.errors import ConfigError

Record = dict[str, Any]
FILE = "records.jsonl"
PLAN = "plan.json"


def append(path: Path, record: Record) -> None:
    """Add one line, on disk before the next pair starts."""
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(record, allow_nan=False) + "\n")


def read(path: Path) -> list[Record]:
    """Every whole record; a last line that was cut off when the run was killed is removed from the file.

    Raises:
        ConfigError: a line in the middle that is not JSON.
    """
    if not path.is_file():
        return []
    text = path.read_text(encoding="utf-8")
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        path.write_text(whole, encoding="utf-8")
    try:
        return [json.loads(line) for line in whole.splitlines()]
    except json.JSONDecodeError as error:
        raise ConfigError("one JSON record per line", f"{path}: {error}", "remove the damaged line") from error


def done(records: Iterable[Record], hashes: dict[str, str]) -> set[tuple[str, str]]:
    """(pair, method) of every record.

    Args:
        records: of an earlier, interrupted run.
        hashes: pair name to sha256 of this run's pairs.

    Raises:
        ConfigError: a record of a pair of the same name with other clouds.
    """
    found = set()
    for record in records:
        if hashes.get(record["pair"], record["sha256"]) != record["sha256"]:
            raise ConfigError("records of these pairs", f"other clouds named {record['pair']}", "choose another --out")
        found.add((record["pair"], record["method"]))
    return found


def sort(records: Iterable[Record], methods: Sequence[str]) -> list[Record]:
    """One record for each pair and method (the first one written), by pair name, then in the order of `methods`."""
    first: dict[tuple[str, str], Record] = {}
    for record in records:
        first.setdefault((record["pair"], record["method"]), record)
    order = {name: k for k, name in enumerate(methods)}
    return sorted(first.values(), key=lambda r: (r["pair"], order.get(r["method"], len(order)), r["method"]))


def write_plan(folder: Path, plan: dict[str, Any]) -> None:
    """What this run was asked: methods, pairs of all shards, command, commit, machine."""
    (folder / PLAN).write_text(json.dumps(plan, indent=1) + "\n", encoding="utf-8")


def read_plan(folder: Path) -> dict[str, Any]:
    """The plan of a finished or interrupted run.

    Raises:
        ConfigError: the folder is no output of `gapr benchmark`.
    """
    if not (folder / PLAN).is_file():
        raise ConfigError("a folder written by gapr benchmark", str(folder), "name one that holds plan.json")
    return dict(json.loads((folder / PLAN).read_text(encoding="utf-8")))
