"""Checks of `gapr register` before the work: files that cannot be written, and options that do not go together."""

from __future__ import annotations

import logging
from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gapr_core.errors import ConfigError, GaprError, MethodUnavailableError
from gapr_core.geometry import se3
from gapr_core.results import RegistrationResult
from gapr_core.runtime import files
from gapr_core.runtime.console import say

log = logging.getLogger(__name__)
Array = NDArray[np.float64]
Named = tuple[str, Path]  # an option, and what it names

OF_EARLIER = ", and what is there is of an earlier run"
FAR_LANDMARKS_MM = 50.0  # median to a cloud, farther than landmarks lie from the part of a bone that was seen
FAR_PAIRS_MM = 20.0  # of landmarks under the pose that fits them best, more than anybody errs by as he touches them
MUCH_NEARER = 0.3  # share of that distance that is left with the axes turned, or to the other cloud, and it was wrong


def check_outputs(args: Namespace) -> None:
    """Raise before the work for outputs that cannot be written, or do not fit an input.

    Raises:
        ConfigError: an unknown ending, a folder that cannot be written, the file of another option, foreign files in a
            scene's folder, or files in LPS of a bone in RAS.
        MethodUnavailableError: a library that an output needs is not installed.
    """
    _check_kinds(args)
    in_lps = files_in_lps(args)
    if in_lps and args.axes == "lps_to_ras":
        option = next(iter(in_lps))
        how = f"say what the mesh is in, or leave {option} out"
        raise ConfigError(f"--axes lps or ras with {option}, which is LPS", "lps_to_ras", how)
    check_collisions(_inputs(args), _outputs(args))
    for _, path in _outputs(args):
        files.check_writable(path)
    if args.slicer:
        from gapr_core.formats import scene

        scene.check_slicer(args.slicer)


def _check_kinds(args: Namespace) -> None:
    """Endings, and the libraries that write them."""
    from gapr_core.formats import transforms

    if args.out:
        transforms.check(args.out)
        if args.out.suffix.lower() == ".h5" and find_spec("SimpleITK") is None:
            raise MethodUnavailableError(".h5 files", "no SimpleITK", "pip install 'gapr_ros[medical]'")
    if args.residuals and args.residuals.suffix.lower() not in (".json", ".ply"):
        raise ConfigError("residuals as .json or .ply", args.residuals.name, "choose one of these")
    if args.rerun:
        from gapr_core.formats import recording

        recording.check(args.rerun)
    if args.report:
        if args.report.suffix.lower() not in (".html", ".htm"):
            raise ConfigError("a report as .html", args.report.name, "let its name end with .html")
        from gapr_core.pages import registration_report  # noqa: F401  a missing library is said before the work


def _inputs(args: Namespace) -> list[Named]:
    """List option and path of every file or folder to read."""
    named = [("--source", args.source), ("--target", args.target), ("--targets", args.targets)]
    named += [("--landmarks", path) for path in args.landmarks or ()] + [("--config", args.config)]
    named += [("--initial", args.initial)]
    return [(option, path) for option, path in named if path]


def _outputs(args: Namespace) -> list[Named]:
    """List option and path of every file to write, those of a scene as well."""
    named = [(f"--{name}", getattr(args, name)) for name in ("out", "residuals", "report", "rerun", "json")]
    outputs = [(option, path) for option, path in named if path]
    if not args.slicer:
        return outputs
    from gapr_core.formats import scene

    files_of_scene = [name for name in scene.FILES if args.targets or name != scene.TARGETS]
    return outputs + [("--slicer", args.slicer / name) for name in files_of_scene]


def check_collisions(inputs: list[Named], outputs: list[Named]) -> None:
    """Raise `ConfigError` where a file would be written over another one of the same run."""
    from gapr_core.formats.sweeps import SLICE_ENDINGS

    for i, (option, path) in enumerate(outputs):
        for other, taken in [*inputs, *outputs[:i]]:
            is_slice = taken.is_dir() and path.suffix.lower() in SLICE_ENDINGS and _is_same(path.parent, taken)
            if is_slice or _is_same(path, taken):
                given = f"{path}, which belongs to {other}"
                raise ConfigError(f"a file for {option} that no other option names", given, "choose another name")
        for other, written in outputs[:i]:
            if path.resolve() in written.resolve().parents or written.resolve() in path.resolve().parents:
                given = f"{path}, and {written} for {other}"
                raise ConfigError(f"a file for {option} that is no folder of another", given, "choose another name")


def _is_same(path: Path, other: Path) -> bool:
    """By name, links followed, and by content: some file systems do not distinguish a from A."""
    return path.resolve() == other.resolve() or (path.exists() and other.exists() and path.samefile(other))


@contextmanager
def naming_old_files(*paths: Path | None) -> Iterator[None]:
    """Say of outputs that an error leaves as they are: a script may take them for those of this run."""
    try:
        yield
    except GaprError:
        for path in paths:
            if path and path.exists():
                say(f"{path} is not written{OF_EARLIER}")
        raise


def check_method(args: Namespace) -> None:
    """Raise before the work for a method known not to give the requested output.

    Raises:
        ConfigError: an option that a method of this name cannot follow.
    """
    from gapr_core.benchmark import methods

    wanted = [name for name in ("guide", "residuals", "slicer", "targets") if getattr(args, name)]
    may_say = methods.is_own(args.method) or (":" in args.method and "guide" not in wanted)
    if wanted and not may_say:
        own = ", ".join(methods.OWN)
        raise ConfigError(f"--{wanted[0]} with one of {own}", args.method, f"leave --{wanted[0]} out")


def check_answer(args: Namespace, result: RegistrationResult) -> None:
    """Raise at the end for files that could not be written, since the method did not give their content.

    Raises:
        ConfigError: a pose without residuals or without a covariance, and an option that needs them.
    """
    if result.ok and result.residuals is None and (args.residuals or args.slicer):
        raise ConfigError("a method that says the residuals", result.method, "use --method gapr")
    if result.ok and result.covariance is None and args.targets:
        raise ConfigError("a method that says the covariance, for --targets", result.method, "use --method gapr")


def files_in_lps(args: Namespace) -> dict[str, Path]:
    """List option and path of every file that is LPS by definition and in the target's frame."""
    residuals = args.residuals if args.residuals and args.residuals.suffix.lower() == ".ply" else None
    landmarks = args.landmarks[1] if args.landmarks else None
    named = {"--out": args.out, "--slicer": args.slicer, "--residuals": residuals, "--targets": args.targets,
             "--landmarks": landmarks, "--initial": args.initial}  # fmt: skip
    return {option: path for option, path in named.items() if path}


def warn_of_axes(args: Namespace) -> None:
    """Warn where files are LPS by definition and the cloud in their frame may be anything; both can be read."""
    from gapr_core.formats import axes, reading

    in_lps = list(files_in_lps(args).values())
    is_known = args.target.is_dir() or reading.says_axes(args.target)
    if in_lps and (args.axes == "as_is" or (args.axes == "auto" and not is_known)):
        log.warning("%s that %s is in LPS. If it is RAS, give --axes ras", _assume(in_lps), args.target.name)
    of_source = args.landmarks[:1] if args.landmarks else []
    of_source += [] if _is_tracked(args) else _files_of_itk(args)  # of a tracker's `warn_of_tracker` says more
    if of_source and args.source_axes == "auto" and not reading.says_axes(args.source):
        how = "If it came from Slicer's Python (RAS), add --source-axes ras"
        log.warning("%s that %s is in LPS. %s", _assume(of_source), args.source.name, how)
    said = axes.stated(args.source) if args.source_axes == "auto" and args.source.is_file() else args.source_axes
    if not isinstance(args.viewpoint, str) and said == "ras":
        log.warning("%s is turned from RAS to LPS: --viewpoint is taken to be in LPS", args.source.name)


def _assume(paths: Sequence[Path]) -> str:
    return " and ".join(path.name for path in paths) + (" assume" if len(paths) > 1 else " assumes")


def warn_of_tracker(args: Namespace) -> None:
    """Warn of a transform for ITK and 3D Slicer of a tracker's numbers, whose axes nobody has named."""
    if _is_tracked(args) and _files_of_itk(args) and args.source_axes == "auto":
        log.warning(
            "%s is taken as LPS. 3D Slicer shows a live tracker (OpenIGTLink, PLUS) as RAS, where this transform would "
            "be wrong: for such a scene give --source-axes ras, else --source-axes lps (docs/tutorials/slicer.md)",
            args.source.name,
        )


def _is_tracked(args: Namespace) -> bool:
    """Tell whether the numbers of the source are a tracker's."""
    from gapr_core.formats import reading
    from gapr_core.formats.options import ReadOptions

    kind = reading.format_of(args.source)
    return kind.is_in_mm(ReadOptions(tip_mm=args.tip)) and not kind.in_lps


def _files_of_itk(args: Namespace) -> list[Path]:
    """List the outputs whose transform is LPS on both sides, for ITK and 3D Slicer."""
    return [path for path in (args.out, args.slicer) if path and path.suffix != ".txt"]


def warn_of_units(args: Namespace) -> None:
    """Warn of a unit without effect: files of such kinds are in mm."""
    from gapr_core.formats import reading
    from gapr_core.formats.options import ReadOptions

    is_in_mm = {
        args.target: reading.format_of(args.target).is_in_mm(ReadOptions()),
        args.source: reading.format_of(args.source).is_in_mm(ReadOptions(tip_mm=args.tip)),
    }
    for option, units, paths in (
        ("--units", args.units, (args.source, args.target)),
        ("--source-units", args.source_units, (args.source,)),
    ):
        if units and all(is_in_mm[path] for path in paths):
            said = " and ".join(path.name for path in paths) + (" are" if len(paths) > 1 else " is")
            log.warning("%s %s changes nothing: %s in mm, as all files of such kinds", option, units, said)


def warn_of_landmarks(args: Namespace, source: Array, target: Array) -> None:
    """Warn of landmarks far from their cloud (N, 3), mm, that other axes would bring near."""
    from gapr_core.formats import markups

    files = zip(args.landmarks or (), (args.source, args.target), (source, target), strict=False)
    for path, cloud, points in files:
        apart_mm, turned_mm = _apart_mm(markups.load(path).points, points)
        if apart_mm > FAR_LANDMARKS_MM and turned_mm < MUCH_NEARER * apart_mm:
            log.warning(
                "%s is %.0f mm from %s, and %.0f mm with x and y negated: one of them is in RAS and read as LPS, or "
                "the other way round. Correct what the file says of its axes (SPACE=, coordinateSystem)",
                path.name, apart_mm, cloud.name, turned_mm,
            )  # fmt: skip


def warn_of_one_file(args: Namespace) -> None:
    """Warn of a bone that is registered to itself, which fits at once and says nothing."""
    if args.source_label == args.label and _is_same(args.source, args.target):
        log.warning("source and target are one file, %s: the pose lays it on itself", args.source.name)


def warn_of_pairs(rms_mm: float) -> None:
    """Warn of landmarks that are far from their partners under the pose that fits them best."""
    if rms_mm > FAR_PAIRS_MM:
        log.warning(
            "the landmarks fit no pose: they are paired by their names where both files have the same, else in order. "
            "Look for another order, another unit, or the other side of the body"
        )


def warn_of_frames(args: Namespace, source: Array, target: Array) -> None:
    """Warn of landmarks that were exchanged: each file is near the cloud of the other, (N, 3) and (M, 3), mm."""
    clouds = (source, target)
    if args.landmarks and all(map(_is_elsewhere, args.landmarks, clouds, clouds[::-1])):
        first, second = (path.name for path in args.landmarks)
        near = f"{first} is near {args.target.name}, and {second} near {args.source.name}"
        log.warning("%s: are the files of --landmarks exchanged? That of the source comes first", near)


def warn_of_start(args: Namespace, start: Array | None, source: Array, target: Array) -> None:
    """Warn of a transform whose inverse, but not itself, lays the source on the target (mm)."""
    if start is None or not args.initial:
        return
    apart_mm, turned_mm = (median_mm(se3.apply(T, source), target) for T in (start, se3.inverse(start)))
    if apart_mm > FAR_LANDMARKS_MM and turned_mm < MUCH_NEARER * apart_mm:
        said = f"lays the source {apart_mm:.0f} mm from the bone, and its inverse {turned_mm:.0f} mm"
        log.warning("%s %s: is it the other way round? See docs/reference/formats.md", args.initial.name, said)


def _is_elsewhere(path: Path, cloud: Array, other: Array) -> bool:
    """Tell whether markups are far from their own cloud (N, 3), mm, and near the other one."""
    from gapr_core.formats import markups

    points = markups.load(path).points
    apart_mm = median_mm(points, cloud)
    return apart_mm > FAR_LANDMARKS_MM and median_mm(points, other) < MUCH_NEARER * apart_mm


def _apart_mm(landmarks: Array, cloud: Array) -> tuple[float, float]:
    """Median distance, mm, of landmarks (K, 3) to a cloud (N, 3): as they are, and with x and y negated."""
    from gapr_core.formats.axes import LPS_RAS

    return median_mm(landmarks, cloud), median_mm(landmarks * LPS_RAS, cloud)


def median_mm(points: Array, cloud: Array) -> float:
    """Median distance, mm, of points (K, 3) to the nearest ones of a cloud (N, 3)."""
    from scipy.spatial import cKDTree

    return float(np.median(cKDTree(cloud).query(points)[0]))
