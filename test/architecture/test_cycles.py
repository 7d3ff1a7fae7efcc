"""No file imports another that, by any way, imports it back; imports for types and inside functions count."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def modules(package):
    """Name and file of every module of a package."""
    for path in sorted((ROOT / package).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        yield ".".join(parts[:-1] if parts[-1] == "__init__" else parts), path


def imported(source):
    """Every name that a source text may import a module by, wherever the import stands."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def cycles(graph):
    """Groups of modules that import each other in a circle (Tarjan 1972: strongly connected components)."""
    order, low, stack, found = {}, {}, [], []

    def visit(name):
        order[name] = low[name] = len(order)
        stack.append(name)
        for other in graph[name]:
            if other not in order:
                visit(other)
                low[name] = min(low[name], low[other])
            elif other in stack:
                low[name] = min(low[name], order[other])
        if low[name] == order[name]:
            group = stack[stack.index(name) :]
            del stack[stack.index(name) :]
            if len(group) > 1:
                found.append(sorted(group))

    for name in graph:
        if name not in order:
            visit(name)
    return found


def graph_of(sources):
    return {name: {other for other in imported(text) if other in sources and other != name}
            for name, text in sources.items()}  # fmt: skip


@pytest.mark.parametrize("package", ["gapr_core", "gapr_ros", "msg_adapters"])
def test_no_files_import_each_other_in_a_circle(package):
    sources = {name: path.read_text(encoding="utf-8") for name, path in modules(package)}
    # a package's own __init__ that offers its modules' names is no floor of the house
    files = {name: text for name, text in sources.items() if name != package}
    assert not cycles(graph_of(files))


def test_a_circle_is_found_and_a_ladder_is_not():
    ladder = {"a": "import b\nimport c", "b": "from c import x", "c": ""}
    assert cycles(graph_of(ladder)) == []
    circle = ladder | {"c": "def f():\n    from a import y"}
    assert cycles(graph_of(circle)) == [["a", "b", "c"]]
