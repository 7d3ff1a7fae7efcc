"""benchmarks/tables.mk names scripts, options and protocols that exist."""

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from gapr_core.data.protocols import PROTOCOLS

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def commands():
    """What `make` would run for all tables, as lists of words."""
    if shutil.which("make") is None:
        pytest.skip("it asks make what it would run: apt install make")
    asked = ["make", "-n", "-f", "benchmarks/tables.mk", "all", "real", "OUT=nowhere", "REAL=nothing"]
    printed = subprocess.run(asked, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [shlex.split(line) for line in printed.splitlines()]


def test_every_script_exists_and_has_the_options_that_it_is_given(commands):
    scripts = [words for words in commands if words[0] == "python" and words[1].startswith("benchmarks/")]
    assert len(scripts) > 15
    for _, script, *options in scripts:
        text = (ROOT / script).read_text(encoding="utf-8")
        missing = [word for word in options if word.startswith("--") and f'"{word}"' not in text]
        assert not missing, f"{script}: {missing}"


def test_every_list_is_of_protocols_that_exist_and_is_registered_once(commands):
    made = [words for words in commands if "make-pairs" in words]
    asked = [words for words in commands if "benchmark" in words]
    folders = [words[words.index("--out") + 1] for words in made]
    assert len(made) > 15 and len(set(folders)) == len(folders)
    assert sorted(folders) == sorted(words[words.index("--pairs") + 1] for words in asked)
    for words in made:
        assert set(words[words.index("--protocol") + 1].split(",")) <= set(PROTOCOLS), words


def test_every_table_that_a_page_names_can_be_made_again(commands):
    published = [words for words in commands if "scripts/publish_table.py" in words]
    names = {words[words.index("--folder") + 2] for words in published}
    pages = " ".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs").rglob("*.md"))
    asked = re.findall(r"`make -f benchmarks/tables\.mk ([a-z_\s]+)`", pages)
    assert len(names) > 20 and len(asked) > 5
    assert {name for line in asked for name in line.split()} <= names
