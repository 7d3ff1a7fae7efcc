"""Files that appear whole or not at all, and one sentence where they cannot be read or written."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from secrets import token_hex
from tempfile import TemporaryFile, gettempdir
from typing import Any

from gapr_core.errors import ConfigError

_WAITING: ContextVar[dict[Path, Path | None] | None] = ContextVar("_WAITING", default=None)  # of `together`


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Give a hidden file next to `path` to write; it replaces `path` if the block ends well.

    After an error the old file is as it was. Missing folders are made. A file that is replaced keeps its permissions. A
    link stays, and its target is replaced; a device or a pipe, such as /dev/null, gets the content.

    Raises:
        ConfigError: the file cannot be written: no such folder, no permission, a full disk.
    """
    path = Path(path)
    _refuse_folder(path)
    into = Path(gettempdir()) / path.name if is_special(path) else Path(os.path.realpath(path))
    scratch = into.with_name(f".{token_hex(8)}{into.suffix}")  # of this call alone, in any thread, container or machine
    try:
        into.parent.mkdir(parents=True, exist_ok=True)
        yield scratch
        if is_special(path):
            path.write_bytes(scratch.read_bytes())
            return
        if into.exists():
            shutil.copymode(into, scratch)
        if (waiting := _WAITING.get()) is not None:
            waiting[into] = scratch
        else:
            os.replace(scratch, into)
    except OSError as error:
        raise unwritable(path, error) from error
    finally:
        if (_WAITING.get() or {}).get(into) != scratch:
            with suppress(OSError):  # no such folder: the error above says more
                scratch.unlink(missing_ok=True)


@contextmanager
def together() -> Iterator[None]:
    """Let the files that a block writes appear at its end, once those that they replace are gone.

    Whoever kills the process leaves files of one run alone: some or all of the old ones, or of the new ones. After an
    error the old files are as they were. A block in another one is part of it.

    Raises:
        ConfigError: a file cannot be replaced.
    """
    if _WAITING.get() is not None:
        yield
        return
    waiting: dict[Path, Path | None] = {}
    token = _WAITING.set(waiting)
    try:
        yield
        for into in reversed(waiting):
            into.unlink(missing_ok=True)
        for into, scratch in waiting.items():
            if scratch is not None:
                os.replace(scratch, into)
    except OSError as error:
        raise unwritable(next(iter(waiting), Path()), error) from error
    finally:
        _WAITING.reset(token)
        for scratch in filter(None, waiting.values()):
            with suppress(OSError):
                scratch.unlink(missing_ok=True)


def remove(path: Path) -> None:
    """Remove a file that does not belong to those that are written `together`; a device or a pipe stays."""
    if is_special(path):
        return
    if (waiting := _WAITING.get()) is not None:
        waiting[Path(os.path.realpath(path))] = None
    else:
        path.unlink(missing_ok=True)


def is_special(path: Path) -> bool:
    """Check whether a device, a pipe or a socket is there, which no file may replace."""
    return os.path.exists(path) and not os.path.isfile(path) and not os.path.isdir(path)


@contextmanager
def one_at_a_time(path: str | Path) -> Iterator[None]:
    """Wait until no other process is in such a block for a file of this folder. A missing folder is made.

    Where the system has no such lock, as on Windows, nothing is waited for.

    Raises:
        ConfigError: the folder cannot be made.
    """
    folder = Path(path).parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(path, error) from error
    lock = _locked(folder)
    try:
        yield
    finally:
        if lock is not None:
            os.close(lock)


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Hold a folder for this process alone. A missing folder is made, and removed again if it stays empty.

    Raises:
        ConfigError: another process is in such a block, or the folder cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = _locked(folder, wait=False)
    except BlockingIOError as error:
        expected, how = "a folder in which nothing runs yet", "wait for its end, stop it, or choose another folder"
        raise ConfigError(expected, f"{folder}, in which another process does", how) from error
    except OSError as error:
        raise unwritable(folder, error) from error
    try:
        yield
    finally:
        if lock is not None:
            os.close(lock)
        with suppress(OSError):  # there is something in it
            folder.rmdir()


def _locked(folder: Path, wait: bool = True) -> int | None:
    """Open a file that holds the lock of a folder until it is closed; None if another process has it.

    Raises:
        BlockingIOError: another process has it, where this one does not `wait`.
    """
    try:
        import fcntl

        lock = os.open(folder, os.O_RDONLY)
    except (ImportError, OSError):
        return None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(lock)
        raise
    except OSError:  # a file system without locks
        pass
    return lock


def check_writable(path: str | Path) -> None:
    """Raise the error of writing a file before there is anything to write; leave nothing behind.

    Raises:
        ConfigError: a folder, or a place where no file can be written.
    """
    path = Path(path)
    _refuse_folder(path)
    if is_special(path):
        return
    try:
        path.exists()  # raises where its name is too long
        folder = next(folder for folder in Path(os.path.realpath(path)).parents if folder.exists())
        with TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise unwritable(path, error) from error


def write_text(path: str | Path, text: str) -> None:
    """Write a whole UTF-8 file; see `replacing`."""
    with replacing(path) as scratch:
        scratch.write_text(text, encoding="utf-8")


def write_json(path: str | Path, content: Any) -> None:
    """Write plain values as a whole JSON file; see `replacing`."""
    write_text(path, json.dumps(content, indent=1) + "\n")


def read_json(path: str | Path, expected: str, how: str = "check the path, or make the file again") -> Any:
    """Read the content of a JSON file.

    Args:
        path: where it is.
        expected: the file's kind, in words, for the error.
        how: to get it, in words, for the error.

    Raises:
        ConfigError: it cannot be read, or is no JSON.
    """
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise ConfigError(expected, f"{path} ({why})", how) from error


def _refuse_folder(path: Path) -> None:
    if not path.name or os.path.isdir(path):
        raise ConfigError("a path of a file", f"{path}, a folder", "add the name of the file")


def unwritable(path: str | Path, error: OSError) -> ConfigError:
    """Say why a path cannot be written."""
    why = error.strerror or str(error)
    if isinstance(error, FileExistsError | NotADirectoryError):
        why = "what should be its folder is a file"
    return ConfigError("a path that can be written", f"{path} ({why})", "choose another path, or free some space")
