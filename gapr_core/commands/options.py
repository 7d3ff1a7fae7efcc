"""Options that several commands share: the method and its settings."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from gapr_core.config import RegistrarConfig
from gapr_core.runtime import settings
from gapr_core.runtime.arguments import a_path
from gapr_core.runtime.console import say


def add_method(parser: ArgumentParser) -> None:
    """`--method`, and the settings."""
    parser.add_argument(
        "--method",
        default="gapr",
        help="gapr (default), gapr_search (needs no torch), gapr_network, gapr_tracker, module:factory, or a baseline, "
        "which refuses almost nothing: its confidence is its share of inliers, not calibrated",
    )
    add_settings(parser)


def say_uncalibrated(method: str) -> None:
    """Say of a baseline that what it calls a confidence is no probability."""
    from gapr_core.benchmark import methods

    if method not in methods.OWN and ":" not in method:
        say(f"{method} is a baseline: its confidence is its share of inliers, not calibrated; a wrong pose may be OK")


def add_settings(parser: ArgumentParser) -> None:
    """`--config` and `--set`."""
    parser.add_argument("--config", type=a_path, help="YAML file of settings; gapr settings lists them")
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", dest="assignments",
        help="one setting, such as refinement.iterations=5; over --config; may be repeated",
    )  # fmt: skip


def registrar_config(args: Namespace) -> RegistrarConfig:
    """The settings that the arguments name, the defaults for all others.

    Raises:
        ConfigError: an unknown setting, a value out of range, or a file that cannot be read.
    """
    return settings.load(RegistrarConfig, args.config, args.assignments)
