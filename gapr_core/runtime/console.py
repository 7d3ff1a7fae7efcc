"""Where commands speak to users."""

from __future__ import annotations

import os
import sys


def say(text: str) -> None:
    """One line on standard output; it goes nowhere, and the program goes on, where nobody reads it any more."""
    try:
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
