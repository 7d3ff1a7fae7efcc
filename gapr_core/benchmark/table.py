"""Records to rows: one per protocol, bone and method, with `all` for the sum over bones and over protocols."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.stats import chi2

from gapr_core import metrics
from gapr_core.benchmark.record import ERROR, Record
from gapr_core.metrics.confidence import SURE

Row = dict[str, Any]
ALL = "all"
TIMES = ("seconds", "seconds_p90", "prepare_seconds")  # what may differ between two runs of one command
RECALLS = {
    "rr_paper": "within_paper", "rr_extent": "within_extent", "rr_1_1": "within_1_1", "rr_2_2": "within_2_2",
    "rr_4_5": "within_4_5",
}  # fmt: skip


def rows(records: Sequence[Record], methods: Sequence[str]) -> list[Row]:
    """Make the table, grouped by protocol, then bone (`all` last), then the methods in the order given."""
    protocols = sorted({r.protocol for r in records})
    table = []
    for protocol in [*protocols, ALL] if len(protocols) > 1 else protocols:
        of_protocol = [r for r in records if protocol in (ALL, r.protocol)]
        for bone in _bones(of_protocol):
            of_bone = [r for r in of_protocol if bone in (ALL, r.bone)]
            for method in methods:
                chosen = [r for r in of_bone if r.method == method]
                if chosen:
                    table.append({"protocol": protocol, "bone": bone, "method": method, **summary(chosen)})
    return table


def differences(records: Sequence[Record], methods: Sequence[str], ours: str) -> list[Row]:
    """Compare ours with each other method on the same pairs: one difference of recalls per protocol and method.

    Pairs that are hard for both cancel out. A refusal is not right; pairs without a truth are left out.

    Returns:
        Rows with `protocol`, `method`, `pairs` that both have, and the counts right for `ours_alone` and `other_alone`.
        `difference` is that of the recall at 4 mm and 5 deg, -1 to 1, with its 95 % bootstrap interval by subject,
        None where all subjects agree.
    """
    judged = [r for r in records if r.has_truth]
    own, found = {r.pair: r for r in judged if r.method == ours}, []
    protocols = sorted({r.protocol for r in own.values()})
    for protocol in [*protocols, ALL] if len(protocols) > 1 else protocols:
        for method in (m for m in methods if m != ours):
            both = [(own[r.pair], r) for r in judged
                    if r.method == method and r.pair in own and protocol in (ALL, r.protocol)]  # fmt: skip
            if both:
                found.append({"protocol": protocol, "method": method, **_difference(both)})
    return found


def _difference(both: Sequence[tuple[Record, Record]]) -> Row:
    """Compare the pairs that ours and another method have judged."""
    more = [int(own.within_4_5) - int(other.within_4_5) for own, other in both]
    low, high = metrics.interval(more, people([own for own, _ in both]))
    counts = {"pairs": len(more), "ours_alone": more.count(1), "other_alone": more.count(-1)}
    ends = {"difference_low": _rounded(low), "difference_high": _rounded(high)}
    return counts | {"difference": _rounded(np.mean(more))} | ends


def summary(records: Sequence[Record]) -> Row:
    """Compute every number of one group; None without a truth, a covariance or two kinds of answers."""
    row: Row = {"pairs": len(records), "persons": len({r.person for r in records} - {""})}
    row |= _answers(records) | _accuracy([r for r in records if r.has_truth])
    row |= _calibration(records) | _uncertainty([r for r in records if r.right]) | _times(records)
    row |= _precision([r for r in records if r.accepted and r.has_truth])
    return {key: _rounded(value) for key, value in row.items()}


def people(records: Sequence[Record]) -> list[str] | None:
    """List the subject of each pair for the bootstrap; None unless it is known of all."""
    named = [r.person for r in records]
    return named if all(named) else None


def _bones(records: Sequence[Record]) -> list[str]:
    bones = sorted({r.bone for r in records})
    return [*bones, ALL] if len(bones) > 1 else bones


def _answers(records: Sequence[Record]) -> Row:
    accepted, wrong = [r.accepted for r in records], [r.false_accept for r in records]
    sure = [r.false_accept and r.confidence >= SURE for r in records]
    low, high = metrics.share_interval(wrong, people(records))
    return {
        "accepted": sum(accepted), "refused": len(records) - sum(accepted), "refused_rate": 1.0 - np.mean(accepted),
        "errors": sum(r.status == ERROR for r in records), "false_accepts": sum(wrong),
        "false_accepts_sure": sum(sure), "false_accept_rate": np.mean(wrong), "false_accept_rate_low": low,
        "false_accept_rate_high": high,
    }  # fmt: skip


def _accuracy(records: Sequence[Record]) -> Row:
    """Over ALL pairs that have a truth: refusals are no success, and count with their stand-in pose in the errors."""
    row: Row = {"pairs_with_truth": len(records)}
    for name, key in RECALLS.items():
        hits = [getattr(r, key) for r in records]
        row[name] = metrics.recall(hits)
        row[f"{name}_low"], row[f"{name}_high"] = metrics.share_interval(hits, people(records))
    rmse = _values(records, "rmse_mm")
    judged, true = _values(records, "judged"), _values(records, "true")
    return row | {
        "rmse_mm": _of(np.mean, rmse), "rmse_median_mm": _of(np.median, rmse),
        "chamfer_mm": _of(np.mean, _values(records, "chamfer_mm")),
        "r2_rotation": metrics.r2_rotation(judged, true) if records else None,
        "r2_translation": metrics.r2_translation(judged, true) if records else None,
        "rte_median_mm": _of(np.median, _values(records, "rte_mm")),
        "rre_median_deg": _of(np.median, _values(records, "rre_deg")),
        "whole_bone_median_mm": _of(np.median, _values(records, "whole_bone_mm")),
        "tre_worst_median_mm": _of(np.median, [max(r.tre_mm.values()) for r in records if r.tre_mm]),
    }  # fmt: skip


def _calibration(records: Sequence[Record]) -> Row:
    known = [r for r in records if r.best_right is not None]
    confidence, right = _values(known, "confidence"), [bool(r.best_right) for r in known]
    return {
        "auroc": metrics.auroc(confidence, right) if known else None,
        "ece": metrics.expected_calibration_error(confidence, right) if known else None,
    }  # fmt: skip


def _uncertainty(right: Sequence[Record]) -> Row:
    """Summarise right answers alone: a wrong basin has no meaningful covariance and no distance to the bound."""
    nees, ratio = _values(right, "nees"), _values(right, "bound_ratio")
    return {
        "nees_6": _of(np.mean, nees / 6.0), "nees_6_median": _of(np.median, nees / 6.0),
        "bound_rmse_mm": _of(np.median, _values(right, "bound_rmse_mm")),
        "bound_ratio": _of(lambda r: np.sqrt(np.mean(r**2)), ratio), "bound_ratio_median": _of(np.median, ratio),
    }  # fmt: skip


def _precision(accepted: Sequence[Record]) -> Row:
    """Summarise all accepted answers, right or wrong: whoever uses a pose has its `tre95_mm` and not the truth."""
    bounded = [r for r in accepted if r.predicted_tre95_mm is not None and r.whole_bone_mm is not None]
    bound, true = _values(bounded, "predicted_tre95_mm"), _values(bounded, "whole_bone_mm")
    return {
        "tre95_covers": _of(np.mean, true <= bound), "tre95_ratio": _of(np.median, bound / np.maximum(true, 1e-9)),
        "nees_median": _of(np.median, _values(accepted, "nees") / chi2.median(6)),
    }  # fmt: skip


def _times(records: Sequence[Record]) -> Row:
    seconds = _values(records, "seconds")
    return {
        "seconds": _of(np.median, seconds), "seconds_p90": _of(lambda s: np.percentile(s, 90), seconds),
        "prepare_seconds": _of(np.median, _values(records, "prepare_seconds")),
    }  # fmt: skip


def _values(records: Sequence[Record], key: str) -> np.ndarray:
    return np.array([value for r in records if (value := getattr(r, key)) is not None], dtype=np.float64)


def _of(statistic: Callable[[Any], Any], values: Any) -> float | None:
    return float(statistic(values)) if len(values) else None


def _rounded(value: Any) -> Any:
    """Six significant digits, so that summation order cannot show; None for NaN."""
    if isinstance(value, float | np.floating):
        return None if not np.isfinite(value) else float(f"{value:.6g}")
    return value
