"""Answers of one kind as columns, and folds by subject and by sensor family."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from gapr_core.calibration.pairs import first_of_twins
from gapr_core.errors import ConfigError
from gapr_core.registration.confidence.features import BONE, FEATURES_OF, SCENE

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Model = TypeVar("Model")
STREAM = "stream"
FOLDS = 6
NO_TRUTH = {
    "rte_mm": np.nan,
    "rre_deg": np.nan,
    "nees": np.nan,
    "true_mm": np.nan,
    "tre_mm": np.nan,
    "tre95_mm": np.nan,
}


@dataclass(frozen=True, eq=False)
class Answers:
    """Answers of one kind, N of them.

    Attributes:
        feature_names: names of the F features.
        names: (N,) names of the pairs.
        rounds: (N,) round of the answer: network, search, track or scene.
        features: (N, F) features.
        right: (N,) mask of poses within 4 mm and 5 deg.
        refused: (N,) mask of poses that a finding refuses.
        family, seen_as, what, bone: (N,) sensor family, view, owner of the source's bone, bone.
        people: N tuples of all subjects whose bones the points are of, the target's first.
        true_mm, tre_mm, tre95_mm: (N,) true error over the whole bone, predicted error and its bound; NaN where no
            pose is right.
        nees: (N,) normalised error squared of the pose.
    """

    feature_names: tuple[str, ...]
    names: NDArray[np.str_]
    rounds: NDArray[np.str_]
    features: Array
    right: Mask
    refused: Mask
    family: NDArray[np.str_]
    seen_as: NDArray[np.str_]
    what: NDArray[np.str_]
    bone: NDArray[np.str_]
    people: tuple[tuple[str, ...], ...]
    true_mm: Array
    tre_mm: Array
    tre95_mm: Array
    nees: Array

    def __len__(self) -> int:
        return len(self.names)

    def of(self, chosen: Mask) -> Answers:
        """Choose answers by a mask (N,)."""
        columns: dict[str, Any] = {
            name: value[chosen] for name, value in vars(self).items() if isinstance(value, np.ndarray)
        }
        return replace(self, **columns, people=tuple(p for p, is_in in zip(self.people, chosen, strict=True) if is_in))

    def with_features(self, names: tuple[str, ...]) -> Answers:
        """Choose features."""
        chosen = [self.feature_names.index(name) for name in names]
        return replace(self, feature_names=names, features=self.features[:, chosen])

    def people_folds(self) -> Iterator[tuple[Mask, Mask]]:
        """Yield (fitted on, judged) masks (N,): no subject of a judged target is in any pair of the fit."""
        people = [tuple(map(first_of_twins, group)) for group in self.people]
        everybody = sorted({person for group in people for person in group})
        drawn = np.random.default_rng(0).permutation(len(everybody)) % FOLDS
        fold_of = dict(zip(everybody, drawn, strict=True))
        own = np.array([fold_of[group[0]] for group in people])
        for number in range(FOLDS):
            is_in = np.array([any(fold_of[person] == number for person in group) for group in people])
            yield ~is_in, own == number


def answers_of(records: Sequence[dict[str, Any]], kind: str) -> Answers:
    """Collect the answers of one kind: a key of `FEATURES_OF`; a record has several, one for each round."""
    found = [(record, round_of(name), NO_TRUTH | answer) for record in records
             for name, answer in record["answers"].items() if kind_of(name) == kind]  # fmt: skip
    columns: dict[str, Any] = {
        key: np.array([record[key if key != "names" else "name"] for record, _, _ in found], dtype=str)
        for key in ("names", "family", "seen_as", "what", "bone")
    }
    columns |= {key: np.array([answer[key] for _, _, answer in found], dtype=float)
                for key in ("true_mm", "tre_mm", "tre95_mm", "nees")}  # fmt: skip
    names = FEATURES_OF[kind]
    features = [[answer["features"][name] for name in names] for _, _, answer in found]
    return Answers(
        names,
        rounds=np.array([name for _, name, _ in found], dtype=str),
        features=np.array(features, dtype=float).reshape(len(found), len(names)),
        right=np.array([answer["right"] for _, _, answer in found], dtype=bool),
        refused=np.array([answer["refusal"] is not None for _, _, answer in found], dtype=bool),
        people=tuple(tuple(record["people"]) or (record["name"],) for record, _, _ in found),
        **columns,
    )


def round_of(name: str) -> str:
    """Name the round of an answer, such as scene of "scene 1"."""
    return name.split()[0]


def kind_of(name: str) -> str:
    """Name the kind of an answer of this name: a key of `FEATURES_OF`; streams are no kind of their own."""
    found = round_of(name)
    return {"scene": SCENE, STREAM: STREAM}.get(found, BONE)


def together(groups: Sequence[Answers]) -> Answers:
    """Join answers that have the same features."""
    first = groups[0]
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(group, name) for group in groups])
        for name, value in vars(first).items()
        if isinstance(value, np.ndarray)
    }
    return replace(first, **columns, people=tuple(people for group in groups for people in group.people))


def of_models_that_saw_no_subject(
    answers: Answers, known: Mask, fit: Callable[[Answers], Model], predict: Callable[[Model, Answers], Array]
) -> Array:
    """Predict (N, ...) by models fitted to the known answers (N,) without the pair's subject."""
    return _predicted(answers, [(judged, fitted & known) for fitted, judged in answers.people_folds()], fit, predict)


def of_models_that_saw_neither(
    answers: Answers, known: Mask, fit: Callable[[Answers], Model], predict: Callable[[Model, Answers], Array]
) -> Array:
    """Predict (N, ...) by models of the known answers (N,) without the pair's subject and its sensor family."""
    folds = []
    for family in np.unique(answers.family):
        of_it: Mask = answers.family == family
        folds += [(judged & of_it, fitted & known & ~of_it) for fitted, judged in answers.people_folds()]
    return _predicted(answers, folds, fit, predict)


def _predicted(
    answers: Answers,
    folds: Sequence[tuple[Mask, Mask]],
    fit: Callable[[Answers], Model],
    predict: Callable[[Model, Answers], Array],
) -> Array:
    """Predict (N, ...) the judged answers of each fold by a model of its fitted ones."""
    predictions: list[tuple[Mask, Array]] = []
    for judged, fitted in folds:
        if judged.any():
            predictions.append((judged, predict(fit(_enough(answers.of(fitted))), answers.of(judged))))
    result = np.full((len(answers), *predictions[0][1].shape[1:]), np.nan)
    for judged, values in predictions:
        result[judged] = values
    return result


def _enough(answers: Answers) -> Answers:
    """Return the answers for a fit, if there are any.

    Raises:
        ConfigError: none is of other subjects and other sensors than the judged ones.
    """
    if not len(answers):
        raise ConfigError("answers of other subjects and sensors to fit to", "none", "collect more pairs (--count)")
    return answers
