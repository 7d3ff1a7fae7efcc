"""Weights as safetensors: configuration, data card and checksum in the header; strict, and no pickle."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from gapr_core.errors import ConfigError, WeightsError
from gapr_core.model.config import ModelConfig
from gapr_core.model.network import GAPRNet
from gapr_core.runtime import files

FORMAT = "gapr-net/1"
DROPPED = {"bone_head": ("none", "mlp"), "bone_scores": (False,), "centred_features": (False,)}  # changed no match


def save(
    network: GAPRNet, path: str | Path, card: dict[str, Any] | None = None, dtype: torch.dtype = torch.float32
) -> str:
    """Write a network, whole or not at all; returns the sha256 of its tensors.

    Args:
        network: what to write.
        path: `*.safetensors`.
        card: its training data, licences, splits, results: anything that JSON takes.
        dtype: float32, or float16 for half the size.
    """
    tensors = {name: t.detach().to("cpu", dtype).contiguous() for name, t in network.state_dict().items()}
    header = {"format": FORMAT, "config": json.dumps(network.config.to_dict()), "card": json.dumps(card or {})}
    return _write_signed(tensors, path, header)


def sign(path: str | Path, out: str | Path) -> str:
    """Write a file again with the checksum over its configuration and card, which older files lack.

    Tensors, configuration and card stay as they are.

    Returns:
        The sha256 of its tensors.

    Raises:
        WeightsError: see `load`.
    """
    load(path)
    header, tensors = _read(path)
    return _write_signed(tensors, out, header)


def _write_signed(tensors: dict[str, Tensor], path: str | Path, header: dict[str, str]) -> str:
    """Write tensors and header with the checksums of both; returns that of the tensors."""
    digest = checksum(tensors)
    signature = checksum(tensors, header["config"], header["card"])
    write_tensors(tensors, path, header | {"sha256": digest, "signature": signature})
    return digest


def write_tensors(tensors: dict[str, Tensor], path: str | Path, header: dict[str, str]) -> None:
    """Write a safetensors file, whole or not at all, with the permissions of any new file (the library has 0600).

    Raises:
        ConfigError: the file cannot be written: no such folder, no permission, a full disk.
    """
    with files.replacing(path) as scratch:
        scratch.touch()
        mode = scratch.stat().st_mode
        try:
            save_file(tensors, str(scratch), metadata=header)
        except SafetensorError as error:
            raise OSError(str(error).removeprefix("Error while serializing: ")) from error
        scratch.chmod(mode)


def load(path: str | Path, device: torch.device | str = "cpu") -> tuple[GAPRNet, dict[str, Any]]:
    """Load the network of a file, in evaluation mode, and its card.

    Raises:
        WeightsError: the file is missing, damaged, of another format, or does not fit its own configuration.
    """
    header, tensors = _read(path)
    if header.get("format") != FORMAT:
        raise WeightsError(f"weights of format {FORMAT}", f"{header.get('format')} in {path}", "export them again")
    signed = checksum(tensors, header.get("config", ""), header.get("card", ""))
    if checksum(tensors) != header.get("sha256") or header.get("signature", signed) != signed:
        raise WeightsError("tensors with the checksum of the header", f"others in {path}", "fetch the file again")
    try:
        network = GAPRNet(_config(json.loads(header["config"])))
        own = {name: t.float() for name, t in tensors.items() if not name.startswith("bone_head.")}
        network.load_state_dict(own, strict=True)
        card = json.loads(header.get("card", "{}"))
    except (ConfigError, RuntimeError, KeyError, TypeError, ValueError) as error:
        raise WeightsError("weights that fit their configuration", f"{path}: {error}", "export them again") from error
    return network.to(device).eval(), card


def _config(settings: dict[str, Any]) -> ModelConfig:
    """Read the configuration of a header; drop former settings at values without effect on matches."""
    return ModelConfig.from_dict(
        {name: value for name, value in settings.items() if value not in DROPPED.get(name, ())}
    )


def checksum(tensors: dict[str, Tensor], *texts: str) -> str:
    """sha256 over texts, names and bytes, in the order of the names."""
    digest = hashlib.sha256("\0".join(texts).encode())
    for name in sorted(tensors):
        tensor = tensors[name].cpu()
        digest.update(name.encode())
        digest.update(
            tensor.contiguous().view(torch.uint8).numpy().tobytes() if tensor.dim() else tensor.numpy().tobytes()
        )
    return digest.hexdigest()


def _read(path: str | Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    try:
        with safe_open(str(path), framework="pt") as file:
            return file.metadata() or {}, {name: file.get_tensor(name) for name in file.keys()}
    except (OSError, SafetensorError) as error:
        raise WeightsError("a readable safetensors file", f"{path}: {error}", "check the path") from error
