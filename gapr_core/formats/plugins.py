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
        """The points, in the unit of the file.

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
    """The plug-in that reads a file or folder, or the folder of the file that makes it one; None without one."""
    for entry in _entries():
        has_ending = path.is_file() and path.name.lower().endswith(f".{entry.name}")
        if has_ending or (_folder_of(path, entry) / entry.name).is_file():
            return Plugin(entry)
    return None


def kinds() -> list[str]:
    """What plug-ins read: endings, and names of files that make a folder one of their kind."""
    return sorted(entry.name if _is_file_name(entry) else f".{entry.name}" for entry in _entries())


def _is_file_name(entry: EntryPoint) -> bool:
    return "." in entry.name


def _folder_of(path: Path, entry: EntryPoint) -> Path:
    """The folder, where the path is that of the file that makes it one of its kind; else the path itself."""
    return path.absolute().parent if _is_file_name(entry) and path.name == entry.name and path.is_file() else path


@cache
def _entries() -> tuple[EntryPoint, ...]:
    """Of the packages that are installed; looked up once, since it reads the metadata of all of them."""
    return tuple(entry_points(group=GROUP))
