"""`gapr check-points`: does an accepted pose hold at points of the bone that were touched after the registration?"""

from __future__ import annotations

import logging
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.commands import answer, checks, options
from gapr_core.geometry import se3
from gapr_core.runtime import files
from gapr_core.runtime.arguments import a_path, above_zero
from gapr_core.runtime.console import say

if TYPE_CHECKING:
    from gapr_core.results import PointCheck, RegistrationResult

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

HOLDS, REFUSED = 0, 2
ELSEWHERE = 0.5  # share of the points above which those with no surface near are no single slips
CLOSE_MM = 1.0  # a bone in m has less than one of them


def add_arguments(parser: ArgumentParser) -> None:
    """Add the options of `gapr check-points`; docs/how-to/check_points.md explains the answer."""
    parser.add_argument(
        "--points", required=True, type=a_path, help="touched points, source frame: markups, cloud or recording"
    )
    parser.add_argument("--target", required=True, type=a_path, help="full bone, as it was registered")
    parser.add_argument("--pose", required=True, type=a_path, metavar="FILE.json",
                        help="the answer of gapr register --json")  # fmt: skip
    parser.add_argument("--units", choices=options.UNITS, help="of meshes and clouds (default: mm)")
    parser.add_argument("--points-units", choices=options.UNITS, help="of the points, where they are in another unit")
    parser.add_argument("--label", action="append", default=[], help="NAME or NUMBER in a label map; may be repeated")
    parser.add_argument("--axes", type=str.lower, default="auto", help="of a target mesh, as in gapr register")
    parser.add_argument("--points-axes", type=str.lower, default="auto", choices=("auto", "lps", "ras"),
                        help="of points that do not say them (auto: LPS)")  # fmt: skip
    options.add_tracker(parser)
    parser.add_argument("--within", type=above_zero, default=se3.RIGHT_MM, metavar="MM",
                        help=f"error over the bone that matters ({se3.RIGHT_MM:g})")  # fmt: skip
    parser.add_argument("--json", type=a_path, help="write the answer here as well; keys: docs/reference/json.md")
    options.add_settings(parser)


def run(args: Namespace) -> int:
    """Print the answer; exit code 0 if the pose holds, 2 if not or if points are too few.

    Raises:
        GaprError: options or files that cannot be used.
    """
    from gapr_core.registration.check_points import check_points
    from gapr_core.registration.problem import target as targets
    from gapr_core.results import Verdict

    config = options.registrar_config(args)
    if args.json:
        inputs = [("--points", args.points), ("--target", args.target), ("--pose", args.pose)]
        checks.check_collisions(inputs, [("--json", args.json)])
        files.check_writable(args.json)
    with checks.naming_old_files(args.json):
        result = answer.read_json(args.pose)
        bone = options.load(args.target, args.units, axes=args.axes, labels=tuple(args.label))
        how: dict[str, Any] = {"axes": args.points_axes, "tip_mm": args.tip, "tool": args.tool}
        units = args.points_units or args.units
        touched = options.load(args.points, units, of_bone=False, **how, reference=args.reference)
        _warn_of_units(args.points, touched.extent_mm)
        target = targets.prepare(bone, "mm", config.target, config.num_threads)
        found = check_points(touched.points, target, result, config, args.within)
    _show(found, args.within, _labels(args.points, len(found.points)))
    if np.isnan(found.distance_mm).mean() > ELSEWHERE:
        _say_elsewhere(found.points, bone.points, result)
    if args.json:
        files.write_json(args.json, _as_json(found))
    return HOLDS if found.verdict is Verdict.HOLDS else REFUSED


def _warn_of_units(path: Path, extent_mm: float) -> None:
    """Warn of points that hardly differ, as those of a whole bone in m that are read as mm."""
    if 0.0 < extent_mm < CLOSE_MM:
        how = "if they are in another unit, name it with --points-units"
        log.warning("all points of %s are within %.2g mm: %s", path.name, extent_mm, how)


def _labels(path: Path, count: int) -> list[str]:
    """Return the labels of placed markups; empty for other files."""
    from gapr_core.formats import markups, reading

    labels = markups.load(path).labels if reading.format_of(path) is reading.MARKUPS else ("",) * count
    return [f" {name}:" if (name := " ".join(label.split())) else "" for label in labels]


def _show(found: PointCheck, within_mm: float, labels: list[str]) -> None:
    """Print the answer in words, every point, and the next step."""
    from gapr_core.results import Verdict

    say(str(found))
    rows = zip(labels, found.distance_mm, found.expected_mm, strict=True)
    for number, (label, distance, expected) in enumerate(rows, 1):
        shown = f"{distance:+.2f} mm, {expected:.2f} mm expected (standard deviation)"
        say(f"{number}.{label} {'no surface is near' if np.isnan(distance) else shown}")
    if np.isnan(found.distance_mm).mean() > ELSEWHERE:
        return
    if found.verdict is Verdict.CONTRADICTED:
        off = f", and is {found.shown_mm:.1f} mm off over the bone" if found.shown_mm > within_mm else ""
        say(f"the pose does not hold there{off}: touch the farthest point again; if it stays, register again")
    elif found.verdict is Verdict.SAYS_LITTLE:
        where = "({:.0f}, {:.0f}, {:.0f})".format(*found.next_point)
        open_mm = max(found.unseen_mm, found.tre95_mm)
        say(f"an error of {open_mm:.1f} mm over the bone might not show, {within_mm:g} mm matters: "
            f"touch more points, the next one at {where} mm on the target")  # fmt: skip


def _say_elsewhere(points: Array, bone: Array, result: RegistrationResult) -> None:
    """Ask what keeps points (N, 3), source frame, from the bone (M, 3), target frame, under the pose; mm."""
    from gapr_core.formats import axes

    near_mm = checks.MUCH_NEARER * checks.median_mm(result.apply(points), bone)
    cause = "are they in the frame of the source, and in its unit and axes (--points-units, --points-axes)?"
    if np.ptp(points, axis=0).max() < CLOSE_MM:
        cause = "are they in the frame of the source, and in its unit (--points-units)?"
    elif checks.median_mm(points, bone) < near_mm:
        cause = "without the pose they are near: are they in the frame of the target? The source's is wanted"
    elif checks.median_mm(result.apply(points * axes.LPS_RAS), bone) < near_mm:
        cause = "with x and y negated they are near: name their axes as those of the source (--points-axes)"
    say(f"most points are not near the bone: {cause}")


def _as_json(found: PointCheck) -> dict[str, Any]:
    """Return the keys of docs/reference/json.md."""
    return {
        "verdict": str(found.verdict),
        "probability": found.probability,
        "points": found.points.tolist(),
        "distance_mm": _numbers(found.distance_mm),
        "expected_mm": _numbers(found.expected_mm),
        "shown_mm": found.shown_mm,
        "unseen_mm": found.unseen_mm,
        "tre95_mm": found.tre95_mm,
        "next_point_mm": found.next_point.tolist(),
        "next_normal": found.next_normal.tolist(),
    }


def _numbers(values: np.ndarray) -> list[float | None]:
    """JSON has no NaN."""
    return [None if np.isnan(value) else float(value) for value in values]
