"""Answers of a made-up world: a small margin is wrong, and errors are as large as predicted times what a test says."""

import numpy as np

from gapr_core.calibration.answers import Answers
from gapr_core.registration.confidence.features import BONE, FEATURES_OF

MARGIN = {"bone": "margin", "scene": "rival_margin"}
OTHERS_MISFIT = 2.0  # by how many deviations the smooth misfit of other subjects' bones is larger


def made_answers(count=1500, seed=0, error_scale=1.0, people=40, kind=BONE, others=0.0):
    """`others`: the share that is of other subjects' bones."""
    rng, names = np.random.default_rng(seed), FEATURES_OF[kind]
    features = rng.normal(size=(count, len(names)))
    is_other = np.arange(count) < others * count
    features[is_other, names.index("smooth_misfit")] += OTHERS_MISFIT
    margin = features[:, names.index(MARGIN[kind])]
    family = rng.choice(["pointer", "ultrasound", "laser"], count)
    tre_mm = np.exp(rng.normal(size=count))
    scale = error_scale(features, family) if callable(error_scale) else np.full(count, error_scale)
    errors = rng.normal(size=(count, 6))
    weights = np.array([0.6, 0.3, 0.1, 0.0, 0.0, 0.0])
    return Answers(
        names,
        rounds=np.full(count, "search" if kind == BONE else kind),
        names=np.array([f"0-{i}" for i in range(count)]),
        features=features,
        right=(margin + 0.3 * rng.normal(size=count) > 0.0) & ~is_other,
        refused=np.zeros(count, dtype=bool),
        family=family,
        seen_as=family,
        what=np.where(is_other, "person", "own"),
        bone=np.full(count, "femur"),
        people=tuple((f"p{i % people}", f"p{(i * 7) % people}") for i in range(count)),
        true_mm=np.where(is_other, np.nan, tre_mm * scale * np.sqrt(errors**2 @ weights)),
        tre_mm=tre_mm,
        tre95_mm=1.79 * tre_mm,  # 95 % quantile of these weights' chi squares, by simulation
        nees=scale**2 * (errors**2).sum(axis=1),
    )


def records_of(answers):
    """As `collect` keeps them."""
    return [
        {"name": str(answers.names[k]), "family": str(answers.family[k]), "seen_as": "L2", "what": str(answers.what[k]),
         "bone": "femur", "people": list(answers.people[k]), "answers": {str(answers.rounds[k]): {
             "features": dict(zip(answers.feature_names, answers.features[k].tolist(), strict=True)),
             "refusal": "equal rival" if answers.refused[k] else None,
             "right": bool(answers.right[k]), "true_mm": answers.true_mm[k], "tre_mm": answers.tre_mm[k],
             "tre95_mm": answers.tre95_mm[k], "nees": answers.nees[k]}}}
        for k in range(len(answers))
    ]  # fmt: skip
