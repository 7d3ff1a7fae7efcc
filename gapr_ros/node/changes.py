"""Parameters that change while the node runs, and on which more rests than the next cloud."""

from __future__ import annotations

from typing import Any

from gapr_ros.parameters import NodeParameters

OF_BONE = "model_path", "model_label", "model_unit", "model_scale", "model_axes"  # read with the bone


class Changes:
    """Tells what has changed since it was asked last.

    Args:
        made_from: the parameters that the method was made from.
        now: those by which clouds are read.
    """

    def __init__(self, made_from: NodeParameters, now: NodeParameters) -> None:
        self._made_from, self._limits, self._reading = made_from, _limits(made_from), _reading(now)

    def of_bone(self, now: NodeParameters) -> list[str]:
        """Names of what says which bone it is and is not as the bone was read with."""
        return [name for name in OF_BONE if getattr(now, name) != getattr(self._made_from, name)]

    def in_reading(self, now: NodeParameters) -> bool:
        """Clouds are read in another way: what was collected cannot be registered with what comes."""
        before, self._reading = self._reading, _reading(now)
        return before != self._reading

    def in_limits(self, now: NodeParameters) -> bool:
        """What the method itself refuses by is another: a new method is needed, for the same bone."""
        before, self._limits = self._limits, _limits(now)
        return before != self._limits


def _reading(parameters: NodeParameters) -> tuple[Any, ...]:
    box = parameters.crop_min, parameters.crop_max
    return parameters.cloud_unit, parameters.range_min, parameters.range_max, *box


def _limits(parameters: NodeParameters) -> tuple[float, ...]:
    return parameters.min_confidence, parameters.max_tre
