"""What the node remembers from cloud to cloud: the last pose of each frame, and how many good ones came in a row."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapr_core.geometry import se3
from gapr_ros.node.refusal import Reason, RefusedError
from gapr_ros.node.region import Place
from gapr_ros.parameters import NodeParameters

Array = NDArray[np.float64]


class Track:
    """The poses of one bone over time. Used by one thread only, but for `place`, which any may read.

    A row of good poses is in one frame. The last pose that went out is kept for every frame: neither clouds in another
    one nor a pause take away what a jump is measured against. Poses in two frames are not compared.

    Attributes:
        place: where the bone was with the last cloud; None when that was refused, or `min_confidence` or `max_tre` have
            changed since.
    """

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self.place: Place | None = None
        self._frame = ""
        self._row: set[object] = set()  # the clouds of the good poses in a row
        self._candidate: Array | None = None
        self._accepted: dict[str, Array] = {}  # by frame

    def judge(
        self, T_frame_model: Array, frame: str, centre_m: Array, cloud: object, parameters: NodeParameters
    ) -> None:
        """Let a good pose pass, or refuse it.

        Args:
            T_frame_model: (4, 4), metres.
            frame: its parent; another one than before starts a new row of good poses.
            centre_m: (3,) of the bone, in its own frame, where a jump is measured.
            cloud: what distinguishes its cloud from others, such as the stamp: one cloud counts once, however often it
                is registered.
            parameters: `max_jump_*` and `require_consecutive`.

        Raises:
            RefusedError: jump, or low_confidence while there are too few good poses in a row.
        """
        if frame != self._frame:
            self.miss()
            self._frame = frame
        self._check_jump(T_frame_model, centre_m, parameters)
        self._count(T_frame_model, centre_m, cloud, parameters)
        if len(self._row) < parameters.require_consecutive:
            self.place = None  # there may be one, of before the limit was raised
            text = f"{len(self._row)} of {parameters.require_consecutive} good poses in a row (require_consecutive)"
            raise RefusedError(Reason.LOW_CONFIDENCE, text)
        self._accepted[frame], self.place = T_frame_model, Place(T_frame_model, frame)

    def miss(self) -> None:
        """A cloud was refused, or none was looked at: the row of good poses ends, and the bone may be elsewhere."""
        self._row, self._candidate, self.place = set(), None, None

    def forget_accepted(self) -> None:
        """The next good pose is no jump, wherever it is: it was found from where somebody says the bone is."""
        self._accepted = {}

    def _check_jump(self, T_frame_model: Array, centre_m: Array, parameters: NodeParameters) -> None:
        accepted = self._accepted.get(self._frame)
        if accepted is None:
            return
        why = jump(accepted, T_frame_model, centre_m, parameters)
        if why:
            self.miss()
            raise RefusedError(Reason.JUMP, f"{why}; call ~/reset if the bone really moved")

    def _count(self, T_frame_model: Array, centre_m: Array, cloud: object, parameters: NodeParameters) -> None:
        if self._candidate is not None and jump(self._candidate, T_frame_model, centre_m, parameters):
            self._row = set()
        self._candidate = T_frame_model
        if len(self._row) < parameters.require_consecutive:  # more say no more
            self._row.add(cloud)


def jump(T_before: Array, T_now: Array, centre_m: Array, parameters: NodeParameters) -> str:
    """How two poses are farther apart than `max_jump_*` allow; empty when they are not."""
    step = se3.apply(T_now, centre_m[None]) - se3.apply(T_before, centre_m[None])
    distance_m = float(np.linalg.norm(step))
    angle = float(np.radians(se3.rotation_angle_deg(se3.inverse(T_before) @ T_now)))
    if 0.0 < parameters.max_jump_translation < distance_m:
        return f"moved {distance_m:.3g} m, max_jump_translation is {parameters.max_jump_translation:g} m"
    if 0.0 < parameters.max_jump_rotation < angle:
        return f"turned {angle:.3g} rad, max_jump_rotation is {parameters.max_jump_rotation:g} rad"
    return ""
