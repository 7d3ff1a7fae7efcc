"""What `gapr demo` says at the end: every frame against the truth, as a table, a page and a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from scipy.spatial import cKDTree

from gapr_core.data.specimen import Specimen
from gapr_core.geometry import se3
from gapr_core.pages import views
from gapr_core.pages.camera_pictures import KEY, CameraView, save_scene_poster, views_as_png
from gapr_core.pages.poster import charts_as_png, save_poster
from gapr_core.pages.report import Image, Report
from gapr_core.pages.views import OnBone
from gapr_core.results import confidence_text
from gapr_ros.demo.act import Act
from gapr_ros.demo.observer import Answer

LIMITS = {"confidence": 0.5, "error at the centroid, mm": se3.RIGHT_MM, "error, deg": se3.RIGHT_DEG}
BONE_COLUMNS = ("bone %", "taken", "right %")
LEFT_OUT = ("points", "TRE mm")  # of a scene's table in the terminal, which is not wide enough
STYLES = {"ok": "green", "hold": "yellow", "bad": "bold red", "": "dim"}
NEAR_MM = 1.5  # a point this near to one that the node used shares its lot: the node thins


@dataclass(frozen=True, eq=False)
class Taken:
    """Which points of a cloud (N) were looked at, and taken for bone, and which are bone."""

    looked_at: NDArray[np.bool_]
    is_taken: NDArray[np.bool_]
    is_bone: NDArray[np.bool_]

    @property
    def right_share(self) -> float:
        """Of the points taken for bone, how many are; not finite where none was taken."""
        return float(self.is_bone[self.is_taken].mean()) if self.is_taken.any() else float("nan")

    def cells(self) -> tuple[str, ...]:
        """Return the part of a row, as text."""
        right = f"{100.0 * self.right_share:.0f}" if self.is_taken.any() else ""
        return f"{100.0 * self.is_bone.mean():.0f}", str(int(self.is_taken.sum())), right


@dataclass(frozen=True)
class Row:
    """One cloud: what came back and how far it is from the truth (not finite without a pose)."""

    frame: int
    points: int
    answer: Answer | None
    error_mm: float = float("nan")
    error_deg: float = float("nan")
    taken: Taken | None = None

    @property
    def mark(self) -> str:
        """How it went: "ok", "hold" for a refusal, "bad" for a wrong pose, "" for a cloud without an answer."""
        if self.answer is None:
            return ""
        if self.answer.T_target_source is None:
            return "hold"
        return "ok" if se3.PoseError(self.error_mm, self.error_deg).is_right else "bad"

    def cells(self) -> tuple[str, ...]:
        """Return the row as text, one string a column."""
        head = (str(self.frame), str(self.points), *(self.taken.cells() if self.taken else ()))
        answer = self.answer
        if answer is None:
            return (*head, "overtaken by a newer cloud", "", "", "", "", "", "")
        words = {"ok": "pose", "hold": f"refused: {answer.refusal}", "bad": "WRONG pose"}[self.mark]
        posed = self.mark != "hold"
        precision = [
            f"{value:.1f}" if posed and value is not None else "" for value in (answer.tre_mm, answer.tre95_mm)
        ]
        errors = (f"{self.error_mm:.2f}", f"{self.error_deg:.2f}") if posed else ("", "")
        latency = f"{answer.latency_ms:.0f}" if np.isfinite(answer.latency_ms) else ""
        return (*head, words, confidence_text(answer.confidence), *precision, *errors, latency)


def columns(rows: Sequence[Row]) -> tuple[str, ...]:
    """Return the headings of the rows' cells."""
    bone = BONE_COLUMNS if rows and rows[0].taken else ()
    return (
        "frame",
        "points",
        *bone,
        "answer",
        "confidence",
        "TRE mm",
        "95 % mm",
        "error mm",
        "error deg",
        "latency ms",
    )


def judge(act: Act, answers: Mapping[int, Answer]) -> list[Row]:
    """Hold every frame's answer against the truth, which only the simulation knows."""
    rows = []
    for number, (cloud, truth) in enumerate(zip(act.clouds, act.truths, strict=True)):
        answer = answers.get(act.stamp_ms(number))
        errors = (float("nan"), float("nan"))
        if answer is not None and answer.T_target_source is not None:
            errors = se3.pose_error(answer.T_target_source, truth, cloud)
        taken = _taken(cloud, act.is_bone[number], answer) if act.is_bone else None
        rows.append(Row(number + 1, len(cloud), answer, *errors, taken))
    return rows


def _taken(cloud: np.ndarray, is_bone: NDArray[np.bool_], answer: Answer | None) -> Taken:
    """Mark the points of the cloud that the node took for bone; none of a refused cloud."""
    if answer is None or answer.used is None or not len(answer.used.points):
        return Taken(np.zeros(len(cloud), dtype=bool), np.zeros(len(cloud), dtype=bool), is_bone)
    used = answer.used
    distance, nearest = cKDTree(used.points).query(cloud)
    looked_at = distance <= NEAR_MM
    return Taken(looked_at, looked_at & used.is_taken[nearest] & (answer.T_target_source is not None), is_bone)


def passed(rows: Sequence[Row]) -> bool:
    """Poses came, and none was wrong."""
    marks = [row.mark for row in rows]
    return "ok" in marks and "bad" not in marks


def verdict(rows: Sequence[Row]) -> str:
    """Sum the outcome up in a sentence."""
    counts = facts(rows)
    return "  ".join(f"{name}: {value}." for name, value in counts.items())


def rich_table(rows: Sequence[Row]) -> Table:
    """Make the table of the terminal."""
    table, names = Table(box=None, header_style="bold", pad_edge=False), columns(rows)
    shown = [k for k, name in enumerate(names) if not (rows[0].taken and name in LEFT_OUT)]
    for k in shown:
        table.add_column(names[k], justify="left" if names[k] == "answer" else "right", no_wrap=True)
    for row in rows:
        cells = row.cells()
        table.add_row(*(_first_words(cells[k]) for k in shown), style=STYLES[row.mark])
    return table


def _first_words(text: str) -> str:
    """`refused: ambiguous` of `refused: ambiguous: another pose fits as well`."""
    return ":".join(text.split(":")[:2])


def write(act: Act, rows: Sequence[Row], folder: Path) -> None:
    """report.html and report.png."""
    shown = max((k for k, row in enumerate(rows) if row.mark in ("ok", "bad")), default=len(rows) - 1)
    frames = [_on_bone(row, cloud, act) for row, cloud in zip(rows, act.clouds, strict=True)]
    images, facing = _views(act, rows), _facing(act, shown)
    _page(act, rows, frames, images, facing).write(folder / "report.html")
    title = f"{act.name}: {_caption(rows[shown])}"
    panels = {name: panel for name, panel in _charts(rows).items() if name != "latency, ms"}
    on_bone = frames[shown].points, frames[shown].distance_mm
    if images:
        save_scene_poster(folder / "report.png", act.bone, images, *on_bone, title, panels, facing)
    else:
        save_poster(folder / "report.png", act.bone, *on_bone, title, panels)


def _page(
    act: Act, rows: Sequence[Row], frames: Sequence[OnBone], images: Sequence[CameraView], facing: np.ndarray | None
) -> Report:
    report = Report(act.title, act.lead)
    add_verdict(report, rows)
    report.facts(facts(rows))
    if images:
        report.heading("What the camera sees")
        report.paragraph("Every image, and what the node took for bone in it.")
        report.images([Image(views_as_png(images), "the images, with the points taken for bone", KEY)])
    report.heading("The points laid on the bone")
    report.paragraph("Frame after frame, to be scrolled. Red points are outside of the bone, blue ones inside.")
    side = max(frames, key=lambda frame: len(frame.points)).side_facing(facing)
    report.film(
        [
            Image(views.png(frame, side), "points on the bone", _caption(row), row.mark == "bad")
            for frame, row in zip(frames, rows, strict=True)
        ]
    )
    add_frames(report, rows)
    return report


def add_verdict(report: Report, rows: Sequence[Row]) -> None:
    """Report how many poses are right, and if one is wrong."""
    right, wrong, refused = ([row.mark for row in rows].count(mark) for mark in ("ok", "bad", "hold"))
    tone = "refused" if wrong or not right else "accepted"
    headline = f"{wrong} wrong poses" if wrong else f"{right} right poses, none wrong"
    report.verdict(tone, headline, [f"{refused} of {len(rows)} clouds were refused, each with a reason."])


def add_frames(report: Report, rows: Sequence[Row]) -> None:
    """Add the charts and the table of all frames."""
    report.heading("Frame by frame")
    report.paragraph(
        "Errors are against the truth of the simulation, which the node never sees: at the centroid of the cloud and "
        "as an angle; TRE is what the node expects of its own pose, over the whole bone, with its 95 % bound. More "
        f"than {se3.RIGHT_MM:g} mm or {se3.RIGHT_DEG:g} degrees is a wrong pose. Dashed: the limits."
    )
    report.images([Image(charts_as_png(_charts(rows), "frame"), "charts over the frames")])
    report.table(columns(rows), [row.cells() for row in rows], [row.mark for row in rows], text=("answer",))


def _on_bone(row: Row, cloud: np.ndarray, act: Act) -> OnBone:
    """Draw one frame: grey is what the node took for no bone. Without a pose nothing is on the bone."""
    if row.answer is None or row.answer.T_target_source is None:
        return OnBone(act.bone, np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)))
    aligned = se3.apply(row.answer.T_target_source, cloud)
    distance_mm = Specimen(act.bone, act.name, "").signed_distance(aligned)
    if row.taken is not None:
        distance_mm = np.where(row.taken.is_taken, distance_mm, np.nan)
    return OnBone(act.bone, aligned, distance_mm, np.zeros((0, 3)))


def _caption(row: Row) -> str:
    if row.answer is None or row.answer.T_target_source is None:
        return f"frame {row.frame}: {row.cells()[columns([row]).index('answer')]}"
    return (
        f"frame {row.frame}, {row.points} points: confidence {confidence_text(row.answer.confidence)}, "
        f"error {row.error_mm:.2f} mm, {row.error_deg:.2f} deg"
    )


def _facing(act: Act, frame: int) -> np.ndarray | None:
    """Find the camera from its points, in the bone's frame; None for a probe, which is on all sides."""
    if not act.is_bone:
        return None
    middle = act.clouds[frame].mean(axis=0)
    return act.truths[frame][:3, :3] @ -middle  # the camera is at the origin of its frame


def _views(act: Act, rows: Sequence[Row]) -> list[CameraView]:
    """Draw the images of a camera, in its own frame; none of a probe."""
    words = {"ok": "pose", "hold": "refused", "bad": "WRONG pose", "": "no answer"}
    return [
        CameraView(f"frame {row.frame}: {words[row.mark]}", cloud, row.taken.looked_at, row.taken.is_taken)
        for row, cloud in zip(rows, act.clouds, strict=True)
        if row.taken is not None
    ]


def _charts(rows: Sequence[Row]) -> dict[str, tuple[list[float], float | None]]:
    """Name to values, and the limit where there is one."""
    nan = float("nan")
    charts = {"confidence": [row.answer.confidence if row.answer else nan for row in rows]}
    if any(row.taken for row in rows):
        charts["taken points that are bone, %"] = [100.0 * row.taken.right_share if row.taken else nan for row in rows]
    charts |= {
        "error at the centroid, mm": [row.error_mm for row in rows],
        "error, deg": [row.error_deg for row in rows],
        "latency, ms": [row.answer.latency_ms if row.answer else nan for row in rows],
    }
    return {name: (values, LIMITS.get(name)) for name, values in charts.items()}


def facts(rows: Sequence[Row]) -> dict[str, str]:
    """List what matters most."""
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
