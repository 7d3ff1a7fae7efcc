"""Pages that open anywhere: one HTML file with tables and pictures, without a script and without the network."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from gapr_core.runtime import files

TEMPLATES = Path(__file__).with_name("templates")


@dataclass(frozen=True)
class Image:
    """A picture of a page.

    Attributes:
        png: its bytes; None where there is none, which is said in its place.
        name: text for readers who cannot see the image.
        caption: a line below.
        is_bad: the caption reports a mistake.
    """

    png: bytes | None
    name: str
    caption: str = ""
    is_bad: bool = False

    @property
    def src(self) -> str:
        """The picture as the address of an `img`."""
        return f"data:image/png;base64,{base64.b64encode(self.png or b'').decode()}"

    @property
    def aspect(self) -> float:
        """Width over height, which stand in the head of a PNG."""
        width, height = (int.from_bytes((self.png or b"")[at : at + 4], "big") for at in (16, 20))
        return width / height


@cache
def environment() -> Environment:
    """Load the templates; texts are escaped, and a name without a value is an error."""
    return Environment(loader=FileSystemLoader(TEMPLATES), autoescape=True, undefined=StrictUndefined)


class Report:
    """A page that is put together piece by piece, then written.

    Args:
        title: the heading.
        lead: one or two sentences under it.
    """

    def __init__(self, title: str, lead: str = "") -> None:
        self.title, self.lead = title, lead
        self._shown: list[tuple[str, Any]] = []

    def _show(self, kind: str, shown: Any) -> None:
        self._shown.append((kind, shown))

    def verdict(self, tone: str, headline: str, lines: Sequence[str]) -> None:
        """Add the outcome in words and a colour: "accepted", "caution" or "refused"."""
        self._show("verdict", {"tone": tone, "headline": headline, "lines": lines})

    def heading(self, text: str) -> None:
        """Begin a section."""
        self._show("h2", text)

    def subheading(self, text: str) -> None:
        """Begin a part of a section."""
        self._show("h3", text)

    def paragraph(self, text: str) -> None:
        """Plain text."""
        self._show("p", text)

    def note(self, text: str) -> None:
        """Text that must not be overlooked, or, at the end of a page, where it comes from."""
        self._show("note", text)

    def bullets(self, lines: Sequence[str]) -> None:
        """Add a list."""
        self._show("bullets", lines)

    def images(self, images: Sequence[Image]) -> None:
        """Pictures side by side, as many as fit."""
        self._show("images", images)

    def film(self, images: Sequence[Image]) -> None:
        """Pictures in the order of time, one beside the other, to be scrolled."""
        self._show("film", images)

    def facts(self, values: Mapping[str, str]) -> None:
        """Add main values in big type: name to value."""
        self._show("facts", values)

    def table(
        self,
        columns: Sequence[str],
        rows: Sequence[Sequence[str]],
        marks: Sequence[str] = (),
        text: Sequence[str] = (),
        best: Set[tuple[int, int]] = frozenset(),
    ) -> None:
        """Add a table of strings.

        Args:
            columns: the headings.
            rows: the cells, row by row.
            marks: for each row "ok", "hold", "bad", "first" (of a group), "aside" or "": how it looks.
            text: the columns that hold words; the others are set to the right.
            best: (row, column) of the cells in bold.
        """
        self._show("table", {"columns": columns, "rows": rows, "marks": marks, "text": text, "best": best})

    def write(self, path: str | Path) -> None:
        """Write one self-contained HTML file."""
        write(path, "report.html", title=self.title, lead=self.lead, shown=self._shown)


def write(path: str | Path, template: str, **values: Any) -> None:
    """Fill a template, and write it."""
    files.write_text(path, environment().get_template(template).render(values))
