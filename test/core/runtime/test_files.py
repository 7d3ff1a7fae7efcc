"""Files appear whole or not at all."""

import json

import pytest

from gapr_core.errors import ConfigError
from gapr_core.runtime import files


def test_a_file_is_written_whole_and_its_folder_is_made(tmp_path):
    files.write_json(tmp_path / "new" / "a.json", {"b": [1, 2]})
    assert json.loads((tmp_path / "new" / "a.json").read_text()) == {"b": [1, 2]}
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["a.json"]


def test_after_an_error_the_old_file_is_as_it_was_and_nothing_lies_around(tmp_path):
    files.write_text(tmp_path / "a.txt", "old")
    with pytest.raises(RuntimeError), files.replacing(tmp_path / "a.txt") as scratch:
        scratch.write_text("half of the n")
        raise RuntimeError
    assert (tmp_path / "a.txt").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_a_full_disk_is_one_sentence_that_names_the_file(tmp_path):
    with pytest.raises(ConfigError, match="a.txt.*No space left"), files.replacing(tmp_path / "a.txt"):
        raise OSError(28, "No space left on device")
    assert not list(tmp_path.iterdir())


def test_a_path_through_a_file_is_one_sentence_that_names_what_was_asked_for(tmp_path):
    (tmp_path / "a.txt").write_text("old")
    for path in (tmp_path / "a.txt" / "b.json", tmp_path / "a.txt" / "c" / "b.json"):
        with pytest.raises(ConfigError, match=r"b\.json \(what should be its folder is a file\)"):
            files.write_text(path, "new")
    assert (tmp_path / "a.txt").read_text() == "old"


@pytest.mark.parametrize("content", [None, b"{", b"\xff\xfe\x00"])
def test_what_is_no_json_is_one_sentence_that_names_the_file(tmp_path, content):
    if content is not None:
        (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(ConfigError, match="a plan.*a.json"):
        files.read_json(tmp_path / "a.json", "a plan")
