"""The folder of a run: its settings, lines of its log, its validation and its curves."""

from __future__ import annotations

import csv
import logging
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from gapr_core.errors import ConfigError
from gapr_core.model.config import ModelConfig
from gapr_core.model.network import GAPRNet
from gapr_core.runtime import files
from gapr_core.runtime.settings import Settings
from gapr_core.training import provenance
from gapr_core.training.config import TrainConfig
from gapr_core.training.losses import Losses
from gapr_core.training.validation import validate

log = logging.getLogger(__name__)
MOST_NAMED = 4  # settings that an error names


def check(folder: Path, config: TrainConfig, model: ModelConfig) -> None:
    """Check for an empty folder, or a run with these settings.

    The network's settings count, not the path of their yaml; an entry that did not exist then stood at its default.

    Raises:
        ConfigError: the folder holds another run, or its settings cannot be read.
    """
    path = folder / "config.json"
    if path.exists():
        train, network = _begun_with(path)
        if others := [*_changes(replace(train, model=config.model), config), *_changes(network, model)]:
            more = f" and {len(others) - MOST_NAMED} more" if len(others) > MOST_NAMED else ""
            given = f"others for {folder}: {', '.join(others[:MOST_NAMED])}{more}"
            raise ConfigError("the settings this folder was begun with", given, "give those, or choose a new folder")


def _changes(begun: Settings, now: Settings) -> list[str]:
    """`name now instead of begun` for every setting that differs; nothing of names alone."""
    then = begun.to_dict()
    return [f"{name} {value!r} instead of {then[name]!r}" for name, value in now.to_dict().items()
            if value != then[name]]  # fmt: skip


def _begun_with(path: Path) -> tuple[TrainConfig, ModelConfig]:
    """Read the settings in a config.json."""
    expected, how = "the settings of a training run", "restore it, or choose a new folder"
    begun = files.read_json(path, expected, how)
    try:
        return TrainConfig.from_dict(begun["train"]), ModelConfig.from_dict(begun["model"])
    except (KeyError, TypeError) as error:
        raise ConfigError(expected, f"{path} with other content", how) from error


def claim(
    folder: Path, config: TrainConfig, model: ModelConfig, anatomy: Path | None, step: int, world: int
) -> list[dict[str, Any]]:
    """Write the run's settings, if they are not there yet, and where it goes on; returns all of provenance.json.

    Only now, when nothing that the settings name was refused: the next try may have others.

    Raises:
        ConfigError: the run there had other real bones, or see `provenance.append`.
    """
    path = folder / "config.json"
    _check_bones(folder, config, anatomy)
    if not path.exists():
        files.write_json(path, {"train": config.to_dict(), "model": model.to_dict()})
    return provenance.append(folder, config, anatomy, step, world)


def _check_bones(folder: Path, config: TrainConfig, anatomy: Path | None) -> None:
    """Raise `ConfigError` where a run had other real bones or train subjects: some may be held out."""
    entries = provenance.entries(folder)
    begun = entries[-1].get("data", {}) if entries else {}
    if "anatomy" in begun and begun["anatomy"] != (now := provenance.data(config.bones, anatomy))["anatomy"]:
        given = f"{_bones(now, anatomy)} where {folder} has had {_bones(begun, None)}"
        how = "give --anatomy as it was, with the same meshes and subjects in train, or choose a new folder"
        raise ConfigError("the bones that this folder was begun with", given, how)


def _bones(data: dict[str, Any], folder: Path | None) -> str:
    """Describe the real bones of an entry of provenance.json."""
    if data["anatomy"] is None:
        return "parametric bones alone"
    where = f" in {folder}" if folder else ""
    return f"{data['train_people']} train subjects{where} (hash {data['anatomy']})"


def log_row(state: dict[str, Any], config: TrainConfig, values: dict[str, float]) -> dict[str, Any]:
    """Format one line of log.csv: progress, and five digits of each value."""
    row = {"step": state["step"], "pairs": state["step"] * config.batch, "seconds": round(state["seconds"], 1)}
    return row | {name: float(f"{value:.5g}") for name, value in values.items()}


def mean_losses(parts: list[Losses]) -> dict[str, float]:
    """Average the total and each loss over one process's micro-batches of a step."""
    names = ["total", "coarse", "fine", "early"]
    means = {name: sum(float(getattr(part, name).detach()) for part in parts) / len(parts) for name in names}
    return {"loss": means.pop("total"), **means}


def report(
    folder: Path, ema: GAPRNet, held_out: Any, state: dict[str, Any], config: TrainConfig, device: torch.device
) -> None:
    """Validate the averaged weights: lines of validation.csv, and one on the terminal."""
    if not held_out:
        return
    scores = validate(ema, held_out, device)
    for protocol, score in scores.items():
        values = {name: round(value, 4) for name, value in asdict(score).items()}
        row = {"pairs": state["step"] * config.batch, "seconds": round(state["seconds"], 1), "protocol": protocol}
        append(folder / "validation.csv", row | values)
    total = scores["all"]
    tqdm.write(
        f"{state['step'] * config.batch} pairs  {state['seconds'] / 60:.0f} min  inliers: coarse "
        f"{total.coarse_inliers:.2f}, fine {total.fine_inliers:.2f}  recall: 4 mm/5 deg {total.first:.2f}, "
        f"a near pose among the proposals {total.among:.2f}"
    )


def draw_curves(folder: Path) -> None:
    """Draw curves.png again; where even matplotlib cannot be loaded, a warning instead of the end of the run."""
    try:
        from gapr_core.training import curves
    except ImportError as error:
        log.warning("no curves of %s: %s", folder, error)
    else:
        curves.draw_or_warn(folder)


def append(path: Path, row: dict[str, Any]) -> None:
    """Append one line to a CSV file, with a head if new; replaces a line cut by a crash."""
    with path.open("a+b") as file:
        size = file.seek(0, 2)
        file.seek(max(size - 4096, 0))
        full_lines = size - len(file.read().rpartition(b"\n")[2])
        file.truncate(full_lines)
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, list(row))
        if full_lines == 0:
            writer.writeheader()
        writer.writerow(row)
