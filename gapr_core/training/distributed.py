"""One process or many under `torchrun`: the few lines that differ."""

from __future__ import annotations

import os

import torch
import torch.distributed as dist
from torch import nn


def start(device: str) -> tuple[int, int, torch.device]:
    """Rank, number of processes and this process's device."""
    rank, world = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
    cuda = torch.cuda.is_available() if device == "auto" else device == "cuda"
    if world > 1:
        dist.init_process_group("nccl" if cuda else "gloo")
    return rank, world, torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0))) if cuda else torch.device("cpu")


def sum_gradients(network: nn.Module, world: int) -> None:
    """Adds the gradients of all processes, in one message."""
    if world == 1:
        return
    parameters = list(network.parameters())
    gradients = [p.grad if p.grad is not None else torch.zeros_like(p) for p in parameters]
    flat = torch.cat([g.flatten() for g in gradients])
    dist.all_reduce(flat)
    for p, part in zip(parameters, flat.split([p.numel() for p in parameters]), strict=True):
        p.grad = part.view_as(p)


def agree(last: bool, world: int) -> bool:
    """True in every process as soon as it is true in the first."""
    if world == 1:
        return last
    flag = torch.tensor([int(last)], device="cuda" if dist.get_backend() == "nccl" else "cpu")
    dist.broadcast(flag, 0)
    return bool(flag.item())


def stop(world: int) -> None:
    """Ends the group."""
    if world > 1:
        dist.destroy_process_group()
