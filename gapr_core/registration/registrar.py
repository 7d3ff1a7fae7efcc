"""The algorithm on one screen: prepare, propose, verify, refine, assess."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core import confidence, covariance, doubts
from gapr_core import source as sources
from gapr_core import target as targets
from gapr_core.clouds import Surface
from gapr_core.confidence import Calibration
from gapr_core.config import RegistrarConfig
from gapr_core.errors import ConfigError, InvalidPointCloudError, MethodUnavailableError
from gapr_core.geometry import se3
from gapr_core.proposals.base import Proposer
from gapr_core.proposals.search import NormalAlignedSearch
from gapr_core.refinement import Fit, evaluate, refine_fully
from gapr_core.results import RegistrationResult, RegistrationStatus
from gapr_core.smooth_bias import compensate
from gapr_core.source import PreparedSource, Unusable
from gapr_core.target import PreparedTarget
from gapr_core.verification import Candidates, verify

Array = NDArray[np.float64]

BOTH_WALLS = 0.82  # a source follows both walls of a hollow bone when they leave less than this share of its residuals
UNFAMILIAR = 0.85  # such a source, which no probe gives, is not what the confidence was fitted on: it is at most this
DOUBT = 0.4  # the confidence is at most this where a rule, not the model, says that the pose may be another one


class Registrar:
    """Lays partial sources on one or many prepared targets.

    Proposers are asked in turn, each round with the poses of all so far, until an answer is sure: with the shipped
    weights the network first, and the exhaustive search only where the network's answer leaves a doubt.

    Args:
        config: every setting.
        proposers: where hypotheses come from; the weight-free search when not given.
        calibrations: the confidence model of each round; the shipped ones when not given.
    """

    name = "gapr"

    def __init__(
        self,
        config: RegistrarConfig | None = None,
        proposers: Sequence[Proposer] | None = None,
        calibrations: Sequence[Calibration] | None = None,
    ) -> None:
        self.config = config or RegistrarConfig()
        self.proposers: tuple[Proposer, ...] = tuple(proposers or (_search(self.config),))
        self.calibrations = tuple(calibrations or (Calibration.shipped(p.name) for p in self.proposers))
        if len(self.calibrations) != len(self.proposers):
            given = f"{len(self.calibrations)} for {len(self.proposers)} proposers"
            raise ConfigError("one confidence model for each proposer", given, "pass as many")

    @classmethod
    def from_pretrained(cls, config: RegistrarConfig | None = None, device: str = "cpu") -> Registrar:
        """The best registrar that ships: GAPR-Net, then the search; nothing is downloaded.

        Args:
            config: every setting.
            device: where the network runs: "cpu", "cuda", or "auto" for the GPU where there is one.

        Raises:
            MethodUnavailableError: torch is not installed; `Registrar()` works without.
            ConfigError: no such device.
        """
        config = config or RegistrarConfig()
        return cls(config, (_network(device), _search(config)))

    def prepare(self, target: str | Path | ArrayLike | Surface, units: str = "mm") -> PreparedTarget:
        """Everything static about a target, the proposers' share included; see `gapr_core.target.prepare`."""
        prepared = targets.prepare(target, units, self.config.target)
        for proposer in self.proposers:
            for each in filter(None, (prepared, prepared.both_walls)):
                proposer.prepare(each)
        return prepared

    def register(
        self, source: ArrayLike, target: PreparedTarget, initial: ArrayLike | None = None
    ) -> RegistrationResult:
        """The pose of a source on the target, or a refusal.

        Args:
            source: (N, 3), mm, in its own frame; rows that are not finite are dropped.
            target: from `prepare`.
            initial: (4, 4) T_target_source to try besides all others, such as the pose of the frame before.

        Raises:
            InvalidPointCloudError: wrong shape or type, or an extent that cannot be a piece of a bone in mm.
        """
        clock = _Clock()
        prepared = sources.prepare(source, self.config.source)
        if isinstance(prepared, Unusable):
            return RegistrationResult(prepared.status, reason=prepared.reason, stage_ms=clock.lap("prepare"))
        clock.lap("prepare")
        poses = np.empty((0, 4, 4)) if initial is None else _rigid(initial)[None]
        result = self._in_rounds(prepared, target, poses, clock)
        if target.both_walls is not None and self._follows_both_walls(prepared, target.both_walls, result):
            result = self._in_rounds(prepared, target.both_walls, result.details["best_pose"][None], clock, UNFAMILIAR)
        return replace(result, stage_ms=clock.stages)

    def _in_rounds(
        self, prepared: PreparedSource, target: PreparedTarget, poses: Array, clock: _Clock, most: float = 1.0
    ) -> RegistrationResult:
        """Ask one proposer after the other until an answer is sure; `most` limits the confidence."""
        result = RegistrationResult(RegistrationStatus.LOW_CONFIDENCE, reason="nothing was proposed")
        fit: Fit | None = None
        for number, (proposer, calibration) in enumerate(zip(self.proposers, self.calibrations, strict=True), 1):
            rng = np.random.default_rng(self.config.seed)
            poses = np.concatenate([poses, proposer.propose(prepared, target, rng).poses])
            clock.lap("propose")
            if len(poses):
                candidates = verify(poses, prepared, target, self.config.verification, self.config.num_threads)
                clock.lap("verify")
                fit = refine_fully(
                    candidates.poses[0], prepared.points, target, self.config.refinement, prepared.neighbours
                )
                clock.lap("refine")
                result = self._assess(fit, candidates, prepared, target, calibration, most)
            result = replace(result, details=result.details | {"rounds": number, "proposer": proposer.name})
            clock.lap("assess")
            if result.confidence >= max(self.config.sure, self.config.min_confidence):
                break
        if fit is not None and result.covariance is not None:
            result = self._freed_from_bias(result, fit, result.covariance, prepared, target)
            clock.lap("refine")
        return result

    def _freed_from_bias(
        self, result: RegistrationResult, fit: Fit, known: Array, source: PreparedSource, target: PreparedTarget
    ) -> RegistrationResult:
        """An accepted answer, of covariance `known`, with its pose and what follows from it freed of smooth bias."""
        config = self.config
        freed = compensate(fit, known, source, target, config.smooth_bias, config.refinement)
        if freed is fit:
            return result
        uncertainty, centre_mm = covariance.estimate(freed, config.covariance), freed.moved.mean(axis=0)
        return replace(
            result,
            T_target_source=freed.T,
            covariance=uncertainty.covariance,
            tre_mm=uncertainty.tre_mm(target.points, centre_mm),
            centre_mm=centre_mm,
        )

    def _follows_both_walls(
        self, prepared: PreparedSource, both_walls: PreparedTarget, result: RegistrationResult
    ) -> bool:
        """True when the inner wall explains much of what the outer one leaves open: no probe sees it, a mesh has it."""
        if "best_pose" not in result.details:
            return False
        fit = evaluate(result.details["best_pose"], prepared.points, both_walls, self.config.refinement)
        return bool(fit.sigma_mm < BOTH_WALLS * np.exp(result.details["log_sigma"]))

    def _assess(
        self,
        fit: Fit,
        candidates: Candidates,
        source: PreparedSource,
        target: PreparedTarget,
        calibration: Calibration,
        most: float,
    ) -> RegistrationResult:
        uncertainty = covariance.estimate(fit, self.config.covariance)
        figures = confidence.measure(fit, candidates, uncertainty, source, target)
        probability = min(calibration.probability(figures), most)
        pushed = probability >= self.config.min_confidence and doubts.can_be_pushed(
            fit, source, target, self.config.verification, self.config.num_threads
        )
        if pushed or doubts.is_matched(candidates) or doubts.is_loose(uncertainty):
            probability = min(probability, DOUBT)
        common = {
            "confidence": probability,
            "inlier_ratio": figures["inlier_ratio"],
            "alternatives": tuple(candidates.poses[1:]),
            "details": figures | {"best_pose": fit.T, "bias_mm": uncertainty.bias_mm},
        }
        if not probability >= self.config.min_confidence:  # nor where it is no number
            status, reason = doubts.why_not(candidates, uncertainty, probability, pushed)
            return RegistrationResult(status, reason=reason, **common)  # type: ignore[arg-type]
        centre_mm = fit.moved.mean(axis=0)
        return RegistrationResult(
            RegistrationStatus.OK,
            fit.T,
            uncertainty.covariance,
            tre_mm=uncertainty.tre_mm(target.points, centre_mm),
            centre_mm=centre_mm,
            **common,  # type: ignore[arg-type]
        )


def _network(device: str) -> Proposer:
    try:
        from gapr_core.proposals.network import NetworkProposer
    except ImportError as error:
        mend = "run: pip install torch safetensors, or take Registrar(), which needs no network"
        raise MethodUnavailableError("torch and safetensors for GAPR-Net", str(error), mend) from error
    return NetworkProposer.from_weights(device=device)


def _search(config: RegistrarConfig) -> NormalAlignedSearch:
    return NormalAlignedSearch(config.search, config.num_threads)


def _rigid(pose: ArrayLike) -> Array:
    T = np.asarray(pose, dtype=np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise InvalidPointCloudError("a finite (4, 4) initial pose", f"shape {T.shape}", "pass T_target_source in mm")
    return se3.nearest_rigid(T)


class _Clock:
    """Wall time of each stage, ms, summed over the rounds."""

    def __init__(self) -> None:
        self.stages: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> dict[str, float]:
        now = time.perf_counter()
        self.stages[stage] = self.stages.get(stage, 0.0) + (now - self._last) * 1000.0
        self._last = now
        return self.stages
