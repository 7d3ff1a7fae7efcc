"""A lopsided bone of a few hundred points and a small network, as fixtures."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from gapr_core.geometry import se3
from gapr_core.model.config import ModelConfig
from gapr_core.model.pyramid import build_cloud, target_frame
from gapr_core.training.targets import training_pair

torch.set_num_threads(1)
SMALL = dict(
    width=16,
    global_width=32,
    superpoints=(14, 26),
    neighbors=(10, 10, 10, 10),
    pair_width=16,
    patch_size=32,
    train_pairs=12,
    test_pairs=24,
    sinkhorn_iterations=12,
    reposition_top=16,
    voxel_growth=1.6,
    fine_stage=0,
)


def small_config(**changes) -> ModelConfig:
    return replace(ModelConfig(), **{**SMALL, **changes})


@cache
def bone(count: int = 500, seed: int = 0) -> np.ndarray:
    """A lopsided blob, mm: no symmetry, 200 mm long."""
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    bump = (
        1.0
        + 0.35 * np.exp(-6 * ((d - [0.6, 0.6, 0.5]) ** 2).sum(1))
        + 0.25 * np.exp(-8 * ((d - [-0.9, 0.1, 0.4]) ** 2).sum(1))
    )
    points = d * bump[:, None] * [100.0, 45.0, 30.0]
    return points + np.stack([0.002 * points[:, 1] ** 2, 0.1 * points[:, 0] * (points[:, 0] > 0), 0 * points[:, 0]], 1)


def view(points: np.ndarray, share: float = 0.5) -> np.ndarray:
    """The part of the bone around its first point."""
    distance = np.linalg.norm(points - points[0], axis=1)
    return points[distance <= np.quantile(distance, share)]


def motion(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return se3.from_rotation_translation(se3.random_rotation(rng), rng.uniform(-80, 80, 3))


def pair(config, seed: int = 3, share: float = 0.5):
    """A view of the bone, moved, and the bone, as a network learns from them."""
    frame = target_frame(bone(), config)
    source = build_cloud(se3.apply(motion(seed), view(bone(700, 1), share)), frame, config)
    return training_pair(source, build_cloud(bone(), frame, config), se3.inverse(motion(seed)), frame)


@pytest.fixture(scope="session")
def toy() -> SimpleNamespace:
    """The functions above."""
    return SimpleNamespace(bone=bone, view=view, motion=motion, small_config=small_config, pair=pair)


@pytest.fixture(scope="session")
def config() -> ModelConfig:
    return small_config()


@pytest.fixture(scope="session")
def clouds(config):
    """Source and target of one pair, and their frame."""
    frame = target_frame(bone(), config)
    source = build_cloud(se3.apply(motion(3), view(bone(700, 1))), frame, config)
    return source, build_cloud(bone(), frame, config), frame
