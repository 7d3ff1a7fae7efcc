"""Text is short: sentences of pages and docstrings, first sentences of docstrings, words in all."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.rst", *sorted((ROOT / "docs").rglob("*.md"))]
LONGEST, FIRST, MOST_WORDS = 30, 20, 26_000
NO_VERB = re.compile(
    r"(what|where|whether|how|which|who|why|when|that|the|a|an|all|each|every|one|no|of|for|in|if|it)\b"
)


def prose_of_page(path):
    """Paragraphs, list items and cells of a page, without code; a span of code and a link count as their words."""
    text = re.sub(r"^( *)```.*?^ *```", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"<!--.*?-->|<[^>\n]+>|!?\[([^\]]*)\]\([^)]*\)", r"\1", text, flags=re.DOTALL)
    text = re.sub(r"``?[^`]+`?`", "code", text)
    return re.split(r"\n\s*\n|\n *(?=[-*|#>]|\d+\. )|\|", text)


def sentences(paragraph):
    return re.split(r"(?<=[.!?:])\*{0,2}\s+", " ".join(paragraph.split()))


def words(sentence):
    return len(re.findall(r"\S*\w\S*", sentence))


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_sentence_of_a_page_is_longer_than_thirty_words(path):
    found = [s for part in prose_of_page(path) for s in sentences(part) if words(s) > LONGEST]
    assert not found


def test_all_pages_together_stay_short():
    pages = [path for path in PAGES if path.parent != ROOT]
    assert sum(len(path.read_text(encoding="utf-8").split()) for path in pages) <= MOST_WORDS


def test_a_release_of_the_changelog_has_at_most_two_hundred_words():
    releases = re.split(r"^\d+\.\d+\.\d+ .*\n-+$", (ROOT / "CHANGELOG.rst").read_text(), flags=re.MULTILINE)[1:]
    assert releases
    assert not [len(text.split()) for text in releases if len(text.split()) > 200]


def docstrings(tree):
    """(node, docstring) of every module, class and function that has one."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    for node in ast.walk(tree):
        if isinstance(node, kinds) and (text := ast.get_docstring(node)):
            yield node, text


def is_verb_first(node, text):
    """Whether the docstring of a function begins with a verb; properties and tests of others name a thing."""
    named = any(isinstance(d, ast.Name) and d.id.endswith("property") for d in getattr(node, "decorator_list", ()))
    return isinstance(node, (ast.Module, ast.ClassDef)) or named or not NO_VERB.match(text.lower())


def faults(path):
    for node, text in docstrings(ast.parse(path.read_text(encoding="utf-8"))):
        name = f"{path.relative_to(ROOT)}: {getattr(node, 'name', 'module')}"
        text = re.sub(r"`[^`]+`", "code", text)
        first = sentences(text.split("\n\n")[0])[0]
        parts = re.split(r"\n\s*\n|\n *(?=[-*]|\d+\. |\w+: |\()|\|", text)
        if words(first) > FIRST or any(words(s) > LONGEST for part in parts for s in sentences(part)):
            yield f"{name}: too long: {first}"
        if not is_verb_first(node, text):
            yield f"{name}: no verb first: {first}"


def test_docstrings_begin_with_a_short_sentence_and_a_verb():
    code = [
        path for folder in ("gapr_core", "gapr_ros", "msg_adapters") for path in sorted((ROOT / folder).rglob("*.py"))
    ]
    assert not [fault for path in code for fault in faults(path)]
