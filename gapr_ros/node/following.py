"""Clouds between two that are assessed (`assess_every`): where the bone is now, on ~/followed_pose and nowhere else.

Such a pose was not assessed. It rests on the last cloud that was: while that one's pose stands, and for no longer.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapr_ros.node import units
from gapr_ros.node.model import Model
from gapr_ros.node.region import Place
from gapr_ros.node.situation import Situation
from gapr_ros.node.track import jump
from gapr_ros.parameters import NodeParameters, why_all_assessed

Array = NDArray[np.float64]


class Following:
    """Says which clouds are followed, and follows them; in the worker's thread."""

    def __init__(self) -> None:
        self._row = 0  # clouds that were followed since the last one that was assessed

    def follow(self, points_mm: Array, frame: str, is_to_be_assessed: bool, now: Situation) -> Array | None:
        """(4, 4) T_frame_model, metres, of a cloud (N, 3), mm, in `frame`; None where it has to be assessed."""
        pose = None if is_to_be_assessed or not self._may_follow(now) else _followed(points_mm, now)
        if pose is not None and not continues(now.place, pose, frame, now.model, now.parameters):
            pose = None
        self._row = 0 if pose is None else self._row + 1
        return pose

    def _may_follow(self, now: Situation) -> bool:
        """Whether it is the turn of a cloud that is followed, and the last one that was assessed is known."""
        its_turn = self._row + 1 < now.parameters.assess_every
        return its_turn and now.initial_pose is None and now.place is not None and not why_all_assessed(now.parameters)


def continues(place: Place | None, T_frame_model: Array, frame: str, model: Model, parameters: NodeParameters) -> bool:
    """Whether a pose (4, 4), metres, may be shown: the last assessed cloud had one in this frame, within the limits."""
    if place is None or place.frame != frame:
        return False
    centre_m = units.to_metres(model.points_mm).mean(axis=0)
    return not jump(place.T_frame_model, T_frame_model, centre_m, parameters)


def _followed(points_mm: Array, now: Situation) -> Array | None:
    follow = getattr(now.method, "follow", None)
    found = None if follow is None else follow(points_mm, now.model.target)
    if found is None or not np.isfinite(found.T_target_source).all():
        return None
    return units.ros_pose(found.T_target_source)
