"""The records of one round as columns, and who may be judged by whom."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from gapr_core.calibration.pairs import first_of_twins
from gapr_core.errors import ConfigError
from gapr_core.registration.confidence.features import FEATURES_OF

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Model = TypeVar("Model")
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
    """What one round answered, N pairs.

    Attributes:
        feature_names: F names.
        names: (N,) of the pairs.
        rounds: (N,) which round answered: keys of `FEATURES_OF`.
        features: (N, F).
        right: (N,) within 4 mm and 5 deg.
        refused: (N,) a rule speaks against the pose, whatever the probability.
        family, seen_as, what, bone: (N,) how and what was seen.
        people: N tuples, everybody whose bone the points are of, the target's first.
        true_mm, tre_mm, tre95_mm: (N,) true error over the whole bone, the predicted one and its bound; NaN where no
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
        """Only the chosen ones."""
        columns: dict[str, Any] = {
            name: value[chosen] for name, value in vars(self).items() if isinstance(value, np.ndarray)
        }
        return replace(self, **columns, people=tuple(p for p, is_in in zip(self.people, chosen, strict=True) if is_in))

    def with_features(self, names: tuple[str, ...]) -> Answers:
        """Only these features."""
        chosen = [self.feature_names.index(name) for name in names]
        return replace(self, feature_names=names, features=self.features[:, chosen])

    def people_folds(self) -> Iterator[tuple[Mask, Mask]]:
        """(fitted on, judged) masks (N,): nobody of a judged target is in any pair that the model is fitted on."""
        people = [tuple(map(first_of_twins, group)) for group in self.people]
        everybody = sorted({person for group in people for person in group})
        drawn = np.random.default_rng(0).permutation(len(everybody)) % FOLDS
        fold_of = dict(zip(everybody, drawn, strict=True))
        own = np.array([fold_of[group[0]] for group in people])
        for number in range(FOLDS):
            is_in = np.array([any(fold_of[person] == number for person in group) for group in people])
            yield ~is_in, own == number


def answers_of(records: Sequence[dict[str, Any]], round_name: str) -> Answers:
    """The answers of one round: a key of `FEATURES_OF`; a record has several of "stream", one for each frame."""
    found = [(record, NO_TRUTH | answer) for record in records
             for name, answer in record["answers"].items() if round_of(name) == round_name]  # fmt: skip
    columns: dict[str, Any] = {
        key: np.array([record[key if key != "names" else "name"] for record, _ in found], dtype=str)
        for key in ("names", "family", "seen_as", "what", "bone")
    }
    columns |= {key: np.array([answer[key] for _, answer in found], dtype=float)
                for key in ("true_mm", "tre_mm", "tre95_mm", "nees")}  # fmt: skip
    names = FEATURES_OF[round_name]
    features = [[answer["features"][name] for name in names] for _, answer in found]
    return Answers(
        names,
        rounds=np.full(len(found), round_name),
        features=np.array(features, dtype=float).reshape(len(found), len(names)),
        right=np.array([answer["right"] for _, answer in found], dtype=bool),
        refused=np.array([answer["refusal"] is not None for _, answer in found], dtype=bool),
        people=tuple(tuple(record["people"]) or (record["name"],) for record, _ in found),
        **columns,
    )


def round_of(name: str) -> str:
    """Of "stream 7": which round answered."""
    return name.split()[0]


def together(groups: Sequence[Answers]) -> Answers:
    """The answers of several rounds, which have the same features."""
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
    """(N,) predictions, each by a model that was fitted to the known answers (N,) without the pair's subject."""
    found = np.full(len(answers), np.nan)
    for fitted, judged in answers.people_folds():
        if judged.any():
            found[judged] = predict(fit(_enough(answers.of(fitted & known))), answers.of(judged))
    return found


def of_models_that_saw_neither(
    answers: Answers, known: Mask, fit: Callable[[Answers], Model], predict: Callable[[Model, Answers], Array]
) -> Array:
    """(N,) predictions, each by a model of the known answers (N,) without the pair's subject and its sensor family."""
    found = np.full(len(answers), np.nan)
    for family in np.unique(answers.family):
        of_it: Mask = answers.family == family
        for fitted, judged in answers.people_folds():
            if (judged & of_it).any():
                others = _enough(answers.of(fitted & known & ~of_it))
                found[judged & of_it] = predict(fit(others), answers.of(judged & of_it))
    return found


def _enough(answers: Answers) -> Answers:
    """The answers that a model is fitted to, if there are any.

    Raises:
        ConfigError: none is of other subjects and other sensors than those that are judged.
    """
    if not len(answers):
        raise ConfigError("answers of other subjects and sensors to fit to", "none", "collect more pairs (--count)")
    return answers
