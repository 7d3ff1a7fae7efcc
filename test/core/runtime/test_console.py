"""What programs say to users, and how they end."""

import logging
from types import SimpleNamespace

import pytest

from gapr_core import cli
from gapr_core.cli import main
from gapr_core.errors import ConfigError
from gapr_core.runtime import console
from gapr_core.runtime.console import exit_code


def fails(error):
    raise error


def test_what_a_user_must_fix_is_one_line_and_exit_code_1(capsys):
    assert exit_code(lambda: fails(ConfigError("a file", "none", "name one")), "program") == 1
    assert capsys.readouterr() == ("", "program: expected a file; got none; name one\n")


def test_other_errors_and_exit_codes_are_those_of_the_program(capsys):
    assert exit_code(lambda: 3, "program") == 3
    with pytest.raises(ZeroDivisionError):
        exit_code(lambda: 1 // 0, "program")
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("name", ["\x1b]0;owned\x07bone", "\x1b[2J", "a\rb", "\u202ebone", "\x9b31m"])
def test_a_name_does_not_steer_the_terminal(capsys, name):
    console.say(f"label {name}")
    main(["register", "--source", f"{name}.ply", "--target", f"{name}.stl"])
    record = logging.LogRecord("gapr_core", logging.WARNING, "", 0, "%s", (name,), None)
    said = "".join(capsys.readouterr()) + cli._Printable("%(message)s").format(record)
    assert not console.STEERING.search(said) and said.count("\\") >= 2


def test_too_little_memory_is_one_line(capsys, monkeypatch):
    def run(_):
        raise MemoryError

    monkeypatch.setattr(cli, "_parser", lambda _: SimpleNamespace(run=run))
    assert main(["register"]) == 1
    assert capsys.readouterr().err.startswith("gapr: not enough memory")
