"""A process that has collected the tests of one file, and forks to run them on each mutation of it.

Loading pytest, the libraries and the tests takes most of the time of a small test run: so it happens once a file. In
the fork every function of the module gets the code of its mutated namesake. That reaches the functions that the tests
have imported by name, too. The first failure ends a run, so the tests that found out about mutants of nearby lines go
first.
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

LIMIT_S = 300  # of processor time, without a mutation
NO_TEST = "no test: it crashed or took too long"
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

    def killer(self, text: str, line: int = 0, first: str = "") -> str:
        """The test that fails with the functions of this text, or why none could end; "" when all pass.

        Args:
            text: of the mutated module.
            line: that differs.
            first: name of the test to begin with.
        """
        self._pipe.send((text, line, first))
        return str(self._pipe.recv())

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
            order, limit_s = Order(), LIMIT_S
            while True:
                try:
                    text, line, first = pipe.recv()
                except EOFError:
                    return True
                session.items.sort(key=lambda item: order.rank(item.nodeid, line, first))
                killer, seconds = _forked(session, module, text, limit_s)
                order.note(killer, line)
                if not line:  # nothing was mutated
                    limit_s = int(5.0 + 4.0 * seconds)
                pipe.send(killer)

    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(1, 2)
        pytest.main([*OPTIONS, "-m", "not slow", *tests], plugins=[Loop()])
    finally:
        os._exit(0)


class Order:
    """Which test goes first: the one that is named, then those that found mutants of the nearest lines."""

    def __init__(self) -> None:
        self._lines: dict[str, list[int]] = {}

    def note(self, killer: str, line: int) -> None:
        """A test failed with a mutation of this line."""
        self._lines.setdefault(killer, []).append(line)

    def rank(self, test: str, line: int, first: str) -> tuple[bool, float, int]:
        """Sorts tests for a mutation of this line."""
        found = self._lines.get(test, [])
        return test != first, min((abs(line - other) for other in found), default=float("inf")), -len(found)


def _forked(session: Any, module: str, text: str, limit_s: int) -> tuple[str, float]:
    """The test that fails, "" when none does; seconds of processor time."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        _run(session, module, text, limit_s, writing)
    os.close(writing)
    _, status, used = os.wait4(child, 0)
    with os.fdopen(reading) as names:
        name = names.read()
    return (name or NO_TEST) if status else "", used.ru_utime + used.ru_stime


def _run(session: Any, module: str, text: str, limit_s: int, writing: int) -> None:
    """All tests on one mutation; writes the name of the one that fails, and exits with 1."""
    from _pytest.main import pytest_runtestloop

    class Failures:
        def pytest_runtest_logreport(self, report: Any) -> None:
            if report.failed:
                os.write(writing, report.nodeid.encode())

    code = 1
    resource.setrlimit(resource.RLIMIT_CPU, (limit_s, limit_s))
    try:
        session.config.pluginmanager.register(Failures())
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
