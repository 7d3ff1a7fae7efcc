"""The page of defects names tests that exist."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "results" / "defects.md"


def test_every_defect_has_tests_and_every_test_that_is_named_exists():
    rows = re.findall(r"^\| ([CD]\d) \|(.*)$", PAGE.read_text(), re.MULTILINE)
    assert [name for name, _ in rows] == [f"C{i}" for i in range(1, 7)] + [f"D{i}" for i in range(1, 9)]
    sources = "".join(path.read_text() for path in (ROOT / "test").rglob("test_*.py"))
    there = set(re.findall(r"^def (test_\w+)", sources, re.MULTILINE))
    for entry, row in rows:
        named = set(re.findall(r"`(test_\w+)`", row))
        assert named, entry
        assert named <= there, (entry, named - there)
