import sys
from pathlib import Path

import pytest

from gapr_core.data import anatomy

sys.path.insert(0, str(Path(__file__).parent))  # the hand-made shapes beside the tests


@pytest.fixture(scope="session")
def anatomy_folder() -> Path:
    folder = anatomy.default_folder()
    if not folder.is_dir():
        pytest.skip(f"the real bones do not ship and {folder} is absent: set {anatomy.ENVIRONMENT_VARIABLE}")
    return folder
