"""How good the network is on pairs of other subjects: inlier ratios and recall of its raw poses."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from gapr_core.data import anatomy, parametric
from gapr_core.data.pool import specimens
from gapr_core.data.protocols import make_pair
from gapr_core.data.specimen import Specimen
from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_core.geometry import se3
from gapr_core.geometry.se3 import PoseError
from gapr_core.model.config import ModelConfig
from gapr_core.model.network import GAPRNet, Output
from gapr_core.model.pyramid import build_cloud, target_frame
from gapr_core.model.repositioning import move
from gapr_core.model.types import Cloud
from gapr_core.registration.proposals.consensus import local_to_global
from gapr_core.registration.proposals.network import correspondences_mm
from gapr_core.training.config import TrainConfig
from gapr_core.training.subjects import check_validate
from gapr_core.training.targets import TrainingPair, training_pair

Array = NDArray[np.float64]

FIRST_SEED, NEXT_SEED = 9000, 1000  # of a protocol's pairs; how far on the seed of a second try lies
TRIES = 20
NEAR_MM, NEAR_DEG = 20.0, 15.0  # from here refinement usually finds the truth


@dataclass(frozen=True)
class ValidationPair:
    """A pair in both forms: as the network sees it, and its truth in mm."""

    protocol: str
    bone: str
    pair: TrainingPair
    source_mm: Array
    T_target_source: Array


@dataclass(frozen=True)
class Scores:
    """Of one pair, or means over several.

    Attributes:
        coarse_inliers: share of the chosen patch pairs that overlap.
        fine_inliers: share of the correspondences within the matching radius of the truth.
        first: 1 if the best pose is within 4 mm and 5 deg. near: the same within 20 mm and 15 deg.
        among: 1 if one of the proposed poses is `near`: what verification and refinement can still save.
    """

    coarse_inliers: float
    fine_inliers: float
    first: float
    near: float
    among: float


def validation_set(train: TrainConfig, model: ModelConfig, folder: Path | None) -> list[ValidationPair]:
    """Make the same pairs at every call: `validation_pairs` per protocol, validation bones in turn.

    Bones of which nobody is in that split are left out.

    Raises:
        ConfigError: nobody is in it, or a protocol makes nothing that the network can see.
    """
    bones = [b for b in train.bones if b in parametric.BONES or (folder and anatomy.corresponded(folder, b))]
    people = [subjects for bone in bones if (subjects := specimens(bone, "val", 3, folder))]
    if train.validation_pairs and not people:
        how = "move some subjects to val in splits.json, or set validation_pairs to 0"
        raise ConfigError(f"subjects of split val with {' or '.join(train.bones)}", f"none in {folder}", how)
    if train.validation_pairs:
        check_validate((subject.person for of_bone in people for subject in of_bone), folder)
    found = []
    for p, protocol in enumerate(train.mix):
        for number in range(train.validation_pairs):
            of_bone = people[number % len(people)]
            specimen = of_bone[(number // len(people) + p) % len(of_bone)]
            found.append(_validation_pair(protocol, specimen, FIRST_SEED + number, model))
    return found


def _validation_pair(protocol: str, specimen: Specimen, seed: int, model: ModelConfig) -> ValidationPair:
    """Make the pair of this seed; one invisible to the network gives way to a later seed."""
    for turn in range(TRIES):
        try:
            made = make_pair(protocol, specimen, seed + turn * NEXT_SEED)
            frame = target_frame(made.target, model)
            source, target = build_cloud(made.source, frame, model), build_cloud(made.target, frame, model)
        except (ConfigError, InvalidPointCloudError):  # no wound shows enough bone; a scene larger than its bone
            continue
        pair = training_pair(source, target, made.T_target_source, frame)
        return ValidationPair(protocol, specimen.bone, pair, made.source, made.T_target_source)
    given = f"none of {TRIES} draws of {protocol} for {specimen.bone} {specimen.person}"
    raise ConfigError("protocols whose sources the network can see", given, f"leave {protocol} out of `mix`")


@torch.inference_mode()
def validate(network: GAPRNet, pairs: list[ValidationPair], device: torch.device) -> dict[str, Scores]:
    """Mean scores of each protocol, and of all pairs under "all"."""
    network.eval()
    scores: dict[str, list[Scores]] = {}
    for v in pairs:
        score = score_pair(network, v, device)
        scores.setdefault(v.protocol, []).append(score)
        scores.setdefault("all", []).append(score)
    network.train()
    return {name: mean_scores(found) for name, found in scores.items()}


def score_pair(network: GAPRNet, v: ValidationPair, device: torch.device) -> Scores:
    """Score one pair in one forward pass with local-to-global consensus."""
    pair = v.pair.to(device)
    output = network(pair.source, pair.target)
    found = correspondences_mm(output.matches, v.pair.source, v.pair.target)
    radius_mm = float(v.pair.radius[0]) * float(v.pair.source.scale_mm[0])
    poses = local_to_global(found, 1.5 * radius_mm)
    errors = [se3.pose_error(T, v.T_target_source, v.source_mm) for T in poses] or [PoseError(np.inf, 180.0)]
    near = [error.within(NEAR_MM, NEAR_DEG) for error in errors]
    coarse, fine = inlier_ratios(output, pair.source, pair)
    return Scores(coarse, fine, float(errors[0].is_right), float(near[0]), float(any(near)))


def inlier_ratios(output: Output, source: Cloud, pair: TrainingPair) -> tuple[float, float]:
    """Coarse and fine inlier ratio of one pair."""
    chosen, matches = output.chosen, output.matches
    coarse = (pair.overlaps[0, chosen.source, chosen.target] > 0).float().mean() if len(chosen) else torch.zeros(())
    gap = torch.linalg.vector_norm(move(pair.T, matches.source[None])[0] - matches.target, dim=-1)
    fine = (gap < pair.radius[0]).float().mean() if len(gap) else torch.zeros(())
    return float(coarse), float(fine)


def mean_scores(scores: list[Scores]) -> Scores:
    """Field by field."""
    rows = [asdict(s) for s in scores]
    return Scores(**{name: float(np.mean([row[name] for row in rows])) for name in rows[0]})
