"""The child of `files.py`: loads each file that stdin names, and answers with one line for each.

Label maps are read in this process, which is quicker than a process for each; `--isolated` reads them as users do.
"""

import contextlib
import io
import json
import logging
import resource
import signal
import sys
import time
from pathlib import Path

import numpy as np

from gapr_core import clouds
from gapr_core.errors import InvalidPointCloudError
from gapr_core.formats import lzf, reading
from gapr_core.formats.options import ReadOptions
from gapr_core.formats.volumes import child, label_map

LONGEST_S = 5  # of CPU: the machine may be busy
STUCK_S = 120
MEMORY_BYTES = 4 << 30
TIP_MM = (0.0, 0.0, 100.0)
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


def tip_of(path):
    """A tip for recordings of tracked tools; other files refuse one."""
    if path.is_dir() or "tip_mm" not in getattr(reading.format_of(path), "uses", ()):
        return None
    return TIP_MM if path.name.endswith(".igs.mha") or b"q0" in path.read_bytes()[:1000].lower() else None


def verdict(path):
    """`read` with its counts, `refused`, or what should not have happened."""
    start = time.process_time()
    try:
        with Warnings() as warnings:
            surface = clouds.load(path, reading.format_of(path).unit, ReadOptions(tip_mm=tip_of(path)))
        answer = f"read {len(surface.points)} {0 if surface.faces is None else len(surface.faces)}{warnings}"
    except InvalidPointCloudError as error:
        answer = "refused" if "\n" not in str(error) and len(str(error)) < 600 else f"long message {str(error)[:80]!r}"
    except Exception as error:
        answer = f"{type(error).__name__} {str(error)[:80]!r}"
    return answer if time.process_time() - start < LONGEST_S else f"slow {answer}"


def in_this_process(path, options, out):
    """What `label_map._in_a_child` gives, or raises; also when the reader raises anything at all."""
    request = {"path": str(path), "labels": list(options.labels), "limits": vars(options.limits), "seconds": 0}
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(io.StringIO()):
        code = child.main(json.dumps(request), str(out))
    if code:
        raise InvalidPointCloudError(*json.loads(said.getvalue()))
    with np.load(out) as data:
        affine = data["affine"].copy()
        affine[:3, 3] += affine[:3, :3] @ data["start"]
        return data["mask"], affine, json.loads(data["notes"].tobytes())


def import_native_readers():
    """Before memory is counted: what is loaded once is no part of a file."""
    for name in ("SimpleITK", "skimage.measure", "highdicom", "plyfile", "gapr_ros.bags.source"):
        with contextlib.suppress(ImportError):
            __import__(name)
    lzf.decompress(b"\0a", 1)  # compiles


def peak_kb():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


if __name__ == "__main__":
    import_native_readers()
    if "--isolated" not in sys.argv:
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
        child._limit = lambda limits, seconds: None
        label_map._in_a_child = in_this_process
    allowed_kb = peak_kb() + GROWTH_KB
    for line in sys.stdin:
        signal.setitimer(signal.ITIMER_PROF, 4 * LONGEST_S)  # a reader that hangs dies, and the parent sees it
        signal.alarm(STUCK_S)  # also one that waits
        answer = verdict(Path(line.rstrip("\n")))
        sys.stdout.write((answer if peak_kb() < allowed_kb else f"memory {answer}") + "\n")
        sys.stdout.flush()
        signal.alarm(0)
        signal.setitimer(signal.ITIMER_PROF, 0)
