"""`gapr settings`: list every setting of the registration with its default, range and meaning."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from gapr_core.config import RegistrarConfig
from gapr_core.pages import markdown
from gapr_core.runtime import settings
from gapr_core.runtime.console import say


def add_arguments(parser: ArgumentParser) -> None:
    """The command has no options."""


def run(args: Namespace) -> int:
    """Print a Markdown table."""
    say(markdown.table(["setting", "default", "range", "meaning"], settings.table(RegistrarConfig)))
    return 0
