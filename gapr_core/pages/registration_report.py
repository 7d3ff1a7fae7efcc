"""The page of one registration: where the source lies, how well, how sure, how precise, and where to look next.

It shows numbers and the names of planned targets only. No path and nothing of a file's header reaches it, since both
may name a patient.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from gapr_core.geometry import se3
from gapr_core.pages import palette
from gapr_core.pages.guidance import GuidedStep, guidance_figure
from gapr_core.pages.registration import Registration
from gapr_core.pages.report import Report, Step, alignment_figure
from gapr_core.registration.confidence.feature_labels import FEATURE_LABELS
from gapr_core.results import Patch, RegistrationResult, confidence_text
from gapr_core.runtime import origin

Array = NDArray[np.float64]
NOWHERE = np.zeros((0, 3))
MOST_HYPOTHESES = 5
NONE = "–"


def write(path: str | Path, registration: Registration) -> None:
    """One self-contained HTML file, for an accepted pose and for a refusal."""
    result = registration.result
    report = Report("Registration", _lead(result))
    report.facts(_facts(result))
    if result.reason:
        report.note(f"Reason: {result.reason}")
    _add_pose(report, result)
    _add_view(report, registration)
    _add_residuals(report, result)
    _add_confidence(report, result)
    _add_errors(report, registration)
    _add_hypotheses(report, registration)
    _add_guidance(report, registration)
    code = origin.release() or "GAPR"
    report.note(f"Method {result.method}, GAPR {code}, {result.seconds:.2f} s. Lengths are in mm.")
    report.write(path)


def _lead(result: RegistrationResult) -> str:
    if result.ok:
        return "Accepted: the pose below takes the source onto the target."
    return f"Refused ({result.status}): there is no pose to use. What is shown is the best hypothesis, to look at only."


def _facts(result: RegistrationResult) -> dict[str, str]:
    return {
        "status": str(result.status).replace("_", " "),
        "confidence": confidence_text(result.confidence),
        "expected error over the bone (TRE)": _mm(result.tre_mm),
        "its 95 % bound": _mm(result.tre95_mm),
        "points that fit": f"{100.0 * result.inlier_ratio:.0f} %",
    }


def _mm(value: float | None) -> str:
    return NONE if value is None else f"{value:.2f} mm"


def _add_pose(report: Report, result: RegistrationResult) -> None:
    if result.T_target_source is None:
        return
    report.heading("Pose")
    report.paragraph(
        "T_target_source, 4x4, mm: it takes points of the source into the frame of the target (source to target). "
        "Copy it into a text file: --initial and numpy.loadtxt read it."
    )
    report.matrix(result.T_target_source)


def _add_view(report: Report, registration: Registration) -> None:
    """The source on the target under the best hypothesis, and under its rivals."""
    report.heading("The source on the target")
    steps = _steps(registration)
    moved = np.vstack([steps[0].points, steps[0].others])
    facing = moved.mean(axis=0) - registration.target.points.mean(axis=0) if len(moved) else None
    report.paragraph(
        "Turn it with the mouse. Colours are the distance to the bone under the best hypothesis; grey points have no "
        "surface near, or lie where a rival hypothesis puts them (slider). Planned targets are named."
    )
    errors = registration.errors
    plan = [_spots([error.position_mm for error in errors], palette.SECOND)] if errors else []
    figure = alignment_figure(registration.target, steps, 0, facing, "hypothesis ", plan)
    _name(figure, [error.position_mm for error in errors], [error.label for error in errors])
    report.figure(figure)


def _steps(registration: Registration) -> list[Step]:
    """One state of the view for each hypothesis; the bone alone where there is none."""
    result = registration.result
    if result.best is None:
        return [Step("none", "no hypothesis was found", NOWHERE, np.zeros(0))]
    points = registration.source if result.residuals is None else result.residuals.points
    rivals = result.hypotheses[1:MOST_HYPOTHESES]
    aside = [
        Step(str(number), f"rival, probability {rival.probability:.2f}: not the answer", NOWHERE, np.zeros(0),
             se3.apply(rival.T_target_source, points))
        for number, rival in enumerate(rivals, 2)
    ]  # fmt: skip
    return [_best_step(result, points), *aside]


def _best_step(result: RegistrationResult, points: Array) -> Step:
    assert result.best is not None
    moved = se3.apply(result.best, points)
    caption = f"{result.status}: " + ("the pose" if result.ok else "the best hypothesis, which was refused")
    if result.residuals is None:
        return Step("1", f"{caption}; this method does not say residuals", NOWHERE, np.zeros(0), moved)
    near = np.isfinite(result.residuals.distance_mm)
    return Step("1", caption, moved[near], np.abs(result.residuals.distance_mm[near]), moved[~near])


def _spots(points: Sequence[Any], colour: str) -> Any:
    """Points (K, 3) of a 3-D view that must be seen."""
    x, y, z = np.array(points, dtype=np.float32).reshape(-1, 3).T
    return go.Scatter3d(x=x, y=y, z=z, mode="markers", marker={"size": 6, "color": colour}, hoverinfo="skip")


def _name(figure: Any, points: Sequence[Any], names: Sequence[str]) -> None:
    """Write names at points (K, 3); they are seen from every side."""
    look = {"ax": 0, "ay": -36, "arrowcolor": "#5d6b7a", "bgcolor": "rgba(255, 255, 255, 0.85)"}
    notes = [
        {"x": float(x), "y": float(y), "z": float(z), "text": escape(name), **look}
        for (x, y, z), name in zip(points, names, strict=True)
    ]
    figure.update_layout(scene_annotations=notes)


def _add_residuals(report: Report, result: RegistrationResult) -> None:
    report.heading("Residuals")
    residuals = result.residuals
    if residuals is None or not np.isfinite(residuals.distance_mm).any():
        report.paragraph("There are none: no hypothesis was compared with the surface point by point.")
        return
    near = np.isfinite(residuals.distance_mm)
    sizes, lost = np.abs(residuals.distance_mm[near]), np.count_nonzero(~near)
    report.paragraph(
        f"Signed distance of {near.sum()} points to the bone, positive outside. Half of them lie within "
        f"{np.median(sizes):.2f} mm, 95 % within {np.percentile(sizes, 95.0):.2f} mm. "
        + (f"Without a surface near: {lost}. " if lost else "")
        + "Residuals are of the patch that was measured: they say little of the far end of the bone."
    )
    report.figure(residual_figure(residuals.distance_mm[near], residuals.inlier[near]))


def residual_figure(distance_mm: Array, inlier: NDArray[np.bool_]) -> Any:
    """A plotly figure: histogram of signed distances (N,) mm, the points that count for the pose and the others."""
    kinds = (("counts for the pose", inlier, palette.FIRST), ("does not count", ~inlier, palette.OTHERS))
    low, high = float(distance_mm.min()), float(distance_mm.max())
    bins = {"start": low, "end": high + 1e-6, "size": max((high - low) / 60.0, 1e-3)}
    bars = [go.Histogram(x=distance_mm[of], name=name, marker_color=colour, xbins=bins) for name, of, colour in kinds]
    figure = go.Figure(bars)
    figure.update_layout(barmode="stack", bargap=0.05, height=320, template="plotly_white", margin={"t": 20, "r": 20})
    figure.update_xaxes(title_text="signed distance to the bone, mm")
    figure.update_yaxes(title_text="points")
    return figure


def _add_confidence(report: Report, result: RegistrationResult) -> None:
    report.heading("Confidence")
    report.paragraph(
        f"{confidence_text(result.confidence)} is the probability that the best hypothesis is within "
        f"{se3.RIGHT_MM:g} mm and {se3.RIGHT_DEG:g} degrees of the truth. Each feature adds to its log odds: "
        "above 0 it speaks for the pose, below 0 against it. Rules refuse what no probability can know; "
        "the reason of the refusal then names the rule."
    )
    if not result.contributions:
        report.paragraph("No features were measured here.")
        return
    ranked = sorted(result.contributions.items(), key=lambda item: -abs(item[1]))
    rows = [
        (FEATURE_LABELS.get(name, name), name, "for" if adds > 0 else "against" if adds < 0 else NONE, f"{adds:+.2f}",
         f"{result.features[name]:.3f}" if name in result.features else NONE)
        for name, adds in ranked
    ]  # fmt: skip
    columns = ("what", "feature", "speaks", "log odds", "value")
    marks = ["ok" if adds > 0 else "hold" if adds < 0 else "" for _, adds in ranked]
    report.table(columns, rows, marks, text=columns[:3])


def _add_errors(report: Report, registration: Registration) -> None:
    report.heading("Expected error at the target (TRE)")
    if not registration.result.ok:
        report.paragraph("There is no pose, so there is no error to expect.")
        return
    rows = [("the whole bone, root mean square", NONE, _mm(registration.result.tre_mm),
             _mm(registration.result.tre95_mm))]  # fmt: skip
    rows += [
        (error.label, "{:.1f} {:.1f} {:.1f}".format(*error.position_mm), _mm(error.expected_mm), _mm(error.bound95_mm))
        for error in registration.errors
    ]
    report.table(("where", "position, mm", "expected", "95 % bound"), rows)


def _add_hypotheses(report: Report, registration: Registration) -> None:
    """The ranked poses, and how far each puts the source from where the best one does."""
    hypotheses = registration.result.hypotheses
    if not hypotheses:
        return
    report.heading("Hypotheses")
    report.paragraph("Distinct poses that were compared. Distances are from the best one: of the source's middle, and "
                     "the angle between them. Only an accepted pose is for use.")  # fmt: skip
    rows = []
    for number, hypothesis in enumerate(hypotheses, 1):
        shift_mm, turn_deg = se3.pose_error(
            hypothesis.T_target_source, hypotheses[0].T_target_source, registration.source
        )
        rows.append((str(number), f"{hypothesis.probability:.3f}", f"{shift_mm:.1f} mm", f"{turn_deg:.1f}°"))
    report.table(("rank", "probability", "distance", "angle"), rows)


def _add_guidance(report: Report, registration: Registration) -> None:
    result, spots = registration.result, registration.spots
    if result.guidance is None or not spots:
        return
    report.heading("Where to look next")
    report.paragraph(
        f"The error over the bone is below {result.guidance.now_mm:.1f} mm (95 %), rival hypotheses included. The bone "
        "is coloured by how much a look there would lower that bound. Numbers: the best patches, in order."
    )
    moved = NOWHERE
    if result.best is not None and result.residuals is not None:
        moved = se3.apply(result.best, result.residuals.points)
    advice = (result.guidance.points, result.guidance.gain_mm, spots[0].centre)
    step = GuidedStep("1", "black: the source; green: where to look, the best place is the large one", moved, 0, advice)
    figure = guidance_figure(registration.target, [step], spots[0].normal)
    figure.add_trace(_spots([spot.centre for spot in spots], "#12a150"))
    _name(figure, [spot.centre for spot in spots], [str(k) for k in range(1, len(spots) + 1)])
    report.figure(figure)
    report.table(("rank", *SPOT_COLUMNS), [(str(k), *spot_cells(spot)) for k, spot in enumerate(spots, 1)])


SPOT_COLUMNS = ("centre, mm", "normal", "tre95 after the look", "gain", "rivals excluded")


def spot_cells(spot: Patch) -> tuple[str, ...]:
    """The cells of a patch, as in `SPOT_COLUMNS`."""
    return (
        "{:.0f} {:.0f} {:.0f}".format(*spot.centre),
        "{:.2f} {:.2f} {:.2f}".format(*spot.normal),
        f"{spot.tre95_mm:.2f} mm",
        f"{spot.gain_mm:.2f} mm",
        f"{100.0 * spot.rivals_excluded:.0f} %",
    )
