"""Ctrl-C that no library can swallow."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event, current_thread, main_thread
from typing import Any

_pressed = Event()


@contextmanager
def heeded() -> Iterator[None]:
    """Ctrl-C raises KeyboardInterrupt as usual, and `check` raises it again where a library has swallowed it.

    Python raises it wherever it is, in an import or a callback from C as well. Other threads than the first get none.
    """
    _pressed.clear()
    if current_thread() is not main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, _press)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def check() -> None:
    """Raise KeyboardInterrupt when Ctrl-C was pressed since `heeded` began."""
    if _pressed.is_set():
        raise KeyboardInterrupt


def _press(number: int, frame: Any) -> None:
    _pressed.set()
    raise KeyboardInterrupt
