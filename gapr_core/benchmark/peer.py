"""Networks of others as methods: their weights, units and poses; `checkout` imports their code.

They are made for 3DMatch with a first voxel of 0.025, so their unit is 40 first voxels of a pair's target.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from gapr_core.baselines.base import Baseline, BaselineTarget, NoPose
from gapr_core.benchmark.checkout import Origin, without_cuda
from gapr_core.benchmark.paper_pipeline import ransac_pose
from gapr_core.errors import GaprError, InvalidPointCloudError, WeightsError
from gapr_core.geometry import se3
from gapr_core.model.config import ModelConfig
from gapr_core.model.pyramid import build_cloud, target_frame
from gapr_core.model.types import Cloud
from gapr_core.registration.proposals.consensus import Correspondences

Array = NDArray[np.float64]
VOXEL = 0.025  # the first voxel of 3DMatch, in a network's unit


class Matches(NamedTuple):
    """(C, 3) points of both clouds in a network's unit that it finds alike, and (C,) how sure it is."""

    source: Array
    target: Array
    score: Array


class Checkout(ABC):
    """The authors' code, imported."""

    origin: ClassVar[Origin]

    @classmethod
    @abstractmethod
    def at(cls, folder: str | Path | None = None) -> Checkout:
        """Import a checkout; that of the environment variable without a folder.

        Raises:
            MethodUnavailableError: there is none, it is another code, or a library that it needs is missing.
        """

    @abstractmethod
    def network(self, sizes: ModelConfig) -> nn.Module:
        """Make the network with random weights, at the sizes of one of our networks."""

    @abstractmethod
    def batch(
        self, source: Cloud, target: Cloud, voxel: float, sizes: ModelConfig, T: Tensor | None = None
    ) -> dict[str, Any]:
        """Make the input of the network.

        Args:
            source, target: of which the finest points are used.
            voxel: the first voxel in the clouds' units.
            sizes: of the network.
            T: (3, 4) true T_target_source in the clouds' units, to learn from.

        Raises:
            InvalidPointCloudError: too few points for the network.
        """

    @abstractmethod
    def matches(self, output: Any, batch: dict[str, Any]) -> Matches:
        """Read the correspondences from an output of the network."""

    @abstractmethod
    def own_pose(self, output: Any, batch: dict[str, Any]) -> Array:
        """(4, 4) T_target_source in the network's unit, as its authors find it.

        Raises:
            NoPose: there is none.
        """


class Peer(Baseline):
    """The network of a checkout, and a pose from its correspondences.

    Args:
        code: the checkout.
        weights: that its training wrote.
        pose: "own", that of its authors, or "ransac", that of the paper's pipeline.

    Raises:
        WeightsError: the file is missing, damaged or of another network.
    """

    def __init__(self, code: Checkout, weights: str | Path, pose: str = "own") -> None:
        self.code, self.pose = code, pose
        self.network, self.sizes = load(code, weights)
        self.thinning = thinning(self.sizes)
        self.name = f"{code.origin.name}{'' if pose == 'own' else f'_{pose}'}@{weights}"

    def _prepare(self, points: Array, normals: Array | None) -> Any:
        frame = target_frame(points, self.thinning)
        return frame, build_cloud(points, frame, self.thinning)

    def _align(self, source: Array, target: BaselineTarget, seed: Array) -> Array:
        frame, cloud = target.static
        try:
            moving = build_cloud(source, frame, self.thinning)
            batch = self.code.batch(moving, cloud, frame.voxel, self.sizes)
        except InvalidPointCloudError as error:
            raise NoPose(str(error)) from error
        with torch.inference_mode(), without_cuda():
            output = self.network(batch)
        unit_mm = frame.scale_mm * frame.voxel / VOXEL
        if self.pose == "own":
            return to_mm(self.code.own_pose(output, batch), moving, cloud, unit_mm)
        return ransac_pose(correspondences_mm(self.code.matches(output, batch), moving, cloud, unit_mm), frame)


def thinning(sizes: ModelConfig) -> ModelConfig:
    """Give the settings for the first voxels: each stage doubles them, all else is as in our network."""
    return replace(sizes, voxel_growth=2.0)


def scaled(source: Cloud, target: Cloud, voxel: float, T: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Finest points (N, 3), (M, 3), and the motion (4, 4) between them, by default none, in a network's unit."""
    scale, motion = VOXEL / voxel, torch.eye(4)
    if T is not None:
        motion[:3] = T
        motion[:3, 3] *= scale
    return source.levels[0].points * scale, target.levels[0].points * scale, motion


def to_mm(T: Array, source: Cloud, target: Cloud, unit_mm: float) -> Array:
    """(4, 4) T_target_source, mm, from one between clouds that were centred, in units of `unit_mm`."""
    centre_p, centre_q = source.centre_mm.numpy()[0], target.centre_mm.numpy()[0]
    shift = centre_q + unit_mm * T[:3, 3] - T[:3, :3] @ centre_p
    return se3.from_rotation_translation(T[:3, :3], shift)


def correspondences_mm(found: Matches, source: Cloud, target: Cloud, unit_mm: float) -> Correspondences:
    """Give the correspondences of a network in mm; RANSAC does not ask for the patches."""
    p = found.source * unit_mm + source.centre_mm.numpy()[0]
    q = found.target * unit_mm + target.centre_mm.numpy()[0]
    return Correspondences(p, q, found.score, np.zeros(len(p), dtype=np.int64))


def save(code: Checkout, network: nn.Module, sizes: ModelConfig, path: Path, card: dict[str, Any]) -> None:
    """Write weights with all that builds the network again."""
    from safetensors.torch import save_file

    header = {"format": _format(code), "sizes": json.dumps(sizes.to_dict()), "card": json.dumps(card)}
    save_file({name: t.contiguous() for name, t in network.state_dict().items()}, str(path), metadata=header)


def load(code: Checkout, path: str | Path) -> tuple[nn.Module, ModelConfig]:
    """Load the network of a file, in evaluation mode, and its sizes.

    Raises:
        WeightsError: the file is missing, damaged or of another network.
    """
    from safetensors import SafetensorError, safe_open

    wanted = f"weights of {code.origin.title} (format {_format(code)})"
    try:
        with safe_open(str(path), framework="pt") as file:
            header, tensors = file.metadata() or {}, {name: file.get_tensor(name) for name in file.keys()}
        if header.get("format") != _format(code):
            raise WeightsError(wanted, f"format {header.get('format')} in {path}", _how_to_train(code))
        sizes = ModelConfig.from_dict(json.loads(header["sizes"]))
        network = code.network(sizes)
        network.load_state_dict(tensors)
    except GaprError:
        raise
    except (OSError, SafetensorError, RuntimeError, KeyError, TypeError, ValueError) as error:
        raise WeightsError(wanted, f"{path}: {' '.join(str(error).split())}", _how_to_train(code)) from error
    return network.eval(), sizes


def _format(code: Checkout) -> str:
    return f"{code.origin.name}/1"


def _how_to_train(code: Checkout) -> str:
    return f"train them with python -m gapr_core.training.{code.origin.name}"
