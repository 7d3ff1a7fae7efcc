"""Hook of MkDocs: what the site takes from outside docs/.

Pages and the notebook that live elsewhere, the help of every command, and the settings of the library.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from operator import attrgetter
from pathlib import Path
from posixpath import dirname, join, normpath, relpath
from typing import Any

from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files

from gapr_core.cli import modules
from gapr_core.config import RegistrarConfig
from gapr_core.pages import markdown
from gapr_core.runtime.settings import table as table_of

ROOT = Path(__file__).resolve().parents[1]
SETTINGS = """# Settings

| where | how |
|---|---|
| Python | `RegistrarConfig(min_confidence=0.8, refinement=RefinementConfig(iterations=5))` (`gapr_core.config`) |
| file | `gapr register --config FILE.yaml`, with `refinement: {iterations: 5}` in it; the node: `settings_file` |
| command line | `gapr register --set refinement.iterations=5` |

A value out of range is an error. `gapr settings` prints these tables as one."""
ELSEWHERE = {
    "contributing.md": "CONTRIBUTING.md",
    "weights.md": "gapr_core/weights/README.md",
    "tutorials/register.ipynb": "examples/register.ipynb",
}  # page: where it lives
LINK = re.compile(r"\[([^\]]*)\]\((?!\w+:|#)([^)#\s]+)(#[^)\s]*)?\)")


@event_priority(1)
def on_files(files: Files, config: Any) -> Files:
    """Add the pages that live elsewhere, before mkdocs-jupyter looks for notebooks, and the help of the commands."""
    for page, path in ELSEWHERE.items():
        if page.endswith(".ipynb"):
            files.append(notebook(page, ROOT / path, config))
        else:
            files.append(File.generated(config, page, content=(ROOT / path).read_text(encoding="utf-8")))
    files.append(File.generated(config, "reference/commands.md", content=help_of_commands()))
    files.append(File.generated(config, "reference/settings.md", content=settings_of_the_library()))
    return files


def notebook(page: str, path: Path, config: Any) -> File:
    """Copy a notebook to a folder of its own: it runs beside its file, and writes there."""
    os.environ["OPEN3D_DISABLE_WEB_VISUALIZER"] = "true"  # or Open3D prints into the cell
    folder = Path(tempfile.mkdtemp())
    (folder / page).parent.mkdir(parents=True)
    shutil.copy(path, folder / page)
    return File(page, str(folder), config.site_dir, config.use_directory_urls)


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Lead links to where the site has what they name."""
    name = page.file.src_uri
    here = dirname(ELSEWHERE.get(name, f"docs/{name}"))
    return LINK.sub(lambda found: link(found, here, dirname(name), files), markdown)


def link(found: re.Match[str], here: str, folder: str, files: Files) -> str:
    """A link of the repository as a link of the site; plain text where the site does not have the file."""
    path = normpath(join(here, found[2]))
    pages = {where: page for page, where in ELSEWHERE.items()}
    page = pages.get(path, path.removeprefix("docs/"))
    file = files.get_file_from_path(page)
    if (file is None or file.inclusion.is_excluded()) and (ROOT / path).exists():
        return f"{found[1]} (`{path}`)"
    return f"[{found[1]}]({relpath(page, folder or '.')}{found[3] or ''})"


def settings_of_the_library() -> str:
    """Every setting with its default, unit, range and help: a table for each group."""
    header = ("setting", "default", "range", "meaning")
    groups: dict[str, list[tuple[object, ...]]] = {"": []}
    for name, *rest in table_of(RegistrarConfig):
        groups.setdefault(name.rpartition(".")[0], []).append((f"`{name}`", *rest))
    parts = [SETTINGS, markdown.table(header, groups.pop(""))]
    for group, rows in groups.items():
        about = (type(attrgetter(group)(RegistrarConfig())).__doc__ or "").splitlines()[0]
        parts += [f"## {group}", about, markdown.table(header, rows)]
    return "\n\n".join(parts)


def help_of_commands() -> str:
    """What `gapr` and each of its commands says with --help."""
    env = {**os.environ, "COLUMNS": "84", "PYTHONPATH": str(ROOT), "NO_COLOR": "1"}
    parts = ["# Command line"]
    for command in ("", *modules()):
        run = [sys.executable, "-m", "gapr_core.cli", *command.split(), "--help"]
        text = subprocess.run(run, capture_output=True, text=True, check=True, env=env).stdout
        parts.append(f"## {f'gapr {command}'.strip()}\n\n```text\n{text}```")
    parts.append("The programs of the ROS package, `register_node` and `bag_replay`: [the ROS 2 node](ros.md).")
    return "\n\n".join(parts)
