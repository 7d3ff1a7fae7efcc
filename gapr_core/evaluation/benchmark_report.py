"""The report of a benchmark: one HTML file with tables, plots and the worst cases; needs no network and no script."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from gapr_core.evaluation import pictures, plots
from gapr_core.evaluation.sections import LEGEND, Section, sections, where_beaten
from gapr_core.evaluation.table import Row

Record = dict[str, Any]
Plan = dict[str, Any]

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1c2430; margin: 0 auto; max-width: 1440px; padding: 1.5rem; }
h1 { margin: 0 0 .3rem } h2 { margin: 2.2rem 0 .6rem; border-bottom: 2px solid #0b5fa5 }
h3 { margin: 1.2rem 0 .4rem }
.wide { overflow-x: auto } table { border-collapse: collapse; font-size: 13px; white-space: nowrap }
th { background: #eef3f8; white-space: normal; vertical-align: bottom; max-width: 8rem }
tr.paper td { color: #6a7480; font-style: italic }
th, td { padding: .25rem .45rem; border-bottom: 1px solid #dde3ea; text-align: right }
td:nth-child(1), td:nth-child(2), th:nth-child(1), th:nth-child(2) { text-align: left }
tr.first td { border-top: 2px solid #aab7c4 } .note { background: #fff4d6; padding: .4rem .8rem; margin: .3rem 0 }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(520px, 1fr)); gap: 1rem }
figure { margin: 0 } figure img { width: 100% } figcaption { font-size: 13px }
.wrong { color: #b3202f; font-weight: 600 }
footer { margin-top: 2rem; font-size: 13px; color: #556070 }
"""


def write(out: Path, records: Sequence[Record], rows: Sequence[Row], plan: Plan, notes: Sequence[str]) -> None:
    """`report.html` and the folder `plots` with its pictures as PNG."""
    (out / "plots").mkdir(exist_ok=True)
    drawn = {name: _save(out / "plots" / f"{name}.png", figure) for name, figure in _plots(records, plan)}
    cases = [(record, _case(out, number, record, plan)) for number, record in enumerate(_worst(records, plan), 1)]
    body = [
        _head(plan, notes), _beaten(rows, plan), "<h2>Tables</h2>", *(_table(section) for section in sections(rows)),
        f"<p>{html.escape(LEGEND)}</p>", "<h2>Plots</h2>",
        f"<div class='plots'>{''.join(map(_image, drawn.items()))}</div>",
        f"<h2>The worst {len(cases)} cases of {html.escape(plan['ours'])}</h2>",
        f"<div class='plots'>{''.join(_worst_case(*case) for case in cases)}</div>", _footer(plan),
    ]  # fmt: skip
    page = f"<!doctype html><html lang='en'><head><meta charset='utf-8'><title>Benchmark</title><style>{STYLE}</style>"
    (out / "report.html").write_text(f"{page}</head><body>{''.join(body)}</body></html>\n", encoding="utf-8")


def _plots(records: Sequence[Record], plan: Plan) -> list[tuple[str, Figure]]:
    methods = [plan["ours"], *(m for m in plan["methods"] if m != plan["ours"])]
    figures = {
        "recall_threshold": plots.recall_against_threshold(records, methods),
        "recall_overlap": plots.recall_against(records, methods, "overlap", "overlap, share of the surface"),
        "recall_noise": plots.recall_against(records, methods, "noise_mm", "noise, mm"),
        "reliability": plots.reliability_diagram(records, methods),
        "risk_coverage": plots.risk_coverage(records, methods),
        "error_ellipsoids": plots.error_ellipsoids(records, plan["ours"]),
    }
    return [(name, figure) for name, figure in figures.items() if figure is not None]


def _worst(records: Sequence[Record], plan: Plan) -> list[Record]:
    return pictures.worst(records, plan["ours"])


def _case(out: Path, number: int, record: Record, plan: Plan) -> str | None:
    """The picture of one case, None when its pair is not on this machine."""
    if not (Path(plan["folder"]) / record["file"]).is_file():
        return None
    return _save(out / "plots" / f"worst_{number:02d}.png", pictures.picture(record, Path(plan["folder"])))


def _save(path: Path, figure: Figure) -> str:
    """Write the PNG and return it as a data URI."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, metadata={"Software": None})
    path.write_bytes(buffer.getvalue())
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}"


def _head(plan: Plan, notes: Sequence[str]) -> str:
    lines = "".join(f"<div class='note'>{html.escape(note)}</div>" for note in notes)
    return f"<h1>Benchmark</h1><p>{len(plan['pairs'])} pairs, {len(plan['methods'])} methods.</p>{lines}"


def _beaten(rows: Sequence[Row], plan: Plan) -> str:
    lines = "".join(f"<li>{html.escape(line)}</li>" for line in where_beaten(rows, plan["ours"]))
    return f"<h2>Where another method beats {html.escape(plan['ours'])}</h2><ul>{lines}</ul>"


def _table(section: Section) -> str:
    header = "".join(f"<th>{html.escape(title)}</th>" for title in section.header)
    lines, previous = [], None
    for i, cells in enumerate(section.cells):
        kind = "paper" if "paper's figure" in cells[1] else "first" if cells[0] != previous else ""
        previous = cells[0]
        texts = [f"<b>{html.escape(c)}</b>" if (i, j) in section.best else html.escape(c) for j, c in enumerate(cells)]
        lines.append(f"<tr class='{kind}'>{''.join(f'<td>{text}</td>' for text in texts)}</tr>")
    title = f"<h3>{html.escape(section.title)}</h3>"
    return f"{title}<div class='wide'><table><tr>{header}</tr>{''.join(lines)}</table></div>"


def _image(named: tuple[str, str]) -> str:
    return f"<figure><img alt='{named[0]}' src='{named[1]}'></figure>"


def _worst_case(record: Record, image: str | None) -> str:
    style = "wrong" if record["false_accept"] else ""
    shown = f"<img alt='{html.escape(record['pair'])}' src='{image}'>" if image else "<p>(its pair is not here)</p>"
    return f"<figure>{shown}<figcaption class='{style}'>{html.escape(pictures.caption(record))}</figcaption></figure>"


def _footer(plan: Plan) -> str:
    shown = {key: plan[key] for key in ("command", "commit", "machine", "threads", "started")}
    return f"<footer>{' · '.join(html.escape(f'{key}: {value}') for key, value in shown.items())}</footer>"
