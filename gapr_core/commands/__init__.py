"""Commands of `gapr`, a module each with `add_arguments(parser)` and `run(args) -> exit code`; `cli` lists all of them.

`options` and `checks` are no commands: shared parts, and the checks of `register` before the work.
"""
