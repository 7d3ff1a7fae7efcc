"""One process or many under `torchrun`: DistributedDataParallel where there are several, nothing where there is one."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from gapr_core.errors import ConfigError


@dataclass(frozen=True)
class Group:
    """This process among those that train together: its `rank` of `world`, and its device."""

    rank: int
    world: int
    device: torch.device

    def wrap(self, module: nn.Module) -> nn.Module:
        """Wrap a module so its backward pass averages gradients of all processes; one needs none."""
        if self.world == 1:
            return module
        devices = [self.device] if self.device.type == "cuda" else None
        return DistributedDataParallel(module, devices, broadcast_buffers=False, gradient_as_bucket_view=True)

    def agree(self, last: bool) -> bool:
        """True in every process as soon as it is true in the first."""
        if self.world == 1:
            return last
        flag = torch.tensor([int(last)], device=self.device)
        dist.broadcast(flag, 0)
        return bool(flag.item())

    def mean(self, values: dict[str, float]) -> dict[str, float]:
        """Average each value over all processes; every process calls this, with the same names."""
        if self.world == 1:
            return values
        sums = torch.tensor(list(values.values()), device=self.device)
        dist.all_reduce(sums)
        return dict(zip(values, (sums / self.world).tolist(), strict=True))

    def wait(self) -> None:
        """Until every process is here."""
        if self.world > 1:
            dist.barrier()

    def share(self, batch: int, micro_batch: int) -> int:
        """Micro-batches of every process in one step.

        Raises:
            ConfigError: the batch cannot be shared equally.
        """
        if batch % (micro_batch * self.world):
            wanted = f"a batch that is a multiple of micro_batch x processes, {micro_batch} x {self.world}"
            raise ConfigError(wanted, str(batch), "change batch or micro_batch, or the number of processes")
        return batch // micro_batch // self.world


def start(device: str) -> Group:
    """Join the group that `torchrun` has made; alone without it.

    Raises:
        ConfigError: `device` is cuda, and torch sees none.
    """
    if device == "cuda" and not torch.cuda.is_available():
        how = "set device to auto or cpu, or install a torch with CUDA and its driver"
        raise ConfigError("a GPU that torch can use", f"none, with torch {torch.__version__}", how)
    rank, world = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
    cuda = torch.cuda.is_available() if device == "auto" else device == "cuda"
    own = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0))) if cuda else torch.device("cpu")
    if cuda:
        torch.cuda.set_device(own)
    if world > 1:
        dist.init_process_group("nccl" if cuda else "gloo")
    return Group(rank, world, own)


def without_sync(module: nn.Module, wanted: bool) -> AbstractContextManager[None]:
    """Gradients stay with this process: for all but the last micro-batch of a step."""
    return module.no_sync() if wanted and isinstance(module, DistributedDataParallel) else nullcontext()


def stop(group: Group) -> None:
    """Leave the group."""
    if group.world > 1:
        dist.destroy_process_group()
