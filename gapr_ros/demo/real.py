"""`gapr demo --real DIR`: public real clouds, registered and compared with what is known of their truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.table import Table

from gapr_core import Registrar, RegistrationResult, metrics
from gapr_core.data import real
from gapr_core.data.real import RealPair
from gapr_core.results import confidence_text

COLUMNS = ("cloud", "points", "answer", "confidence", "TRE mm", "off mm", "off deg", "truth")


def run(folder: Path, console: Any, weights: Path | None = None) -> int:
    """Print a line for each cloud; 1 when an accepted pose is wrong, or none was accepted."""
    registrar, table, right, wrong = Registrar.from_pretrained(weights=weights), Table(*COLUMNS), 0, 0
    for pair in real.pairs(folder):
        console.print(f"registering {pair.name}", highlight=False)
        result = registrar.register(pair.source, registrar.prepare(pair.target))
        row, is_right = judged(pair, result)
        table.add_row(*row)
        right, wrong = right + (is_right is True), wrong + (is_right is False)
    console.print(table)
    console.print(f"{right} right, {wrong} wrong of the accepted ones with a known truth (4 mm, 5 deg)")
    return 1 if wrong or not right else 0


def judged(pair: RealPair, result: RegistrationResult) -> tuple[list[str], bool | None]:
    """Make a row of the table, and say if the pose is right; None without pose or truth."""
    size = "" if result.tre_mm is None else f"{result.tre_mm:.1f}"
    row = [pair.name, str(len(pair.source)), str(result.status), confidence_text(result.confidence), size]
    if result.T_target_source is None or pair.T_target_source is None:
        return [*row, "", "", pair.truth], None
    error = metrics.pose_error(result.T_target_source, pair.T_target_source, pair.source)
    return [*row, f"{error.rte_mm:.2f}", f"{error.rre_deg:.2f}", pair.truth], bool(error.is_right)
