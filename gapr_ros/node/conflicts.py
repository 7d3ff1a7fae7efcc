"""What is wrong around the node and not in a cloud: said once, and shown in the diagnostics while it lasts."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Any


class Conflicts:
    """Sentences by kind; the executor's thread only.

    Args:
        write: logs a sentence when it is new.
    """

    def __init__(self, write: Callable[[str], None]) -> None:
        self._write = write
        self._texts: dict[str, str] = {}
        self._until: dict[str, float] = {}

    def note(self, kind: str, text: str, for_s: float = float("inf"), log: bool = True) -> None:
        """There is one of this kind, seen again or for the first time; it lasts `for_s` unless it is seen again.

        An empty text: there is none any more. Without `log` it was logged elsewhere.
        """
        now = time.monotonic()
        lasts = now < self._until.get(kind, now)
        if log and text and not (lasts and text == self._texts[kind]):
            self._write(text)
        self._texts[kind], self._until[kind] = text, now + for_s

    @property
    def texts(self) -> tuple[str, ...]:
        """Those that last, in the order in which their kinds were first seen."""
        now = time.monotonic()
        return tuple(text for kind, text in self._texts.items() if text and now < self._until[kind])


def names_of(publishers: Iterable[Any]) -> str:
    """The full names of the nodes that publish, with commas, from what the graph says of each publisher."""
    return ", ".join(f"{each.node_namespace.rstrip('/')}/{each.node_name}" for each in publishers)
