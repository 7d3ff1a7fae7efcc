"""`gapr pivot`: find the tip of a pointer from a recording in which it was turned on its tip."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from gapr_core.commands import checks
from gapr_core.runtime import files
from gapr_core.runtime.arguments import a_path
from gapr_core.runtime.console import say

OK = 0


def add_arguments(parser: ArgumentParser) -> None:
    """Add the options of `gapr pivot`."""
    parser.add_argument("recording", type=a_path, help="NDI Track's CSV, or a PLUS sequence (.igs.mha)")
    parser.add_argument("--tool", type=int, help="which of several recorded tools, from 0")
    parser.add_argument("--reference", type=int, metavar="TOOL", help="the tool that the dimple moves with, from 0")
    parser.add_argument("--json", type=a_path, help="write tip, pivot and residual here as well")


def run(args: Namespace) -> int:
    """Print the tip in the marker's frame, as `gapr register --tip` takes it, and how well it fits.

    Raises:
        GaprError: options or a recording that cannot be used.
    """
    from gapr_core.formats import tracker
    from gapr_core.formats.poses import poses_in

    if args.json:
        checks.check_collisions([("the recording", args.recording)], [("--json", args.json)])
        files.check_writable(args.json)
    tip = tracker.pivot(poses_in(args.recording, args.tool, args.reference))
    say(f"--tip {','.join(f'{x:.3f}' for x in tip.tip_mm)}")
    left_out = f", without {tip.left_out} of which the tip had left its place" if tip.left_out else ""
    say(f"residual {tip.residual_mm:.3f} mm over {tip.poses} poses{left_out}")
    if args.json:
        found = {"tip_mm": tip.tip_mm.tolist(), "pivot_mm": tip.pivot_mm.tolist(), "residual_mm": tip.residual_mm}
        files.write_json(args.json, found | {"poses": tip.poses, "left_out": tip.left_out})
    return OK
