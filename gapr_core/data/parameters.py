"""Named anatomical parameters with ranges, and how a subject's are drawn."""

from __future__ import annotations

from dataclasses import field, fields
from typing import Any, TypeVar

import numpy as np

P = TypeVar("P")
SIZE_CORRELATION = 0.7  # how strongly lengths of one subject go together


def length(low: float, high: float) -> Any:
    """Declare a size, mm, that grows with the subject; about 95 % of subjects lie between `low` and `high`."""
    return field(default=(low + high) / 2.0, metadata={"range": (low, high), "grows": True})


def trait(low: float, high: float) -> Any:
    """Declare an angle, a ratio or another trait that does not go with body size."""
    return field(default=(low + high) / 2.0, metadata={"range": (low, high), "grows": False})


def draw(parameters: type[P], rng: np.random.Generator) -> P:
    """Draw one subject's parameters: normal about the middle of each range, two standard deviations to its ends,
    clipped.
    """
    body = rng.normal()
    values = {f.name: _draw_one(f.metadata, body, rng) for f in fields(parameters) if f.metadata}  # type: ignore[arg-type]
    return parameters(**values)


def _draw_one(metadata: Any, body: float, rng: np.random.Generator) -> float:
    low, high = metadata["range"]
    own = rng.normal()
    share = SIZE_CORRELATION if metadata["grows"] else 0.0
    z = share * body + np.sqrt(1.0 - share**2) * own
    return float(np.clip((low + high) / 2.0 + z * (high - low) / 4.0, low, high))
