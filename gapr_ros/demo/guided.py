"""A probe that follows the guidance: small looks at a bone, each where the node says that it would help most."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gapr_core import metrics
from gapr_core.data.looking_probe import LookingProbe
from gapr_core.data.pool import parametric_specimen
from gapr_core.geometry import se3
from gapr_core.pages import views
from gapr_core.pages.poster import charts_as_png
from gapr_core.pages.report import Image, Report
from gapr_core.pages.views import OnBone
from gapr_core.results import Guidance, confidence_text
from gapr_ros.demo.act import Act, write_bone
from gapr_ros.demo.report import Row, add_frames, add_verdict, facts, judge
from gapr_ros.demo.running import STARTING, Sender, running

if TYPE_CHECKING:
    from gapr_ros.demo.observer import Advice, Answer, Observer

Array = NDArray[np.float64]
GOAL_MM = 2.0  # bound of the error over the bone (95 %) with which the probe has seen enough
PARAMETERS = {"guide": True, "track": False}
TITLE = "A probe that follows the guidance"
LEAD = (
    "The probe sees 30 mm of a {bone} at a time. After every look register_node says what it knows by now and where "
    f"another look would help most; the probe goes there, until the 95 % bound of the error over the whole bone is "
    f"{GOAL_MM:g} mm."
)


@dataclass(frozen=True, eq=False)
class Look:
    """One look and what the node said.

    Attributes:
        cloud: (N, 3) mm, tracker frame: all points so far.
        newest: how many of them, at the end, are of this look.
        answer: to the cloud; None where none came.
        advice: where to look next; None where the node did not say.
    """

    cloud: Array
    newest: int
    answer: Answer | None
    advice: Advice | None

    @property
    def is_enough(self) -> bool:
        """The bone is known as well as asked for."""
        bound = self.answer.tre95_mm if self.answer and self.answer.T_target_source is not None else None
        return bound is not None and bound <= GOAL_MM


def make_probe(bone: str, seed: int) -> LookingProbe:
    """Put a probe in front of a parametric bone."""
    return LookingProbe(parametric_specimen(bone, seed), seed)


def follow(
    probe: LookingProbe, observer: Observer, most: int, folder: Path, console: Any, own: Mapping[str, Any] | None = None
) -> list[Look]:
    """Look, ask the node, and look where the answer says, until the pose is good enough or advice ends.

    `own` are the user's parameters of the node.

    Raises:
        DemoError: the node did not start, or ended too early.
    """
    path, looks = write_bone(probe.specimen, folder), []
    parameters = {"model_path": path.resolve(), "model_unit": "mm", **PARAMETERS, **(own or {})}
    with running(observer, folder, parameters) as node:
        sender = Sender(node, "tracker")
        with console.status(STARTING):
            node.wait_until_ready()
        cloud, centre = np.empty((0, 3)), probe.anywhere
        for number in range(most):
            newest = probe.look(centre, number)
            cloud = np.vstack([cloud, newest])
            observer.forget_advice()
            answer = sender.ask(cloud, 1000 * (1 + number))
            looks.append(Look(cloud, len(newest), answer, observer.advice))
            console.print(f"   {_line(1 + number, looks[-1])}", highlight=False)
            if looks[-1].is_enough or observer.advice is None:
                break
            centre = observer.advice.centre
    return looks


def _line(number: int, look: Look) -> str:
    """Describe a look for the terminal."""
    answer, points = look.answer, len(look.cloud)
    if answer is None:
        return f"look {number}, {points} points: no answer"
    if answer.T_target_source is None:
        return shorten(f"look {number}, {points} points: refused: {answer.refusal}", 104, placeholder=" ...")
    bound = "" if answer.tre95_mm is None else f", error over the bone below {answer.tre95_mm:.1f} mm (95 %)"
    return f"look {number}, {points} points: pose, confidence {confidence_text(answer.confidence)}{bound}"


def judged(probe: LookingProbe, looks: Sequence[Look]) -> list[Row]:
    """Hold every look against the truth."""
    act = Act(
        probe.specimen.bone, probe.specimen.surface, Path(), tuple(look.cloud for look in looks),
        (probe.T_target_source,) * len(looks), 1.0, TITLE, LEAD,
    )  # fmt: skip
    return judge(act, {act.stamp_ms(k): look.answer for k, look in enumerate(looks) if look.answer is not None})


def write(probe: LookingProbe, looks: Sequence[Look], rows: Sequence[Row], folder: Path) -> None:
    """report.html."""
    report = Report(TITLE, LEAD.format(bone=probe.specimen.bone))
    add_verdict(report, rows)
    report.facts(_facts(looks, rows))
    report.heading("Where to look next")
    report.paragraph(
        "Look after look, to be scrolled. The bone is coloured by how much a look there would lower the bound of the "
        "error over the bone, rival poses included. Dark: the points so far, where they really are. Red: the newest "
        "look. 1: where the node sends the probe. Below: that bound, and the true error over the bone."
    )
    steps = [_on_bone(probe, look) for look in looks]
    side = max(steps, key=lambda step: len(step.points)).sides(1)[0]
    captions = [_line(number, look) for number, look in enumerate(looks, 1)]
    report.film([Image(views.png(on, side), "bone by gain", line) for on, line in zip(steps, captions, strict=True)])
    bounds = [_bound_mm(look) for look in looks]
    errors = [_error_over_bone_mm(probe, look) for look in looks]
    curves = {"95 % bound, mm": (bounds, GOAL_MM), "true error, mm": (errors, GOAL_MM)}
    report.images([Image(charts_as_png(curves, "look"), "bound and error over the looks")])
    add_frames(report, rows)
    report.write(folder / "report.html")


def verdict(looks: Sequence[Look], rows: Sequence[Row]) -> str:
    """Sum the outcome up in a sentence."""
    return "  ".join(f"{name}: {value}." for name, value in _facts(looks, rows).items())


def _facts(looks: Sequence[Look], rows: Sequence[Row]) -> dict[str, str]:
    arrived = f"after {len(looks)} looks" if looks[-1].is_enough else "not reached"
    own = {f"{GOAL_MM:g} mm over the bone (95 %)": arrived, "points": str(len(looks[-1].cloud))}
    return own | facts(rows)


def _on_bone(probe: LookingProbe, look: Look) -> OnBone:
    """Draw what is known after a look, and where the next one would help."""
    bone, points = probe.specimen.surface, se3.apply(probe.T_target_source, look.cloud)
    old, new = np.split(points, [len(points) - look.newest])
    advice, place = look.advice, np.zeros((0, 3))
    gain = Guidance(bone.points, np.zeros(len(bone.points)), 0.0, ())
    if advice is not None:
        gain, place = Guidance(advice.points, advice.gain_mm, 0.0, ()), advice.centre[None]
    return OnBone(bone, old, np.zeros(len(old)), place, gain, new)


def _bound_mm(look: Look) -> float:
    answer = look.answer
    if answer is None or answer.T_target_source is None or answer.tre95_mm is None:
        return float("nan")
    return float(answer.tre95_mm)


def _error_over_bone_mm(probe: LookingProbe, look: Look) -> float:
    """Root mean square over the bone of how far the pose puts it off; not finite without a pose."""
    if look.answer is None or look.answer.T_target_source is None:
        return float("nan")
    bone = probe.specimen.surface.points
    return metrics.whole_bone_rmse_mm(look.answer.T_target_source, probe.T_target_source, bone)
