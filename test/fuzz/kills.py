"""Commands killed at random moments over the output of an earlier run: `python test/fuzz/kills.py --count 200`.

What is left belongs to the earlier run or to the killed one, never to both, and every file of it is whole. Commands
that go on where they stopped must then end as if nobody had killed them.
"""

import argparse
import contextlib
import io
import json
import os
import re
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mesh_samples import body
from scipy.spatial.transform import Rotation

from gapr_core import cli
from gapr_core.benchmark import runner
from gapr_core.data.pair import Pair
from gapr_core.data.pair_files import save_pair
from gapr_core.formats import markups
from gapr_core.geometry import se3
from gapr_core.pages import benchmark_report, registration_report  # noqa: F401  loaded once, and not by every child
from gapr_core.results import RegistrationResult, RegistrationStatus, Residuals

POLL_S = 0.0005
PATIENCE_S = 60.0
GROWING = re.compile(r"plan\.json|records\.jsonl|.*\.npz|poses\.json")  # what a command that goes on has so far
LEFT = re.compile(r"plots/.*")  # pictures of other cases of the run before, which the report does not show


class Method:
    """Lays the source, which is the target's first points, on them: least squares finds the pose."""

    name = "kills:Method"

    def prepare(self, target, units="mm"):
        return getattr(target, "points", target)

    def register(self, source, target):
        T = se3.kabsch(source, target[: len(source)])
        far = np.zeros(len(source))
        residuals, covariance = Residuals(source, far, far == 0), np.diag([1e-2] * 3 + [1e-6] * 3)
        return RegistrationResult(
            RegistrationStatus.OK,
            T,
            covariance,
            0.95,
            0.5,
            1.0,
            0.9,
            residuals=residuals,
            centre_mm=source.mean(axis=0),
        )


@dataclass(frozen=True)
class Command:
    """One that writes: its words for the inputs and the output of a run, and whether the same command goes on."""

    words: Callable[[str, Path], list[str]]
    goes_on: bool = False


COMMANDS = {
    "register": Command(lambda run, out: [
        "register", "--method", "kills:Method", "--source", f"{run}/source.npy", "--target", f"{run}/bone.npz",
        "--targets", f"{run}/plan.mrk.json", "--out", f"{out}/pose.tfm", "--residuals", f"{out}/residuals.ply",
        "--slicer", f"{out}/scene", "--report", f"{out}/page.html", "--json", f"{out}/answer.json"]),
    "check-points": Command(lambda run, out: [
        "check-points", "--points", f"{run}/source.npy", "--target", f"{run}/bone.npz", "--pose", f"{run}/pose.json",
        "--json", f"{out}/found.json"]),
    "pivot": Command(lambda run, out: ["pivot", f"{run}/tool.csv", "--json", f"{out}/tip.json"]),
    "evaluate": Command(lambda run, out: [
        "evaluate", "--pairs", f"{run}/pairs", "--method", "kills:Method", "--out", f"{out}/poses.json"], True),
    "benchmark": Command(lambda run, out: [
        "benchmark", "--pairs", "one/pairs", "--methods", f"kills:Method{',icp' * (run == 'two')}",
        "--out", str(out)], True),
    "make-pairs": Command(lambda run, out: [
        "make-pairs", "--protocol", "L1", "--bones", "thoracic", "--count", "3", "--people", "2", "--split", "all",
        "--out", f"{out}/{run}"], True),
}  # fmt: skip


def inputs(run, shift_mm):
    """Write the files that the commands of one run read."""
    (Path(run) / "pairs").mkdir(parents=True)
    points, faces = body(40, 60)
    points = 3.0 * points.astype(float) + shift_mm
    np.savez(f"{run}/bone.npz", points=points, faces=faces)
    np.save(f"{run}/source.npy", points[:600])
    markups.save(Path(run) / "plan.mrk.json", markups.Markups(points[:3], ("a", "b", "c")))
    pose = Method().register(points[:600], points)
    Path(f"{run}/pose.json").write_text(json.dumps(pose.to_json()))
    rows = ["State,Q0,Qx,Qy,Qz,Tx,Ty,Tz"]
    for rotation in Rotation.from_rotvec(np.random.default_rng(0).normal(0.0, 0.4, (30, 3))):
        (x, y, z, w), place = rotation.as_quat(), shift_mm - rotation.apply([0.0, 0.0, 100.0])
        rows.append("OK," + ",".join(f"{number:.6f}" for number in (w, x, y, z, *place)))
    Path(f"{run}/tool.csv").write_text("\n".join(rows) + "\n")
    for k in range(6):
        T = se3.exp([shift_mm, k, 0.0, 0.1 * k, 0.0, 0.0])
        source = se3.apply(se3.inverse(T), points[:600])
        pair = Pair(source, points, T, f"pair_{k}", "femur", f"person {k % 3}", "L1", {"noise_mm": 0.3, "overlap": 0.3})
        save_pair(Path(run) / "pairs" / f"pair_{k}.npz", pair)


def start(words):
    """Begin a command in a process of its own, which has everything loaded; its number."""
    if (process := os.fork()) != 0:
        return process
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        code = cli.main(words)
    os._exit(code)


def finish(words):
    """Run a command to its end; the seconds."""
    begun = time.monotonic()
    code = os.waitstatus_to_exitcode(os.waitpid(start(words), 0)[1])
    assert code == 0, (code, words)
    return time.monotonic() - begun


def files_in(folder):
    """The content of every file that has its name: those that are being written are hidden."""
    found = [path for path in sorted(folder.rglob("*")) if path.is_file() and not path.name.startswith(".")]
    return {str(path.relative_to(folder)): path.read_bytes() for path in found}


def is_whole(name, data):
    """Whether a file ends as its kind ends."""
    if name.endswith(".npz"):
        with np.load(io.BytesIO(data)) as arrays:
            return bool(arrays["source"].size)
    if name.endswith(".json"):
        return bool(json.loads(data))
    ends = {".html": b"</html>", ".png": b"IEND\xaeB`\x82", ".ply": b"", ".jsonl": b""}
    return data.rstrip(b"\n").endswith(ends.get(Path(name).suffix, b"")) and len(data) > 0


def fault(before, left, done):
    """Why what is left is of two runs, or damaged; None where it is neither."""
    for name, data in left.items():
        if data != before.get(name) and not is_whole(name, data):
            return f"{name} is damaged"
    judged = [name for name in left if not GROWING.fullmatch(Path(name).name) and not LEFT.fullmatch(name)]
    old = [name for name in judged if left[name] == before.get(name) != done.get(name)]
    new = [name for name in judged if left[name] != before.get(name)]
    return f"{old} of the run before beside {new}" if old and new else None


def killed_once(command, out, full_s, watches, rng):
    """Kill the second run at a random moment; whether it was before its end."""
    before, begun = set(out.rglob("*")), time.monotonic()
    process, wait_s = start(command.words("two", out)), rng.uniform(0.0, full_s)
    if watches:  # from the first change of a name on, where the time that a run takes says little
        while set(out.rglob("*")) == before and time.monotonic() - begun < PATIENCE_S:
            if os.waitpid(process, os.WNOHANG)[0]:
                return False
            time.sleep(POLL_S)
        wait_s = rng.exponential(0.1 * full_s)
    time.sleep(wait_s)
    os.kill(process, signal.SIGKILL)
    return os.WIFSIGNALED(os.waitpid(process, 0)[1])


def run(count, seed, names=tuple(COMMANDS)):
    """Kills by (command, how it ended), and what was wrong."""
    rng, tally, faults = np.random.default_rng(seed), Counter(), []
    runner._run_pool = lambda tasks, *_: (runner.run_task(tasks.popleft()) for _ in list(tasks))  # in this process
    for name in names:
        command, base, whole = COMMANDS[name], Path(f"{name} before").absolute(), Path(f"{name} done").absolute()
        finish(command.words("one", base))
        before = files_in(base)
        shutil.copytree(base, whole)
        full_s = finish(command.words("two", whole))
        done = files_in(whole)
        for number in range(-(-count // len(names))):
            out = Path(f"{name} {number}").absolute()
            shutil.copytree(base, out)
            was_killed = killed_once(command, out, full_s, number % 2 == 1, rng)
            found = fault(before, files_in(out), done)
            if command.goes_on and number % 4 == 0 and not found:
                finish(command.words("two", out))
                ended = files_in(out)
                found = None if ended.keys() == done.keys() else f"goes on to {sorted(ended)}"
            tally[name, "killed" if was_killed else "over"] += 1
            faults += [(name, number, found)] * bool(found)
            shutil.rmtree(out)
    return tally, faults


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        inputs("one", 0.0)
        inputs("two", 100.0)
        tally, faults = run(args.count, args.seed)
    for (name, how), times in sorted(tally.items()):
        sys.stdout.write(f"{name}: {times} {how}\n")
    sys.stdout.write("".join(f"FINDING {found}\n" for found in faults))
    return 1 if faults else 0


if __name__ == "__main__":
    raise SystemExit(main())
