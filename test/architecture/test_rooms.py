"""Few modules lie next to the packages, and the page of the registration names all of its modules."""

import re
from pathlib import Path

import pytest

import gapr_core.registration

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(("package", "most"), [("gapr_core", 8), ("gapr_ros", 3)])
def test_few_files_stand_next_to_the_folders_of(package, most):
    files = sorted(path.name for path in (ROOT / package).glob("*.py"))
    assert len(files) <= most, files


def test_the_map_of_the_registration_names_all_of_its_rooms():
    room = ROOT / "gapr_core/registration"
    files = {path.stem for path in room.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    named = set(re.findall(r"`([a-z_.]+)`", gapr_core.registration.__doc__))
    assert files - {"__init__"} <= named
