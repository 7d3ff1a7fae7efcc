"""Files appear whole or not at all."""

import json
import os
import stat
import threading

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


def test_a_link_stays_and_what_it_leads_to_is_replaced(tmp_path):
    (tmp_path / "run").mkdir()
    for name in ("old", "none_yet"):
        (tmp_path / name).symlink_to(tmp_path / "run" / name)
    (tmp_path / "run" / "old").write_text("before")
    for name in ("old", "none_yet"):
        files.check_writable(tmp_path / name)
        files.write_text(tmp_path / name, "after")
        assert (tmp_path / name).is_symlink() and (tmp_path / "run" / name).read_text() == "after"
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == ["none_yet", "old"]


def test_a_pipe_or_a_device_is_written_to_and_never_replaced(tmp_path):
    pipe = tmp_path / "pipe.json"
    os.mkfifo(pipe)
    read = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_text()), daemon=True)
    reader.start()
    files.check_writable(pipe)
    files.write_json(pipe, {"a": 1})
    reader.join(10.0)
    assert json.loads(read[0]) == {"a": 1} and stat.S_ISFIFO(pipe.stat().st_mode)
    assert [path.name for path in tmp_path.iterdir()] == ["pipe.json"]


def test_threads_that_write_one_file_each_leave_a_whole_one(tmp_path):
    together, failed = threading.Barrier(4), []

    def write(number):
        try:
            with files.replacing(tmp_path / "a.txt") as scratch:
                scratch.write_text(str(number) * 1000)
                together.wait(10)
        except ConfigError as error:
            failed.append(error)

    threads = [threading.Thread(target=write, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failed and (tmp_path / "a.txt").read_text() in {str(number) * 1000 for number in range(4)}
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_a_file_that_is_replaced_keeps_its_permissions(tmp_path):
    for mode in (0o600, 0o664):
        files.write_text(tmp_path / "a.txt", "old")
        (tmp_path / "a.txt").chmod(mode)
        files.write_text(tmp_path / "a.txt", "new")
        assert stat.S_IMODE((tmp_path / "a.txt").stat().st_mode) == mode


def test_a_name_may_be_as_long_as_the_file_system_allows_and_no_longer(tmp_path):
    longest = tmp_path / ("a" * 251 + ".txt")
    files.check_writable(longest)
    files.write_text(longest, "new")
    assert longest.read_text() == "new"
    for refused in (files.check_writable, lambda path: files.write_text(path, "new")):
        with pytest.raises(ConfigError, match="too long"):
            refused(tmp_path / ("a" * 252 + ".txt"))


def test_a_folder_is_of_one_process_at_a_time_and_leaves_nothing(tmp_path):
    run = tmp_path / "run"
    with files.alone_in(run):
        with (
            pytest.raises(ConfigError, match="run, in which another process does; wait for its end"),
            files.alone_in(run),
        ):
            pass
        (run / "a.txt").write_text("kept")
    with files.alone_in(run):
        (run / "a.txt").unlink()
    assert not run.exists()
