"""What to do where tf2 has no transform: its own text does not say. Its exception and the stamps in the text do."""

from __future__ import annotations

import re

FAR_S = 600.0  # clouds and transforms that are so far apart are not of one recording, nor of one clock
LATE_S = 2.0  # a transform that is so much older than the cloud is not late: it does not come
TIMES = re.compile(r"\btime (\d+\.\d+)")  # the last one in the text is that of what tf2 has
UNKNOWN = re.compile(r'^"([^"]+)" passed to .* does not exist')
SAME_BAG = "play /tf and --clock of the same bag, with use_sim_time:=true"


def explained(
    error: Exception, parent: str, child: str, stamp_ns: int, waited_s: float = 0.0, ahead_ns: int = 0
) -> str:
    """The text of tf2 without its full stop, and a remedy where the case is a known one.

    Args:
        error: of tf2's look-up.
        parent, child: names of frames.
        stamp_ns: of the cloud; 0 for the newest transform there is.
        waited_s: how long the transform was waited for.
        ahead_ns: stamp of a transform that was left out since it is ahead of the clock; 0 for none.
    """
    text = str(error).strip().rstrip(".")
    remedy = _remedy(type(error).__name__, text, (parent, child), stamp_ns * 1e-9, waited_s, ahead_ns * 1e-9)
    return f"{text}; {remedy}" if remedy else text


def _remedy(kind: str, text: str, names: tuple[str, str], stamp_s: float, waited_s: float, ahead_s: float) -> str:
    unknown, times = UNKNOWN.match(text), TIMES.findall(text)
    if times and stamp_s:
        return _out_of_range(stamp_s, float(times[-1]), waited_s)
    if text.startswith(","):  # tf2 knows the frames, and no transform of them
        return "what was heard before was forgotten, and nothing has come since"
    if unknown or kind == "LookupException":
        who = f"'{unknown[1]}'" if unknown else " or ".join(f"'{name}'" for name in names)
        return _never_heard(f"nobody sends {who} on /tf or /tf_static so far", stamp_s, ahead_s)
    if kind == "ConnectivityException":
        return _never_heard(f"nobody sends what leads from '{names[1]}' to '{names[0]}' so far", stamp_s, ahead_s)
    return ""


def _out_of_range(stamp_s: float, held_s: float, waited_s: float) -> str:
    """The cloud has another time than all transforms: `held_s` is that of the nearest."""
    apart_s, is_newer = abs(stamp_s - held_s), stamp_s > held_s
    if apart_s > FAR_S:
        or_stopped = ", or start the node again that sent it, if it has stopped" if is_newer else ""
        return f"clouds and /tf are {_span(apart_s)} apart: {SAME_BAG}{or_stopped}"
    if not is_newer:
        how = "send the next one; if that lasts, send it sooner, or by the clock of /tf"
        return f"the cloud is {apart_s:.3g} s older than all that was heard: {how}"
    if apart_s > LATE_S:
        return f"the last transform is {apart_s:.3g} s older than the cloud: does its node still run, by this clock?"
    waited = f"waited {waited_s:.2g} s: " if waited_s >= 0.001 else ""
    return f"{waited}raise tf_timeout, or send the frame more often"


def _never_heard(what: str, stamp_s: float, ahead_s: float) -> str:
    """Transforms that are ahead of the clock were left out: theirs may be the frame."""
    if stamp_s and ahead_s - stamp_s > FAR_S:
        return f"{what}, or it was left out: clouds and /tf are {_span(ahead_s - stamp_s)} apart: {SAME_BAG}"
    if ahead_s:
        return f"{what}, or it was left out, with stamps ahead of the clock: synchronise the clocks"
    return f"{what}: start the node that does, or correct the name"


def _span(seconds: float) -> str:
    for unit, name in ((86400.0, "days"), (3600.0, "h")):
        if seconds >= 2.0 * unit:
            return f"{seconds / unit:.0f} {name}"
    return f"{seconds / 60.0:.0f} min"
