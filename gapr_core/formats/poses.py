"""The poses that a tracking system recorded, whatever the file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gapr_core.errors import GaprError, InvalidPointCloudError
from gapr_core.formats import sweeps, tracker
from gapr_core.formats.limits import FileLimits
from gapr_core.formats.meshes import arrays
from gapr_core.formats.reading import format_of, reason_of, unreadable


def poses_in(path: Path, tool: int | None = None, reference: int | None = None) -> NDArray[np.float64]:
    """(N, 4, 4) poses of one recorded tool, mm, in the frame of the tracker or of a reference.

    Args:
        path: NDI Track's CSV, a PLUS sequence, or an array (N, 4, 4).
        tool, reference: which of the recorded tools, from 0; None where there is one, and for the tracker's frame.

    Raises:
        InvalidPointCloudError: neither of them, no pose of that tool, several tools and none chosen, or no such
            reference.
    """
    if not format_of(path).is_tracked or path.is_dir():
        given = path.name or path.resolve().name
        how = "record the tool while it is turned on its tip"
        raise InvalidPointCloudError(tracker.RECORDINGS, given, how)
    try:
        if path.suffix.lower() == ".npy":
            limits = FileLimits.from_environment()
            return tracker.rigid_poses(arrays.array_of(limits.read(path), limits), path)
        if not path.name.lower().endswith(".igs.mha"):
            return tracker.read_poses(path, tool=tool, reference=reference)
        return sweeps.pose_of(sweeps.transforms(path), tool, path, reference)
    except GaprError:
        raise
    except Exception as error:
        raise unreadable(path, reason_of(error)) from error
