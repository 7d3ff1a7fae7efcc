"""What became of one cloud."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from std_msgs.msg import Header

from gapr_core.results import RegistrationResult, confidence_text
from gapr_ros.node.refusal import Reason
from gapr_ros.node.worker import Job

Array = NDArray[np.float64]
OLD_S = 1.0  # age of a cloud from which on an answer says it: ~/register takes the newest there is, however old


@dataclass(frozen=True, eq=False)
class Found:
    """Where the bone is.

    Attributes:
        pose: (4, 4) T_frame_model, metres.
        covariance: (6, 6) of that pose, metres and radians, fixed axes of the frame.
    """

    pose: Array
    covariance: Array


@dataclass
class Outcome:
    """Filled step by step while a cloud is processed; a pose only when there is no reason against it.

    Attributes:
        job: where the cloud came from and who waits for it.
        cloud_frame: frame of the cloud.
        header: frame of the pose (`output_frame` or that of the cloud) and stamp of the cloud.
        reason: why there is no pose, or None.
        text: the reason in full.
        found: where the bone is in the frame; None when refused.
        followed: (4, 4) T_frame_model, metres, of a cloud that was not assessed; it then has no pose and no reason.
        confidence: of the registration, 0 to 1, whatever was decided later.
        points_in: of the message.
        points_used: given to registration, with those of the clouds that are registered with it.
        seen_from: (3,) mm, frame of the cloud: where its pixels say that the camera was, if they were asked and say.
        age_s: of the cloud when it was taken in hand; None while the clock does not run.
        tre_mm, tre95_mm, inlier_ratio: of the registration.
        result: its whole answer; None where it was not asked.
        has_initial_pose: the registration began at a pose from outside.
        found_by: how far the registration had to look: track, network, search, or scene, a camera's view.
        tf_wait_s: of it, how long transforms were waited for.
        exec_ms: wall time of the whole way.
    """

    job: Job
    cloud_frame: str = ""
    header: Header = field(default_factory=Header)
    reason: Reason | None = None
    text: str = ""
    found: Found | None = None
    followed: Array | None = None
    confidence: float = 0.0
    points_in: int = 0
    points_used: int = 0
    seen_from: Array | None = None
    age_s: float | None = None
    tre_mm: float | None = None
    tre95_mm: float | None = None
    result: RegistrationResult | None = None
    inlier_ratio: float = 0.0
    has_initial_pose: bool = False
    found_by: str = ""
    tf_wait_s: float = 0.0
    exec_ms: float = 0.0

    @property
    def ok(self) -> bool:
        """True when the pose goes out."""
        return self.found is not None

    @property
    def confidence_out(self) -> float:
        """What ~/confidence says: 0 when refused."""
        return self.confidence if self.ok else 0.0

    def refuse(self, reason: Reason, text: str) -> None:
        """Take the pose away."""
        self.reason, self.text = reason, text
        self.found = self.followed = None

    @classmethod
    def refused(cls, job: Job, header: Header, reason: Reason, text: str) -> Outcome:
        """Of a cloud that is not taken in at all."""
        return cls(job, header.frame_id, header, reason, text)

    def answer_waiters(self) -> None:
        """Give it to those who wait for it."""
        for waiter in self.job.waiters:
            waiter.set_result(self)

    def __str__(self) -> str:
        if self.ok:
            said = f"OK  confidence {confidence_text(self.confidence)}"
            said += "" if self.tre_mm is None else f"  TRE {self.tre_mm:.1f} mm"
            said += f"  inliers {self.inlier_ratio:.2f}  {self.exec_ms:.0f} ms"
            return said + (f"  the cloud is {self.age_s:.1f} s old" if (self.age_s or 0.0) > OLD_S else "")
        return f"refused: {self.reason}" + (f": {self.text}" if self.text else "")
