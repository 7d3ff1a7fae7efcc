"""The paper's pipeline as a method: GAPR-Net's correspondences, then RANSAC; no search, no refinement."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.baselines.base import Baseline, BaselineTarget, NoPose
from gapr_core.benchmark.ransac import ransac, sharpened
from gapr_core.errors import InvalidPointCloudError
from gapr_core.registration.proposals.consensus import Correspondences
from gapr_core.registration.proposals.network import SHIPPED, correspondences_mm

if TYPE_CHECKING:
    from gapr_core.model.pyramid import Frame

Array = NDArray[np.float64]
PAPER = SHIPPED.with_name("gapr_net_paper.safetensors")
AGREES = 1.5  # matching radii within which a correspondence agrees with a pose


class PaperPipeline(Baseline):
    """Section IV of the paper from end to end, with the weights of a run.

    Args:
        weights: safetensors file; without one those of the paper's regime that ship.

    Raises:
        WeightsError: the file is missing, damaged or of another format.
    """

    def __init__(self, weights: str | Path = PAPER) -> None:
        from gapr_core.model import weights as files

        self.network = files.load(weights)[0]
        self.name = "gapr_paper" if Path(weights) == PAPER else f"gapr_paper@{weights}"

    def _prepare(self, points: Array, normals: Array | None) -> Any:
        import torch

        from gapr_core.model.pyramid import build_cloud, target_frame

        frame = target_frame(points, self.network.config)
        cloud = build_cloud(points, frame, self.network.config)
        with torch.inference_mode():
            return frame, cloud, self.network.backbone(cloud)

    def _align(self, source: Array, target: BaselineTarget, seed: Array) -> Array:
        import torch

        from gapr_core.model.pyramid import build_cloud

        frame, cloud, features = target.static
        try:
            moving = build_cloud(source, frame, self.network.config)
        except InvalidPointCloudError as error:
            raise NoPose(str(error)) from error
        with torch.inference_mode():
            output = self.network(moving, cloud, features)
        found = correspondences_mm(output.matches, moving, cloud)
        return ransac_pose(found, frame)


def ransac_pose(found: Correspondences, frame: Frame) -> Array:
    """(4, 4) T_target_source, mm, that most correspondences agree with, fitted to them.

    Raises:
        NoPose: three never agree.
    """
    from gapr_core.model.pyramid import matching_radius

    radius_mm = matching_radius(frame) * frame.scale_mm
    poses = ransac(found, AGREES * radius_mm, np.random.default_rng(0))
    if not len(poses):
        raise NoPose(f"no pose that three of {len(found.score)} correspondences agree on")
    return sharpened(poses[0], found, radius_mm)
