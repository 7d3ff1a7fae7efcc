"""The table as Markdown, JSON and CSV."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gapr_core.evaluation.sections import LEGEND, sections, where_beaten
from gapr_core.evaluation.table import Row

Plan = dict[str, Any]


def write_json(path: Path, rows: Sequence[Row], plan: Plan) -> None:
    """Rows and what made them."""
    path.write_text(json.dumps({"run": plan, "rows": list(rows)}, indent=1) + "\n", encoding="utf-8")


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """One line per row, empty where there is no figure."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def write_markdown(path: Path, rows: Sequence[Row], plan: Plan, notes: Sequence[str]) -> None:
    """The table for people."""
    parts = ["# Benchmark", *(f"> {note}" for note in notes)]
    for section in sections(rows):
        body = [[f"**{c}**" if (i, j) in section.best else c for j, c in enumerate(line)]
                for i, line in enumerate(section.cells)]  # fmt: skip
        lines = [section.header, ["---"] * len(section.header), *body]
        parts += [f"## {section.title}", "\n".join(f"| {' | '.join(line)} |" for line in lines)]
    beaten = where_beaten(rows, plan["ours"])
    parts += [f"## Where another method beats {plan['ours']}", "\n".join(f"- {line}" for line in beaten)]
    made = f"Made by `{plan['command']}` at commit {plan['commit']}, {plan['threads']} thread(s), {plan['machine']}."
    path.write_text("\n\n".join([*parts, LEGEND, made]) + "\n", encoding="utf-8")
