"""The soak as a test; slow."""

from __future__ import annotations

import pytest
from soak import KINDS, Soak, draw, soak


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("kind", KINDS)
def test_twenty_seconds_at_10_hz_are_answered_or_counted(tmp_path, kind):
    result = soak(tmp_path, kind, 20.0, distinct=60)
    result.rss_mb = [1.0]  # too short to say anything about memory
    result.check()
    draw([result], tmp_path / "soak.png")
    assert (tmp_path / "soak.png").stat().st_size > 10_000


def test_a_soak_that_loses_a_cloud_or_grows_does_not_pass():
    def result(**changes):
        good = {"sent": 9, "received": 8, "accepted": 5, "refused": 1, "dropped": 2, "lost": 1, "statuses": 6,
                "transforms": 5, "latency_s": [0.1] * 6, "rss_mb": [100.0] * 40, "exit_code": 0}  # fmt: skip
        return Soak("sweeps", **(good | changes))

    result().check()
    growing = [100.0 + 0.2 * second for second in range(40)]
    for change in ({"received": 7}, {"dropped": 1}, {"statuses": 5}, {"transforms": 4}, {"rss_mb": growing},
                   {"exit_code": 1}):  # fmt: skip
        with pytest.raises(AssertionError):
            result(**change).check()
