"""One file for each step of a cloud, from bytes to messages:

    subscription   takes the bytes, deserialised only in their turn.
    session        owns all that lives from configure to cleanup, and hands the cloud on.
    gate           judges its frame and stamp, later its answer: resets, limits, order of time, jumps.
    worker         holds the newest cloud until the thread that registers is free.
    register       reads it (cloud), looks frames up (frames, tf_guard), registers, converts (units).
    outcome        a pose, or a reason.
    publish        sends the outcome, and the pose to /tf (frames).

`lifecycle` is the node itself: states, parameters, clock. `model` reads the bone and makes the method, in a
thread. `report` sends /diagnostics, `services` answers calls. They call the node by the members of `host` only.
"""
