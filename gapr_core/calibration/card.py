"""The card of the models as a page: the data of the fit, and their quality on unseen data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gapr_core.calibration.pairs import SEEN_AS, SHAPE_SHARE, WHAT
from gapr_core.pages.markdown import table

Rows = Mapping[str, Mapping[str, Any]]
CONFIDENCE = {
    "pairs": "pairs", "right": "right", "auroc": "AUROC", "ece": "ECE", "wrong": "wrong at .5",
    "wrong_sure": "wrong at .9", "right_accepted": "right at .5", "right_sure": "right at .9",
}  # fmt: skip
PRECISION = {
    "accepted": "accepted", "covered": "covered", "bound_over_true": "tre95 / true", "true_over_tre": "true / tre",
    "nees_over_median": "NEES / 5.35", "nees_before": "before",
}  # fmt: skip


def as_markdown(cards: Mapping[str, Any], made: Mapping[str, Any]) -> str:
    """Write the page for all models of one run."""
    views = {name: share for of_family in SEEN_AS.values() for name, share in of_family.items()}
    parts = [
        "# Confidence and precision: card",
        f"Made by `{made['command']}` at commit {made['commit']}, seed {made['seed']}, {made['split']} subjects; "
        f"the pairs were registered by the code of {', '.join(made['commits_of_pairs'])}.",
        f"The families {' and '.join(made['held_out_families'])} are in no fit, only judged. "
        "New bones are drawn from shape models of all subjects, and the network learned from the same subjects: who is "
        "unseen here is unseen by the confidence.",
        f"How a bone is seen in the first list (`--count`): {_shares(views)}.",
        f"Whose bone it is there: {_shares(WHAT)}; {100 * SHAPE_SHARE:.0f} % are shapes without a knowable pose. "
        "Scenes, look-alikes and streams come on top; the tables count all.",
        "AUROC and ECE (10 equal-width bins) are of own bones; wrong and right count the answers that a confidence of "
        ".5 or .9 and the findings accept.",
    ]
    for name, card in cards.items():
        if name == "precision":
            parts += ["## Precision: subjects that were not fitted", _table(card["coverage"], PRECISION),
                      "## Precision: neither the subject nor the sensor family was fitted",
                      _table(card["coverage_unseen_families"], PRECISION)]  # fmt: skip
        else:
            parts += [f"## Answers of the kind {name}: subjects that were not fitted",
                      _table(card["unseen_subjects"], CONFIDENCE),
                      "By whose bone the source is of:", _table(card["unseen_subjects_by_what"], CONFIDENCE),
                      f"## Answers of the kind {name}: neither the subject nor the sensor family was fitted",
                      _table(card["unseen_families"], CONFIDENCE)]  # fmt: skip
    return "\n\n".join(parts) + "\n"


def _shares(weights: Mapping[str, float]) -> str:
    total = sum(weights.values())
    return ", ".join(f"{name} {100.0 * weight / total:.1f} %" for name, weight in weights.items())


def _table(rows: Rows, columns: Mapping[str, str]) -> str:
    cells = [[name, *(_cell(row[key]) for key in columns)] for name, row in rows.items()]
    return table(["", *columns.values()], cells)


def _cell(value: Any) -> str:
    return "" if value is None else f"{value:g}"
