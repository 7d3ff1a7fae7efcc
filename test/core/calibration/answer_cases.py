"""Answers of a made-up world: a small margin is wrong, and errors are as large as predicted times what a test says."""

import numpy as np

from gapr_core.calibration.answers import Answers
from gapr_core.registration.confidence.features import FEATURES


def made_answers(count=1500, seed=0, error_scale=1.0, people=40):
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(count, len(FEATURES)))
    margin = features[:, FEATURES.index("margin")]
    family = rng.choice(["pointer", "ultrasound", "laser"], count)
    tre_mm = np.exp(rng.normal(size=count))
    scale = error_scale(features, family) if callable(error_scale) else np.full(count, error_scale)
    errors = rng.normal(size=(count, 6))
    weights = np.array([0.6, 0.3, 0.1, 0.0, 0.0, 0.0])
    return Answers(
        FEATURES,
        rounds=np.full(count, "search"),
        names=np.array([f"0-{i}" for i in range(count)]),
        features=features,
        right=margin + 0.3 * rng.normal(size=count) > 0.0,
        refused=np.zeros(count, dtype=bool),
        family=family,
        seen_as=family,
        what=np.full(count, "own"),
        bone=np.full(count, "femur"),
        people=tuple((f"p{i % people}", f"p{(i * 7) % people}") for i in range(count)),
        true_mm=tre_mm * scale * np.sqrt(errors**2 @ weights),
        tre_mm=tre_mm,
        tre95_mm=1.79 * tre_mm,  # 95 % quantile of these weights' chi squares, by simulation
        nees=scale**2 * (errors**2).sum(axis=1),
    )
