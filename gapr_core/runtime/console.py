"""Where commands speak to users."""

from __future__ import annotations

import os
import sys


def say(text: str) -> None:
    """One line on standard output; nobody who listens any more is no reason to write no file, or to end with 0."""
    try:
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
