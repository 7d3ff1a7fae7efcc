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
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
from mesh_samples import samples
from mutations import mutated
from patient_samples import native_samples, text_samples
from tqdm import tqdm

HERE = Path(__file__).parent
CASES = HERE / "cases"
BATCH = 100  # files that a child is asked for at once

LABEL_MAPS = (".nii", ".nii.gz", ".nrrd", "raw.mha", "packed.mha", ".dcm")
A_POINT_A_LINE = (".xyz", ".txt", ".csv", ".fcsv")


class Child:
    """A reader that is restarted when it dies.

    Args:
        options: `--isolated`, or none (see reader.py).
    """

    def __init__(self, *options):
        self._process, self._options = None, options

    def ask(self, paths):
        """Its verdicts on these files, up to the first that it did not survive.

        All of them are asked for at once: on a busy machine, waiting for each answer takes longer than reading.
        """
        if self._process is None:
            command = [sys.executable, str(HERE / "reader.py"), *self._options]
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
            )
        with suppress(BrokenPipeError):
            self._process.stdin.write("".join(f"{path}\n" for path in paths))
            self._process.stdin.flush()
        for _ in paths:
            answer = self._process.stdout.readline().strip()
            yield answer or self._bury()
            if not answer:
                return

    def _bury(self):
        code = self._process.wait()
        self._process = None
        return f"process died with {code}"

    def close(self):
        """End it, whatever it reads."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


class Reader:
    """One child for all files, and a fresh one for a label map that the first could not bear."""

    def __init__(self):
        self._child = Child()

    def ask(self, *paths):
        """The verdicts on these files, as their users would have them."""
        verdicts = []
        while len(verdicts) < len(paths):
            for verdict in self._child.ask(paths[len(verdicts) :]):
                verdicts.append(verdict)
                if verdict.split()[0] not in ("read", "refused"):
                    self._child.close()  # its memory counts from here
                    verdicts[-1] = self._alone(paths[len(verdicts) - 1], verdict)
                    break
        return verdicts

    def _alone(self, path, verdict):
        if not path.name.endswith(LABEL_MAPS):
            return verdict
        isolated = Child("--isolated")
        (verdict,) = isolated.ask([path])
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
    files, reader, tally, findings = files or originals(), Reader(), Counter(), []
    with closing(reader), tqdm(total=count, unit="file", disable=None) as bar:
        whole = dict(zip([name for name, _ in files], _read(reader, files), strict=True))
        assert all(verdict.startswith("read") for verdict in whole.values()), whole
        for start in range(0, count, BATCH):
            numbers = range(start, min(start + BATCH, count))
            names = [files[i % len(files)][0] for i in numbers]
            damages = [mutated(files[i % len(files)][1], np.random.SeedSequence([seed, i])) for i in numbers]
            verdicts = _read(reader, [(name, data) for name, (_, data) in zip(names, damages, strict=True)])
            for i, name, (kind, damaged), verdict in zip(numbers, names, damages, verdicts, strict=True):
                tally[verdict.split()[0]] += 1
                if is_finding(kind, verdict, whole[name], name, damaged):
                    findings.append((f"{kind}-{seed}-{i}-{name}", verdict))
                    tqdm.write(f"FINDING {findings[-1][0]}: {verdict}", file=sys.stderr)
                    keep.mkdir(exist_ok=True)
                    (keep / findings[-1][0]).write_bytes(damaged)
            bar.update(len(numbers))
    return tally, findings


def _read(reader, files):
    """The verdicts on (name, bytes), each in a folder of its own."""
    with tempfile.TemporaryDirectory() as folder:
        return reader.ask(*[_write(Path(folder) / str(i), name, data) for i, (name, data) in enumerate(files)])


def _write(folder, name, data):
    folder.mkdir()
    (folder / name).write_bytes(data)
    return folder / name


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
