"""Proposals of GAPR-Net: correspondences, then consensus."""

from __future__ import annotations

import json
import os
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_core.model.network import GAPRNet
from gapr_core.model.pyramid import Frame, build_cloud, target_frame
from gapr_core.model.types import Cloud, Features, Matches
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.proposals.consensus import Correspondences, local_to_global

Array = NDArray[np.float64]
RADIUS_VOXELS, SMALLEST_VOXEL_MM = 1.5, 5.0  # radius of agreement of a correspondence, over the first voxel
SHIPPED = Path(__file__).parents[2] / "weights" / "gapr_net.safetensors"


class NetworkProposer:
    """Poses from the correspondences of a trained network.

    Args:
        network: in evaluation mode, on any device.
        weights_name: key of the target's cached features, with the device, so that networks of the
            same weights share them; without a name they are the network's alone.
    """

    def __init__(self, network: GAPRNet, weights_name: str = "") -> None:
        self.network = network.eval()
        self.name = "network"
        self.is_shipped = False  # the shipped confidence was fitted to these weights
        self._key = "network", weights_name or network  # the network itself: an id may recur
        _survive_forks()

    @classmethod
    def from_weights(cls, path: str | Path = SHIPPED, device: str = "cpu") -> NetworkProposer:
        """Load the network of a safetensors file; the shipped one without a path.

        Raises:
            WeightsError: the file is missing, damaged or of another format.
            ConfigError: no such device.
        """
        from gapr_core.model import weights

        network = weights.load(path, _available(device))[0]
        name = f"{weights.checksum(dict(network.state_dict()))} {json.dumps(network.config.to_dict())}"
        proposer = cls(network, name)
        proposer.is_shipped = Path(path).resolve() == SHIPPED.resolve()
        return proposer

    def propose(self, source: PreparedSource, target: PreparedTarget, rng: np.random.Generator) -> Array:
        """Propose distinct poses, best first; none where the source is too small or too large for the network."""
        import torch

        frame, cloud, features = self.prepare(target)
        try:
            moving = build_cloud(source.whole, frame, self.network.config)
        except InvalidPointCloudError:
            return np.empty((0, 4, 4))
        with torch.inference_mode():
            output = self.network(moving.to(self._device), cloud.to(self._device), features)
        found = correspondences_mm(output.matches, moving, cloud)
        radius_mm = RADIUS_VOXELS * max(SMALLEST_VOXEL_MM, frame.voxel * frame.scale_mm)
        return local_to_global(found, radius_mm)

    def prepare(self, target: PreparedTarget) -> tuple[Frame, Cloud, Features]:
        """Compute the target's pyramid and features once, and keep them with it."""
        import torch

        key = *self._key, str(self._device)
        if key not in target.cache:
            frame = target_frame(target.points, self.network.config)
            cloud = build_cloud(target.points, frame, self.network.config)
            with torch.inference_mode():
                features = self.network.backbone(cloud.to(self._device))
            target.cache[key] = frame, cloud, features
        return target.cache[key]

    @property
    def _device(self) -> Any:
        return next(self.network.parameters()).device


@cache
def _survive_forks() -> None:
    """Let forked processes run torch in one thread: OpenMP's threads do not survive a fork, and a child would hang."""
    import torch

    os.register_at_fork(after_in_child=partial(torch.set_num_threads, 1))


def _available(device: str) -> str:
    """Resolve a device's name; "auto" is the GPU where there is one."""
    import torch

    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if device != "cpu" and not device.startswith("cuda"):
        raise ConfigError("a device: cpu, cuda or auto", repr(device), "choose cpu or auto")
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise ConfigError("a device of this machine", f"{device}, but torch sees no GPU", "choose cpu or auto")
    return device


def correspondences_mm(matches: Matches, source: Cloud, target: Cloud) -> Correspondences:
    """Convert matches of a single pair from the clouds' units to mm."""
    scale = float(source.scale_mm[0])
    p = matches.source.double().cpu().numpy() * scale + source.centre_mm.cpu().numpy()
    q = matches.target.double().cpu().numpy() * scale + target.centre_mm.cpu().numpy()
    return Correspondences(p, q, matches.score.double().cpu().numpy(), matches.patch.cpu().numpy())
