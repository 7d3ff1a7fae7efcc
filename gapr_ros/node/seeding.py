"""The pose from outside on its way to the method; it is given up where its frame cannot be found."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from numpy.typing import NDArray

from gapr_ros.node.refusal import RefusedError
from gapr_ros.node.situation import Seed

log = logging.getLogger(__name__)
PATIENCE_S = 2.0  # the listener of transforms may have started with the seed


class Seeding:
    """Says where a registration starts. Used by the worker's thread only.

    While the frame of a seed is missing, clouds are refused, since it may come. Once it has been missing for
    `PATIENCE_S`, the seed is given up for good: it may be of another node, for which the same topic is usual.
    """

    def __init__(self) -> None:
        self._missing: Seed | None = None  # its frame was not there for the last cloud, nor for those since then
        self._since = 0.0
        self._given_up: Seed | None = None

    def start(self, seed: Seed | None, find: Callable[[Seed], NDArray]) -> NDArray | None:
        """The (4, 4) that `find` makes of a seed; None where there is no seed, or none any more.

        Raises:
            RefusedError: what `find` raised, while the seed is not given up.
        """
        if seed is None or seed is self._given_up:
            return None
        try:
            found = find(seed)
        except RefusedError as refusal:
            self._miss(seed, refusal)
            return None
        self._missing = None
        return found

    def _miss(self, seed: Seed, refusal: RefusedError) -> None:
        text, now = f"the initialpose is in {seed.frame}: {refusal.text}", time.monotonic()
        if seed is not self._missing:
            self._missing, self._since = seed, now
        if now - self._since < PATIENCE_S:
            how = f"it is given up if that lasts {PATIENCE_S:g} s"
            raise RefusedError(refusal.reason, f"{text}; {how}") from refusal
        self._given_up = seed
        log.warning("%s; it is given up, and clouds are registered without it", text)
