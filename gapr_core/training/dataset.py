"""Training pairs made on the fly, each a pure function of the run's settings and its number."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset

from gapr_core.data import anatomy, parametric
from gapr_core.data.pool import parametric_people, parametric_specimen
from gapr_core.data.protocols import Pair, make_pair
from gapr_core.data.specimen import Specimen
from gapr_core.errors import ConfigError
from gapr_core.geometry import se3
from gapr_core.model.config import ModelConfig
from gapr_core.model.pyramid import FEWEST_POINTS, Frame, build_cloud, target_frame
from gapr_core.model.types import Cloud
from gapr_core.training.config import TrainConfig
from gapr_core.training.shapes import ShapeModel, vary
from gapr_core.training.targets import TrainingPair, join, training_pair

Array = NDArray[np.float64]
OWN_TARGET = ("incomplete",)  # protocols whose target is not the whole bone


class People:
    """Bones of one type: subjects of the split, and new ones from their shape model; parametric where there is none."""

    def __init__(self, bone: str, folder: Path | None, split: str) -> None:
        self.bone, self.split = bone, split
        self.real = anatomy.surfaces(folder, bone, split) if folder else []
        known = anatomy.corresponded(folder, bone) if folder else []
        sets = [c.of({s.person for s in self.real}) for c in known]
        self.models = [ShapeModel.of(c) for c in sets if len(c.points) > 2]
        if not self.real and bone not in parametric.BONES:
            raise ConfigError(f"meshes or a parametric model of {bone}", "neither", "leave it out of `bones`")

    def draw(self, number: int, synthetic: float, seed: int) -> Specimen:
        """Subject `number`: always the same one."""
        rng = np.random.default_rng([seed, number])
        if not self.real:
            people = parametric_people(self.split, 2000)
            return parametric_specimen(self.bone, people[int(rng.integers(len(people)))])
        if self.models and rng.random() < synthetic:
            surface = self.models[int(rng.integers(len(self.models)))].draw(rng)
        else:
            surface = self.real[int(rng.integers(len(self.real)))].surface
        return Specimen(vary(surface, rng), self.bone, f"drawn_{number}", "drawn")


@dataclass
class PooledBone:
    """A bone in use: its target's pyramid in a frame of its own, which `turn` (4, 4) takes it to from the scan's."""

    specimen: Specimen
    frame: Frame
    target: Cloud
    turn: Array


class TrainingPairs(Dataset[TrainingPair]):
    """Micro-batches by number. Bones come and go as the numbers rise; a worker keeps those in use."""

    def __init__(self, train: TrainConfig, model: ModelConfig, folder: Path | None, split: str = "train") -> None:
        self.train, self.model = train, model
        self.people = [People(bone, folder, split) for bone in available(train.bones, folder)]
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
        """Pair `number`; the rare one with too few points or overlap gives way to a later draw of the same number."""
        rng = np.random.default_rng([self.train.seed, 1, number])
        for _ in range(20):
            bone = self._bone(self._bone_number(number))
            made = make_pair(str(rng.choice(self.protocols, p=self.weights)), bone.specimen, int(rng.integers(2**31)))
            found = self._prepare(made, bone) if len(made.source) >= FEWEST_POINTS else None
            if found is not None and bool((found.overlaps > 0.1).any()):
                return found
        raise RuntimeError(f"no usable pair under number {number}")

    def _bone_number(self, number: int) -> int:
        """Neighbouring pairs share a bone, and so its features."""
        rng = np.random.default_rng([self.train.seed, 3, number // self.train.share])
        return number // self.train.reuse + int(rng.integers(self.train.pool))

    def _prepare(self, made: Pair, bone: PooledBone) -> TrainingPair:
        frame, target, T = bone.frame, bone.target, made.T_target_source.copy()
        T[:3, 3] += made.metadata["origin_mm"]
        if made.protocol in OWN_TARGET:
            own = made.target + made.metadata["origin_mm"]
            frame = target_frame(own, self.model)
            target = build_cloud(own, frame, self.model).turned(bone.turn)
        return training_pair(build_cloud(made.source, frame, self.model), target, bone.turn @ T, frame)

    def _bone(self, number: int) -> PooledBone:
        if number not in self._pool:
            people = self.people[number % len(self.people)]
            specimen = people.draw(number, self.train.synthetic, self.train.seed)
            rng = np.random.default_rng([self.train.seed, 2, number])
            points, _ = specimen.sample(8192, rng)
            frame = target_frame(points, self.model)
            turn = se3.from_rotation_translation(se3.random_rotation(rng), np.zeros(3))
            self._pool[number] = PooledBone(specimen, frame, build_cloud(points, frame, self.model).turned(turn), turn)
        self._pool.move_to_end(number)
        while len(self._pool) > 2 * self.train.pool:
            self._pool.popitem(last=False)
        return self._pool[number]


def available(bones: tuple[str, ...], folder: Path | None) -> list[str]:
    """The bones that there are meshes or a parametric model of."""
    return [b for b in bones if b in parametric.BONES or (folder and anatomy.surfaces(folder, b))]


def one_thread(worker: int) -> None:
    """Workers share the machine with the training process: one thread each."""
    torch.set_num_threads(1)
