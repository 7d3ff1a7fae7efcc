"""Mutation tests: change one operator or number of a formula, and see whether a test notices.

    make mutants                                          # every file of TESTS
    python scripts/mutants.py --files covariance,table    # some of them
    python scripts/mutants.py --out mutants.jsonl
    python scripts/mutants.py --every 5                   # a sample: every fifth mutant

A run that was stopped goes on where it was: what is in `--out` of the same code and the same tests is not run again.
A mutant that was killed stays killed as long as its file, the test that failed and what stands around the tests do.

cosmic-ray finds and makes the mutations. Each runs in a forked process that has loaded the tests already
(`mutants_session`); no file changes. The tests of a file with kernels run without Numba's compiler, so that theirs
count, too.
Numbers given to constants in capital letters are settings, not formulas: they are listed apart, as are the mutants of
`mutants_equivalent.txt`, which change nothing.
"""

from __future__ import annotations

import argparse
import ast
import functools
import importlib.abc
import importlib.util
import json
import os
import pickle
import resource
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from hashlib import sha256
from itertools import islice
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
os.environ |= {
    "NUMBA_NUM_THREADS": "1",  # threads do not outlive a fork
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MPLBACKEND": "Agg",
    "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
}
sys.path[:0] = [str(ROOT), str(ROOT / "scripts")]
from mutants_session import NO_TEST, OPTIONS, Session, compile_kernels_unless, function_around  # noqa: E402

LIMIT_S = 60  # of processor time, loading included: a mutant that takes longer hangs, and the tests noticed
sys.setrecursionlimit(10_000)  # a tree of syntax is deep

SKIPPED = ("BitOr", "BitAnd", "BitXor", "RShift", "LShift", "FloorDiv", "_Mod", "Mod_")  # no formula has them
REPLACED = ("core/Number", "core/ReplaceTrue", "core/ReplaceFalse", "core/RemoveDecorator")
FORMULAS, CORE = "test/formulas", "test/core/registration"
REGISTRATION, METRICS, GEOMETRY = "gapr_core/registration/", "gapr_core/metrics/", "gapr_core/geometry/"
TESTS = {
    REGISTRATION + "fit/kernels.py": [f"{FORMULAS}/test_kernels.py"],
    REGISTRATION + "fit/refinement.py": [f"{FORMULAS}/test_refinement.py"],
    REGISTRATION + "fit/verification.py": [f"{FORMULAS}/test_verification.py"],
    REGISTRATION + "fit/alternatives.py": [f"{FORMULAS}/test_alternatives.py", f"{FORMULAS}/test_checks.py"],
    REGISTRATION + "checks/table.py": [f"{FORMULAS}/test_checks.py"],
    REGISTRATION + "checks/conclude.py": [f"{FORMULAS}/test_conclude.py"],
    REGISTRATION + "checks/image.py": [f"{FORMULAS}/test_image.py"],
    REGISTRATION + "checks/assessment.py": [f"{FORMULAS}/test_assessment.py"],
    REGISTRATION + "checks/assess.py": [
        f"{FORMULAS}/test_assessment.py",
        f"{FORMULAS}/test_smooth_bias.py",
        f"{FORMULAS}/test_checks.py",
    ],
    REGISTRATION + "checks/deformation.py": [f"{FORMULAS}/test_deformation.py"],
    REGISTRATION + "checks/unknowns.py": [f"{FORMULAS}/test_deformation.py"],
    REGISTRATION + "confidence/classifier.py": [f"{CORE}/test_confidence.py"],
    REGISTRATION + "confidence/features.py": [f"{FORMULAS}/test_features.py", f"{FORMULAS}/test_scene_fit.py"],
    REGISTRATION + "confidence/additive.py": [f"{CORE}/test_confidence.py", f"{CORE}/test_precision_model.py"],
    REGISTRATION + "uncertainty/linear_model.py": [f"{FORMULAS}/test_bias_field.py"],
    REGISTRATION + "uncertainty/smooth_bias.py": [f"{FORMULAS}/test_smooth_bias.py"],
    REGISTRATION + "uncertainty/covariance.py": [f"{CORE}/test_covariance.py"],
    REGISTRATION + "uncertainty/error_calibration.py": [f"{CORE}/test_precision_model.py"],
    REGISTRATION + "problem/sensor.py": [f"{FORMULAS}/test_sensor.py"],
    REGISTRATION + "scenes/free_space.py": [f"{FORMULAS}/test_free_space.py"],
    REGISTRATION + "scenes/kernels.py": [f"{FORMULAS}/test_clutter_kernels.py", f"{FORMULAS}/test_free_space.py"],
    REGISTRATION + "scenes/clutter.py": [f"{FORMULAS}/test_clutter.py"],
    REGISTRATION + "scenes/scene_fit.py": [f"{FORMULAS}/test_scene_fit.py", f"{FORMULAS}/test_conclude.py"],
    REGISTRATION + "scenes/look_agreement.py": [f"{FORMULAS}/test_scene.py"],
    REGISTRATION + "streams/evidence.py": [f"{FORMULAS}/test_evidence.py"],
    REGISTRATION + "streams/look_accumulator.py": [f"{FORMULAS}/test_look_accumulation.py"],
    REGISTRATION + "check_points.py": [f"{FORMULAS}/test_check_points.py"],
    GEOMETRY + "twists.py": ["test/core/test_twists.py", f"{FORMULAS}/test_precision.py"],
    GEOMETRY + "se3.py": ["test/core/test_se3.py", "test/core/metrics/test_pose_metrics.py"],
    GEOMETRY + "extent.py": ["test/core/test_extent.py"],
    METRICS + "pose.py": ["test/core/metrics/test_pose_metrics.py"],
    METRICS + "confidence.py": ["test/core/metrics/test_confidence_metrics.py"],
    METRICS + "surfaces.py": ["test/core/metrics/test_surface_metrics.py"],
    METRICS + "cramer_rao.py": ["test/core/test_twists.py"],
    METRICS + "bootstrap.py": ["test/core/test_twists.py"],
}


@dataclass
class Mutant:
    """One mutation and what became of it: killed, survived, setting or equivalent.

    `digest` is of code and tests, `killer` the test that failed, `grounds` what is to stay for that.
    """

    file: str
    line: int
    operator: str
    occurrence: int
    text: str
    fate: str = ""
    digest: str = ""
    killer: str = ""
    grounds: str = ""

    @property
    def key(self) -> str:
        """What `mutants_equivalent.txt` names it by; line numbers would not last."""
        return f"{self.file}: {self.operator}: {self.text}"


def mutants_of(file: str) -> Iterator[tuple[Mutant, str]]:
    """Every mutation of a file with the mutated text."""
    import cosmic_ray.plugins
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.mutating import MutationVisitor

    source = (ROOT / file).read_text(encoding="utf-8")
    digest = _digest(file)
    lines, settings, unchanged = source.splitlines(), _lines_of_settings(source), ast.dump(ast.parse(source))
    tree = get_ast(source)
    fresh = pickle.dumps(tree, -1)  # read back for every mutation: 20 times as fast as parsing
    for name in cosmic_ray.plugins.operator_names():
        operator_class = cosmic_ray.plugins.get_operator(name)
        if operator_class.arguments() or any(part in name for part in SKIPPED) or name == "core/NoOp":
            continue
        operator = operator_class()
        places = [place for node in ast_nodes(tree) for place in operator.mutation_positions(node)]
        for occurrence, ((line, _), _) in enumerate(places):
            mutated = MutationVisitor(occurrence, operator).walk(pickle.loads(fresh)).get_code()
            if _dump(mutated) in ("", unchanged):
                continue
            changed = next((b for a, b in zip(lines, mutated.splitlines(), strict=False) if a != b), "").strip()
            fate = "setting" if line in settings and name.startswith(REPLACED) else ""
            yield Mutant(file, line, name.removeprefix("core/"), occurrence, changed, fate, digest), mutated


def _dump(text: str) -> str:
    """The syntax tree in words; "" when the text is no Python, such as `a > not b`."""
    try:
        return ast.dump(ast.parse(text))
    except SyntaxError:
        return ""


def _digest(file: str) -> str:
    """Of a file and its tests."""
    texts = [(ROOT / name).read_bytes() for name in (file, *TESTS.get(file, ()))]
    return sha256(b"".join(texts)).hexdigest()[:16]


@functools.cache
def grounds_of(file: str, killer: str) -> str:
    """Digest of a file, of the test that failed with a mutant of it, and of all but the tests around that."""
    if "::" not in killer:
        return _digest(file)
    path, name = killer.split("[")[0].split("::")
    parts = ast.parse((ROOT / path).read_text(encoding="utf-8")).body
    kept = [node for node in parts if not getattr(node, "name", "").startswith("test_") or node.name == name]
    text = (ROOT / file).read_text(encoding="utf-8") + "".join(map(ast.dump, kept))
    return sha256(text.encode()).hexdigest()[:16]


def _lines_of_settings(source: str) -> set[int]:
    """Lines of NAMES_IN_CAPITALS, of decorators, and of the defaults of parameters and of fields."""
    found: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        parts: list[ast.expr] = []
        if isinstance(node, ast.Assign) and all(_is_setting(target) for target in node.targets):
            parts = [node.value]
        elif isinstance(node, ast.FunctionDef):
            parts = [*node.decorator_list, *node.args.defaults]
        elif isinstance(node, ast.ClassDef):
            fields = (field.value for field in node.body if isinstance(field, ast.AnnAssign))
            parts = [*node.decorator_list, *(value for value in fields if value is not None)]
        for part in parts:
            found |= set(range(part.lineno, (part.end_lineno or part.lineno) + 1))
    return found


def _is_setting(target: ast.expr) -> bool:
    return all(name.id.isupper() for name in ast.walk(target) if isinstance(name, ast.Name))


class _Mutated(importlib.abc.MetaPathFinder, importlib.abc.SourceLoader):
    """Imports one module from a text."""

    def __init__(self, file: str, text: str) -> None:
        self.name, self.path, self.text = file.removesuffix(".py").replace("/", "."), str(ROOT / file), text

    def find_spec(self, name, path=None, target=None):  # type: ignore[no-untyped-def]
        return importlib.util.spec_from_loader(name, self, origin=self.path) if name == self.name else None

    def get_filename(self, fullname: str) -> str:
        return self.path

    def get_data(self, path: str) -> bytes:
        return self.text.encode()

    def path_stats(self, path: str):  # type: ignore[no-untyped-def]
        raise OSError  # no cached bytecode


def run(file: str, text: str, tests: list[str]) -> bool:
    """True when the tests fail with this text in place of the file."""
    child = os.fork()
    if child == 0:
        _run_tests(file, text, tests)
    return os.waitpid(child, 0)[1] != 0


def _run_tests(file: str, text: str, tests: list[str]) -> None:
    """In the forked process; never returns."""
    import pytest

    code = 1
    resource.setrlimit(resource.RLIMIT_CPU, (LIMIT_S, LIMIT_S))
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(1, 2)
        sys.meta_path.insert(0, _Mutated(file, text))
        compile_kernels_unless(text)
        code = int(pytest.main([*OPTIONS, "-m", "not slow", *(str(ROOT / test) for test in tests)]))
    finally:
        os._exit(1 if code else 0)


class Runner:
    """Runs tests on mutations of files, in a process that has collected them where that can be.

    What lies outside of functions needs a process of its own.
    """

    def __init__(self) -> None:
        self._file, self._source, self._session = "", "", None

    def killer(self, mutant: Mutant, text: str, first: str) -> str:
        """The test of the mutant's file that fails with this text, "" when none does; `first` is tried first."""
        if mutant.file != self._file:
            self.close()
            self._file, self._source = mutant.file, (ROOT / mutant.file).read_text(encoding="utf-8")
            tests = [str(ROOT / test) for test in TESTS[mutant.file]]
            self._session = Session(mutant.file.removesuffix(".py").replace("/", "."), tests)
            if name := self._session.killer(self._source, 0, range(0), ""):
                raise SystemExit(f"mutants: the tests of {mutant.file} fail without any mutation: {name}")
        around = function_around(self._source, mutant.line)
        if self._session is not None and around:
            return self._session.killer(text, mutant.line, around, first)
        return NO_TEST if run(mutant.file, text, TESTS[mutant.file]) else ""

    def close(self) -> None:
        """End the process."""
        if self._session is not None:
            self._session.close()
        self._session = None


def main() -> int:
    """Run every mutant, print the table and the survivors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", help="parts of names, with commas; all when not given")
    parser.add_argument("--every", type=int, default=1, help="only every n-th mutant of a file: a sample (1: all)")
    parser.add_argument("--out", type=Path, default=ROOT / "mutants.jsonl", help="every mutant and its fate")
    parser.add_argument("--least", type=float, default=0.85, help="share that must be killed")
    args = parser.parse_args()
    import numba  # noqa: F401  all of these are loaded once, before the forks
    import pytest  # noqa: F401
    import scipy.spatial.transform
    import scipy.stats  # noqa: F401
    from tqdm import tqdm

    wanted = [file for file in TESTS if not args.files or any(part in file for part in args.files.split(","))]
    earlier = _decided(args.out)
    listed = (ROOT / "scripts" / "mutants_equivalent.txt").read_text(encoding="utf-8").splitlines()
    equivalent = {line for line in listed if not line.startswith("#")}  # a reason stands above each

    done, runner = [], Runner()
    with args.out.open("a", encoding="utf-8") as file:
        found = (pair for name in wanted for pair in islice(mutants_of(name), 0, None, args.every))
        for mutant, text in tqdm(found, unit="mutant"):
            if not mutant.fate and mutant.key in equivalent:
                mutant.fate = "equivalent"
            before = earlier.get(_place(mutant), mutant)
            mutant.fate = mutant.fate or _settled(mutant, before)
            if not mutant.fate:
                mutant.killer = runner.killer(mutant, text, before.killer)
                mutant.fate = "killed" if mutant.killer else "survived"
                mutant.grounds = grounds_of(mutant.file, mutant.killer) if mutant.killer else ""
                file.write(json.dumps(asdict(mutant)) + "\n")
                file.flush()
            done.append(mutant)
    runner.close()
    return report(done, args.least)


def _decided(path: Path) -> dict[tuple[str, ...], Mutant]:
    """The last record of every mutant that earlier runs wrote, with these or other tests."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    mutants = [Mutant(**json.loads(line)) for line in lines]
    return {_place(mutant): mutant for mutant in mutants}


def _settled(mutant: Mutant, before: Mutant) -> str:
    """What became of a mutant in an earlier run, where that is still so; else ""."""
    if before.killer and before.grounds == grounds_of(mutant.file, before.killer):
        return "killed"
    return before.fate if before.digest == mutant.digest else ""


def _place(mutant: Mutant) -> tuple[str, ...]:
    return mutant.file, mutant.operator, str(mutant.occurrence), mutant.text


def report(done: list[Mutant], least: float) -> int:
    """The table by file, and every survivor; 1 when a smaller share than `least` was killed."""
    write = sys.stdout.write
    write("\n| file | killed | of | % | settings | equivalent |\n|---|---|---|---|---|---|\n")
    for file in [*dict.fromkeys(mutant.file for mutant in done), "all"]:
        fates = [mutant.fate for mutant in done if file in (mutant.file, "all")]
        killed, of = fates.count("killed"), fates.count("killed") + fates.count("survived")
        share = 100.0 * killed / max(of, 1)
        write(f"| {file} | {killed} | {of} | {share:.0f} | {fates.count('setting')} | {fates.count('equivalent')} |\n")
    for mutant in done:
        if mutant.fate == "survived":
            write(f"{mutant.file}:{mutant.line}: {mutant.operator}: {mutant.text}\n")
    return int(share < 100.0 * least)


if __name__ == "__main__":
    raise SystemExit(main())
