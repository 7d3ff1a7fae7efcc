"""Damaged files of every format, read in a child process that may die: `python test/fuzz/files.py --count 20000`.

A file is read or refused in one line. Anything else is a finding: another error, a hang, a dead process, or a file
that was cut and is read with fewer points or faces and no warning. A text file with a point a line does not say how
many it has: one that is cut between two lines is read. A label map that harms the process is read again in one of its
own, as users read it. Findings are kept in test/fuzz/cases, which the default suite reads.
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
from patient_samples import native_samples, text_samples
from tqdm import tqdm

HERE = Path(__file__).parent
CASES = HERE / "cases"


LABEL_MAPS = (".nii", ".nii.gz", ".nrrd", "raw.mha", "packed.mha", ".dcm")
A_POINT_A_LINE = (".xyz", ".txt", ".csv", ".fcsv")


class Child:
    """A reader that is restarted when it dies.

    Args:
        options: `--isolated`, or none (see reader.py).
    """

    def __init__(self, *options):
        self._process, self._options = None, options

    def ask(self, path):
        """Its verdict on one file."""
        if self._process is None:
            command = [sys.executable, str(HERE / "reader.py"), *self._options]
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
            self._process = None


class Reader:
    """One child for all files, and a fresh one for a label map that the first could not bear."""

    def __init__(self):
        self._child = Child()

    def ask(self, path):
        """The verdict on one file, as its user would have it."""
        verdict = self._child.ask(path)
        if verdict.split()[0] not in ("read", "refused"):
            self._child.close()  # its memory counts from here
            if path.name.endswith(LABEL_MAPS):
                isolated = Child("--isolated")
                verdict = isolated.ask(path)
                isolated.close()
        return verdict

    def close(self):
        self._child.close()


def originals():
    """(name, bytes) of an undamaged file of every format."""
    return sorted((samples() | text_samples() | native_samples()).items())


def is_finding(kind, verdict, whole, name, damaged):
    """Whether this should not happen to a file damaged in this way, of which `whole` is the undamaged verdict."""
    if verdict == "refused":
        return False
    if name.endswith(A_POINT_A_LINE) and damaged.endswith(b"\n"):
        whole = verdict
    return not verdict.startswith("read") or (kind == "cut" and verdict != whole and "warning" not in verdict)


def run(count, seed, keep=CASES, files=None):
    """Verdicts by kind, and the findings as (name, verdict)."""
    files, child, tally, findings = files or originals(), Reader(), Counter(), []
    with tempfile.TemporaryDirectory() as folder:
        whole = {name: child.ask(_write(folder, name, data)) for name, data in files}
        assert all(verdict.startswith("read") for verdict in whole.values()), whole
        for i in tqdm(range(count), unit="file", disable=None):
            name, data = files[i % len(files)]
            kind, damaged = mutated(data, np.random.SeedSequence([seed, i]))
            verdict = child.ask(_write(folder, name, damaged))
            tally[verdict.split()[0]] += 1
            if is_finding(kind, verdict, whole[name], name, damaged):
                findings.append((f"{kind}-{seed}-{i}-{name}", verdict))
                tqdm.write(f"FINDING {findings[-1][0]}: {verdict}", file=sys.stderr)
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
    parser.add_argument("--keep", type=Path, default=CASES, help="folder for files that did harm")
    args = parser.parse_args()
    tally, findings = run(args.count, args.seed, args.keep)
    sys.stdout.write(f"{args.count} files, {len(findings)} findings: {dict(tally)}\n")
    sys.stdout.write("".join(f"FINDING {name}: {verdict}\n" for name, verdict in findings))
    return 1 if findings else 0


if __name__ == "__main__":
    raise SystemExit(main())
