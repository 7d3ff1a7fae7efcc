"""Readers that other packages bring, such as that of bags: the entry-point group `gapr.sources`.

The name of an entry is the ending of a file without its dot, or the name of a file that makes a folder one of its kind.
Its value is a module with `read(path, options) -> Surface`, in the unit of the file, and `UNIT`, which that usually is.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from gapr_core.errors import MethodUnavailableError
from gapr_core.formats.options import ReadOptions
from gapr_core.surface import Surface

GROUP = "gapr.sources"
OURS = "'gapr_ros[ros]'"


@dataclass(frozen=True)
class Plugin:
    """A kind of file that another package reads; as `reading.Format` to those who use it."""

    entry: EntryPoint
    in_patient = is_tracked = False

    @property
    def unit(self) -> str:
        """Of its numbers, where the user names none: "mm" or "m"."""
        return str(self._module().UNIT)

    def read(self, path: Path, options: ReadOptions) -> Surface:
        """The points, in the unit of the file.

        Raises:
            InvalidPointCloudError: what the reader cannot read.
            MethodUnavailableError: a library that the reader needs is not installed.
        """
        return self._module().read(path, options)  # type: ignore[no-any-return]

    def _module(self) -> Any:
        try:
            return self.entry.load()
        except ModuleNotFoundError as error:
            how = f"pip install {OURS if self.entry.value.startswith('gapr_ros.') else error.name}"
            raise MethodUnavailableError(f"files of the kind {self.entry.name}", f"no {error.name}", how) from error


def of(path: Path) -> Plugin | None:
    """The plug-in that reads a file or folder; None without one."""
    for entry in _entries():
        if (path.is_file() and path.name.lower().endswith(f".{entry.name}")) or (path / entry.name).is_file():
            return Plugin(entry)
    return None


def endings() -> list[str]:
    """What plug-ins read, by the names of their entries."""
    return sorted(entry.name for entry in _entries())


@cache
def _entries() -> tuple[EntryPoint, ...]:
    """Of the packages that are installed; looked up once, since it reads the metadata of all of them."""
    return tuple(entry_points(group=GROUP))
