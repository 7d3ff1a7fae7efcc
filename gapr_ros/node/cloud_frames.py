"""The frames that clouds come in: with several of them the parent of the bone changes from cloud to cloud."""

from __future__ import annotations

from gapr_ros.node.conflicts import Conflicts

MOST_NAMED = 5
SHOWN_S = 10.0  # after the last change


class CloudFrames:
    """Notes a conflict each time that the frame changes while no `output_frame` keeps the bone's parent the same."""

    def __init__(self, conflicts: Conflicts) -> None:
        self._conflicts = conflicts
        self._all: list[str] = []
        self._last = ""

    def note(self, frame: str, output_frame: str) -> None:
        """A cloud came in this frame."""
        if frame not in self._all and len(self._all) < MOST_NAMED:
            self._all.append(frame)
        before, self._last = self._last, frame
        if before in ("", frame) or output_frame:
            return
        text = (
            f"clouds come in {len(self._all)} frames ({', '.join(self._all)}): the parent of the bone changes with them"
        )
        self._conflicts.note("cloud frames", f"{text}; set output_frame", SHOWN_S)

    def forget(self) -> None:
        """The next frame is the first one."""
        self._all, self._last = [], ""
        self._conflicts.note("cloud frames", "")
