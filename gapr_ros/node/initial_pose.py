"""The pose from outside on its way to the method; it is given up where its frame cannot be found."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from numpy.typing import NDArray

from gapr_ros.node.refusal import RefusedError
from gapr_ros.node.situation import InitialPose

log = logging.getLogger(__name__)
REMAP = "remap it if it is of another node"
PATIENCE_S = 2.0  # the listener of transforms may have started with the pose


class InitialPoses:
    """Says where a registration starts. Used by the worker's thread only.

    While the frame of an initial pose is missing, clouds are refused, since it may come. Once it has been missing for
    `PATIENCE_S`, it is given up for good: it may be of another node, for which the same topic is usual.
    """

    def __init__(self) -> None:
        self._missing: InitialPose | None = None  # its frame was not there for the last cloud, nor for those since then
        self._since = 0.0
        self._given_up: InitialPose | None = None

    def start(self, given: InitialPose | None, find: Callable[[InitialPose], NDArray]) -> NDArray | None:
        """The (4, 4) that `find` makes of an initial pose; None where there is none, or none any more.

        Raises:
            RefusedError: what `find` raised, while it is not given up.
        """
        if given is None or given is self._given_up:
            return None
        try:
            found = find(given)
        except RefusedError as refusal:
            self._miss(given, refusal)
            return None
        self._missing = None
        return found

    def _miss(self, given: InitialPose, refusal: RefusedError) -> None:
        text, now = f"the initialpose is in {given.frame}: {refusal.text}", time.monotonic()
        if given is not self._missing:
            self._missing, self._since = given, now
        if now - self._since < PATIENCE_S:
            how = f"it is given up if that lasts {PATIENCE_S:g} s; {REMAP}"
            raise RefusedError(refusal.reason, f"{text}; {how}") from refusal
        self._given_up = given
        log.warning("%s; it is given up, and clouds are registered without it; %s", text, REMAP)
