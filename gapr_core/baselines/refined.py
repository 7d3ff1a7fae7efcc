"""Composition: one or more coarse methods, each refined by a fine one, the best kept by residual."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from numpy.typing import ArrayLike

from gapr_core.baselines.base import Baseline, RegistrationMethod
from gapr_core.results import RegistrationResult


class Refined:
    """`Refined(KissMatcher(), PointToPlane())`, or with several coarse methods: all refined, lowest residual wins.

    Args:
        coarse: one method or several.
        fine: a baseline that takes an initial pose.
        name: defaults to the names of both.
    """

    def __init__(
        self, coarse: RegistrationMethod | Sequence[RegistrationMethod], fine: Baseline, name: str | None = None
    ) -> None:
        self.coarse = list(coarse) if isinstance(coarse, Sequence) else [coarse]
        self.fine = fine
        self.name = name or "+".join([*(method.name for method in self.coarse), fine.name])

    def prepare(self, target: Any, units: str = "mm") -> tuple[list[Any], Any]:
        """Prepare the target for every coarse method and for the fine one."""
        fine = self.fine.prepare(target, units)
        return [method.prepare(fine) for method in self.coarse], fine

    def register(self, source: ArrayLike, target: Any) -> RegistrationResult:
        """Pose with the lowest truncated residual after refinement; a refusal when every coarse method refused."""
        coarse_targets, fine_target = target if isinstance(target, tuple) else self.prepare(target)
        start = time.perf_counter()
        coarse = [method.register(source, own) for method, own in zip(self.coarse, coarse_targets, strict=True)]
        middle = time.perf_counter()
        seeds = [result.T_target_source for result in coarse if result.T_target_source is not None]
        refined = [self.fine.register(source, fine_target, initial=seed) for seed in seeds]
        stage_ms = {"coarse": (middle - start) * 1e3, "refine": (time.perf_counter() - middle) * 1e3}
        best = min(
            [r for r in refined if r.ok], key=lambda r: r.features["residual_mm"], default=(refined or coarse)[0]
        )
        return replace(best, method=self.name, stage_ms=stage_ms)
