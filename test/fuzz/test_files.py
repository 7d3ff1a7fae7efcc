"""A small share of `files.py` in the default suite, and every case that was ever found."""

from pathlib import Path

import files
import packed
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mesh_samples import samples
from mutations import mutated
from patient_samples import native_samples, text_samples
from reader import verdict

IN_PYTHON = samples() | text_samples()  # a reader in native code may end this process: a child reads those
NAMES = sorted(IN_PYTHON)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(name=st.sampled_from(NAMES), seed=st.integers(0, 2**32 - 1))
def test_a_damaged_file_is_read_or_refused_in_one_line(tmp_path, name, seed):
    kind, damaged = mutated(IN_PYTHON[name], seed)
    (tmp_path / name).write_bytes(IN_PYTHON[name])
    whole = verdict(tmp_path / name)
    (tmp_path / name).write_bytes(damaged)
    assert not files.is_finding(kind, verdict(tmp_path / name), whole, name, damaged), kind


@pytest.mark.parametrize("name", NAMES)
def test_a_file_that_is_cut_anywhere_is_refused_or_read_whole(tmp_path, name):
    data, path = IN_PYTHON[name], tmp_path / name
    path.write_bytes(data)
    whole = verdict(path)
    assert whole.startswith("read")
    for length in range(0, len(data), max(1, len(data) // 60)):
        path.write_bytes(data[:length])
        assert not files.is_finding("cut", verdict(path), whole, name, data[:length]), length


def test_damaged_label_maps_and_bags_are_read_or_refused_in_a_process_that_survives(tmp_path):
    tally, findings = files.run(5 * len(native_samples()), 3, tmp_path / "kept", sorted(native_samples().items()))
    assert len(native_samples()) >= 9 and not findings and set(tally) == {"read", "refused"}


def test_damaged_bytes_behind_a_header_make_no_other_surface_where_there_is_a_checksum(monkeypatch):
    monkeypatch.setattr(packed.child, "_limit", lambda limits, seconds: None)
    monkeypatch.setattr(packed.label_map, "_in_a_child", packed.in_this_process)
    found = {outcome for _, outcome in packed.run(100, 1)}
    assert {"refused", "same"} <= found <= {"refused", "same", "warned", "moved"}


@pytest.fixture(scope="module")
def reader():
    asked = files.Reader()
    yield asked
    asked.close()


@pytest.mark.parametrize("case", sorted((Path(__file__).parent / "cases").glob("*-*")), ids=lambda path: path.name)
def test_what_was_found_once_is_refused_or_read_with_a_warning(case, reader):
    (verdict,) = reader.ask(case)
    assert verdict == "refused" or verdict.endswith("with a warning")


def test_the_fuzzer_reports_a_dead_process_and_goes_on(tmp_path):
    reader, missing = files.Reader(), tmp_path / "none.ply"
    assert reader.ask(missing) == ["refused"]
    reader._child._process.kill()
    verdicts = reader.ask(missing, missing, missing)
    assert verdicts[0].startswith("process died") and verdicts[1:] == ["refused", "refused"]
    reader.close()


def test_files_after_one_that_took_too_much_are_read_by_a_fresh_process(tmp_path, monkeypatch):
    asked, closed = [], []

    class Scripted:
        def ask(self, paths):
            asked.append([path.name for path in paths])
            yield from ("memory read 1 0" if path.name == "b.ply" else "refused" for path in paths)

        def close(self):
            closed.append(len(asked))

    monkeypatch.setattr(files, "Child", Scripted)
    names = ["a.ply", "b.ply", "c.ply"]
    assert files.Reader().ask(*map(Path, names)) == ["refused", "memory read 1 0", "refused"]
    assert asked == [names, ["c.ply"]] and closed == [1]
