"""The one owner of time: which clouds are of now, and when time has started over."""

from __future__ import annotations

from std_msgs.msg import Header

from gapr_ros.node.refusal import Reason, RefusedError
from gapr_ros.parameters import NodeParameters

LAST_NS = 2**31 * 1_000_000_000  # the seconds of a stamp are an int32
BACK_NS = 1_000_000_000  # older than the newest cloud by more than this: the stamps went back
RESTART_AFTER = 3  # so many clouds in a row whose stamps went back are no stragglers: time has started over


def stamp_ns(header: Header) -> int:
    """The stamp, ns; 0 when there is none."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


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


def check_age(stamp: int, now_ns: int, max_age_s: float) -> None:
    """Refuse a cloud that is too old. Off without a limit, before the clock runs and for clouds without a stamp.

    Raises:
        RefusedError: stale.
    """
    age_s = (now_ns - stamp) * 1e-9
    if max_age_s > 0.0 and now_ns > 0 and stamp > 0 and age_s > max_age_s:
        raise RefusedError(Reason.STALE, f"the cloud is {age_s:.3g} s old, max_cloud_age is {max_age_s:g} s")


class Timeline:
    """Judges the clouds as they arrive; what it refuses changes nothing, here or elsewhere.

    A stamp that went back is that of a straggler, or time has started over, as in a bag that is looped without
    simulated time. One cloud cannot say which: it is refused. Several in a row that arrive one after the other with
    stamps that go forward among themselves can: with the last of them time starts over.
    """

    def __init__(self) -> None:
        self._newest_ns = 0
        self._back_ns: list[int] = []  # stamps of the clouds in a row that went back

    def admit(self, stamp: int, now_ns: int, parameters: NodeParameters) -> bool:
        """Let a cloud of now pass. True when time has started over with it.

        Args:
            stamp: of a cloud that has just arrived, ns; 0 for none.
            now_ns: the clock, ns; 0 while it does not run.
            parameters: `max_future` and `max_cloud_age`.

        Raises:
            RefusedError: bad_fields, future or stale.
        """
        check_stamp(stamp)
        check_future(stamp, now_ns, parameters.max_future)
        check_age(stamp, now_ns, parameters.max_cloud_age)
        stamp = stamp or now_ns
        if stamp >= self._newest_ns - BACK_NS:
            self._newest_ns, self._back_ns = max(stamp, self._newest_ns), []
            return False
        self._note_back(stamp)
        self._newest_ns, self._back_ns = stamp, []
        return True

    def forget(self) -> None:
        """Time starts over: whatever comes next is the newest."""
        self.__init__()  # type: ignore[misc]

    def _note_back(self, stamp: int) -> None:
        """Count a stamp that went back; refuse it until there are enough of them."""
        goes_on = bool(self._back_ns) and stamp > self._back_ns[-1]
        self._back_ns = [*self._back_ns, stamp] if goes_on else [stamp]
        if len(self._back_ns) < RESTART_AFTER:
            behind_s = (self._newest_ns - stamp) * 1e-9
            count = f"{len(self._back_ns)} of {RESTART_AFTER} in a row that start time over"
            raise RefusedError(Reason.STALE, f"the stamp is {behind_s:.3g} s behind the newest cloud's ({count})")
