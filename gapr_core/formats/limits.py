"""How large a file may be, packed and unpacked, before it is read."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from gapr_core.errors import ConfigError, InvalidPointCloudError

MB = 1 << 20
RAISE_IT = "thin the data, or raise {variable} if the file is to be trusted"


@dataclass(frozen=True)
class FileLimits:
    """Limits of a reader. A load takes at most 20 times the unpacked data plus 200 MB of memory.

    Attributes:
        file_mb: size of the file, MB.
        unpacked_mb: size of its arrays (points, faces, voxels) in memory, MB.
        vertices: number of points, and half the number of triangles.
    """

    file_mb: float = 1024.0
    unpacked_mb: float = 2048.0
    vertices: int = 20_000_000

    @classmethod
    def from_environment(cls) -> FileLimits:
        """Read GAPR_MAX_FILE_MB, GAPR_MAX_UNPACKED_MB and GAPR_MAX_VERTICES over the defaults.

        Raises:
            ConfigError: a variable that is no positive number.
        """
        return cls(
            _positive("GAPR_MAX_FILE_MB", cls.file_mb),
            _positive("GAPR_MAX_UNPACKED_MB", cls.unpacked_mb),
            int(_positive("GAPR_MAX_VERTICES", cls.vertices)),
        )

    def read(self, path: Path) -> bytes:
        """Read the whole file, once its size has passed.

        It is read, not mapped: a mapped file that another program cuts meanwhile kills the process.
        """
        most, data = int(self.file_mb * MB), b""
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            if size <= most:
                data = file.read(size + 1)  # takes as much memory as it may fill
            if len(data) > size:  # a pipe has no size, and a file may have grown
                data += file.read(most + 1 - len(data))
        if max(size, len(data)) > most:
            self._refuse(f"a file of at most {self.file_mb:g} MB", "more", "GAPR_MAX_FILE_MB")
        return data

    def check_unpacked(self, size_bytes: int) -> None:
        """Raise `InvalidPointCloudError` for arrays of so many bytes that they are not to be unpacked."""
        if size_bytes > self.unpacked_mb * MB:
            given = f"{size_bytes / MB:.0f} MB"
            self._refuse(f"at most {self.unpacked_mb:g} MB of unpacked data", given, "GAPR_MAX_UNPACKED_MB")

    def check_counts(self, points: int, faces: int = 0) -> None:
        """Raise `InvalidPointCloudError` for more points or triangles than the limit."""
        if points > self.vertices or faces > 2 * self.vertices:
            given = f"{points} points and {faces} triangles"
            self._refuse(f"at most {self.vertices} points", given, "GAPR_MAX_VERTICES")

    def _refuse(self, expected: str, given: str, variable: str) -> None:
        raise InvalidPointCloudError(expected, given, RAISE_IT.format(variable=variable))


def _positive(variable: str, default: float) -> float:
    text = os.environ.get(variable, str(default))
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise ConfigError(f"a positive number in {variable}", repr(text), "correct it, or unset it")
    return value
