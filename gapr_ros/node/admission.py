"""Which clouds are let in: those of now, in a frame that a pose can be in; and what is said when time starts over."""

from __future__ import annotations

from std_msgs.msg import Header

from gapr_ros.node import intake, timeline
from gapr_ros.node.cloud_frames import SHOWN_S, CloudFrames
from gapr_ros.node.conflicts import Conflicts, names_of
from gapr_ros.node.frames import Frames
from gapr_ros.node.host import Host
from gapr_ros.node.timeline import Timeline

NO_CLOCK = "use_sim_time is true and no /clock has come: neither max_future nor max_cloud_age is checked"
STAMPS_WENT_BACK = "the stamps of the clouds went back"
CLOCK_WENT_BACK, CLOCK_CHANGED = "the clock jumped back", "the node's clock is another one now"
OVER = "time starts over and the track is cleared"
TWO_CLOCKS = "the clock jumped back, and has {} publishers on /clock ({}): each step back drops clouds; leave one"
BEHIND = (
    "/tf waits for stamps 10 s newer than those it had before, or tf2 would mix the poses of both rounds: "
    "play bags with --clock, for nodes with use_sim_time:=true, or start the listeners again and call ~/reset"
)


class Admission:
    """Judges frame and time of clouds as they arrive, and tells tf2 when time starts over. The executor's thread only.

    Args:
        host: the node.
        times: admits stamps.
        frames: what is looked up and sent.
        conflicts: where it goes what a user has to know.
    """

    def __init__(self, host: Host, times: Timeline, frames: Frames, conflicts: Conflicts) -> None:
        self._host, self._times, self._frames, self._conflicts = host, times, frames, conflicts
        self._cloud_frames = CloudFrames(conflicts)

    def admit(self, header: Header, now_ns: int, alone: bool) -> bool:
        """Judge a cloud before it can push another one out of the mailbox. True when time has started over with it.

        Raises:
            RefusedError: bad_frame, bad_fields, future or stale.
        """
        frame, parameters = intake.plain_frame(header.frame_id), self._host.parameters
        intake.check_frame(frame, parameters.model_frame)
        starts_over = self._times.admit(timeline.stamp_ns(header), now_ns, parameters, alone)
        if starts_over:
            self._conflicts.note("time", f"{STAMPS_WENT_BACK}: {OVER}", SHOWN_S)
            self._frames.hold()
            self._cloud_frames.forget()
        self._frames.note_cloud(timeline.stamp_ns(header))
        self._cloud_frames.note(frame, parameters.output_frame)
        return starts_over

    def start_over(self, why: str) -> None:
        """The clock jumped, which everybody knows who uses it: whatever comes next is the newest."""
        self.forget()
        self._frames.start_over()
        clocks = self._host.ros.get_publishers_info_by_topic("/clock") if why == CLOCK_WENT_BACK else []
        if len(clocks) > 1:
            self._conflicts.note("clocks", TWO_CLOCKS.format(len(clocks), names_of(clocks)), SHOWN_S)
        else:
            self._host.ros.get_logger().warning(f"{why}: {OVER}")

    def forget(self) -> None:
        """Whatever comes next is the newest, on /tf too: its listeners are started again."""
        self._times.forget()
        self._frames.forget()
        self._cloud_frames.forget()
        for kind in ("time", "/tf"):
            self._conflicts.note(kind, "")

    def note_clock(self, now_ns: int) -> None:
        """Say so while simulated time has no clock."""
        self._conflicts.note("clock", "" if now_ns else NO_CLOCK)

    def note_tf(self) -> None:
        """Say so while /tf waits."""
        self._conflicts.note("/tf", BEHIND if self._frames.behind else "")
