"""A part of the network with flat tensors as arguments, which is what `torch.export` and ONNX take and store.

Everything but the tensors is frozen as it is in the example: the sizes of the clouds, how many there are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any

from torch import Tensor, nn


def leaves(value: Any) -> list[Tensor]:
    """The tensors inside nested dataclasses and tuples, in the order of their fields."""
    if isinstance(value, Tensor):
        return [value]
    if isinstance(value, tuple):
        return [leaf for v in value for leaf in leaves(v)]
    if is_dataclass(value):
        return [leaf for f in fields(value) for leaf in leaves(getattr(value, f.name))]
    return []


def with_leaves(value: Any, tensors: Iterator[Tensor]) -> Any:
    """The same structure with other tensors in place of its own."""
    if isinstance(value, Tensor):
        return next(tensors)
    if isinstance(value, tuple):
        return tuple(with_leaves(v, tensors) for v in value)
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{f.name: with_leaves(getattr(value, f.name), tensors) for f in fields(value)})
    return value


class Flat(nn.Module):
    """`part(*example)` as a function of the example's tensors; answers with the tensors of the part's answer.

    `torch.export.export(flat, tuple(flat.example))` gives a program for clouds of the example's sizes.
    """

    def __init__(self, part: nn.Module, *example: Any) -> None:
        super().__init__()
        self.part, self.structure = part, example

    @property
    def example(self) -> list[Tensor]:
        """Arguments of one call."""
        return leaves(self.structure)

    def forward(self, *tensors: Tensor) -> list[Tensor]:
        return leaves(self.part(*with_leaves(self.structure, iter(tensors))))
