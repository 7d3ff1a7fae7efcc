"""Can the confidence, the bound and the covariance be believed, over a mix of pairs?

    python benchmarks/trust.py OUT [OUT ...] [--method gapr]

OUT are output folders of `gapr benchmark`; all their records together are the mix, so that the caller decides how much
there is of what. Three tables: of the confidence, which judges the best pose of every pair, refused or not; of
`tre95_mm`, the bound of the error, and of the normalised error squared (NEES; 5.35 is the median of chi square with six
degrees of freedom), which both judge every accepted answer to a pair that has a true pose.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from gapr_core import metrics
from gapr_core.benchmark import records
from gapr_core.benchmark.record import Record
from gapr_core.benchmark.table import ALL, people, summary
from gapr_core.errors import ConfigError
from gapr_core.pages import markdown
from gapr_core.runtime.console import say

Groups = dict[str, list[Record]]


def main() -> int:
    """Print one table for each question."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, metavar="OUT", help="output folder of gapr benchmark")
    parser.add_argument("--method", default="gapr", help="whose answers")
    args = parser.parse_args()
    mix = read(args.folders, args.method)
    groups = by_family(mix)
    say("\n\n".join((of_confidence(groups), of_bound(groups), of_covariance(groups))))
    return 0


def read(folders: Sequence[Path], method: str) -> list[Record]:
    """All records of a method, one for each pair.

    Raises:
        ConfigError: a folder without any.
    """
    mix: list[Record] = []
    for folder in tqdm(folders, "folders", disable=None):
        found = records.sort((r for r in records.read(folder / records.FILE) if r.method == method), [method])
        if not found:
            raise ConfigError(f"records of {method}", f"none in {folder}", "name an output folder of gapr benchmark")
        mix += found
    return mix


def by_family(mix: Sequence[Record]) -> Groups:
    """The records of each protocol, and of each setting that was not the default; those of all last."""
    groups: Groups = {}
    for record in mix:
        groups.setdefault(f"{record.protocol}, {record.settings}".removesuffix(", "), []).append(record)
    return dict(sorted(groups.items())) | {ALL: list(mix)}


def of_confidence(groups: Groups) -> str:
    """Does it rank right above wrong, is it a probability, and how many wrong poses are accepted?"""
    head = ("family", "pairs", "best pose right", "AUROC", "ECE", "right and accepted", "wrong and accepted",
            "of these at >= 0.9")  # fmt: skip
    lines = []
    for name, found in groups.items():
        row = summary(found)
        best, right = (sum(map(bool, which)) for which in ([r.best_right for r in found], [r.right for r in found]))
        counts = (right, row["false_accepts"], row["false_accepts_sure"])
        lines.append((name, len(found), best, shown(row["auroc"], 4), shown(row["ece"], 4), *counts))
    return markdown.table(head, lines)


def of_bound(groups: Groups) -> str:
    """Does the true error stay below `tre95_mm`, and how much larger is the bound?"""
    head = ("family", "accepted, with a true pose", "true error below `tre95_mm`", "% (95 % interval by subject)",
            "`tre95_mm` / error, median")  # fmt: skip
    lines = []
    for name, accepted in with_truth(groups):
        below = [
            r.predicted_tre95_mm is not None and (r.whole_bone_mm or 0.0) <= r.predicted_tre95_mm for r in accepted
        ]
        low, high = (100.0 * end for end in metrics.share_interval(below, people(accepted)))
        share = f"{100.0 * sum(below) / len(below):.1f} ({low:.1f} to {high:.1f})"
        lines.append((name, len(accepted), sum(below), share, shown(summary(accepted)["tre95_ratio"], 2)))
    return markdown.table(head, lines)


def of_covariance(groups: Groups) -> str:
    """Is the error as large as the covariance says?"""
    rows = [(name, len(accepted), shown(summary(accepted)["nees_median"], 2)) for name, accepted in with_truth(groups)]
    return markdown.table(("family", "accepted, with a true pose", "median NEES / 5.35"), rows)


def with_truth(groups: Groups) -> list[tuple[str, list[Record]]]:
    """The accepted answers that can be measured, of the groups that have some."""
    accepted = [(name, [r for r in found if r.accepted and r.has_truth]) for name, found in groups.items()]
    return [(name, found) for name, found in accepted if found]


def shown(value: float | None, digits: int) -> str:
    """A number, or a dash where there is nothing to say."""
    return "-" if value is None else f"{value:.{digits}f}"


if __name__ == "__main__":
    raise SystemExit(main())
