"""Training pairs made on the fly, each a pure function of the run's settings and its number."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset

from gapr_core.data import anatomy, parametric
from gapr_core.data.pair import TARGET_POINTS
from gapr_core.data.pool import parametric_people, parametric_specimen
from gapr_core.data.protocols import PROTOCOLS, WITH_OTHERS, Pair, make_pair
from gapr_core.data.specimen import Specimen
from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_core.geometry import se3
from gapr_core.model.config import ModelConfig
from gapr_core.model.pyramid import FEWEST_POINTS, build_cloud, target_frame
from gapr_core.training import bone_cache
from gapr_core.training.bone_cache import PooledBone
from gapr_core.training.config import TrainConfig
from gapr_core.training.shapes import ShapeModel, vary
from gapr_core.training.targets import TrainingPair, join, training_pair

Array = NDArray[np.float64]
CROPPED = ("paper", "overlap", "incomplete")  # protocols (beginnings) that crop a cloud
OWN_TARGET = ("incomplete",)  # protocols whose target is not the whole bone
COARSE = 0.6  # of the superpoints, in the first part of a schedule with `coarse_first`
LANES = 4  # the bone of a pair and its micro-batch have numbers that are the same modulo this


class People:
    """Bones of one type: subjects of the split, and new ones from their shape model; parametric where there is none.

    Raises:
        ConfigError: neither meshes of the split nor a parametric model, or meshes of nobody in the split `train`.
    """

    def __init__(self, bone: str, folder: Path | None, split: str) -> None:
        self.bone, self.split = bone, split
        self.real = anatomy.surfaces(folder, bone, split) if folder else []
        known = anatomy.corresponded(folder, bone) if folder else []
        if split == "train" and known and not self.real:
            given = f"meshes of {', '.join(known[0].person[:3])} ... in {folder}, and none of them in train"
            how = "correct the names in splits.json, or move the meshes away to train on parametric bones"
            raise ConfigError(f"subjects of the split train with a {bone}", given, how)
        sets = [own for c in known if len((own := c.of({s.person for s in self.real})).points) > 2]
        self.models = [ShapeModel.of(c) for c in sets]
        self.model_subjects = [c.person for c in sets]
        if not self.real and bone not in parametric.BONES:
            raise ConfigError(f"meshes or a parametric model of {bone}", "neither", "leave it out of `bones`")

    def draw(self, number: int, synthetic: float, seed: int) -> Specimen:
        """Subject `number`: always the same one."""
        return self.draw_of(number, synthetic, seed)[0]

    def draw_of(self, number: int, synthetic: float, seed: int) -> tuple[Specimen, tuple[str, ...]]:
        """Subject `number`, and whose bones it was made of."""
        rng = np.random.default_rng([seed, number])
        if not self.real:
            people = parametric_people(self.split, 2000)
            specimen = parametric_specimen(self.bone, people[int(rng.integers(len(people)))])
            return specimen, (specimen.person,)
        if self.models and rng.random() < synthetic:
            index = int(rng.integers(len(self.models)))
            surface, subjects = self.models[index].draw(rng), self.model_subjects[index]
        else:
            real = self.real[int(rng.integers(len(self.real)))]
            surface, subjects = real.surface, (real.person,)
        return Specimen(vary(surface, rng), self.bone, f"drawn_{number}", "drawn"), subjects


@dataclass(frozen=True, eq=False)
class SampledOnce(Specimen):
    """A bone of which every sample is one and the same: a protocol crops the target's own points."""

    cloud: Array | None = None

    def sample(self, count: int, rng: np.random.Generator) -> tuple[Any, Any]:
        """Sample the cloud; normals are unknown."""
        return self.cloud, None


class TrainingPairs(Dataset[TrainingPair]):
    """Micro-batches by number. Bones come and go as the numbers rise; a worker keeps those in use."""

    def __init__(
        self,
        train: TrainConfig,
        model: ModelConfig,
        folder: Path | None,
        split: str = "train",
        cache: Path | None = None,
    ) -> None:
        check_mix(train.mix)
        self.train, self.model, self.cache = train, model, cache
        self.people = [People(bone, folder, split) for bone in train.bones]
        self.protocols = list(train.mix)
        self.weights = np.array([train.mix[p] for p in self.protocols]) / sum(train.mix.values())
        self._pool: OrderedDict[int, PooledBone] = OrderedDict()

    def __len__(self) -> int:
        return -(-self.train.pairs // self.train.micro_batch)

    def __getitem__(self, number: int) -> TrainingPair:
        """Micro-batch `number`."""
        first = number * self.train.micro_batch
        return join([self.pair(first + i) for i in range(self.train.micro_batch)])

    def pair(self, number: int) -> TrainingPair:
        """Make pair `number`; one with too few points or overlap gives way to a later draw."""
        rng = np.random.default_rng([self.train.seed, 1, number])
        which = self._bone_number(number)
        for _ in range(20):
            bone = self._bone(which)
            protocol = str(rng.choice(self.protocols, p=self.weights))
            seed = int(rng.integers(2**31))
            try:
                made = make_pair(protocol, self._seen_by(protocol, bone), seed)
                found = self._prepare(made, bone, self._sizes(which)) if len(made.source) >= FEWEST_POINTS else None
            except (ConfigError, InvalidPointCloudError):  # no wound shows enough bone; a scene larger than its bone
                continue
            if found is not None and bool((found.overlaps > 0.1).any()):
                return replace(found, subjects=bone.subjects)
        raise RuntimeError(f"no usable pair under number {number}")

    def _bone_number(self, number: int) -> int:
        """Neighbouring pairs share a bone, and so its features; micro-batches take turns in lanes of their own bones.

        Those of one turn take bones of the same kinds, which came in together. So each of two or four processes needs
        its own bones only, and has as much to do as the others, which wait for it.
        """
        micro_batch, place = divmod(number, self.train.micro_batch)
        turn, lane = divmod(micro_batch, LANES)
        rng = np.random.default_rng([self.train.seed, 3, turn, place // self.train.share])
        row = _oldest_row(self.train, number) + int(rng.integers(max(1, self.train.pool // LANES)))
        return LANES * row + lane

    def _seen_by(self, protocol: str, bone: PooledBone) -> Specimen:
        """Return a protocol's input: the bone, or the target's own points for a crop."""
        whose = bone.specimen
        if self.train.source_points == "new" or not protocol.startswith(CROPPED):
            return whose
        return SampledOnce(whose.surface, whose.bone, whose.person, whose.cohort, bone.points)

    def _sizes(self, bone: int) -> ModelConfig:
        """Return the network's settings for this bone: fewer superpoints for bones that come in first."""
        if bone // LANES * LANES * self.train.reuse >= self.train.coarse_first * self.train.pairs:
            return self.model
        few, many = (max(4, round(COARSE * count)) for count in self.model.superpoints)
        return replace(self.model, superpoints=(few, many))

    def _prepare(self, made: Pair, bone: PooledBone, model: ModelConfig) -> TrainingPair:
        frame, target, T = bone.frame, bone.target, made.T_target_source.copy()
        T[:3, 3] += made.metadata["origin_mm"]
        if made.protocol in OWN_TARGET:
            own = made.target + made.metadata["origin_mm"]
            frame = target_frame(own, model)
            target = build_cloud(own, frame, model).turned(bone.turn)
        return training_pair(build_cloud(made.source, frame, model), target, bone.turn @ T, frame)

    def _bone(self, number: int) -> PooledBone:
        if number not in self._pool:
            self._pool[number] = self._shared_bone(number)
        self._pool.move_to_end(number)
        while len(self._pool) > 2 * self.train.pool:
            self._pool.popitem(last=False)
        return self._pool[number]

    def _shared_bone(self, number: int) -> PooledBone:
        """Bone `number`, drawn by whichever worker needs it first."""
        if self.cache is None:
            return self._new_bone(number)
        path = self.cache / f"{number}.npz"
        if path.exists():
            return bone_cache.load(path)
        bone = self._new_bone(number)
        bone_cache.save(path, bone)
        return bone

    def _new_bone(self, number: int) -> PooledBone:
        people = self.people[number // LANES % len(self.people)]  # a row is of one kind
        specimen, subjects = people.draw_of(number, self.train.synthetic, self.train.seed)
        rng = np.random.default_rng([self.train.seed, 2, number])
        points, _ = specimen.sample(TARGET_POINTS, rng)
        model, turn = self._sizes(number), np.eye(4)
        frame = target_frame(points, model)
        if self.train.target_frame == "random":
            turn = se3.from_rotation_translation(se3.random_rotation(rng), np.zeros(3))
        target = build_cloud(points, frame, model).turned(turn)
        return PooledBone(specimen, points, frame, target, turn, subjects)


def check_mix(mix: Mapping[str, float]) -> None:
    """Raise `ConfigError` for a protocol that does not exist or has no true pose to learn from."""
    known = [name for name in PROTOCOLS if name not in WITH_OTHERS]
    unknown = [name for name in mix if name not in known]
    if unknown or not sum(mix.values()) > 0:
        given = ", ".join(unknown) or "shares that add up to 0"
        raise ConfigError(f"a mix of the protocols {', '.join(known)}", given, "correct `mix`")


def prune(folder: Path, train: TrainConfig, pairs: int) -> None:
    """Delete the cache's bones of pairs before number `pairs`."""
    bone_cache.prune(folder, LANES * _oldest_row(train, pairs))


def _oldest_row(train: TrainConfig, number: int) -> int:
    """Return the first row of `LANES` bones that pairs from `number` on may need."""
    return number // (train.reuse * LANES)


def one_thread(worker: int) -> None:
    """Workers share the machine with the training process: one thread each."""
    torch.set_num_threads(1)
