"""The `gapr` command, also as `python -m gapr_core` where its script is not on the path."""

import sys


def main() -> int:
    """Run `gapr_core.cli.main`, which takes a moment to load: one line and 130 where it is interrupted meanwhile."""
    try:
        from gapr_core import cli

        return cli.main()
    except KeyboardInterrupt:
        sys.stderr.write("gapr: stopped\n")
        return 130


if __name__ == "__main__":
    sys.exit(main())
