"""The state of a run as one safetensors file: nothing in it can execute."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from gapr_core.errors import WeightsError
from gapr_core.model.network import GAPRNet
from gapr_core.model.weights import checksum, write_tensors


def save_checkpoint(
    path: Path, network: GAPRNet, ema: GAPRNet, optimizer: torch.optim.Optimizer, state: dict[str, Any]
) -> None:
    """Write weights, averaged weights, moments of AdamW and `state`; the old file stays until the new one is whole.

    Raises:
        ConfigError: the file cannot be written, see `write_tensors`.
    """
    tensors = {f"network.{name}": t for name, t in network.state_dict().items()}
    tensors |= {f"ema.{name}": t for name, t in ema.state_dict().items()}
    for index, moments in optimizer.state_dict()["state"].items():
        tensors |= {f"adam.{index}.{name}": t for name, t in moments.items()}
    contiguous = {name: t.detach().cpu().contiguous().clone() for name, t in tensors.items()}
    text = json.dumps(state)
    write_tensors(contiguous, path, {"state": text, "sha256": checksum(contiguous, text)})


def load_checkpoint(path: Path, network: GAPRNet, ema: GAPRNet, optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """Fill network, averaged network and optimiser; returns the state.

    Raises:
        WeightsError: the checkpoint is damaged, or of another configuration.
    """
    try:
        with safe_open(str(path), framework="pt") as file:
            header = file.metadata()
            state = json.loads(header["state"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}
        if header.get("sha256", "") not in ("", checksum(tensors, header["state"])):  # older ones have none
            raise ValueError("its checksum is not that of its content")
        network.load_state_dict(_under(tensors, "network."))
        ema.load_state_dict(_under(tensors, "ema."))
    except (OSError, SafetensorError, RuntimeError, KeyError, TypeError, ValueError) as error:
        given, how = f"{path}: {' '.join(str(error).split())}", "restore it, or choose another folder"
        raise WeightsError("a checkpoint of this configuration", given, how) from error
    moments: dict[int, dict[str, Tensor]] = {}
    for name, tensor in _under(tensors, "adam.").items():
        index, key = name.split(".")
        moments.setdefault(int(index), {})[key] = tensor
    optimizer.load_state_dict({"state": moments, "param_groups": optimizer.state_dict()["param_groups"]})
    return state


def _under(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)}
