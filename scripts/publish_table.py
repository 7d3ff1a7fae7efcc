"""Put a table that a command wrote into a folder, with its command, commit and machine.

    python scripts/publish_table.py recall out            # the output folder of `gapr benchmark`
    python scripts/publish_table.py scanners table.md --command "python benchmarks/scanners.py --count 10"

The pages of docs/results quote such tables. Paths of this machine are shortened to their last part.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from gapr_core.runtime import origin

TABLES = Path(__file__).resolve().parents[1] / "build" / "tables"
ABSOLUTE = re.compile(r"(?<![\w.])/(?:[\w.+-]+/)*([\w.+-]+)/?")
RULE = re.compile(r"\|(\s*-{3,}\s*\|)+$")  # the line under the head of a table


def main() -> None:
    """Write one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", help="of the file, without .md")
    parser.add_argument("made", type=Path, help="folder of gapr benchmark, or a file with what a script printed")
    parser.add_argument("--command", help="that printed it; a folder of gapr benchmark knows its own")
    parser.add_argument("--commit", help="that ran it (this one)")
    parser.add_argument("--folder", type=Path, default=TABLES, help="where the tables are (build/tables)")
    args = parser.parse_args()
    if args.made.is_dir():
        text = (args.made / "table.md").read_text(encoding="utf-8").removeprefix("# Benchmark\n\n")
    elif args.command:
        text = printed(args.made.read_text(encoding="utf-8"), args.command, args.commit or origin.commit() or "unknown")
    else:
        parser.error("--command is needed for a file")
    args.folder.mkdir(parents=True, exist_ok=True)
    (args.folder / f"{args.name}.md").write_text(ABSOLUTE.sub(r"\1", text), encoding="utf-8")


def printed(text: str, command: str, commit: str) -> str:
    """The table lines of an output, a blank one before each next head, and a line on where they come from."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    rules = {number for number, line in enumerate(lines) if RULE.match(line)}
    table = "\n".join("\n" * (number > 0 and number + 1 in rules) + line for number, line in enumerate(lines))
    return f"{table}\n\nMade by `{command}` at commit {commit}, {origin.machine()}.\n"


if __name__ == "__main__":
    main()
