"""A share of the fuzzing for every day, every message that once did harm, and the harness itself."""

from __future__ import annotations

import os

import fuzz
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

KEPT = {"empty": b""} | {path.stem: path.read_bytes() for path in sorted(fuzz.FINDINGS.glob("*.cdr"))}
REASONS = {"bad_fields", "bad_frame", "empty_cloud", "non_finite", "too_few_points", "unit_mismatch", "read"}


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1))
def test_a_mutated_cloud_is_read_as_by_a_decoder_of_its_own_or_refused(seed, number):
    assert fuzz.check(fuzz.case(seed, number)) in REASONS


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=400))
def test_any_bytes_are_refused_or_read(data):
    assert fuzz.check(data) in REASONS


@pytest.mark.parametrize("data", KEPT.values(), ids=KEPT)
def test_a_message_that_once_did_harm_or_has_nothing_in_it_does_none(data):
    assert fuzz.check(data) in REASONS


def test_mutated_messages_reach_every_outcome():
    reached = {fuzz.check(fuzz.case(1, number)) for number in range(600)}
    assert reached >= {"bad_fields", "bad_frame", "empty_cloud", "non_finite", "unit_mismatch"}


def test_cases_that_do_harm_are_found_and_kept_and_the_rest_is_read(tmp_path, monkeypatch):
    planted = tmp_path / "planted.py"
    planted.write_text(
        "import os, sys\nimport fuzz\nreal = fuzz.check\n"
        "def check(data):\n"
        "    if data == fuzz.case(5, 3):\n        raise KeyError('planted')\n"
        "    if data == fuzz.case(5, 7):\n        os.abort()\n"
        "    return real(data)\n"
        "fuzz.check = check\nsys.exit(fuzz.main())\n"
    )
    monkeypatch.setattr(fuzz, "__file__", str(planted))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(fuzz.FINDINGS.parent), os.environ.get("PYTHONPATH", "")]))
    outcomes, findings = fuzz.run(7, 5, tmp_path / "kept")
    assert findings == ["case 5/3: 'planted'"] and sum(outcomes.values()) == 6
    outcomes, findings = fuzz.run(8, 5, tmp_path / "kept", first=7)
    assert len(findings) == 1 and findings[0].startswith("case 5/7: exit code -6")
    assert {path.read_bytes() for path in (tmp_path / "kept").iterdir()} == {fuzz.case(5, 3), fuzz.case(5, 7)}
