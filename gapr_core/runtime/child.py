"""Run native code that may crash in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

PACKAGES = Path(__file__).resolve().parents[2]  # the folder that gapr_core is in


def run(module: str, *arguments: str, timeout_s: float | None = None) -> subprocess.CompletedProcess[str]:
    """`python -m module arguments` with its output; nothing of the caller's working folder is imported.

    Python looks there first: a file of its user's, such as `random.py`, would be run in place of its own.

    Args:
        module: one of this package.
        arguments: with absolute paths, since the process has another working folder.
        timeout_s: until it is ended.

    Raises:
        subprocess.TimeoutExpired: it was.
    """
    paths = [str(Path(entry).absolute()) for entry in os.environ.get("PYTHONPATH", "").split(os.pathsep) if entry]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(PACKAGES), *paths])}
    command = [sys.executable, "-m", module, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, cwd=PACKAGES, env=environment)
