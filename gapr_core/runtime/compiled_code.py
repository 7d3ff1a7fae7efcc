"""Where numba keeps the code that it compiled: next to the modules, in the user's cache, or else nowhere that lasts.

It refuses to compile at all where it can write to neither, as a service without a home on a read-only system.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"
PACKAGE = Path(__file__).parent  # a folder with modules, as all of the package


def find_a_place() -> None:
    """Give numba a temporary folder, for this process alone, where it has no other; say so once."""
    if os.environ.get(VARIABLE) or _can_write(PACKAGE / "__pycache__") or _can_write(_of_user()):
        return
    import atexit  # not above: see `gapr_core.TYPE_CHECKING`
    import logging
    import shutil
    import tempfile

    folder = tempfile.mkdtemp(prefix="gapr-compiled-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ[VARIABLE] = folder
    if "numba" in sys.modules:  # it has read its settings
        sys.modules["numba"].config.CACHE_DIR = folder
    logging.getLogger(__name__).warning(
        "compiled code can be kept neither in %s nor in %s: every start compiles for seconds; set %s to a folder that "
        "can be written", PACKAGE.parent, _of_user(), VARIABLE,
    )  # fmt: skip


def _of_user() -> Path:
    """Find the user's folder of numba (its `appdirs`)."""
    return Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) / "numba"


def _can_write(folder: Path) -> bool:
    """Check whether a folder can be written to, or made."""
    there = next(place for place in (folder, *folder.parents) if place.exists())
    return os.access(there, os.W_OK | os.X_OK)
