"""What `gapr register` can know before the work: files that cannot be written, and options that do not go together."""

from __future__ import annotations

import logging
from argparse import Namespace
from pathlib import Path

from gapr_core.errors import ConfigError

log = logging.getLogger(__name__)


def check_outputs(args: Namespace) -> None:
    """Raise before the work for outputs of a kind that is not written, or that do not go with the axes.

    Raises:
        ConfigError: an ending that nothing is written to, or files in LPS of a bone that is turned to RAS.
        MethodUnavailableError: a library that an output needs is not installed.
    """
    from gapr_core.formats import transforms

    if args.out:
        transforms.check(args.out)
    if args.residuals and args.residuals.suffix.lower() not in (".json", ".ply"):
        raise ConfigError("residuals as .json or .ply", args.residuals.name, "choose one of these")
    if args.rerun:
        from gapr_core.formats import recording

        recording.check(args.rerun)
    if args.report:
        if args.report.suffix.lower() not in (".html", ".htm"):
            raise ConfigError("a report as .html", args.report.name, "let its name end with .html")
        from gapr_core.pages import registration_report  # noqa: F401  a missing library is said before the work
    in_lps = files_in_lps(args)
    if in_lps and args.axes == "lps_to_ras":
        option = next(iter(in_lps))
        how = f"say what the mesh is in, or leave {option} out"
        raise ConfigError(f"--axes lps or ras with {option}, which is LPS", "lps_to_ras", how)


def files_in_lps(args: Namespace) -> dict[str, Path]:
    """The option and the path of every file that is LPS by definition and in the frame of the target."""
    residuals = args.residuals if args.residuals and args.residuals.suffix.lower() == ".ply" else None
    landmarks = args.landmarks[1] if args.landmarks else None
    named = {"--out": args.out, "--slicer": args.slicer, "--residuals": residuals, "--targets": args.targets,
             "--landmarks": landmarks}  # fmt: skip
    return {option: path for option, path in named.items() if path}


def warn_of_axes(args: Namespace) -> None:
    """Warn where files are LPS by definition and the target may be anything; it can be read."""
    from gapr_core.formats import axes, reading

    names = ", ".join(path.name for path in files_in_lps(args).values())
    if not names or args.target.is_dir() or reading.format_of(args.target).in_patient:
        return
    if args.axes == "as_is" or (args.axes == "auto" and axes.stated(args.target) is None):
        log.warning("in LPS: %s. If %s is RAS, give --axes ras", names, args.target.name)
