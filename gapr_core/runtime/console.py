"""Where commands speak to users."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable

from gapr_core.errors import GaprError

STEERING = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")


def printable(text: str) -> str:
    """Escape control characters of a terminal: names in files, and of files, may hold it."""
    return STEERING.sub(lambda found: repr(found[0])[1:-1], text)


def say(text: str) -> None:
    """Print one line on standard output; the program goes on if nobody reads it any more.

    Letters that the output cannot hold, in names of files and of planned targets, come out as their numbers.
    """
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    shown = printable(text).encode(encoding, "backslashreplace").decode(encoding)
    try:
        sys.stdout.write(f"{shown}\n")
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def exit_code(main: Callable[[], int], program: str) -> int:
    """Return the exit code of a program; 1, and one line on standard error, if its user must fix something."""
    try:
        return main()
    except GaprError as error:
        sys.stderr.write(f"{program}: {printable(str(error))}\n")
        return 1
