"""A process that has collected the tests of one file, and forks to run them on each mutation of it.

Loading pytest, the libraries and the tests takes most of the time of a small test run: so it happens once a file. In
the fork every function of the module gets the code of its mutated namesake. That reaches the functions that the tests
have imported by name, too.
"""

from __future__ import annotations

import ast
import functools
import importlib
import os
import resource
import types
from collections.abc import Mapping, Sequence
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any

LIMIT_S = 30  # of processor time: a mutant that takes longer hangs, and the tests noticed
OPTIONS = ("-x", "-q", "-p", "no:cacheprovider", "-p", "no:timeout", "-o", "addopts=", "--import-mode=importlib")


class Session:
    """Runs the tests of one module on mutations of it.

    Args:
        module: its dotted name.
        tests: files.
    """

    def __init__(self, module: str, tests: Sequence[str]) -> None:
        self._pipe, theirs = Pipe()
        self.process = os.fork()
        if self.process == 0:
            self._pipe.close()
            _serve(module, tests, theirs)
        theirs.close()

    def fails(self, text: str) -> bool:
        """True when the tests fail with the functions of this text."""
        self._pipe.send(text)
        return bool(self._pipe.recv())

    def close(self) -> None:
        """End the process."""
        self._pipe.close()
        os.waitpid(self.process, 0)


def in_function(source: str, line: int) -> bool:
    """True for a line in the body of a function: only such code can be exchanged."""
    functions = (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef))
    return any(node.body[0].lineno <= line <= (node.end_lineno or 0) for node in functions)


def _serve(module: str, tests: Sequence[str], pipe: Connection) -> None:
    """In the forked process; never returns."""
    import pytest

    class Loop:
        """In place of pytest's own loop."""

        @pytest.hookimpl(tryfirst=True)
        def pytest_runtestloop(self, session: Any) -> bool:
            while True:
                try:
                    text = pipe.recv()
                except EOFError:
                    return True
                child = os.fork()
                if child == 0:
                    _run(session, module, text)
                pipe.send(os.waitpid(child, 0)[1] != 0)

    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(1, 2)
        pytest.main([*OPTIONS, "-m", "not slow", *tests], plugins=[Loop()])
    finally:
        os._exit(0)


def _run(session: Any, module: str, text: str) -> None:
    """All tests on one mutation; exits with 1 when one fails."""
    from _pytest.main import pytest_runtestloop

    code = 1
    resource.setrlimit(resource.RLIMIT_CPU, (LIMIT_S, LIMIT_S))
    try:
        exchange(importlib.import_module(module), text)
        pytest_runtestloop(session)
        code = int(session.testsfailed > 0 or not session.testscollected)
    finally:
        os._exit(code)


def exchange(module: types.ModuleType, text: str) -> None:
    """Give the functions of a module the code of those of another text of it."""
    names: dict[str, Any] = {"__name__": module.__name__, "__file__": module.__file__}
    exec(compile(text, str(module.__file__), "exec"), names)
    _exchange_all(vars(module), names, module.__name__)


def _exchange_all(old: Mapping[str, Any], new: Mapping[str, Any], module: str) -> None:
    for name, value in old.items():
        if isinstance(value, type) and value.__module__ == module and name in new:
            _exchange_all(vars(value), vars(new[name]), module)
        elif name in new:
            for mine, other in zip(_functions(value), _functions(new[name]), strict=False):
                if mine.__module__ == module:
                    mine.__code__, mine.__defaults__ = other.__code__, other.__defaults__


def _functions(value: Any) -> list[types.FunctionType]:
    """Those within properties, class methods, cached functions and the like."""
    if isinstance(value, property):
        return [f for f in (value.fget, value.fset) if isinstance(f, types.FunctionType)]
    if isinstance(value, staticmethod | classmethod):
        value = value.__func__
    if isinstance(value, functools.cached_property):
        value = value.func
    value = getattr(value, "__wrapped__", value)
    return [value] if isinstance(value, types.FunctionType) else []
