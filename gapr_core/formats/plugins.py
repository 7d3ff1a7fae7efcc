"""Readers that other packages bring, such as that of bags: the entry-point group `gapr.sources`.

The name of an entry is the ending of a file without its dot, or the name of a file that makes a folder one of its kind.
Its value is a module with `read(path, options) -> Surface`, in the unit of the file, and `UNIT`, which that usually is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from gapr_core.errors import MethodUnavailableError
from gapr_core.formats import axes
from gapr_core.formats.options import ReadOptions
from gapr_core.surface import Surface

GROUP = "gapr.sources"
OURS = "'gapr_ros[ros]'"


@dataclass(frozen=True)
class Plugin:
    """A kind of file that another package reads; as `reading.Format` to those who use it."""

    entry: EntryPoint
    in_mm = in_lps = is_tracked = False

    def is_in_mm(self, _: ReadOptions) -> bool:
        """False: the user may name the unit."""
        return False

    @property
    def unit(self) -> str:
        """Of its numbers, where the user names none: "mm" or "m"."""
        return str(self._module().UNIT)

    def read(self, path: Path, options: ReadOptions) -> Surface:
        """Read the points, in the file's unit.

        Raises:
            InvalidPointCloudError: what the reader cannot read.
            MethodUnavailableError: a library that the reader needs is not installed.
        """
        surface = self._module().read(_folder_of(path, self.entry), replace(options, axes="auto"))
        return axes.turned_as_named(surface, path, options.axes, in_lps=False)

    def _module(self) -> Any:
        try:
            return self.entry.load()
        except ModuleNotFoundError as error:
            is_ours = self.entry.value.startswith("gapr_ros.")
            missing = "reading bags" if is_ours else f"files of the kind {self.entry.name}"
            how = f"pip install {OURS if is_ours else error.name}"
            raise MethodUnavailableError(missing, f"no {error.name}", how) from error


def of(path: Path) -> Plugin | None:
    """Find the plug-in for a file or folder, or for a file that marks its folder; None without."""
    for entry in _entries():
        has_ending = path.is_file() and path.name.lower().endswith(f".{entry.name}")
        if has_ending or (_folder_of(path, entry) / entry.name).is_file():
            return Plugin(entry)
    return None


def kinds() -> list[str]:
    """List the plug-ins' endings, and names of files that mark a folder."""
    return sorted(entry.name if _is_file_name(entry) else f".{entry.name}" for entry in _entries())


def _is_file_name(entry: EntryPoint) -> bool:
    return "." in entry.name


def _folder_of(path: Path, entry: EntryPoint) -> Path:
    """Return the folder of a file that marks it; else the path itself."""
    return path.absolute().parent if _is_file_name(entry) and path.name == entry.name and path.is_file() else path


@cache
def _entries() -> tuple[EntryPoint, ...]:
    """List entry points of installed packages, once, since all metadata is read."""
    return tuple(entry_points(group=GROUP))
