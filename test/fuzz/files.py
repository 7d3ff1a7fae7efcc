"""Damaged files of every format, read in a child process that may die: `python test/fuzz/files.py --count 20000`.

A file is read or refused in one line. Anything else is a finding: another error, a hang, a dead process, or a file
that was cut and is read with fewer points or faces and no warning. Findings are kept in test/fuzz/cases, which the
default suite reads.
"""

import argparse
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np
from mesh_samples import samples
from mutations import mutated
from tqdm import tqdm

HERE = Path(__file__).parent
CASES = HERE / "cases"


class Child:
    """A reader that is restarted when it dies."""

    def __init__(self):
        self._process = None

    def ask(self, path):
        """Its verdict on one file."""
        if self._process is None:
            command = [sys.executable, str(HERE / "reader.py")]
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
            )
        try:
            self._process.stdin.write(f"{path}\n")
            self._process.stdin.flush()
            answer = self._process.stdout.readline().strip()
        except BrokenPipeError:
            answer = ""
        return answer or self._bury()

    def _bury(self):
        code = self._process.wait()
        self._process = None
        return f"process died with {code}"

    def close(self):
        if self._process is not None:
            self._process.stdin.close()
            self._process.wait()


def is_finding(kind, verdict, whole):
    """Whether this should not happen to a file damaged in this way, of which `whole` is the undamaged verdict."""
    if verdict == "refused":
        return False
    return not verdict.startswith("read") or (kind == "cut" and verdict != whole and "warning" not in verdict)


def run(count, seed, keep=CASES):
    """Verdicts by kind, and the findings as (name, verdict)."""
    originals, child, tally, findings = sorted(samples().items()), Child(), Counter(), []
    with tempfile.TemporaryDirectory() as folder:
        whole = {name: child.ask(_write(folder, name, data)) for name, data in originals}
        for i in tqdm(range(count), unit="file", disable=None):
            name, data = originals[i % len(originals)]
            kind, damaged = mutated(data, np.random.SeedSequence([seed, i]))
            verdict = child.ask(_write(folder, name, damaged))
            tally[verdict.split()[0]] += 1
            if is_finding(kind, verdict, whole[name]):
                findings.append((f"{kind}-{seed}-{i}-{name}", verdict))
                keep.mkdir(exist_ok=True)
                (keep / findings[-1][0]).write_bytes(damaged)
    child.close()
    return tally, findings


def _write(folder, name, data):
    path = Path(folder) / name
    path.write_bytes(data)
    return path


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    tally, findings = run(args.count, args.seed)
    sys.stdout.write(f"{dict(tally)}\n" + "".join(f"FINDING {name}: {verdict}\n" for name, verdict in findings))
    return 1 if findings else 0


if __name__ == "__main__":
    raise SystemExit(main())
