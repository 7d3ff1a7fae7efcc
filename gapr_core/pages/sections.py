"""The printed tables: columns, headings, the paper's numbers below ours, and where another method is better."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from gapr_core.benchmark.table import ALL, Row
from gapr_core.pages import paper_numbers


class Column(NamedTuple):
    """One column of a printed table."""

    title: str
    text: Callable[[Row], str]
    key: str = ""
    better: int = 0  # 1: higher is better, -1: lower, 0: no ranking


class Section(NamedTuple):
    """A heading with a table; `best` marks the cells to print bold."""

    title: str
    header: list[str]
    cells: list[list[str]]
    best: set[tuple[int, int]]


def number(key: str, digits: int) -> Callable[[Row], str]:
    """Prints a number; a dash where there is none."""
    return lambda row: "–" if row.get(key) is None else f"{row[key]:.{digits}f}"


def percent(key: str, interval: bool = False) -> Callable[[Row], str]:
    """Prints a share in percent, with its 95 % interval on request."""

    def text(row: Row) -> str:
        if row.get(key) is None:
            return "–"
        ends = f" [{100 * row[f'{key}_low']:.0f}–{100 * row[f'{key}_high']:.0f}]" if interval else ""
        return f"{100 * row[key]:.1f}{ends}"

    return text


def count(key: str) -> Callable[[Row], str]:
    """Prints a count."""
    return lambda row: "–" if row.get(key) is None else str(row[key])


SURE_TITLE = "of these with confidence ≥ 0.9"
FIRST = [
    Column("pairs", count("pairs")),
    Column("right %", percent("rr_4_5", True), "rr_4_5", 1),
    Column("wrong and accepted %", percent("false_accept_rate", True), "false_accept_rate", -1),
    Column("refused %", percent("refused_rate")),
    Column("median error mm", number("whole_bone_median_mm", 2), "whole_bone_median_mm", -1),
]  # after the method: what a table is read for
ACCURACY = [
    *FIRST,
    Column("RR % (paper)", percent("rr_paper", True), "rr_paper", 1),
    Column("RR % (0.02 half extent)", percent("rr_extent"), "rr_extent", 1),
    Column("RR % 1 mm/1°", percent("rr_1_1"), "rr_1_1", 1),
    Column("RR % 2 mm/2°", percent("rr_2_2"), "rr_2_2", 1),
    Column("RMSE mm", number("rmse_mm", 3), "rmse_mm", -1),
    Column("median RMSE mm", number("rmse_median_mm", 3), "rmse_median_mm", -1),
    Column("CD mm", number("chamfer_mm", 3), "chamfer_mm", -1),
    Column("R²(R)", number("r2_rotation", 3)),
    Column("R²(t)", number("r2_translation", 3)),
    Column("RTE mm", number("rte_median_mm", 2), "rte_median_mm", -1),
    Column("RRE °", number("rre_median_deg", 2), "rre_median_deg", -1),
    Column("worst TRE mm", number("tre_worst_median_mm", 2), "tre_worst_median_mm", -1),
]
SAFETY = [
    *FIRST,
    Column("accepted", count("accepted")),
    Column("wrong and accepted", count("false_accepts"), "false_accepts", -1),
    Column(SURE_TITLE, count("false_accepts_sure"), "false_accepts_sure", -1),
    Column("errors", count("errors")),
    Column("AUROC", number("auroc", 3), "auroc", 1),
    Column("ECE", number("ece", 3), "ece", -1),
    Column("NEES/6", number("nees_6", 2)),
    Column("median NEES/5.35", number("nees_median", 2)),
    Column("TRE ≤ tre95 %", percent("tre95_covers")),
    Column("tre95 / TRE", number("tre95_ratio", 2)),
    Column("× bound", number("bound_ratio", 2)),
    Column("s", number("seconds", 3)),
    Column("s, 90 %", number("seconds_p90", 3)),
    Column("prepare s", number("prepare_seconds", 3)),
]
SUMMARY = [
    *FIRST,
    *(column for column in SAFETY if column.title in ("wrong and accepted", SURE_TITLE)),
    *(column for column in ACCURACY if column.key in ("rr_paper", "rr_1_1", "rr_2_2")),
    Column("s", number("seconds", 3)),
]
LEGEND = (
    "Right: within 4 mm and 5° where the source is, of all pairs with a truth. Wrong and accepted: an accepted pose "
    "beyond that, or any on a wrong pair. In brackets 95 % intervals by subject: bootstrap, and Wilson's where all "
    "subjects agree. Median error: RMSE over the whole bone. RR: the share right within other limits. RR (paper): RMSE "
    "below 0.01 of the longest edge of the target's box; a half extent is the largest distance to its mean. Errors "
    "count a refusal with centroid on centroid, no rotation. RTE (at the source's centroid), RRE and worst TRE (of the "
    "named targets) are medians. AUROC and ECE judge the confidence of every pose given, also of the best one behind a "
    "refusal. "
    "NEES/6 (about 1 is honest) and × bound (RMSE over the Cramer-Rao bound, root-mean-square) are of the right "
    "answers; of all accepted ones: median NEES/5.35, share whose error over the whole bone is below tre95_mm, median "
    "of tre95_mm over that error. s: median register time without reading files and without preparing the target, "
    "which is apart. The confidence of a baseline is its share of source points within 5 mm, not calibrated. R²(R) is "
    "no measure of accuracy: Euler angles wrap around. Pair by pair: an interval that holds 0 does not show which "
    "method is better. Definitions: docs/develop/metrics.md."
)


def sections(rows: Sequence[Row]) -> list[Section]:
    """Summarise all bones; then per protocol accuracy (the paper's numbers below ours), safety and time."""
    protocols = dict.fromkeys(row["protocol"] for row in rows)
    last_bone = {row["protocol"]: row["bone"] for row in rows}  # `all`, or the only one
    over_bones = [row for row in rows if row["bone"] == last_bone[row["protocol"]]]
    found = [_section("Summary, all bones", over_bones, SUMMARY, first="protocol")]
    for protocol in protocols:
        chosen = [row for row in rows if row["protocol"] == protocol]
        name = "All protocols" if protocol == ALL else f"Protocol {protocol}"
        if any(row["pairs_with_truth"] for row in chosen):
            with_truth = [row for row in chosen if row["pairs_with_truth"]]
            found.append(_section(f"{name}: accuracy", with_truth, ACCURACY, paper=protocol))
        found.append(_section(f"{name}: safety, uncertainty, time", chosen, SAFETY))
    return found


def compared(differences: Sequence[Row], ours: str) -> list[Section]:
    """Ours against each other method, pair by pair (`table.differences`); nothing where it is alone."""
    if not differences:
        return []
    header = ["protocol", "method", "pairs", f"{ours} alone is right", "the method alone is right",
              f"right %: {ours} less the method"]  # fmt: skip
    cells = [[row["protocol"], row["method"], str(row["pairs"]), str(row["ours_alone"]), str(row["other_alone"]),
              _signed(row)] for row in differences]  # fmt: skip
    return [Section(f"{ours} and the others, pair by pair", header, cells, set())]


def _signed(row: Row) -> str:
    """Format a difference of shares in percent, with its interval where there is one."""
    low, high = row["difference_low"], row["difference_high"]
    ends = "" if low is None else f" [{100.0 * low:+.0f} to {100.0 * high:+.0f}]"
    return f"{100.0 * row['difference']:+.1f}{ends}"


def where_beaten(rows: Sequence[Row], ours: str) -> list[str]:
    """List the columns of each protocol in which another method is better, over all its bones."""
    lines = []
    for protocol in dict.fromkeys(row["protocol"] for row in rows):
        of_protocol = [row for row in rows if row["protocol"] == protocol]
        bone = of_protocol[-1]["bone"]  # `all` comes last; the only bone where there is one
        by_method = {row["method"]: row for row in of_protocol if row["bone"] == bone}
        if ours in by_method:
            own = by_method.pop(ours)
            found = [_beaten(own, list(by_method.values()), c) for c in dict.fromkeys(ACCURACY + SAFETY) if c.better]
            lines += [f"{protocol}, {line}; {ours} {own_text}" for line, own_text in found if line]
    return lines or ["nowhere in these pairs"]


def _beaten(own: Row, others: Sequence[Row], column: Column) -> tuple[str, str]:
    """Return the methods that are better in one column, and our value."""
    if own[column.key] is None:
        return "", ""
    there = [row for row in others if row[column.key] is not None]
    better = [row for row in there if column.better * (row[column.key] - own[column.key]) > 0]
    listed = ", ".join(f"{row['method']} {column.text(row)}" for row in better)
    return f"{column.title}: {listed}" if better else "", column.text(own)


def _section(
    title: str, rows: Sequence[Row], columns: Sequence[Column], first: str = "bone", paper: str = ""
) -> Section:
    columns = [c for c in columns if any(c.text(row) != "–" for row in rows)]
    cells: list[list[str]] = []
    best: set[tuple[int, int]] = set()
    for name in dict.fromkeys(row[first] for row in rows):
        group = [row for row in rows if row[first] == name]
        best |= {(len(cells) + i, j + 2) for i, j in _best(group, columns)}
        cells += [[name, row["method"], *(c.text(row) for c in columns)] for row in group]
        cells += _paper_cells(paper, name, columns)
    return Section(title, [first, "method", *(c.title for c in columns)], cells, best)


def _best(group: Sequence[Row], columns: Sequence[Column]) -> set[tuple[int, int]]:
    """Find the best cells of each ranked column, unless all are equal."""
    marked = set()
    for j, column in enumerate(columns):
        ranked = [(i, row[column.key]) for i, row in enumerate(group) if column.better]
        values = {i: column.better * value for i, value in ranked if value is not None}
        if len(set(values.values())) > 1:
            marked |= {(i, j) for i, v in values.items() if v == max(values.values())}
    return marked


def _paper_cells(protocol: str, bone: str, columns: Sequence[Column]) -> list[list[str]]:
    lines = []
    for method, f in paper_numbers.of(protocol, bone).items():
        cd = "–" if f.chamfer_mm is None else f"{f.chamfer_mm:.3f}"
        numbers = {"rr_paper": f"{f.rr_percent:.1f}", "rmse_mm": f"{f.rmse_mm:.3f}", "chamfer_mm": cd}
        named = {"R²(R)": f"{f.r2_rotation:.3f}", "R²(t)": f"{f.r2_translation:.3f}"}
        own = [numbers.get(c.key) or named.get(c.title, "") for c in columns]
        lines.append([bone, f"{method} (the paper's number, on the paper's data)", *own])
    return lines
