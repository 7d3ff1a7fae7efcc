"""The table as Markdown, JSON and CSV."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from gapr_core.benchmark.records import Plan
from gapr_core.benchmark.table import Row
from gapr_core.pages import markdown
from gapr_core.pages.sections import LEGEND, compared, sections, where_beaten
from gapr_core.runtime import files
from gapr_core.runtime.console import printable


def write_json(path: Path, rows: Sequence[Row], apart: Sequence[Row], plan: Plan, ran: Mapping[str, str]) -> None:
    """Rows, differences pair by pair, and what made them: the plan, and what ran, and on what."""
    files.write_json(path, {"run": asdict(plan) | dict(ran), "rows": list(rows), "differences": list(apart)})


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write one line per row; a cell without a value is empty, and none is a formula of a spreadsheet."""
    with files.replacing(path) as scratch, scratch.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows({key: _inert(value) for key, value in row.items()} for row in rows)


def _inert(value: object) -> object:
    """Make a cell that a spreadsheet and a terminal show as it is: names come from files."""
    return re.sub(r"^(?=\s*[=+@-])", "'", printable(value)) if isinstance(value, str) else value


def write_markdown(
    path: Path, rows: Sequence[Row], apart: Sequence[Row], plan: Plan, ran: Mapping[str, str], notes: Sequence[str]
) -> None:
    """Write the tables as Markdown."""
    parts = ["# Benchmark", *(f"> {markdown.text(note)}" for note in notes)]
    for section in [*sections(rows), *compared(apart, plan.ours)]:
        body = [[f"**{c}**" if (i, j) in section.best else c for j, c in enumerate(line)]
                for i, line in enumerate(section.cells)]  # fmt: skip
        parts += [f"## {markdown.text(section.title)}", markdown.table(section.header, body)]
    beaten = "\n".join(f"- {markdown.text(line)}" for line in where_beaten(rows, plan.ours))
    parts += [f"## Where another method beats {markdown.text(plan.ours)}", beaten]
    made = f"Made by `{plan.command}` at commit {ran['commit']}, {ran['threads']} thread(s), {ran['machine']}."
    files.write_text(path, "\n\n".join([*parts, LEGEND, made]) + "\n")
