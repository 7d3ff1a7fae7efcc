"""One module a command of `gapr`: each has `add_arguments(parser)` and `run(args) -> exit code`."""
