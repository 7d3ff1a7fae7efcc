"""Count the house: lines, functions, settings, words and tests of a checkout.

python scripts/house.py [CHECKOUT]
"""

from __future__ import annotations

import ast
import re
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from statistics import quantiles

PACKAGES = ("gapr_core", "gapr_ros", "msg_adapters", "test", "benchmarks", "scripts", "examples")
FUNCTION = (ast.FunctionDef, ast.AsyncFunctionDef)
DOCUMENTED = (ast.Module, ast.ClassDef, *FUNCTION)


def main() -> None:
    """Print one line for each count."""
    root = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1])
    for package in PACKAGES:
        print(f"{package}: {_code(sorted((root / package).rglob('*.py')))}")
    for folder in sorted(path for path in (root / "gapr_core").iterdir() if path.is_dir()):
        if files := sorted(folder.rglob("*.py")):
            print(f"gapr_core/{folder.name}: {_code(files)}")
    print(_settings(root))
    print(_text(root))
    print(_docstrings([path for name in PACKAGES[:3] for path in (root / name).rglob("*.py")]))
    print(_tests(root))


def _code(files: list[Path]) -> str:
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in files]
    lines = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in files)
    lengths = [(n.end_lineno or 0) - n.lineno + 1 for t in trees for n in ast.walk(t) if isinstance(n, FUNCTION)]
    constants = sum(len(_constants(tree)) for tree in trees)
    if len(lengths) < 2:
        return f"{len(files)} files, {lines} lines"
    cuts = quantiles(lengths, n=100, method="inclusive")
    spread = f"{cuts[49]:.0f} / {cuts[89]:.0f} / {cuts[98]:.0f} / {max(lengths)}"
    return f"{len(files)} files, {lines} lines, functions {spread} (50, 90, 99 %, longest), {constants} constants"


def _constants(tree: ast.Module) -> list[str]:
    targets = [t for n in tree.body if isinstance(n, ast.Assign) for t in n.targets]
    targets += [n.target for n in tree.body if isinstance(n, ast.AnnAssign)]
    names = [name.id for t in targets for name in ast.walk(t) if isinstance(name, ast.Name)]
    return [name for name in names if name.isupper()]


def _settings(root: Path) -> str:
    config = (root / "gapr_core/config.py").read_text(encoding="utf-8")
    node = (root / "config/register_node.yaml").read_text(encoding="utf-8")
    library = len(re.findall(r"= (?:setting|Field)\(", config))
    return f"settings of the library {library}, parameters of the node {len(re.findall(r'^    [a-z_]+: ', node, re.M))}"


def _text(root: Path) -> str:
    every = {path: path.read_text(encoding="utf-8") for path in (root / "docs").rglob("*.md")}
    pages = [text for path, text in every.items() if path.parent.name != "tables"]
    words = [len(text.split()) for text in pages]
    rows = sum(len(line.split()) for text in pages for line in text.splitlines() if line.startswith("|"))
    outside = sum(len(text.split()) for text in every.values()) - sum(words)
    hashes = sum(len(re.findall(r"\b(?=[a-f]*\d)(?=\d*[a-f])[0-9a-f]{7}\b", text)) for text in pages)
    longest = max(len(sentence.split()) for text in pages for sentence in _sentences(text))
    changelog = len((root / "CHANGELOG.rst").read_text(encoding="utf-8").split())
    return (
        f"docs {len(pages)} pages, {sum(words)} words (in tables {rows}), generated tables {outside} words, "
        f"changelog {changelog} words, {hashes} hashes, longest sentence {longest} words"
    )


def _sentences(text: str) -> Iterator[str]:
    text = re.sub(r"^( *)```.*?^ *```|<!--.*?-->", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"``?[^`]+`?`", "code", re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text))
    for part in re.split(r"\n\s*\n|\n *(?=[-*|#>]|\d+\. )|\|", text):
        yield from re.split(r"(?<=[.!?:])\*{0,2}\s+", " ".join(part.split()))


def _docstrings(files: list[Path]) -> str:
    nodes = [node for path in files for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))]
    texts = [text for node in nodes if isinstance(node, DOCUMENTED) and (text := ast.get_docstring(node))]
    words = Counter(word.lower() for text in texts for word in re.findall(r"[A-Za-z']+", text))
    shares = ", ".join(f"{word} {1000 * words[word] / words.total():.1f}" for word in ("what", "it", "that"))
    over = sum(len(next(_sentences(text)).split()) > 20 for text in texts)
    return f"{len(texts)} docstrings, {words.total()} words, of 1000: {shares}; first sentence over 20 words: {over}"


def _tests(root: Path) -> str:
    files = list((root / "test").rglob("*.py"))
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in files]
    tests = sum(isinstance(n, FUNCTION) and n.name.startswith("test_") for tree in trees for n in ast.walk(tree))
    lines = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in files)
    return f"{tests} test functions in {lines} lines"


if __name__ == "__main__":
    main()
