"""Where commands speak to users."""

from __future__ import annotations

import sys


def say(text: str) -> None:
    """One line on standard output."""
    sys.stdout.write(f"{text}\n")
