"""`gapr settings`: list the settings that a user touches; with --all those of the method, too."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from gapr_core.config import RegistrarConfig
from gapr_core.pages import markdown
from gapr_core.runtime import settings
from gapr_core.runtime.console import say

USERS = ("sensor.", "covariance.model_mm", "target.flat_end_mm2", "other_bone_prior", "min_confidence", "max_tre_mm",
         "guide", "num_threads")  # fmt: skip


def add_arguments(parser: ArgumentParser) -> None:
    """`--all`."""
    parser.add_argument("--all", action="store_true", help="every setting, those of the method too")


def run(args: Namespace) -> int:
    """Print a Markdown table."""
    rows = [row for row in settings.table(RegistrarConfig) if args.all or row.name.startswith(USERS)]
    say(markdown.table(["setting", "default", "range", "meaning"], rows))
    if not args.all:
        say("Set one with --set NAME=VALUE. The method has more: gapr settings --all")
    return 0
