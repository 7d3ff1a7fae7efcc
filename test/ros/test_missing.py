"""What the node says where tf2 has no transform: the text of tf2, and what to do. Its texts are those of Jazzy."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from rclpy.time import Time

from gapr_ros.node import frames, missing
from gapr_ros.node.refusal import RefusedError

NOW_S = 1_795_858_731.0
CHAIN = ", when looking up transform from frame [probe] to frame [ref]"
UNKNOWN = '"ref" passed to lookupTransform argument target_frame does not exist. '
APART = (
    "Could not find a connection between 'ref' and 'probe' because they are not part of the same tree."
    "Tf has two or more unconnected trees."
)
BAG = "apart: play /tf and --clock of the same bag, with use_sim_time:=true"


class TransformException(Exception):
    """As that of tf2."""


class LookupException(TransformException):
    pass


class ConnectivityException(TransformException):
    pass


class ExtrapolationException(TransformException):
    pass


def future(latest_s):
    text = f"Lookup would require extrapolation into the future.  Requested time {NOW_S:.6f} but the latest data is at"
    return ExtrapolationException(f"{text} time {latest_s:.6f}{CHAIN}")


def past(earliest_s):
    text = f"Lookup would require extrapolation into the past.  Requested time {NOW_S:.6f} but the earliest data is at"
    return ExtrapolationException(f"{text} time {earliest_s:.6f}{CHAIN}")


def only(one_s):
    text = f"Lookup would require extrapolation at time {NOW_S:.6f}, but only time {one_s:.6f} is in the buffer"
    return ExtrapolationException(text + CHAIN)


@pytest.mark.parametrize(("error", "remedy"), [
    (future(NOW_S - 0.002), "waited 0.1 s: raise tf_timeout, or send the frame more often"),
    (only(NOW_S - 0.5), "waited 0.1 s: raise tf_timeout, or send the frame more often"),
    (future(NOW_S - 30.0), "the last transform is 30 s older than the cloud: does its node still run"),
    (future(NOW_S - 500.0), "the last transform is 500 s older"),
    (future(1.7e9), f"clouds and /tf are 1109 days {BAG}, or start the node again that sent it, if it has stopped"),
    (past(NOW_S + 8.0), "the cloud is 8 s older than all that was heard: send the next one; if that lasts"),
    (past(NOW_S + 10_000.0), f"clouds and /tf are 3 h {BAG}"),
    (only(NOW_S + 1000.0), f"clouds and /tf are 17 min {BAG}"),
    (LookupException(UNKNOWN), "nobody sends 'ref' on /tf or /tf_static so far: start the node that does, or correct"),
    (LookupException("in other words"), "nobody sends 'ref' or 'probe' on /tf or /tf_static so far"),
    (ConnectivityException(APART), "nobody sends what leads from 'probe' to 'ref' so far: start the node that does"),
    (ExtrapolationException(CHAIN), "what was heard before was forgotten, and nothing has come since"),
])  # fmt: skip
def test_a_transform_that_is_missing_comes_with_tf2s_own_text_and_what_to_do(error, remedy):
    said = missing.explained(error, "ref", "probe", int(NOW_S * 1e9), 0.1003)
    assert said.startswith(f"{str(error).strip().rstrip('.')}; {remedy}") and ".;" not in said


def test_what_is_not_known_is_said_as_tf2_says_it():
    said = missing.explained(TransformException("ref does not exist."), "ref", "probe", int(NOW_S * 1e9))
    assert said == "ref does not exist"


@pytest.mark.parametrize(("ahead_s", "remedy"), [
    (1e8, f"or it was left out: clouds and /tf are 1157 days {BAG}"),
    (5.0, "or it was left out, with stamps ahead of the clock: synchronise the clocks"),
    (0.0, "so far: start the node that does"),
])  # fmt: skip
def test_a_frame_may_be_missing_because_its_stamps_are_ahead_of_the_clock(monkeypatch, ahead_s, remedy):
    """As those of the live /tf while a bag's clock runs: they never reach the buffer."""

    def lookup_transform(*_):
        raise LookupException(UNKNOWN)

    nothing = SimpleNamespace(unregister=lambda: None)
    buffer = SimpleNamespace(jump_handle=nothing, clear=lambda: None, can_transform=lambda *_: False,
                             lookup_transform=lookup_transform)  # fmt: skip
    tf2 = SimpleNamespace(Buffer=lambda node: buffer, TransformListener=lambda *_: nothing,
                          TransformException=TransformException)  # fmt: skip
    monkeypatch.setattr(frames, "_import_tf2", lambda: tf2)
    stamp = Time(nanoseconds=int(NOW_S * 1e9))
    looked_up = frames.Frames(None, publish=False, listen=True, is_future=lambda ns: ns > stamp.nanoseconds)
    looked_up._is_ahead(stamp.nanoseconds + int(ahead_s * 1e9))
    with pytest.raises(RefusedError, match="ref <- probe: .*does not exist; nobody sends 'ref'") as refused:
        looked_up.lookup("ref", "probe", stamp, 0.0)
    assert remedy in refused.value.text
