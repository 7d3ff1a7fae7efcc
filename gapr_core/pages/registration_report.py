"""The page of one registration: a verdict, the error at every target, the picture, why, and the details folded.

It shows numbers, the name of the bone as the user gave it and the names of planned targets. No path and nothing of a
file's header reaches it, since both may name a patient.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from gapr_core.errors import ConfigError
from gapr_core.geometry import se3
from gapr_core.pages import palette, report, views
from gapr_core.pages.report import Image
from gapr_core.registration.caveats import loosest_turn
from gapr_core.registration.confidence.features import FEATURE_LABELS
from gapr_core.results import Effect, RegistrationResult, RegistrationStatus, Residuals, confidence_text
from gapr_core.runtime import origin

Array = NDArray[np.float64]
NONE = "–"
MORE = "Measure more of the bone, on sides that face different ways."
NEXT = {  # the one thing to do after a refusal, where no finding advises more
    RegistrationStatus.TOO_FEW_POINTS: "Measure more points, spread over the bone.",
    RegistrationStatus.AMBIGUOUS: "Measure a place where the bone differs from its other end and side.",
    RegistrationStatus.DEGENERATE: MORE,
    RegistrationStatus.LOW_CONFIDENCE: f"{MORE} Check that this is the bone, the side and the unit.",
    RegistrationStatus.IMPRECISE: "Measure far from the points that there are.",
    RegistrationStatus.CLUTTER: "Crop the cloud to the bone, or give the camera's place as the viewpoint.",
}
STRENGTHS = ((2.0, "strongly"), (0.5, "clearly"), (0.0, "slightly"))  # log odds from which on


def write(path: str | Path, result: RegistrationResult, name: str = "") -> None:
    """Write one self-contained HTML file, for an accepted pose and for a refusal."""
    if Path(path).suffix.lower() not in (".html", ".htm"):
        raise ConfigError("a report as .html", Path(path).name, "let its name end with .html")
    report.write(path, "registration.html", title=name or "Registration", **_answer(result, name), **_details(result))


def fragment(result: RegistrationResult) -> str:
    """Verdict, errors and picture for a notebook."""
    style, answer = (report.environment().get_template(name) for name in ("style.css", "answer.html"))
    return f'<style>{style.render()}</style><div class="gapr">{answer.render(_answer(result, ""))}</div>'


def _answer(result: RegistrationResult, name: str) -> dict[str, Any]:
    """Add all parts that are not folded."""
    spots = [] if result.guidance is None or result.ok else result.guidance.spots()
    shown = views.of_result(result) if result.bone is not None and result.best is not None else None
    by = f"GAPR {origin.release() or ''}".strip()
    return {
        "result": result,
        "tone": "refused" if not result.ok else "caution" if result.warnings else "accepted",
        "headline": _headline(result),
        "lines": _lines(result),
        "next": _next(result),
        "about": " · ".join(filter(None, (name, f"{datetime.now():%Y-%m-%d %H:%M}", by))),
        "has_rivals": any(spot.rivals_excluded >= 0.005 for spot in spots),
        "spots": [_spot(number, spot, result) for number, spot in enumerate(spots, 1)],
        "gain_views": _sides(views.of_result(result, with_gain=True)) if spots and result.bone is not None else [],
        "errors": _errors(result),
        "views": _sides(shown) if shown is not None and result.ok else [],
        "scale": f"{shown.scale_mm:g}" if shown is not None else "",
        "colours": palette.SIGNED,
    }


def _headline(result: RegistrationResult) -> str:
    count = len(result.warnings)
    if not result.ok:
        return "No pose"
    return f"Pose accepted, with {count} warning{'s' if count > 1 else ''}" if count else "Pose accepted"


def _lines(result: RegistrationResult) -> list[str]:
    """Say in words what may be trusted, or why there is no pose."""
    if not result.ok:
        said = [finding.text for finding in result.findings if finding.effect is not Effect.WIDEN]
        return [_sentence(text) for text in said or [result.reason or str(result.status).replace("_", " ").lower()]]
    within = f"{se3.RIGHT_MM:g} mm and {se3.RIGHT_DEG:g} degrees"
    lines = [f"Where the points are: right within {within} with a probability of {confidence_text(result.confidence)}."]
    if result.tre_mm is not None and result.tre95_mm is not None:
        lines.append(f"The bone as a whole: {result.tre_mm:.1f} mm off to expect, below {result.tre95_mm:.1f} mm in 95 "
                     "of 100 cases.")  # fmt: skip
    return lines


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}" + ("" if text.endswith((".", "?", "!")) else ".")


def _next(result: RegistrationResult) -> list[str]:
    """Name the one thing to do after a refusal."""
    if result.ok:
        return []
    advised = [finding.advice for finding in result.findings if finding.advice]
    return [_sentence(advice) for advice in advised[:1] or [NEXT[result.status]]]


def _spot(number: int, spot: Any, result: RegistrationResult) -> tuple[str, ...]:
    assert result.bone is not None
    where = views.place_in_words(spot.centre, spot.normal, result.bone)
    return str(number), where, _mm(spot.tre95_mm), f"{100.0 * spot.rivals_excluded:.0f} %"


def _errors(result: RegistrationResult) -> list[tuple[str, ...]]:
    rows = [
        (f"{number}. {target.label}", _mm(target.expected_mm), _mm(target.bound95_mm), target.place or NONE)
        for number, target in enumerate(result.targets, 1)
    ]
    return [*rows, ("the bone as a whole", _mm(result.tre_mm), _mm(result.tre95_mm), NONE)]


def _mm(value: float | None) -> str:
    return NONE if value is None else f"{value:.1f} mm"


def _sides(on: views.OnBone) -> list[Image]:
    return [Image(views.png(on, side), f"the bone {views.NAMES[side]}", views.NAMES[side]) for side in on.sides()]


def _details(result: RegistrationResult) -> dict[str, Any]:
    residuals = result.residuals
    has_distances = residuals is not None and bool(np.isfinite(residuals.distance_mm).any())
    is_shown = not result.ok and result.best is not None and result.bone is not None
    return {
        "why": _why(result),
        "refused_views": _sides(views.of_result(result)) if is_shown else [],
        "matrix": "" if result.T_target_source is None else _matrix(result.T_target_source),
        "residuals": _spread(residuals) if has_distances and residuals is not None else "",
        "histogram": _histogram(residuals) if has_distances and residuals is not None else None,
        "features": _features(result),
        "hypotheses": _hypotheses(result),
        "made": f"Method {result.method}, {result.seconds:.2f} s. Lengths are in mm. The letters are the patient's "
        "sides (left, right, front A, back P, up S, down I), for a bone in LPS.",
    }


def _why(result: RegistrationResult) -> list[str]:
    """List the reasons of the verdict that it does not hold itself, one sentence each."""
    lines = [_sentence(str(finding)) for finding in result.findings if result.ok or finding.effect is Effect.WIDEN]
    matters = result.ok or result.status is RegistrationStatus.LOW_CONFIDENCE  # others are refused however probable
    if matters and result.pose_probability is not None:
        lines.append(f"If this is the right bone, the pose is right with a probability of "
                     f"{confidence_text(result.pose_probability)}.")  # fmt: skip
    if matters and result.bone_evidence is not None:
        times = float(f"{10.0 ** abs(result.bone_evidence):.2g}")
        than = "likelier" if result.bone_evidence >= 0.0 else "less likely"
        lines.append(f"The points are {times:,g} times {than} on this bone than on another subject's.")
    if result.ok:
        lines.append(f"{100.0 * result.inlier_ratio:.0f} % of the points fit.")
        if result.residuals is not None and np.isfinite(result.residuals.distance_mm).any():
            lines.append(_spread(result.residuals))
        if result.bone is not None and (turn := loosest_turn(result, result.bone.points)):
            lines.append(f"It may still turn about {turn[0]} by {turn[1]:.1f} degrees (95 %).")
        return lines
    against = sorted((adds, name) for name, adds in result.contributions.items() if adds <= -STRENGTHS[1][0])
    lines += [
        f"{_sentence(FEATURE_LABELS.get(name, name))[:-1]} speaks {_strength(adds)} against it."
        for adds, name in against[:2]
    ]
    return lines


def _strength(adds: float) -> str:
    return next(word for least, word in STRENGTHS if abs(adds) >= least)


def _matrix(T: Array) -> str:
    return "\n".join(" ".join(f"{value + 0.0:14.9f}" for value in row) for row in np.round(T, 9))


def _spread(residuals: Residuals) -> str:
    near = np.isfinite(residuals.distance_mm)
    sizes, lost = np.abs(residuals.distance_mm[near]), np.count_nonzero(~near)
    return (
        f"Half of {near.sum()} points lie within {np.median(sizes):.2f} mm of the bone, "
        f"95 % within {np.percentile(sizes, 95.0):.2f} mm" + (f"; {lost} have no surface near." if lost else ".")
    )


def _histogram(residuals: Residuals) -> Image:
    """Signed distances: the points that count for the pose, and the others."""
    near = np.isfinite(residuals.distance_mm)
    made = Figure(figsize=(8.0, 2.6), dpi=views.DPI, layout="constrained")
    FigureCanvasAgg(made)
    axes: Any = made.subplots()
    groups = [residuals.distance_mm[near & residuals.inlier], residuals.distance_mm[near & ~residuals.inlier]]
    names = ["counts for the pose", "does not count"]
    axes.hist(groups, bins=50, stacked=True, color=[palette.FIRST, palette.OTHERS], label=names)
    axes.set(xlabel="signed distance to the bone, mm (above 0: outside)", ylabel="points")
    axes.legend(frameon=False, loc="upper right")
    axes.spines[["top", "right"]].set_visible(False)
    return Image(views.as_png(made), "histogram of the distances")


def _features(result: RegistrationResult) -> list[tuple[str, ...]]:
    ranked = sorted(result.contributions.items(), key=lambda item: -abs(item[1]))
    return [
        (FEATURE_LABELS.get(name, name), f"{_strength(adds)} {'for' if adds > 0.0 else 'against'}" if adds else NONE,
         f"{adds:+.2f}", f"{result.features[name]:.3f}" if name in result.features else NONE)
        for name, adds in ranked
    ]  # fmt: skip


def _hypotheses(result: RegistrationResult) -> Sequence[tuple[str, ...]]:
    """List the ranked poses, and how far each moves the source from the best one."""
    if result.source is None or not len(result.source):
        return []
    best = np.eye(4) if result.best is None else result.best
    return [
        (str(number), f"{each.probability:.3f}", f"{shift_mm:.1f} mm", f"{turn_deg:.1f}°")
        for number, each in enumerate(result.hypotheses, 1)
        for shift_mm, turn_deg in [se3.pose_error(each.T_target_source, best, result.source)]
    ]
