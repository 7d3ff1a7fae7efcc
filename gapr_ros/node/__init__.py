"""What register_node is made of, a file for each task.

The way of one cloud, from bytes to messages:

    subscription   takes the bytes; a cloud is not deserialised before it is its turn
    session        owns all that lives from configure to cleanup, and hands the cloud on
    admission      judges its frame and its stamp (timeline), which its header says
    worker         holds the newest cloud until the thread that registers is free
    registration   reads it (intake), looks frames up (frames), crops (region), follows or registers, converts (units)
    outcome        what became of it: a pose, or a reason (refusal)
    course         decides whether the pose goes out: resets, limits, order of time, jumps (track)
    publishers     sends what became of it (messages), and to /tf (frames)

`check_points` are the other way in: points that a pointer touched, which check the pose that stands.
`lifecycle` is the node itself: states, parameters, clock. `loader` reads bones in another thread (model, method).
`reporter` sends /diagnostics (diagnostics). Files do not call the node, but the six members of `host`.
`parameter_files` finds those of the command line that are for other nodes.
"""
