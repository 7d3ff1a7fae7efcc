"""The tables and curves of `gapr ablate`, from whatever is finished."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from gapr_core import metrics
from gapr_core.data.make_pairs import Recipe
from gapr_core.pages.markdown import table as table_of
from gapr_core.pages.writers import write_csv
from gapr_core.runtime import files
from gapr_core.training import curves, provenance
from gapr_core.training.config import TrainConfig, Variant, trained_as

Record = dict[str, Any]
FIGURES = {  # of a record -> what the column is called
    "coarse": "coarse inliers", "fine": "fine inliers", "rr_paper": "recall (paper)", "rr_4_5": "recall 4 mm / 5°",
    "refined_rr_paper": "refined: recall (paper)", "refined_rr_4_5": "refined: 4 mm / 5°",
}  # fmt: skip
ALL = "all"


def folder_of(out: Path, model: Path, seed: int) -> Path:
    """Return the folder of a network's training."""
    return out / f"{model.stem}_seed{seed}"


def write(out: Path, plan: Sequence[Variant], config: TrainConfig, recipe: Recipe, seeds: int) -> None:
    """table.md, table.json, table.csv and the curves of each table, from whatever is finished."""
    trained = trained_as(plan, config.model_settings)
    folders = {v: [folder_of(out, trained[v.model], seed) for seed in range(seeds)] for v in plan}
    rows = [row(v, protocol, folders[v]) for v in plan for protocol in _protocols(recipe)]
    last = {v.table: v for v in plan}
    rivals = [v for v in plan if v is not last[v.table]]
    apart = [difference(v, last[v.table], protocol, folders) for v in rivals for protocol in _protocols(recipe)]
    made = provenance.summary([folder for found in folders.values() for folder in found])
    settings = {"train": config.to_dict(), "exam": asdict(recipe), "seeds": seeds, "made": made}
    files.write_json(out / "table.json", {"settings": settings, "rows": rows, "differences": apart})
    write_csv(out / "table.csv", rows)
    tables = list(dict.fromkeys(v.table for v in plan))
    pictures = {table: draw(out, {v: folders[v] for v in plan if v.table == table}) for table in tables}
    files.write_text(out / "table.md", markdown(rows, apart, pictures, settings))


def row(variant: Variant, protocol: str, folders: Sequence[Path]) -> Record:
    """Means over pairs and seeds with 95 % intervals over subjects; None where no seed is finished."""
    exams = [_records(folder, protocol) for folder in folders if (folder / "exam.json").exists()]
    chosen = [r for records in exams for r in records]
    found: Record = {"table": variant.table, "network": variant.label, "model": variant.model.stem}
    on_paper = variant.paper if protocol == "paper" else None
    found |= {"protocol": protocol, "seeds": len(exams), "pairs": len(chosen), "paper_rr_percent": on_paper}
    for name in FIGURES:
        found |= _mean(name, [r[name] for r in chosen], [r["person"] for r in chosen], metrics.share_interval)
    return found


def difference(variant: Variant, last: Variant, protocol: str, folders: Mapping[Variant, Sequence[Path]]) -> Record:
    """Subtract the last network of its table, on the same pairs with the same seeds.

    As `row`: means with 95 % intervals over subjects. Paired, so that pairs hard for both cancel.
    """
    both = [pair for pair in zip(folders[variant], folders[last], strict=True)
            if all((folder / "exam.json").exists() for folder in pair)]  # fmt: skip
    pairs = [_same(_records(own, protocol), _records(other, protocol)) for own, other in both]
    chosen = [pair for found in pairs for pair in found]
    found: Record = {"table": variant.table, "network": variant.label, "last": last.label, "protocol": protocol}
    found |= {"seeds": len(both), "pairs": len(chosen)}
    for name in FIGURES:
        more = [own[name] - other[name] for own, other in chosen]
        found |= _mean(name, more, [own["person"] for own, _ in chosen], metrics.interval)
    return found


def _records(folder: Path, protocol: str) -> list[Record]:
    records = json.loads((folder / "exam.json").read_text())["records"]
    return [r for r in records if protocol in (ALL, r["protocol"])]


def _same(first: Sequence[Record], second: Sequence[Record]) -> list[tuple[Record, Record]]:
    """Records of the same pairs."""
    by_pair = {r["pair"]: r for r in second}
    return [(r, by_pair[r["pair"]]) for r in first if r["pair"] in by_pair]


def _mean(name: str, values: Sequence[float], people: Sequence[str], interval: Callable[..., Any]) -> Record:
    numbers = (float(np.mean(values)), *interval(values, people)) if values else (np.nan,) * 3
    ends = zip(("", "_low", "_high"), numbers, strict=True)
    return {name + end: None if np.isnan(value) else round(value, 4) for end, value in ends}


def draw(out: Path, folders: dict[Variant, list[Path]]) -> str | None:
    """Draw the curves of one table's networks; returns the picture's name, None without data."""
    begun = {v.label: found[0] for v, found in folders.items() if (found[0] / "log.csv").exists()}
    if not begun:
        return None
    name = re.sub("[^a-z]+", "_", next(iter(folders)).table.partition("(")[0].lower()).strip("_")
    return curves.draw(list(begun.values()), out / f"curves_{name}.png", list(begun)).name


def markdown(rows: Sequence[Record], apart: Sequence[Record], pictures: dict[str, str | None], settings: Record) -> str:
    """Write the tables as Markdown, the paper's numbers in a column of their own."""
    parts = ["# Ablations", _preamble(settings)]
    for table, picture in pictures.items():
        own = [r for r in rows if r["table"] == table]
        parts.append(f"## {table}")
        for protocol in dict.fromkeys(r["protocol"] for r in own):
            has_paper = any(r["paper_rr_percent"] for r in own if r["protocol"] == protocol)
            head = ["network", *FIGURES.values(), *(["the paper's recall, its data"] if has_paper else [])]
            lines = [_row(r, has_paper) for r in own if r["protocol"] == protocol]
            count = max(r["pairs"] for r in own if r["protocol"] == protocol)
            parts += [f"Protocol {protocol}, {count} pairs", table_of(head, lines)]
            compared = [r for r in apart if (r["table"], r["protocol"]) == (table, protocol) and r["pairs"]]
            if compared:
                parts.append(f"Less the last row, on the same pairs with the same seeds ({compared[0]['last']}):")
                lines = [[r["network"], r["seeds"], *_cells(r, "+.1f")] for r in compared]
                parts.append(table_of(["network", "seeds", *FIGURES.values()], lines))
        parts += [f"![curves]({picture})"] if picture else []
    return "\n\n".join([*parts, *settings["made"]]) + "\n"


def _preamble(settings: Record) -> str:
    run, exam = settings["train"], settings["exam"]
    return (
        f"{run['pairs']} training pairs a network, {settings['seeds']} seed(s), the same pairs in the same order for "
        f"all; examined on subjects of split {exam['split']}, {exam['count']} pairs a protocol and bone "
        f"({', '.join(exam['bones'])}).\n\nIn %, with 95 % intervals from a bootstrap over subjects. Recall is of the "
        "best raw pose (consensus of the matches, no search): RMSE < 0.01 x the longest edge of the target's box, "
        "or 4 mm and 5° at the source's centroid; refined: after the point-to-surface refinement. The paper's "
        "numbers are on its own data at its own budget: compare the order of the rows, not the values. A dash: not "
        "finished, or no value."
    )


def _row(r: Record, has_paper: bool) -> list[str]:
    on_paper = ["–" if r["paper_rr_percent"] is None else f"{r['paper_rr_percent']:.1f}"]
    return [r["network"], *_cells(r, ".1f"), *(on_paper if has_paper else [])]


def _cells(r: Record, form: str) -> list[str]:
    """Means and intervals in %, as text."""
    numbers = [[r[name + end] for end in ("", "_low", "_high")] for name in FIGURES]
    texts = [[format(100 * value, form) for value in found if value is not None] for found in numbers]
    return [f"{found[0]} ({' to '.join(found[1:])})" if found[1:] else "".join(found) or "–" for found in texts]


def _protocols(recipe: Recipe) -> list[str]:
    return [*recipe.protocols, ALL] if len(recipe.protocols) > 1 else list(recipe.protocols)
