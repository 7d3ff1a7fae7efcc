"""Compiled code finds a place where neither the package nor the user's cache can be written."""

import logging
import os

import pytest

from gapr_core.runtime import compiled_code


@pytest.fixture
def nowhere(monkeypatch, tmp_path):
    monkeypatch.delenv(compiled_code.VARIABLE, raising=False)
    monkeypatch.setattr(compiled_code, "_can_write", lambda _: False)
    monkeypatch.setattr("tempfile.mkdtemp", lambda prefix: str(tmp_path))
    monkeypatch.setattr("atexit.register", lambda *_, **__: None)
    yield tmp_path
    os.environ.pop(compiled_code.VARIABLE, None)


def test_a_temporary_folder_takes_it_and_is_named(nowhere, caplog, monkeypatch):
    import numba

    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    with caplog.at_level(logging.WARNING):
        compiled_code.find_a_place()
    assert os.environ[compiled_code.VARIABLE] == numba.config.CACHE_DIR == str(nowhere)
    assert "set NUMBA_CACHE_DIR" in caplog.text


@pytest.mark.parametrize("place", ["variable", "package", "user"])
def test_each_other_place_is_enough(nowhere, monkeypatch, place):
    if place == "variable":
        monkeypatch.setenv(compiled_code.VARIABLE, "/somewhere")
    else:
        of_user = compiled_code._of_user()
        wanted = of_user if place == "user" else compiled_code.PACKAGE / "__pycache__"
        monkeypatch.setattr(compiled_code, "_can_write", lambda folder: folder == wanted)
    compiled_code.find_a_place()
    assert os.environ.get(compiled_code.VARIABLE) == ("/somewhere" if place == "variable" else None)


def test_a_folder_can_be_written_where_it_could_be_made(tmp_path, monkeypatch):
    assert compiled_code._can_write(tmp_path / "a" / "b") and not (tmp_path / "a").exists()
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert not compiled_code._can_write(tmp_path / "a" / "b")
