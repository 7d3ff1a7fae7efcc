from __future__ import annotations

import importlib.util
from pathlib import Path

_spec = importlib.util.spec_from_file_location("toy_clouds", Path(__file__).parents[1] / "model" / "conftest.py")
_toys = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(_toys)
toy, config = _toys.toy, _toys.config
