"""Options that several commands share: the method, its settings, a tracker's recording, and how files are read."""

from __future__ import annotations

from argparse import ArgumentParser, ArgumentTypeError, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gapr_core.config import RegistrarConfig
from gapr_core.runtime import settings
from gapr_core.runtime.arguments import a_path

if TYPE_CHECKING:
    from gapr_core.surface import Surface

UNITS = ("mm", "cm", "m", "in")


def add_method(parser: ArgumentParser) -> None:
    """`--method`, and the settings."""
    parser.add_argument(
        "--method",
        default="gapr",
        help="gapr (default), gapr_search (needs no torch), gapr_network, gapr_tracker, module:factory, or a baseline, "
        "which refuses almost nothing: its confidence is its share of inliers, not calibrated",
    )
    parser.add_argument("--weights", type=a_path, help="of a network of your own (gapr train), instead of the shipped")
    add_settings(parser)


def method_name(args: Namespace) -> str:
    """Join `--method` with `--weights` where there are some: "gapr@FILE"."""
    return f"{args.method}@{args.weights}" if args.weights else str(args.method)


def add_settings(parser: ArgumentParser) -> None:
    """`--config` and `--set`."""
    parser.add_argument("--config", type=a_path, help="YAML file of settings; gapr settings lists them")
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", dest="assignments",
        help="one setting, such as refinement.iterations=5; over --config; may be repeated",
    )  # fmt: skip


def registrar_config(args: Namespace) -> RegistrarConfig:
    """Read the settings from the arguments, with defaults for all others.

    Raises:
        ConfigError: an unknown setting, a value out of range, or a file that cannot be read.
    """
    return settings.load(RegistrarConfig, args.config, args.assignments)


def add_tracker(parser: ArgumentParser) -> None:
    """`--tip`, `--tool` and `--reference`: which points of a tracker's recording are meant, and in whose frame."""
    parser.add_argument("--tip", type=place, help="X,Y,Z of the pointer's tip in its marker's frame, mm (gapr pivot)")
    parser.add_argument("--tool", type=int, help="which of several tools in a recording, from 0")
    parser.add_argument(
        "--reference",
        type=int,
        metavar="TOOL",
        help="the tool on the bone, from 0: points are in its frame, not the tracker's",
    )


def place(text: str) -> tuple[float, float, float]:
    """X,Y,Z of an argument.

    Raises:
        ArgumentTypeError: not three finite numbers.
    """
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError as error:
        raise ArgumentTypeError(f"three numbers X,Y,Z, not {text!r}") from error
    if not np.isfinite([x, y, z]).all():
        raise ArgumentTypeError(f"three finite numbers X,Y,Z, not {text!r}")
    return x, y, z


def load(path: Path, units: str | None, of_bone: bool = True, **how: Any) -> Surface:
    """Load a file in the named unit or the usual one; `how` are fields of `ReadOptions`.

    See `clouds.load` for `of_bone`.
    """
    from gapr_core import clouds
    from gapr_core.formats import reading
    from gapr_core.formats.options import ReadOptions

    return clouds.load(path, units or reading.format_of(path).unit, ReadOptions(**how), of_bone=of_bone)
