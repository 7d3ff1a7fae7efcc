"""How the code reads: short functions, short files, no left-overs."""

import ast
import re
import subprocess
import sys
from pathlib import Path
from statistics import median

import pytest

ROOT = Path(__file__).parents[2]
FILES = sorted(path for package in ("gapr_core", "msg_adapters", "gapr_ros") for path in (ROOT / package).rglob("*.py"))


def functions(path):
    """(name, lines) of every function of a file, from `def` to its last line, docstring excluded."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            first = node.body[0]
            documented = isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)
            yield f"{path.relative_to(ROOT)}:{node.lineno} {node.name}", length(node) - documented * length(first)


def length(node):
    return node.end_lineno - node.lineno + 1


def share_of(values, limit):
    return sum(value <= limit for value in values) / len(values)


def test_half_of_the_functions_have_at_most_12_lines_and_nine_of_ten_under_35():
    lengths = dict(function for path in FILES for function in functions(path))
    longest = sorted(lengths.items(), key=lambda item: -item[1])[:10]
    assert median(lengths.values()) <= 12, longest
    assert share_of(lengths.values(), 34) >= 0.9, longest


def test_four_of_five_files_have_at_most_250_lines_and_none_more_than_500():
    lengths = {str(path.relative_to(ROOT)): len(path.read_text(encoding="utf-8").splitlines()) for path in FILES}
    longest = sorted(lengths.items(), key=lambda item: -item[1])[:10]
    assert share_of(lengths.values(), 250) >= 0.8, longest
    assert max(lengths.values()) <= 500, longest


FORBIDDEN = {
    "print in library code": (r"^\s*print\(", set()),
    "a debugger": (r"\bbreakpoint\(|import i?pdb", set()),
    "a pickle that runs code": (r"\bpickle\.loads?\(|torch\.load\((?!.*weights_only=True)|allow_pickle=True", set()),
    "a device chosen for the user": (r"\.cuda\(", set()),
    "a path of one machine": (r"[\"'](/home|/root|/tmp|/work|/Users)/", set()),
}


@pytest.mark.parametrize("what", FORBIDDEN)
def test_the_code_is_free_of(what):
    pattern, exempt = FORBIDDEN[what]
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in FILES
        if str(path.relative_to(ROOT)) not in exempt
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
        if re.search(pattern, line)
    ]
    assert not found


RUFF = Path(sys.executable).parent / "ruff"


@pytest.mark.skipif(not RUFF.exists(), reason="ruff is no part of an installation for use: pip install '.[test]'")
def test_ruff_finds_nothing():
    run = subprocess.run([RUFF, "check", "--output-format=concise", "."], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout
