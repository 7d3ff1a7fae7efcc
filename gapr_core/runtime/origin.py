"""Name the code and the processor, which stand with every number."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Iterable
from dataclasses import asdict
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from gapr_core import __version__

WEIGHTS = Path(__file__).resolve().parents[1] / "weights"


def commit() -> str | None:
    """Find the commit of the source tree; None if the package was installed without its repository."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    no_tag = "--exclude=*"
    asked = ["git", "--no-optional-locks", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12", no_tag]
    try:
        answer = subprocess.run(asked, capture_output=True, text=True, timeout=30)
    except (OSError, subprocess.TimeoutExpired):
        return None  # no git here: the version is given as well
    return answer.stdout.strip() or None


def of_answers(config: Any) -> dict[str, str]:
    """Give code, settings and weights as short texts: all that an answer depends on but clouds and method.

    Args:
        config: a dataclass of settings.
    """
    return {
        "version": f"{__version__} {commit() or ''}".strip(),
        "settings": settings(config),
        "weights": shipped_weights(),
    }


def shipped_weights() -> str:
    """Hash the network and all models that are installed."""
    return digest_of(path for path in sorted(WEIGHTS.iterdir()) if path.suffix != ".md")


def digest_of(paths: Iterable[Path]) -> str:
    """Hash the content of these files in their order."""
    return _digest(path.read_bytes() for path in paths)


def settings(config: Any) -> str:
    """Hash the settings of a dataclass."""
    return _digest([json.dumps(asdict(config), sort_keys=True).encode()])


def _digest(parts: Iterable[bytes]) -> str:
    digest = sha256()
    for part in parts:
        digest.update(sha256(part).digest())
    return digest.hexdigest()[:16]


def release() -> str | None:
    """Read the version of the installed package."""
    try:
        return version("gapr_ros")
    except PackageNotFoundError:
        return None


def machine() -> str:
    """Processor, cores and Python, in words; nothing that names the computer."""
    return f"{cpu_name()}, {os.cpu_count()} cores, Python {platform.python_version()}"


def cpu_name() -> str:
    """Read the name of the processor from the system."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.is_file() else []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, platform.processor() or platform.machine())
