"""The child of `files.py`: loads each file that stdin names, and answers with one line for each."""

import logging
import resource
import signal
import sys
import time
from pathlib import Path

from gapr_core import clouds
from gapr_core.errors import InvalidPointCloudError

LONGEST_S = 5
MEMORY_BYTES = 4 << 30
GROWTH_KB = 200 << 10  # the files are small: what a load may take besides 20 times the unpacked data


class Warnings(logging.Handler):
    """Whether the reader warned of what it read."""

    def __init__(self):
        super().__init__(logging.WARNING)
        self._count = 0

    def emit(self, record):
        self._count += 1

    def __enter__(self):
        logging.getLogger("gapr_core").addHandler(self)
        return self

    def __exit__(self, *error):
        logging.getLogger("gapr_core").removeHandler(self)

    def __str__(self):
        return " with a warning" if self._count else ""


def verdict(path):
    """`read` with its counts, `refused`, or what should not have happened."""
    start = time.monotonic()
    try:
        with Warnings() as warnings:
            surface = clouds.load(path)
        answer = f"read {len(surface.points)} {0 if surface.faces is None else len(surface.faces)}{warnings}"
    except InvalidPointCloudError as error:
        answer = "refused" if "\n" not in str(error) and len(str(error)) < 600 else f"long message {str(error)[:80]!r}"
    except Exception as error:
        answer = f"{type(error).__name__} {str(error)[:80]!r}"
    return answer if time.monotonic() - start < LONGEST_S else f"slow {answer}"


def peak_kb():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    allowed_kb = peak_kb() + GROWTH_KB
    for line in sys.stdin:
        signal.alarm(4 * LONGEST_S)  # a reader that hangs dies, and the parent sees it
        answer = verdict(Path(line.rstrip("\n")))
        sys.stdout.write((answer if peak_kb() < allowed_kb else f"memory {answer}") + "\n")
        sys.stdout.flush()
        signal.alarm(0)
