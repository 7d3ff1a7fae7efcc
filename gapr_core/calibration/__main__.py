"""Fit the confidence and the error bound; one command makes the data, the models and their card.

    python -m gapr_core.calibration --anatomy DIR --out runs/calibration --jobs 2 --count 3000

Pairs are drawn on the fly from subjects of the train split; finished ones stay in `records.jsonl`, so a stopped run
goes on where it was. The fit itself is convex: the same records give the same models.
"""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.calibration import conformal, streams
from gapr_core.calibration.answers import Answers, answers_of, together
from gapr_core.calibration.card import as_markdown
from gapr_core.calibration.collect import collect
from gapr_core.calibration.fit import (
    ACCEPTED,
    Models,
    by_group,
    confidences,
    fit,
    known_families,
    of_own_bone,
    of_unseen_families,
    of_unseen_people,
)
from gapr_core.calibration.pairs import HELD_OUT, IN_A_ROW, Task, look_alikes, scenes
from gapr_core.data.anatomy import SPLITS
from gapr_core.errors import ConfigError
from gapr_core.registration.confidence import classifier
from gapr_core.registration.confidence.additive import FORMAT, as_dict
from gapr_core.registration.confidence.features import FEATURES_OF
from gapr_core.registration.uncertainty import error_calibration
from gapr_core.registration.uncertainty.error_calibration import PRECISION_FEATURES
from gapr_core.runtime import cluster, origin
from gapr_core.runtime.arguments import at_least_one
from gapr_core.runtime.console import exit_code, say
from gapr_core.runtime.files import write_json, write_text

Array = NDArray[np.float64]

SHARED = tuple(name for name in PRECISION_FEATURES if name != "log_tre")  # features of every kind


def main(arguments: Sequence[str] | None = None) -> int:
    """Collect, fit, judge and write."""
    given = sys.argv[1:] if arguments is None else arguments
    args = _parser().parse_args(given)
    tasks = _tasks(args)
    if not tasks:
        raise ConfigError("pairs, scenes or streams to collect", "none", "raise --count")
    records = collect(tasks, args.out / "records.jsonl", args.jobs, args.dask)
    commits = sorted({str(record.get("commit")) for record in records})
    made = {"commit": origin.commit(), "commits_of_pairs": commits,
            "command": " ".join(["python -m gapr_core.calibration", *given]),
            "seed": args.seed, "split": args.split, "held_out_families": list(HELD_OUT)}  # fmt: skip
    cards = write_models(records, args.out, made)
    write_text(args.out / "confidence.md", as_markdown(cards, made))
    say(f"{len(records)} pairs; models and confidence.md are in {args.out}")
    return 0


def _parser() -> ArgumentParser:
    parser = ArgumentParser(prog="python -m gapr_core.calibration", description=__doc__,
                            formatter_class=RawDescriptionHelpFormatter)  # fmt: skip
    parser.add_argument("--anatomy", required=True, type=Path, help="folder with the bones (docs/develop/anatomy.md)")
    parser.add_argument("--out", required=True, type=Path, help="folder for records, models and their card")
    parser.add_argument("--count", type=int, default=3000, help="pairs (default: %(default)s)")
    parser.add_argument(
        "--scenes", type=int, default=0, help="more pairs of each family of scenes (default: %(default)s)"
    )
    parser.add_argument("--look-alikes", type=int, default=0,
                        help="three times as many more pairs of subjects' bones, half of them against another "
                        "subject's: at L3, by all other families, thinned, a camera's (%(default)s)")  # fmt: skip
    parser.add_argument(
        "--streams", type=int, default=0, help="streams of frames, half of them of others (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the pairs (default: %(default)s)")
    parser.add_argument("--split", default="train", choices=[split for split in SPLITS if split != "test"],
                        help="subjects to learn from (default: %(default)s)")  # fmt: skip
    parser.add_argument("--jobs", type=at_least_one, default=2, help="processes (default: %(default)s)")
    parser.add_argument("--dask", metavar="ADDRESS", help=cluster.ARGUMENT)
    return parser


def _tasks(args: Namespace) -> list[Task]:
    """List the pairs that the options ask for, each list spread evenly: a stopped run holds some of each."""
    which = (str(args.anatomy), args.split, args.seed)
    lists = [
        [Task(*which, number) for number in range(args.count)],
        scenes(*which, args.scenes),
        look_alikes(*which, args.look_alikes),
        streams.tasks(*which, args.streams),
    ]
    placed = [(place // IN_A_ROW * IN_A_ROW / len(tasks), task) for tasks in lists for place, task in enumerate(tasks)]
    return [task for _, task in sorted(placed, key=lambda each: each[0])]


def write_models(records: Sequence[dict[str, Any]], folder: Path, made: dict[str, Any]) -> dict[str, Any]:
    """Fit and judge both numbers of each kind, and the precision; returns their cards by name."""
    models, cards, accepted = {}, {}, []
    for kind in FEATURES_OF:
        answers = answers_of(records, kind)
        if not len(answers):
            raise ConfigError(f"answers of the kind {kind!r}", "none", "collect more pairs and scenes")
        found = {"subjects": of_unseen_people(answers), "families": of_unseen_families(answers)}
        cards[kind] = {
            "pairs": len(answers),
            "right": int(answers.right.sum()),
            "unseen_subjects": by_group(answers, found["subjects"], answers.family),
            "unseen_subjects_by_what": by_group(answers, found["subjects"], answers.what),
            "unseen_families": by_group(answers, found["families"], answers.family),
        }
        models[kind] = fit(answers.of(known_families(answers)))
        confidence = confidences(found["subjects"])
        chosen = (confidence >= ACCEPTED) & ~answers.refused & of_own_bone(answers) & answers.right
        accepted.append((answers.of(chosen).with_features(tuple(SHARED)), confidence[chosen]))
    rho_pose, rho_bone = streams.correlations(records)
    pose, bone = ({kind: as_dict(getattr(each, name)) for kind, each in models.items()} for name in Models._fields)
    data = {"pose": pose, "bone": bone, "rho_pose": rho_pose, "rho_bone": rho_bone}
    _write(folder / classifier.SHIPPED.name, "confidence", data, made | cards)
    precision, cards["precision"] = fit_precision(accepted)
    _write(folder / error_calibration.SHIPPED.name, "precision", precision, made | cards["precision"])
    return cards


def fit_precision(kinds: Sequence[tuple[Answers, Array]]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Fit scale and bound factors to the accepted right answers of each kind; returns model and card.

    Raises:
        ConfigError: nothing is accepted.
    """
    answers, confidence = together([each for each, _ in kinds]), np.concatenate([each for _, each in kinds])
    if not len(answers):
        raise ConfigError("accepted answers with a truth", "none", "collect more pairs (--count)")
    known = known_families(answers)
    new_sensor = conformal.scales_of_unseen_families(answers, known)
    new_subject = conformal.scales_of_unseen_people(answers, known)
    scores = answers.true_mm / (new_subject * answers.tre95_mm)
    at, factors = conformal.factors(scores[known], confidence[known], answers.family[known])
    if not at:
        raise ConfigError(f"{conformal.FEWEST} accepted answers in a range of the confidence", "fewer", "raise --count")
    data = {**as_dict(conformal.fit_scale(answers.of(known))), "confidences": np.round(at, 4).tolist(),
            "factors": np.round(factors, 4).tolist()}  # fmt: skip
    factor = np.interp(confidence, at, factors)
    tables = {"coverage": new_subject, "coverage_unseen_families": new_sensor}
    rows = {name: conformal.coverage(answers, scale, factor) for name, scale in tables.items()}
    return data, {"accepted": len(answers), **rows}


def _write(path: Path, kind: str, data: dict[str, Any], card: dict[str, Any]) -> None:
    write_json(path, {"format": FORMAT, "kind": kind, **data, "card": card})


if __name__ == "__main__":
    raise SystemExit(exit_code(main, "python -m gapr_core.calibration"))
