"""What `gapr demo` says at the end: every frame against the truth, as a table, a page and a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.table import Table

from gapr_core.data.specimen import Specimen
from gapr_core.evaluation.poster import save_poster
from gapr_core.evaluation.report import Report, Step, alignment_figure, timeline_figure
from gapr_core.geometry import se3
from gapr_ros.observer import Answer

if TYPE_CHECKING:
    from gapr_ros.demo import Scene

LIMIT_MM, LIMIT_DEG = 4.0, 5.0  # farther off at the source's centroid, or turned farther, is wrong
COLUMNS = ("frame", "points", "answer", "confidence", "TRE mm", "error mm", "error deg", "latency ms")
STYLES = {"ok": "green", "hold": "yellow", "bad": "bold red", "": "dim"}


@dataclass(frozen=True)
class Row:
    """One cloud: what came back and how far it is from the truth (not finite without a pose)."""

    frame: int
    points: int
    answer: Answer | None
    error_mm: float = float("nan")
    error_deg: float = float("nan")

    @property
    def mark(self) -> str:
        """How it went: "ok", "hold" for a refusal, "bad" for a wrong pose, "" for a cloud without an answer."""
        if self.answer is None:
            return ""
        if self.answer.T_target_source is None:
            return "hold"
        return "ok" if self.error_mm <= LIMIT_MM and self.error_deg <= LIMIT_DEG else "bad"

    def cells(self) -> tuple[str, ...]:
        """The row as text, one string a column."""
        answer = self.answer
        if answer is None:
            return (str(self.frame), str(self.points), "no answer: a newer cloud came first", "", "", "", "", "")
        words = {"ok": "pose", "hold": f"refused: {answer.refusal}", "bad": "WRONG pose"}[self.mark]
        posed = self.mark != "hold"
        tre = f"{answer.tre_mm:.1f}" if posed and answer.tre_mm is not None else ""
        errors = (f"{self.error_mm:.2f}", f"{self.error_deg:.2f}") if posed else ("", "")
        latency = f"{answer.latency_ms:.0f}" if np.isfinite(answer.latency_ms) else ""
        return (str(self.frame), str(self.points), words, f"{answer.confidence:.2f}", tre, *errors, latency)


def judge(scene: Scene, answers: Mapping[int, Answer]) -> list[Row]:
    """Every frame of the bag with its answer, against the truth that only the simulation knows."""
    rows = []
    for number, cloud in enumerate(scene.sweep.clouds):
        answer = answers.get(scene.stamp_ms(number))
        errors = (float("nan"), float("nan"))
        if answer is not None and answer.T_target_source is not None:
            errors = se3.pose_error(answer.T_target_source, scene.sweep.T_target_source, cloud)
        rows.append(Row(number + 1, len(cloud), answer, *errors))
    return rows


def passed(rows: Sequence[Row]) -> bool:
    """Poses came, and none was wrong."""
    marks = [row.mark for row in rows]
    return "ok" in marks and "bad" not in marks


def verdict(rows: Sequence[Row]) -> str:
    """The outcome in a sentence."""
    counts = _counts(rows)
    return "  ".join(f"{name}: {value}." for name, value in counts.items())


def rich_table(rows: Sequence[Row]) -> Table:
    """For the terminal."""
    table = Table(box=None, header_style="bold", pad_edge=False)
    for name in COLUMNS:
        table.add_column(name, justify="left" if name == "answer" else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(_first_words(cell) for cell in row.cells()), style=STYLES[row.mark])
    return table


def _first_words(text: str) -> str:
    """`refused: ambiguous` of `refused: ambiguous: another pose fits as well`."""
    return ":".join(text.split(":")[:2])


def write(scene: Scene, rows: Sequence[Row], folder: Path) -> None:
    """report.html and report.png."""
    steps = _steps(scene, rows)
    shown = max((k for k, row in enumerate(rows) if row.mark in ("ok", "bad")), default=len(rows) - 1)
    charts = _charts(rows)
    _page(scene, rows, steps, shown, charts).write(folder / "report.html")
    title = f"{scene.name}: {steps[shown].caption}"
    limits = {"confidence": 0.5, "error at the centroid, mm": LIMIT_MM, "error, deg": LIMIT_DEG}
    panels = {name: (values, limits.get(name)) for name, values in charts.items() if name in limits}
    save_poster(folder / "report.png", scene.bone, steps[shown].points, steps[shown].distances_mm, title, panels)


def _page(
    scene: Scene, rows: Sequence[Row], steps: Sequence[Step], shown: int, charts: Mapping[str, Sequence[float]]
) -> Report:
    lead = (
        f"A tracked probe sweeps along a {scene.name}; the one-sided cloud of all it has seen so far goes from a bag "
        "through register_node, a ROS 2 process of its own, to a pose of the pre-operative bone, or to a refusal."
    )
    report = Report("From a bag to a trusted pose", lead)
    report.facts(_counts(rows))
    report.heading("The points laid on the bone")
    report.figure(alignment_figure(scene.bone, steps, shown))
    report.heading("Frame by frame")
    report.paragraph(
        "Errors are against the truth of the simulation, which the node never sees: at the centroid of the cloud and "
        "as an angle; TRE is what the node expects of its own pose, over the whole bone. More than "
        f"{LIMIT_MM:g} mm or {LIMIT_DEG:g} degrees is a wrong pose. Dashed: the limits."
    )
    limits = {"confidence": 0.5, "error at the centroid, mm": LIMIT_MM, "error, deg": LIMIT_DEG}
    report.figure(timeline_figure([row.frame for row in rows], charts, "frame", limits))
    report.table(COLUMNS, [row.cells() for row in rows], [row.mark for row in rows], text=("answer",))
    return report


def _steps(scene: Scene, rows: Sequence[Row]) -> list[Step]:
    bone = Specimen(scene.bone, scene.name, "")
    return [_step(row, cloud, bone) for row, cloud in zip(rows, scene.sweep.clouds, strict=True)]


def _step(row: Row, cloud: np.ndarray, bone: Specimen) -> Step:
    if row.answer is None or row.answer.T_target_source is None:
        return Step(str(row.frame), f"frame {row.frame}: {row.cells()[2]}", np.zeros((0, 3)), np.zeros(0))
    aligned = se3.apply(row.answer.T_target_source, cloud)
    caption = (
        f"frame {row.frame}, {row.points} points: confidence {row.answer.confidence:.2f}, "
        f"error {row.error_mm:.2f} mm, {row.error_deg:.2f} deg"
    )
    return Step(str(row.frame), caption, aligned, bone.distance(aligned))


def _charts(rows: Sequence[Row]) -> dict[str, list[float]]:
    nan = float("nan")
    return {
        "confidence": [row.answer.confidence if row.answer else nan for row in rows],
        "error at the centroid, mm": [row.error_mm for row in rows],
        "error, deg": [row.error_deg for row in rows],
        "latency, ms": [row.answer.latency_ms if row.answer else nan for row in rows],
    }


def _counts(rows: Sequence[Row]) -> dict[str, str]:
    marks = [row.mark for row in rows]
    names = {
        "ok": "right poses",
        "bad": "wrong poses",
        "hold": "refused with a reason",
        "": "overtaken by a newer one",
    }
    counts = {name: str(marks.count(mark)) for mark, name in names.items()}
    errors = [row.error_mm for row in rows if row.mark in ("ok", "bad")]
    latencies = [row.answer.latency_ms for row in rows if row.answer and np.isfinite(row.answer.latency_ms)]
    counts["median error"] = f"{np.median(errors):.2f} mm" if errors else "none"
    counts["median latency"] = f"{np.median(latencies):.0f} ms" if latencies else "none"
    return counts
