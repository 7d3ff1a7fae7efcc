"""The poses that a tracking system recorded, whatever the file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gapr_core.errors import GaprError, InvalidPointCloudError
from gapr_core.formats import sweeps, tracker
from gapr_core.formats.reading import format_of, unreadable


def poses_in(path: Path, tool: int = 0) -> NDArray[np.float64]:
    """(N, 4, 4) poses of one recorded tool, mm, of NDI Track's CSV or a PLUS sequence.

    Raises:
        InvalidPointCloudError: neither of them, or no pose of that tool.
    """
    format_of(path)
    try:
        if not path.name.lower().endswith(".igs.mha"):
            return tracker.read_poses(path, tool=tool)
        poses = sweeps.transforms(path)
        if not 0 <= tool < len(poses):
            raise InvalidPointCloudError(f"tool {tool}", f"{path.name} with {', '.join(poses)}", "count them from 0")
        return list(poses.values())[tool]
    except GaprError:
        raise
    except Exception as error:
        raise unreadable(path, str(error) or type(error).__name__) from error
