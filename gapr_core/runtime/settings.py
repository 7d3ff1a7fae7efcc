"""Settings as frozen dataclasses: default, range, unit and help in one place, the same from file, command line and ROS.

    @dataclass(frozen=True)
    class Search(Settings):
        spins: int = setting(36, "turns about the normal that are tried", low=1, high=360)

`Search(spins=0)` raises; `from_dict`, `load` and `table` work for every such class, nested ones too.
"""

from __future__ import annotations

import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, asdict, dataclass, field, fields, is_dataclass
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

from gapr_core.errors import ConfigError

MOST_VALUES = 100_000  # of a file
T = TypeVar("T")
S = TypeVar("S", bound="Settings")


def setting(
    default: Any, text: str, *, low: float | None = None, high: float | None = None, unit: str = "",
    choices: Iterable[str] = (), **more: Any,
) -> Any:  # fmt: skip
    """Declare a field of a settings class.

    Args:
        default: the value where none is given; the annotation of the field decides the type.
        text: help, a phrase without the unit and the range.
        low, high: ends of the range, both included; None where there is no end.
        unit: of the value; empty for counts and shares.
        choices: of a text; empty for any.
        more: facts for other readers of the field, such as whether a ROS parameter may change at run time.
    """
    metadata = {"text": text, "low": low, "high": high, "unit": unit, "choices": tuple(choices), **more}
    if isinstance(default, dict | list):
        return field(default_factory=default.copy, metadata=metadata)
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class Settings:
    """Base of settings: values of another type or out of range cannot be made.

    Whole numbers become floats where floats are wanted, lists tuples, and NumPy's numbers plain ones.

    Raises:
        ConfigError: a value of another type, out of range, or none of the choices.
    """

    def __post_init__(self) -> None:
        hints = _hints(type(self))  # type: ignore[arg-type]
        for each in fields(self):
            object.__setattr__(self, each.name, _of_type(hints[each.name], getattr(self, each.name), each.name))
            problem = why_not(each, getattr(self, each.name))
            if problem:
                raise ConfigError(f"{each.name} {problem}", repr(getattr(self, each.name)), "correct the setting")

    @classmethod
    def from_dict(cls: type[S], values: Any) -> S:
        """Make a dataclass from nested mappings; an absent key keeps its default."""
        return from_dict(cls, values)

    @classmethod
    def from_yaml(cls: type[S], path: str | Path) -> S:
        """Put a file's entries over the defaults; see `load`."""
        return load(cls, path)

    def __init_subclass__(cls) -> None:
        cls.__repr__ = Settings.__repr__  # type: ignore[method-assign]  # else `dataclass` writes one of all settings

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(changes(self))})"

    def to_dict(self) -> dict[str, Any]:
        """Nested dictionaries, as `from_dict` takes them."""
        return asdict(self)


def _of_type(hint: Any, value: Any, name: str) -> Any:
    """Convert a value that was given in Python to its annotation; nested settings are made already."""
    if not (isinstance(hint, type) and is_dataclass(hint)):
        return _converted(hint, value, name)
    if not isinstance(value, hint):
        how = f"write {name}={hint.__name__}(...), or take from_dict for mappings"
        raise ConfigError(f"{name} of type {hint.__name__}", repr(value), how)
    return value


def why_not(of: Field, value: Any) -> str:
    """Name the range or choices that a value of a field misses; empty if none."""
    choices, low, high = (of.metadata.get(key) for key in ("choices", "low", "high"))
    if choices and value not in choices:
        return f"one of {', '.join(choices)}"
    if (low is None and high is None) or (value is None and of.default is None):
        return ""
    numbers = value.values() if isinstance(value, dict) else value if isinstance(value, tuple | list) else (value,)
    if all(_is_within(number, low, high) for number in numbers):
        return ""
    return f"of {range_text(of)}"


def range_text(of: Field) -> str:
    """Describe the range of a field with its unit; empty without one."""
    low, high, unit = (of.metadata.get(key) for key in ("low", "high", "unit"))
    ends = [f"at least {low:g}" if low is not None else "", f"at most {high:g}" if high is not None else ""]
    text = f"{low:g} to {high:g}" if low is not None and high is not None else "".join(ends)
    return f"{text} {unit}".strip() if text else ""


def from_dict(cls: type[T], values: Any, path: str = "") -> T:
    """Put a nested mapping over the defaults; see the function `from_dict`.

    Args:
        cls: the dataclass; its annotations decide the types. Lists become tuples, whole numbers floats.
        values: a mapping of names to values.
        path: prefix of the names in an error.

    Raises:
        ConfigError: a name that the dataclass does not have, a value of another type or out of range, or a missing one.
    """
    if not isinstance(values, Mapping):
        where = f" under {path.rstrip('.')}" if path else ""
        raise ConfigError(f"a mapping of settings{where}", repr(values), "write `name: value` lines")
    known = {f.name: f for f in fields(cls)}  # type: ignore[arg-type]
    unknown = [str(name) for name in values if name not in known]
    if unknown:
        how = _did_you_mean(cls, unknown[0], path)
        raise ConfigError(f"one of {', '.join(known)}", f"{path}{unknown[0]}", how or f"correct it in {cls.__name__}")
    missing = [f"{path}{name}" for name, f in known.items() if name not in values and not _has_default(f)]
    if missing:
        raise ConfigError(f"{', '.join(missing)} for {cls.__name__}", "none", "add it")
    hints = _hints(cls)  # type: ignore[arg-type]
    return cls(**{name: _converted(hints[name], value, f"{path}{name}") for name, value in values.items()})


def _did_you_mean(cls: type, name: str, path: str) -> str:
    """Ask for a setting of the same or nearly the same name; empty where there is none."""
    names = [row.name for row in table(cls, path)]
    near = [each for each in names if each.endswith(f".{name}")]
    by_end = {each.rpartition(".")[2]: each for each in reversed(names)}
    near = near or [by_end[end] for end in get_close_matches(name, by_end, n=1)]
    return f"did you mean {' or '.join(near)}?" if near else ""


def load(cls: type[T], file: str | Path | None = None, assignments: Sequence[str] = ()) -> T:
    """Settings from a YAML file, with `name.name=value` over them; others keep their default.

    Raises:
        ConfigError: the file cannot be read, or see `from_dict`.
    """
    values = read_yaml(file) if file is not None else {}
    for text in assignments:
        name, equals, value = text.partition("=")
        if not equals:
            raise ConfigError("name=value, such as refinement.iterations=5", repr(text), "write it with an =")
        _put(values, name.strip().split("."), _parsed(value))
    return from_dict(cls, values)


def read_yaml(path: str | Path) -> dict[str, Any]:
    """Read the mapping in a YAML file; an empty file is an empty mapping.

    Raises:
        ConfigError: it cannot be read, is no YAML, names a key twice, or holds something else than a mapping.
    """
    import yaml

    try:
        text = Path(path).read_text(encoding="utf-8")
        twice = _key_named_twice(_composed(text))
        values = yaml.safe_load(text) or {}
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        why = " ".join(str(getattr(error, "strerror", None) or error).split())
        raise ConfigError("a YAML file", f"{path} ({why})", "check the path and the file") from error
    if twice:
        raise ConfigError(f"every key once in {path}", twice, "keep one of them")
    if not isinstance(values, dict):
        raise ConfigError(f"a mapping in {path}", type(values).__name__, "write `name: value` lines")
    return values


def _composed(text: str) -> Any:
    """Compose the tree of YAML nodes of a text.

    Raises:
        YAMLError: it is nested deeper than settings are, or its aliases stand for too many values.
    """
    import yaml

    try:
        root = yaml.compose(text, Loader=yaml.SafeLoader)
        too_many = _values_in(root, {}) > MOST_VALUES
    except RecursionError as error:
        raise yaml.YAMLError("it is nested too deeply") from error
    if too_many:
        raise yaml.YAMLError(f"its aliases stand for more than {MOST_VALUES} values")
    return root


def _values_in(node: Any, known: dict[int, int]) -> int:
    """Count the values that a node stands for, those of its aliases included."""
    if node is None or isinstance(node.value, str):
        return 1
    if id(node) not in known:
        known[id(node)] = MOST_VALUES  # of an alias within itself
        inner = [part for pair in node.value for part in pair] if node.id == "mapping" else node.value
        known[id(node)] = min(1 + sum(_values_in(part, known) for part in inner), MOST_VALUES + 1)
    return known[id(node)]


def _key_named_twice(root: Any) -> str:
    """Find the first key that stands twice in one mapping of a YAML tree, with its line; empty without one."""
    waiting, seen = [root], set[int]()
    while waiting:
        node = waiting.pop()
        if node is None or isinstance(node.value, str) or id(node) in seen:  # an alias is a node that was seen
            continue
        seen.add(id(node))
        if node.id == "sequence":
            waiting += node.value
            continue
        known = set[tuple[str, str]]()
        for key, value in node.value:
            if (named := (key.tag, str(key.value))) in known:
                return f"{key.value} again in line {key.start_mark.line + 1}"
            known.add(named)
            waiting.append(value)
    return ""


class Row(NamedTuple):
    """One setting as a reader sees it."""

    name: str
    default: Any
    range: str
    text: str


def table(cls: type, prefix: str = "") -> Iterator[Row]:
    """List every setting of a class and of those nested in it, with dotted names."""
    hints = _hints(cls)
    for f in fields(cls):
        hint = hints[f.name]
        if isinstance(hint, type) and is_dataclass(hint):
            yield from table(hint, f"{prefix}{f.name}.")
            continue
        default = f.default_factory() if f.default_factory is not MISSING else f.default
        of_range = ", ".join(f.metadata.get("choices", ())) or range_text(f) or f.metadata.get("unit", "")
        yield Row(f"{prefix}{f.name}", default, of_range, f.metadata.get("text", ""))


def changes(config: Any, prefix: str = "") -> list[str]:
    """`name=value` of every setting that is not its default, with dotted names; no entry where all are."""
    found: list[str] = []
    for f in fields(config):
        value = getattr(config, f.name)
        if is_dataclass(value):
            found += changes(value, f"{prefix}{f.name}.")
        elif value != (f.default_factory() if f.default_factory is not MISSING else f.default):
            found.append(f"{prefix}{f.name}={value}")
    return found


@cache
def _hints(cls: type) -> dict[str, Any]:
    return get_type_hints(cls)


def _has_default(of: Field) -> bool:
    return of.default is not MISSING or of.default_factory is not MISSING


def _is_within(number: Any, low: float | None, high: float | None) -> bool:
    """Tell whether a value is a number within the ends; NaN is not."""
    if not isinstance(number, int | float):
        return False
    return number >= (float("-inf") if low is None else low) and number <= (float("inf") if high is None else high)


def _converted(hint: Any, value: Any, path: str) -> Any:
    """Convert the value to its annotation."""
    value = value.item() if getattr(value, "shape", None) == () else value  # of NumPy
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):  # only X | None is used
        return None if value is None else _converted(arguments[0], value, path)
    if is_dataclass(hint):
        return from_dict(hint, value, f"{path}.")  # type: ignore[arg-type]
    if origin is tuple and isinstance(value, tuple | list):
        each = [arguments[0]] * len(value) if arguments[-1] is Ellipsis else list(arguments)
        if len(each) == len(value):
            return tuple(_converted(h, v, path) for h, v in zip(each, value, strict=True))
    if origin is dict and isinstance(value, Mapping):
        return {name: _converted(arguments[1], v, f"{path}.{name}") for name, v in value.items()}
    if origin is list and isinstance(value, list):
        return [_converted(arguments[0], v, path) for v in value]
    if hint is Any or (hint is not float and type(value) is hint):
        return value
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    raise ConfigError(f"{path} of type {getattr(hint, '__name__', hint)}", repr(value), "correct the value")


def _put(values: dict[str, Any], names: list[str], value: Any) -> None:
    for name in names[:-1]:
        inner = values.setdefault(name, {})
        if not isinstance(inner, dict):
            raise ConfigError(f"a mapping under {name}", repr(inner), "correct the name")
        values = inner
    values[names[-1]] = value


def _parsed(text: str) -> Any:
    """Parse a value as YAML reads it, 1e-3 included."""
    import yaml

    try:
        _composed(text)
        value = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError("a value such as 5, 0.5, true, [1, 2]", repr(text), "correct the value") from error
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value
