"""The soak as a test; slow."""

from __future__ import annotations

import pytest
from soak import soak


@pytest.mark.slow
@pytest.mark.timeout(400)
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_two_hundred_clouds_at_10_hz_are_answered_or_counted_and_memory_is_flat(tmp_path, storage):
    soak(tmp_path, 200, 10.0, storage).check()
