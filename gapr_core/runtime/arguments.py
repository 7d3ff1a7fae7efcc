"""Types of command-line options."""

from __future__ import annotations

from argparse import ArgumentTypeError
from pathlib import Path


def above_zero(text: str) -> float:
    """Parse a number above 0; it may be infinite."""
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not number > 0.0:  # NaN neither
        raise ArgumentTypeError(f"expected a number above 0, got {text!r}")
    return number


def at_least_one(text: str) -> int:
    """Parse a count of 1 or more."""
    if not text.strip().isdecimal() or int(text) < 1:
        raise ArgumentTypeError(f"expected a whole number of at least 1, got {text!r}")
    return int(text)


def names(text: str) -> tuple[str, ...]:
    """Split a list with commas, and keep each word once."""
    return tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))


def a_path(text: str) -> Path:
    """Parse a path; refuse an empty one, such as that of a variable that is not set."""
    if not text.strip():
        raise ArgumentTypeError("expected a path, got an empty text: is a variable of the shell not set?")
    return Path(text)
