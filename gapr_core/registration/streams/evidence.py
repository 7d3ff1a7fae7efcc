"""Evidence of a stream for both numbers: this pose, and this bone.

The log odds of frame k are a + b + e_k. a is true of all frames (right or wrong), b an effect of this pair of bones and
of the measurement, e_k an effect of the frame. With variances s_b^2 and s_e^2 alike for right and wrong, n frames of
mean m have the log odds m / (rho + (1 - rho) / n), where rho = s_b^2 / (s_b^2 + s_e^2). So frames that agree raise the
evidence, never beyond m / rho: counting makes nothing certain. `gapr_core.calibration` fits both rho on train streams.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gapr_core.registration.confidence.classifier import LARGEST_EVIDENCE, LARGEST_LOG_ODDS, Judgement

MEMORY = 10.0  # frames after which a frame's weight has fallen to about 1/e
AGREE_MM = 15.0  # largest motion between frames (rms) of a track
SAME_MM = 1e-4  # rounding to single precision; the noise of a new measurement moves the mean farther


def fingerprint(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute (7,) number, mean and standard deviations, mm, of points (N, 3): their order does not matter."""
    return np.hstack([len(points), points.mean(axis=0), points.std(axis=0)]) if len(points) else np.zeros(7)


def is_repeated(cloud: NDArray[np.float64], before: NDArray[np.float64]) -> bool:
    """Return True where two fingerprints are of the same points, up to rounding: a driver sent the last cloud again."""
    return bool(np.abs(cloud - before).max() <= SAME_MM)


class Evidence:
    """Combined numbers of a stream on one target: observe each frame, reset with another target.

    Args:
        rho_pose, rho_bone: correlation of two frames, 0 independent, 1 identical.
    """

    def __init__(self, rho_pose: float, rho_bone: float) -> None:
        self._rho = np.array([rho_pose, rho_bone])
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        # sums over the frames, older ones with less weight: (2,) log odds of the pose and evidence of the bone,
        # (2,) weights, and the number of frames that agree, up to the last one
        self._now = self._before = np.zeros(2), np.zeros(2), 0

    def observe(self, frame: Judgement, agrees: bool, again: bool = False) -> Judgement:
        """Judge a frame in the light of those before it.

        Args:
            frame: the numbers of this frame alone; NaN comes back and is not counted.
            agrees: its pose continues the last one. After a jump the frames before it do not support it: evidence for
                pose or bone is forgotten, evidence against them is not.
            again: it repeats the last frame, which is counted once, with the new numbers.
        """
        own = np.array([frame.pose_log_odds, frame.bone_evidence])
        if not np.isfinite(own).all():
            return frame
        self._before = self._before if again else self._now
        total, weight, frames = self._before
        if not agrees:
            total, weight, frames = np.minimum(total, 0.0), weight * (total <= 0.0), 0
        kept = 1.0 - 1.0 / MEMORY
        total, weight, frames = kept * total + own, kept * weight + 1.0, frames + 1
        self._now = total, weight, frames
        combined = total / weight / (self._rho + (1.0 - self._rho) / frames)
        if not agrees:
            combined = np.minimum(combined, own)
        limits = np.array([LARGEST_LOG_ODDS, LARGEST_EVIDENCE])
        pose, bone = np.clip(combined, -limits, limits)
        return replace(frame, pose_log_odds=float(pose), bone_evidence=float(bone))
