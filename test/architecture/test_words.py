"""Plain English in pages, docstrings and messages: a short list of words, and what to write instead."""

import ast
import re
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
INSTEAD = {
    r"told": "say what it knows or is given; `told apart`: distinguished, separated",
    r"tells? apart": "distinguish, separate",
    r"anew": "again",
    r"beside": "with, next to, as well as",
    r"strays?": "outliers, distant points",
    r"settles?|settled": "converge, decide",
    r"mend(s|ed)?": "fix",
    r"figures(?!/)": "features, numbers, values; plots",
    r"on the wire|the wire": "messages, in ROS",
    r"by so much": "name the amount",
    r"reckons?|reckoned": "assume, allow for",
    r"lonely": "isolated, single",
    r"people|persons?": "subjects; users",
    r"strangers?|somebody else's": "another subject",
    r"(inner|outer|both|cortical) walls?": "inner and outer cortex",
    r"freed": "bias-corrected, released",
    r"all the same": "even so, or leave it out",
    r"by and by|betimes|thither|whence": "a common word",
}
FORBIDDEN = {re.compile(rf"\b(?:{word})\b", re.IGNORECASE): better for word, better in INSTEAD.items()}
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.rst", "gapr_core/weights/README.md")),
    *(path for path in sorted((ROOT / "docs").rglob("*.md")) if path.parent.name != "tables"),
]
FOLDERS = ("gapr_core", "gapr_ros", "msg_adapters", "benchmarks", "examples", "scripts")
CODE = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]


def prose_of_page(path):
    """(line, text) without blocks and spans of code, links and addresses, which keep the names of the code."""
    text = re.sub(r"^( *)```.*?^ *```", lambda block: "\n" * block[0].count("\n"), path.read_text(encoding="utf-8"),
                  flags=re.MULTILINE | re.DOTALL)  # fmt: skip
    text = re.sub(r"``?[^`\n]+`?`|\]\([^)]*\)", "", text)
    yield from enumerate(text.splitlines(), start=1)


def prose_of_code(path):
    """(line, text) of comments, docstrings and other strings with a space in them; names and keys are no prose."""
    with tokenize.open(path) as file:
        yield from (
            (t.start[0], t.string) for t in tokenize.generate_tokens(file.readline) if t.type == tokenize.COMMENT
        )
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value.strip():
            text = re.sub(
                r"`[^`\n]+`|^ *\*{0,2}\w+(?:, \*{0,2}\w+)*: (?=\S)", "", node.value, flags=re.MULTILINE
            )  # names of arguments go
            yield from enumerate(text.splitlines(), start=node.lineno)


def found_in(path):
    prose = prose_of_code if path.suffix == ".py" else prose_of_page
    for number, line in prose(path):
        for pattern, better in FORBIDDEN.items():
            if match := pattern.search(line):
                yield f"{path.relative_to(ROOT)}:{number}: '{match[0]}' in '{line.strip()}': {better}"


@pytest.mark.parametrize("path", [*PAGES, *CODE], ids=lambda path: str(path.relative_to(ROOT)))
def test_words_are_common_ones(path):
    assert not list(found_in(path))


def test_the_check_finds_a_word_in_prose_and_not_in_code(tmp_path):
    page, module = tmp_path / "page.md", tmp_path / "module.py"
    page.write_text("`mend` this\n```\nmend\n```\nto mend it\n")
    module.write_text('"""How to mend it."""\nmend = {"mend": 1}\n# mended\n')
    assert [line for line in prose_of_page(page) if "mend" in line[1]] == [(5, "to mend it")]
    assert list(prose_of_code(module)) == [(3, "# mended"), (1, "How to mend it.")]
