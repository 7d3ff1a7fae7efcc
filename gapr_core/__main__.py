"""`python -m gapr_core`: the `gapr` command, where its script is not on the path."""

import sys

from gapr_core.cli import main

if __name__ == "__main__":
    sys.exit(main())
