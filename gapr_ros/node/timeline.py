"""The one owner of time: which clouds are of now, and when time has started over."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from rclpy.time import Time
from std_msgs.msg import Header

from gapr_core.geometry import se3
from gapr_ros.node.refusal import Reason, RefusedError
from gapr_ros.parameters import NodeParameters

Array = NDArray[np.float64]
LAST_NS = 2**31 * 1_000_000_000  # the seconds of a stamp are an int32
BACK_NS = 1_000_000_000  # older than the newest cloud by more than this: the stamps went back
RESTART_AFTER = 3  # so many clouds in a row whose stamps went back are no stragglers: time has started over
ALIKE_M = 1e-5  # two poses of one stamp that move no point of the bone by more are the same


def stamp_ns(header: Header) -> int:
    """The stamp, ns; 0 when there is none."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def stamp_text(header: Header) -> str:
    """The stamp as seconds with nine decimals."""
    return f"{header.stamp.sec}.{header.stamp.nanosec:09d}"


def age_s(stamp: int, now_ns: int) -> float | None:
    """How old a stamp, ns, is, s; None without one, and while no clock runs."""
    return (now_ns - stamp) * 1e-9 if stamp and now_ns else None


def normal(header: Header) -> Header:
    """The header with a stamp whose nanoseconds are less than a second; stamp 0 where it is no time."""
    stamp = stamp_ns(header)
    known = stamp if 0 <= stamp < LAST_NS else 0
    return Header(frame_id=header.frame_id, stamp=Time(nanoseconds=known).to_msg())


def check_stamp(stamp: int) -> None:
    """Refuse what is no time: a negative stamp, or one whose nanoseconds run over the last second.

    Raises:
        RefusedError: bad_fields.
    """
    if not 0 <= stamp < LAST_NS:
        raise RefusedError(Reason.BAD_FIELDS, f"the stamp is no time: {stamp} ns")


def check_future(stamp: int, now_ns: int, max_future_s: float) -> None:
    """Refuse a cloud whose stamp is ahead of the clock: every listener of tf2 would drop what comes after it as old.

    Off without a limit, before the clock runs and for clouds without a stamp.

    Raises:
        RefusedError: future.
    """
    ahead_s = (stamp - now_ns) * 1e-9
    if max_future_s > 0.0 and now_ns > 0 and stamp > 0 and ahead_s > max_future_s:
        text = f"the stamp is {ahead_s:.3g} s ahead of the clock, max_future is {max_future_s:g} s"
        raise RefusedError(Reason.FUTURE, f"{text}; synchronise the clocks")


def is_far_ahead(stamp: int, now_ns: int, max_future_s: float) -> bool:
    """Whether the stamp of a transform is a second more ahead of the clock than that of a cloud may be.

    Some nodes send transforms that hold for the second to come, as AMCL does. Off as `check_future` is.
    """
    return max_future_s > 0.0 and now_ns > 0 and stamp - now_ns > max_future_s * 1e9 + BACK_NS


def check_age(stamp: int, now_ns: int, max_age_s: float) -> None:
    """Refuse a cloud that is too old. Off without a limit, before the clock runs and for clouds without a stamp.

    Raises:
        RefusedError: stale.
    """
    age = age_s(stamp, now_ns)
    if max_age_s > 0.0 and age is not None and age > max_age_s:
        raise RefusedError(Reason.STALE, f"the cloud is {age:.3g} s old, max_cloud_age is {max_age_s:g} s")


class Timeline:
    """Judges the clouds as they arrive and their answers; what it refuses changes nothing, here or elsewhere.

    The poses that go out are in the order of their stamps, one for each stamp: tf2 has one transform for a stamp, and
    its latest one is that with the newest stamp. A stamp behind the last answer with a pose is that of a straggler, as
    of a camera that is slower than another one. One that went back by more than a second may be one, too, or time has
    started over, as in a bag that is looped without simulated time. One cloud cannot say which: it is refused. Several
    in a row that arrive one after the other with stamps that go forward among themselves can: with the last of them
    time starts over. So it does with one that has the very stamp with which this round began, where all clouds come
    from one publisher: a bag that is played once more.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Time starts over: whatever comes next is the newest."""
        self._newest_ns = 0
        self._first_ns, self._count = 0, 0  # of this round
        self._answered_ns, self._answered_in, self._answer = 0, "", np.eye(4)  # the last pose that went out
        self._shown_ns = 0  # of the last pose that was followed
        self._back_ns: list[int] = []  # stamps of the clouds in a row that went back

    def admit(self, stamp: int, now_ns: int, parameters: NodeParameters, alone: bool = False) -> bool:
        """Let a cloud of now pass. True when time has started over with it.

        Args:
            stamp: of a cloud that has just arrived, ns; 0 for none.
            now_ns: the clock, ns; 0 while it does not run.
            parameters: `max_future` and `max_cloud_age`.
            alone: all clouds come from one publisher.

        Raises:
            RefusedError: bad_fields, future or stale.
        """
        check_stamp(stamp)
        check_future(stamp, now_ns, parameters.max_future)
        check_age(stamp, now_ns, parameters.max_cloud_age)
        stamp = stamp or now_ns
        if stamp >= max(self._newest_ns - BACK_NS, self._answered_ns):
            self._first_ns, self._count = self._first_ns if self._count else stamp, self._count + 1
            self._newest_ns, self._back_ns = max(stamp, self._newest_ns), []
            return False
        first_ns = stamp if alone and self._begins_again(stamp) else self._note_back(stamp)
        self.forget()
        self._newest_ns, self._first_ns, self._count = stamp, first_ns, 1
        return True

    def check_answer(self, T_frame_model: Array, header: Header, points_m: Array) -> None:
        """Refuse a pose that would go out behind a newer one, or as the second one of its stamp.

        Args:
            T_frame_model: (4, 4), metres.
            header: frame and stamp of the pose.
            points_m: (N, 3) of the bone in its own frame.

        Raises:
            RefusedError: stale.
        """
        stamp = stamp_ns(header)
        if stamp < self._answered_ns:  # it was let in before the newer one was answered
            raise RefusedError(Reason.STALE, self._older(stamp))
        if 0 < stamp == self._answered_ns and not self._is_sent(T_frame_model, header.frame_id, points_m):
            text = "another pose was sent for this stamp, and stands; send clouds with stamps of their own, or ~/reset"
            raise RefusedError(Reason.STALE, text)

    def note_answer(self, T_frame_model: Array, header: Header) -> None:
        """This pose goes out."""
        self._answered_ns, self._answered_in, self._answer = stamp_ns(header), header.frame_id, T_frame_model

    def admit_shown(self, T_frame_model: Array, header: Header, points_m: Array) -> bool:
        """Whether a pose that was followed is newer than all that went out; it is the last one shown from now on."""
        try:
            self.check_answer(T_frame_model, header, points_m)
        except RefusedError:
            return False
        is_next = stamp_ns(header) > self._shown_ns or not self._shown_ns
        self._shown_ns = max(self._shown_ns, stamp_ns(header))
        return is_next

    def _is_sent(self, T_frame_model: Array, frame: str, points_m: Array) -> bool:
        """Whether the pose is the one that went out last."""
        moved = se3.apply(T_frame_model, points_m) - se3.apply(self._answer, points_m)
        return frame == self._answered_in and bool((np.linalg.norm(moved, axis=1) <= ALIKE_M).all())

    def _older(self, stamp: int) -> str:
        return f"the stamp is {(self._answered_ns - stamp) * 1e-9:.3g} s older than the last answer with a pose"

    def _begins_again(self, stamp: int) -> bool:
        """Whether a round of several clouds began with this stamp."""
        return stamp == self._first_ns and self._count >= RESTART_AFTER

    def _note_back(self, stamp: int) -> int:
        """Count a stamp that went far back, and refuse it until there are enough of them; the first of them."""
        if stamp >= self._newest_ns - BACK_NS:
            raise RefusedError(Reason.STALE, self._older(stamp))
        goes_on = bool(self._back_ns) and stamp > self._back_ns[-1]
        self._back_ns = [*self._back_ns, stamp] if goes_on else [stamp]
        if len(self._back_ns) < RESTART_AFTER:
            behind_s = (self._newest_ns - stamp) * 1e-9
            count = f"{len(self._back_ns)} of {RESTART_AFTER} in a row that start time over"
            raise RefusedError(Reason.STALE, f"the stamp is {behind_s:.3g} s behind the newest cloud's ({count})")
        return self._back_ns[0]
