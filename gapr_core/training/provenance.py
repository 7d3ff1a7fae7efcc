"""Where a run comes from: code, machine and data, one entry for each time it was begun or taken up again.

Kept in a file of its own next to config.json: another commit or machine is no reason to refuse to go on.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable
from datetime import datetime, timezone
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch

import gapr_core.data
from gapr_core.data import anatomy
from gapr_core.errors import ConfigError
from gapr_core.runtime.files import read_json, write_json
from gapr_core.runtime.origin import commit, cpu_name, release
from gapr_core.training.config import TrainConfig

FILE = "provenance.json"
PARAMETRIC = ("parametric.py", "parameters.py", "solid.py", "deformation.py", "degradation.py", "bones/*.py")
Entry = dict[str, Any]


def append(folder: Path, config: TrainConfig, bones: Path | None, step: int, world: int) -> list[Entry]:
    """Add an entry to the folder's provenance.json.

    Args:
        folder: of the run.
        config: its settings.
        bones: the anatomy folder, None for parametric bones.
        step: optimiser steps that were done before.
        world: processes that train together.

    Returns:
        All entries, the oldest first; what the header of the weights carries.

    Raises:
        ConfigError: the file there cannot be read.
    """
    path, known = folder / FILE, entries(folder)
    begun_with = _digest([Path(config.initial).read_bytes()]) if config.initial and not step else None
    entry = {"step": step, **code(), **machine(), "processes": world, "data": data(config.bones, bones)}
    known.append(entry | {"initial": begun_with})
    write_json(path, known)
    return known


def entries(folder: Path) -> list[Entry]:
    """Read all entries of a folder's provenance.json, oldest first; none without the file.

    Raises:
        ConfigError: the file there cannot be read.
    """
    return _read(folder / FILE) if (folder / FILE).exists() else []


def summary(folders: Iterable[Path]) -> list[str]:
    """Summarise code, machines and data of these runs in order; runs not begun have none."""
    return list(dict.fromkeys(_sentence(entry) for folder in folders for entry in entries(folder)))


def _read(path: Path) -> list[Entry]:
    expected, how = "the provenance of a training run", "restore it, or move it out of the folder"
    found = read_json(path, expected, how)
    if not isinstance(found, list) or not all(isinstance(entry, dict) for entry in found):
        raise ConfigError(expected, f"{path} with other content", how)
    return found


def _sentence(entry: Entry) -> str:
    by, drawn = entry["commit"] or f"version {entry['gapr']}", entry["data"]
    return (
        f"Trained by {by}, torch {entry['torch']}, {entry['processes']} process(es) of "
        f"{entry['threads']} thread(s) on {entry['gpu'] or entry['cpu']}, {entry['platform']}; data: "
        f"{drawn['train_people']} real train subjects (hash {drawn['anatomy']}), "
        f"parametric model {drawn['parametric']}."
    )


def code() -> Entry:
    """Record time, commit of the source tree (`-dirty` after changes), and versions."""
    return {
        "time": datetime.now(timezone.utc).isoformat(timespec="seconds"), "commit": commit(), "gapr": release(),
        "torch": torch.__version__, "python": platform.python_version(),
    }  # fmt: skip


def machine() -> Entry:
    """Operating system, processor and threads; nothing that names the computer."""
    return {
        "platform": f"{platform.system()} {platform.release()} {platform.machine()}", "cpu": cpu_name(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "cores": len(os.sched_getaffinity(0)), "threads": torch.get_num_threads(),
    }  # fmt: skip


def data(bones: Iterable[str], folder: Path | None) -> Entry:
    """Record the bones: number of train subjects, a hash of subjects and meshes, the parametric model."""
    people = sorted(anatomy.splits(folder)["train"]) if folder else []
    return {
        "train_people": len(people), "anatomy": meshes_hash(bones, people, folder) if folder else None,
        "parametric": parametric_version(),
    }  # fmt: skip


def meshes_hash(bones: Iterable[str], people: list[str], folder: Path) -> str:
    """sha256 (16 digits) over the subjects and the names and contents of their mesh files, wherever the folder is."""
    files = sorted({path for bone in bones for path in folder.glob(f"{bone}_*.npz")}, key=lambda path: path.name)
    return _digest([*people, *(part for path in files for part in (path.name, path.read_bytes()))])


def parametric_version() -> str:
    """sha256 (16 digits) over the source that draws parametric bones: another one, other bones."""
    root = Path(gapr_core.data.__file__).parent
    files = sorted({path for pattern in PARAMETRIC for path in root.glob(pattern)})
    return _digest([part for path in files for part in (str(path.relative_to(root)), path.read_bytes())])


def _digest(parts: list[str | bytes]) -> str:
    digest = sha256()
    for part in parts:
        content = part.encode() if isinstance(part, str) else part
        digest.update(len(content).to_bytes(8, "big") + content)
    return digest.hexdigest()[:16]
