"""What programs say to users, and how they end."""

import pytest

from gapr_core.errors import ConfigError
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
