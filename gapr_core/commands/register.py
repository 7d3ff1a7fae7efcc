"""`gapr register`: register one partial cloud to one full bone."""

from __future__ import annotations

import logging
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from gapr_core.commands import checks, options
from gapr_core.commands.answer import made_by
from gapr_core.errors import ConfigError
from gapr_core.results import RegistrationResult
from gapr_core.runtime import files
from gapr_core.runtime.arguments import a_path
from gapr_core.runtime.console import say

if TYPE_CHECKING:
    from gapr_core.config import RegistrarConfig
    from gapr_core.surface import Surface

log = logging.getLogger(__name__)

OK, REFUSED = 0, 2


def add_arguments(parser: ArgumentParser) -> None:
    """Add the options of `gapr register`; docs/reference/formats.md explains formats, axes and units."""
    parser.add_argument(
        "--source", required=True, type=a_path, help="partial cloud, markups, recording, folder of slices, bag"
    )
    parser.add_argument("--target", required=True, type=a_path, help="full bone: mesh, cloud or label map")
    parser.add_argument("--units", choices=options.UNITS, help="of meshes and clouds (default: mm; clouds of a bag: m)")
    parser.add_argument("--source-units", choices=options.UNITS, help="of the source, where it is in another unit")
    parser.add_argument("--topic", default="", help="of the clouds in a bag; may be left out where it has one")
    parser.add_argument("--clouds", type=_span, default=(None, None), metavar="FIRST:LAST",
                        help="clouds of the topic that are joined, as a slice: 0:1 is the first (all)")  # fmt: skip
    parser.add_argument("--label", action="append", default=[], help="NAME or NUMBER in a label map; may be repeated")
    parser.add_argument("--source-label", action="append", default=[], metavar="LABEL",
                        help="the same in a label map that is the source")  # fmt: skip
    parser.add_argument("--axes", type=str.lower, default="auto",
                        help="of a target mesh: lps, ras, as_is, lps_to_ras, or auto (what it says)")  # fmt: skip
    parser.add_argument("--source-axes", type=str.lower, default="auto", choices=("auto", "lps", "ras"),
                        help="of a source that does not say them, such as a tracker's: ras for what 3D Slicer shows "
                        "live over OpenIGTLink (auto: LPS)")  # fmt: skip
    options.add_tracker(parser)
    parser.add_argument("--viewpoint", type=_place, default="auto", metavar="X,Y,Z|auto|none",
                        help="of the camera in the source's frame, mm; auto: its pixels or its surface may show it; "
                        "none: all is bone")  # fmt: skip
    guess = parser.add_mutually_exclusive_group()
    guess.add_argument(
        "--landmarks", nargs=2, type=a_path, metavar=("SOURCE", "TARGET"), help="paired markups: a first guess"
    )
    guess.add_argument("--initial", type=a_path, metavar="POSE", help="a first guess: a file as --out writes it")
    parser.add_argument("--targets", type=a_path, help="markups of a plan, target frame: the error to expect there")
    parser.add_argument("--out", type=a_path, help="the pose as pose.tfm or .h5 (LPS, ITK's direction) or 4x4 .txt")
    parser.add_argument(
        "--residuals", type=a_path, help="signed distance of every point used, as .json or coloured .ply"
    )
    parser.add_argument("--slicer", type=a_path, metavar="FOLDER", help="a scene for 3D Slicer")
    parser.add_argument("--report", type=a_path, metavar="FILE.html", help="one page with all of it, on refusals too")
    parser.add_argument("--rerun", type=a_path, metavar="FILE.rrd", help="a recording for rerun, on refusals too")
    parser.add_argument("--guide", action="store_true", help="say where on the bone another look would help most")
    parser.add_argument("--json", type=a_path, help="write the result here as well; keys: docs/reference/json.md")
    options.add_method(parser)


def _place(text: str) -> tuple[float, float, float] | str:
    return text if text in ("auto", "none") else options.place(text)


def _span(text: str) -> tuple[int | None, int | None]:
    try:
        first, last = (int(word) if word else None for word in text.split(":"))
    except ValueError as error:
        raise ArgumentTypeError(f"FIRST:LAST, such as 0:10, not {text!r}") from error
    return first, last


def run(args: Namespace) -> int:
    """Print the result; exit code 0 with a pose, 2 when the data refuse one.

    Raises:
        GaprError: options or files that cannot be used, before the work; what a method did not say, at the end.
    """
    from gapr_core import Registrar, Tracker
    from gapr_core.benchmark import methods
    from gapr_core.registration import caveats

    args.method = options.method_name(args)
    checks.check_outputs(args)
    checks.check_method(args)
    config = options.registrar_config(args)
    config = replace(config, guide=config.guide or args.guide)
    is_guided = config.guide or (bool(args.report) and methods.is_own(args.method))  # for the page of a refusal
    method = methods.make(args.method, replace(config, guide=is_guided))
    with checks.naming_old_files(args.out, args.residuals, args.slicer, args.json, args.report, args.rerun):
        plan, hints = _plan(args), _hints(args, method)
        target, source = _read(args)
        if args.viewpoint == "none" or source.joined or source.faces is not None:
            method = method.of_bone_alone() if isinstance(method, Registrar | Tracker) else method
        checks.warn_of_start(args, hints.get("initial"), source.points, target.points)
        hints |= _seen(args, method, source)
        result = method.register(source.points, method.prepare(target), **hints)  # type: ignore[call-arg]
    if result.bone is None:
        result = caveats.completed(result, target, source.points)
    if plan is not None and not (result.ok and result.covariance is None):
        result = result.with_targets(plan.points, plan.labels)
    code = _show(args, result)
    if config.guide or (result.guidance is not None and not result.ok):
        _say_where_next(result)
    _write(args, result, config)
    checks.check_answer(args, result)
    return code


def _read(args: Namespace) -> tuple[Surface, Surface]:
    """Target and source, with a warning of everything that may be wrong and can be read nevertheless."""
    target = options.load(args.target, args.units, axes=args.axes, labels=tuple(args.label))
    how = {"axes": args.source_axes, "tip_mm": args.tip, "tool": args.tool, "reference": args.reference}
    how |= {"topic": args.topic, "clouds": args.clouds, "labels": tuple(args.source_label)}
    source = options.load(args.source, args.source_units or args.units, **how)
    if source.faces is not None and target.faces is None:
        log.warning(
            "the source is a surface and the target a cloud; exchange them if %s is the whole bone", args.source
        )
    checks.warn_of_one_file(args)
    checks.warn_of_units(args)
    checks.warn_of_axes(args)
    checks.warn_of_tracker(args)
    checks.warn_of_landmarks(args, source.points, target.points)
    checks.warn_of_frames(args, source.points, target.points)
    return target, source


def _plan(args: Namespace) -> Any:
    from gapr_core.formats import markups

    return markups.load(args.targets) if args.targets else None


def _hints(args: Namespace, method: Any) -> dict[str, Any]:
    """Start and viewpoint, if they are given; a method that cannot use one says so."""
    from gapr_core.baselines.base import takes

    hints: dict[str, Any] = {}
    if args.landmarks:
        from gapr_core.formats import planning

        start = planning.start_of(*args.landmarks)
        say(f"landmarks lie {start.rms_mm:.2f} mm apart (rms) at the start")
        checks.warn_of_pairs(start.rms_mm)
        hints["initial"] = start.T_target_source
    elif args.initial:
        from gapr_core.formats import transforms

        hints["initial"] = transforms.read(args.initial)
    if not isinstance(args.viewpoint, str):
        hints["viewpoint"] = np.array(args.viewpoint)
    for name in (hint for hint in hints if not takes(method, hint)):
        raise ConfigError(f"a method that takes {name}", args.method, "use --method gapr, or leave the option out")
    return hints


def _seen(args: Namespace, method: Any, source: Surface) -> dict[str, Any]:
    """Take the camera's place from the source, if it is not given and the method needs one."""
    from gapr_core.baselines.base import takes
    from gapr_core.geometry import pinhole

    if args.viewpoint != "auto" or not takes(method, "viewpoint") or source.faces is not None:
        return {}
    camera = pinhole.camera_of(source.points) if source.camera is None else source.camera
    if camera is None:
        return {}
    x, y, z = camera
    say(f"{args.source.name} is an image seen from {x:.0f},{y:.0f},{z:.0f} mm (--viewpoint none: take all for bone)")
    return {"viewpoint": camera}


def _show(args: Namespace, result: RegistrationResult) -> int:
    """Print the result in words, before a file can fail."""
    say(str(result))
    for line in (*result.targets, *(f"warning: {warning}" for warning in result.warnings)):
        say(str(line))
    for finding in result.findings:
        if finding.text not in result.reason:
            say(str(finding))
    if result.T_target_source is None:
        for path in filter(None, (args.out, args.residuals, args.slicer)):
            say(f"no pose: {path} is not written{', and that of an earlier run is removed' if path.exists() else ''}")
        return REFUSED
    say(np.array2string(result.T_target_source, precision=6, suppress_small=True))
    return OK


def _say_where_next(result: RegistrationResult) -> None:
    """List the best patches in order, or why there are none."""
    if result.guidance is None:
        seen = "the source shows the whole bone" if result.best is not None else "no hypothesis was found"
        say(f"where to look next: not known, {seen}")
        return
    say(f"where to look next (the error bound over the bone is {result.guidance.now_mm:.2f} mm, rivals included):")
    for rank, spot in enumerate(result.guidance.spots(), 1):
        centre = "({:.1f}, {:.1f}, {:.1f})".format(*spot.centre)
        normal = "({:.2f}, {:.2f}, {:.2f})".format(*spot.normal)
        say(f"{rank}. {centre} mm, normal {normal}: expected tre95 {spot.tre95_mm:.2f} mm, "
            f"gain {spot.gain_mm:.2f} mm, {100 * spot.rivals_excluded:.0f} % of the rivals excluded")  # fmt: skip


def _write(args: Namespace, result: RegistrationResult, config: RegistrarConfig) -> None:
    """Write the requested files; those of a pose only after one was accepted."""
    with files.together():
        _write_all(args, result, config)


def _write_all(args: Namespace, result: RegistrationResult, config: RegistrarConfig) -> None:
    if args.json:
        files.write_json(args.json, result.to_json() | made_by(args.method, config))
    if args.report:
        result.report(args.report, " and ".join(args.label))
    if args.rerun:
        from gapr_core.formats import recording

        recording.write(args.rerun, result)
    _write_pose(args, result)


def _write_pose(args: Namespace, result: RegistrationResult) -> None:
    """Write what belongs to a pose; where there is none, remove that of an earlier run, which contradicts the rest."""
    from gapr_core.formats import scene

    if args.out:
        result.save(args.out) if result.ok else files.remove(args.out)
    if not result.ok or result.residuals is None or result.source is None:
        if args.residuals:
            files.remove(args.residuals)
        if args.slicer:
            scene.remove(args.slicer)
        return
    used, given = len(result.residuals.points), len(result.source)
    if used < given and (args.residuals or args.slicer):
        say(f"distances are of {used} of {given} points, those that were used: docs/reference/formats.md")
    if args.residuals and args.residuals.suffix.lower() == ".json":
        files.write_json(args.residuals, scene.residuals_json(result.residuals))
    elif args.residuals:
        scene.write_coloured(args.residuals, result.apply(result.residuals.points), result.residuals)
    if args.slicer:
        scene.write_slicer(args.slicer, result)
