"""The report of a benchmark: one HTML file with tables, plots and the worst cases; needs no network and no script."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from gapr_core.benchmark.record import Record
from gapr_core.benchmark.records import Plan
from gapr_core.benchmark.table import Row
from gapr_core.pages import pictures, plots
from gapr_core.pages.report import Image, Report
from gapr_core.pages.sections import LEGEND, Section, compared, sections, where_beaten
from gapr_core.runtime import files

CAPTIONS = {  # of the plots: what a reader must know who sees nothing else
    "recall_threshold": "Share of the pairs within x mm and 1.25 x degrees; refusals are misses. Grey: 1, 2 and 4 mm.",
    "recall_overlap": "Share of the pairs within 4 mm and 5°, over how much of the bone the source covers; a dot is "
    "the mean of a bin.",
    "recall_noise": "Share of the pairs within 4 mm and 5°, over the standard deviation of the source's noise; a dot "
    "is the mean of a bin.",
    "reliability": "Of the poses with about this confidence, the share that is right. A dot is as large as the share "
    "of poses in its bin; on the grey line the confidence is honest, below it is too high.",
    "risk_coverage": "Share of wrong poses among the surest ones. At the dot the method refuses the rest.",
    "error_ellipsoids": "Dots are errors of right answers. The ellipses hold 95 %: as found, as the covariances say, "
    "and as the noise alone allows.",
}


def write(
    out: Path,
    records: Sequence[Record],
    rows: Sequence[Row],
    apart: Sequence[Row],
    plan: Plan,
    ran: Mapping[str, str],
    notes: Sequence[str],
) -> None:
    """`report.html` and the folder `plots` with its pictures as PNG."""
    report = Report("Benchmark", f"{len(plan.pairs)} pairs, {len(plan.methods)} methods.")
    for note in notes:
        report.note(note)
    report.heading(f"Where another method beats {plan.ours}")
    report.bullets(where_beaten(rows, plan.ours))
    report.heading("Tables")
    for section in [*sections(rows), *compared(apart, plan.ours)]:
        _add_table(report, section)
    report.paragraph(LEGEND)
    report.heading("Plots")
    report.images([Image(_saved(out, name, figure), name, CAPTIONS[name]) for name, figure in _plots(records, plan)])
    worst = pictures.worst(records, plan.ours)
    report.heading(f"The worst {len(worst)} cases of {plan.ours}")
    report.images([_case(out, number, record, plan) for number, record in enumerate(worst, 1)])
    made = {"command": plan.command, **ran, "started": plan.started}
    report.note(" · ".join(f"{name}: {value}" for name, value in made.items()))
    report.write(out / "report.html")


def _plots(records: Sequence[Record], plan: Plan) -> list[tuple[str, Figure]]:
    methods = [plan.ours, *(m for m in plan.methods if m != plan.ours)]
    tiles = {
        "recall_threshold": plots.recall_against_threshold(records, methods),
        "recall_overlap": plots.recall_against(records, methods, "overlap", "overlap, share of the surface"),
        "recall_noise": plots.recall_against(records, methods, "noise_mm", "noise, mm"),
        "reliability": plots.reliability_diagram(records, methods),
        "risk_coverage": plots.risk_coverage(records, methods),
        "error_ellipsoids": plots.error_ellipsoids(records, plan.ours),
    }
    return [(name, value) for name, value in tiles.items() if value is not None]


def _case(out: Path, number: int, record: Record, plan: Plan) -> Image:
    """Show one case; without a picture if its pair is not on this machine."""
    folder = Path(plan.folder)
    is_here = (folder / record.file).is_file()
    png = _saved(out, f"worst_{number:02d}", pictures.picture(record, folder)) if is_here else None
    return Image(png, record.pair, pictures.caption(record), record.false_accept)


def _saved(out: Path, name: str, figure: Figure) -> bytes:
    """Return the PNG, and write it into the folder `plots`."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, metadata={"Software": None})
    with files.replacing(out / "plots" / f"{name}.png") as path:
        path.write_bytes(buffer.getvalue())
    return buffer.getvalue()


def _add_table(report: Report, section: Section) -> None:
    firsts = [i == 0 or line[0] != section.cells[i - 1][0] for i, line in enumerate(section.cells)]
    marks = ["aside" if "paper's number" in line[1] else "first" if is_first else ""
             for line, is_first in zip(section.cells, firsts, strict=True)]  # fmt: skip
    report.subheading(section.title)
    report.table(section.header, section.cells, marks, section.header[:2], section.best)
