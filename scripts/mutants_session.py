"""A process that has collected the tests of one file, and forks to run them on each mutation of it.

Loading pytest, the libraries and the tests takes most of the time of a small test run: so it happens once a file. In
the fork every function of the module gets the code of its mutated namesake. That reaches the functions that the tests
have imported by name, too.

Only tests that call the mutated function run on a mutant: a first run without a mutation notes which do. The first
failure ends a run, so the tests that failed on mutants of nearby lines go first.
"""

from __future__ import annotations

import ast
import functools
import gc
import importlib
import json
import os
import resource
import sys
import threading
import types
from collections.abc import Generator, Mapping, Sequence
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest

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

    def killer(self, text: str, line: int, around: range, first: str) -> str:
        """The test that fails with the functions of this text, or why none could end; "" when all pass.

        Args:
            text: of the mutated module.
            line: that differs; 0 when none does.
            around: lines of the function that differs.
            first: name of the test to begin with, or "".
        """
        self._pipe.send((text, line, around, first))
        return str(self._pipe.recv())

    def close(self) -> None:
        """End the process."""
        self._pipe.close()
        os.waitpid(self.process, 0)


def function_around(source: str, line: int) -> range:
    """Lines of the outermost function whose body holds this line; empty outside: only functions can be exchanged."""
    functions = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef)]
    for node in functions:  # the outermost come first
        if node.body[0].lineno <= line <= (node.end_lineno or 0):
            return range(min([node.lineno, *(part.lineno for part in node.decorator_list)]), (node.end_lineno or 0) + 1)
    return range(0)


def compile_kernels_unless(text: str) -> None:
    """Switch Numba's compiler off for tests of a module that has kernels: a compiled one would stay what it was."""
    import numba

    numba.config.DISABLE_JIT = "numba.njit" in text


def _serve(module: str, tests: Sequence[str], pipe: Connection) -> None:
    """In the forked process; never returns."""

    class Loop:
        """In place of pytest's own loop."""

        @pytest.hookimpl(tryfirst=True)
        def pytest_runtestloop(self, session: Any) -> bool:
            order, limit_s, items = Order(), LIMIT_S, session.items
            gc.freeze()  # what is never looked at is never copied in a fork
            while True:
                try:
                    text, line, around, first = pipe.recv()
                except EOFError:
                    return True
                wanted = [item for item in items if not line or order.calls(item.nodeid, around)]
                session.items = sorted(wanted, key=lambda item: order.rank(item.nodeid, line, first))
                outcome, failed, seconds = _forked(session, module, text, line, limit_s)
                if not line and not failed:
                    limit_s = int(5.0 + 4.0 * seconds)
                    order.called = json.loads(outcome)
                if failed:
                    order.note(outcome, line)
                pipe.send((outcome or NO_TEST) if failed else "")

    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(1, 2)
        compile_kernels_unless(Path(f"{module.replace('.', '/')}.py").read_text(encoding="utf-8"))
        pytest.main([*OPTIONS, "-m", "not slow", *tests], plugins=[Loop()])
    finally:
        os._exit(0)


class Order:
    """Which tests run: those that call the function. First the one that is named, then those that failed nearby.

    Attributes:
        called: first lines of the functions that each test calls, and under "" those that fixtures call.
    """

    def __init__(self) -> None:
        self.called: dict[str, list[int]] = {}
        self._lines: dict[str, list[int]] = {}

    def calls(self, test: str, around: range) -> bool:
        """True when a function that begins within these lines is called."""
        return any(line in around for line in (*self.called.get("", ()), *self.called.get(test, ())))

    def note(self, killer: str, line: int) -> None:
        """A test failed with a mutation of this line."""
        self._lines.setdefault(killer, []).append(line)

    def rank(self, test: str, line: int, first: str) -> tuple[bool, float, int]:
        """Sorts tests for a mutation of this line."""
        found = self._lines.get(test, [])
        return test != first, min((abs(line - other) for other in found), default=float("inf")), -len(found)


class Calls:
    """A plugin that notes which functions of a file each test calls."""

    def __init__(self, file: str) -> None:
        self.file, self.of, self._into = file, {"": set()}, set()  # type: ignore[var-annotated]
        threading.setprofile(self._note)
        sys.setprofile(self._note)

    def _note(self, frame: types.FrameType, event: str, _: Any) -> None:
        if event == "call" and frame.f_code.co_filename == self.file:
            self._into.add(frame.f_code.co_firstlineno)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self) -> Generator[None, Any, Any]:
        self._into = self.of[""]  # a fixture may be shared with tests that come later
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: Any) -> Generator[None, Any, Any]:
        self._into = self.of.setdefault(item.nodeid, set())
        return (yield)


class Failures:
    """A plugin that writes the name of a test that fails."""

    def __init__(self, writing: int) -> None:
        self._writing = writing

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed:
            os.write(self._writing, report.nodeid.encode())


def _forked(session: Any, module: str, text: str, line: int, limit_s: int) -> tuple[str, bool, float]:
    """What the fork said (the test that fails, or without a mutation the calls), whether one failed, seconds."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        _run(session, module, text, line, limit_s, writing)
    os.close(writing)
    with os.fdopen(reading) as file:
        outcome = file.read()
    _, status, used = os.wait4(child, 0)
    return outcome, status != 0, used.ru_utime + used.ru_stime


def _run(session: Any, module: str, text: str, line: int, limit_s: int, writing: int) -> None:
    """The tests on one mutation, until one fails; exits with 1 then."""
    from _pytest.main import pytest_runtestloop

    code = 1
    resource.setrlimit(resource.RLIMIT_CPU, (limit_s, limit_s))
    try:
        session.config.pluginmanager.register(Failures(writing))
        loaded = importlib.import_module(module)
        exchange(loaded, text)
        if line:
            pytest_runtestloop(session)
        else:
            calls = Calls(str(loaded.__file__))
            session.config.pluginmanager.register(calls)
            pytest_runtestloop(session)
            sys.setprofile(None)
            os.write(writing, json.dumps({test: sorted(lines) for test, lines in calls.of.items()}).encode())
        code = int(session.testsfailed > 0)
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
