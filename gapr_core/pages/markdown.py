"""Tables for pages and terminals, as Markdown; whole, or line by line where rows come one after the other."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from gapr_core.runtime.console import printable


def table(header: Sequence[object], rows: Iterable[Iterable[object]]) -> str:
    """Write all lines of a table; a cell is shown as `str` shows it."""
    return "\n".join([head(header), *map(row, rows)])


def head(header: Sequence[object]) -> str:
    """Write the two lines above the rows."""
    return f"{row(header)}\n{row(['---'] * len(header))}"


def row(cells: Iterable[object]) -> str:
    """Write one line; a `|` in a cell is escaped."""
    escaped = (text(cell).replace("|", r"\|") for cell in cells)
    return f"| {' | '.join(escaped)} |"


def text(said: object) -> str:
    """Make one line of any name; a `<`, which begins HTML, and what steers a terminal are escaped."""
    return printable(" ".join(str(said).split())).replace("<", r"\<")
