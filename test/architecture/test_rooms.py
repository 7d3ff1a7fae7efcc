"""The street: few files stand next to the rooms."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(("package", "most"), [("gapr_core", 8), ("gapr_ros", 3)])
def test_few_files_stand_next_to_the_folders_of(package, most):
    files = sorted(path.name for path in (ROOT / package).glob("*.py"))
    assert len(files) <= most, files
