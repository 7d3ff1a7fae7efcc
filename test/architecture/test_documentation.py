"""What the documentation shows is true: its code runs, its links lead somewhere, its words exist."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from textwrap import dedent
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest

from gapr_core import baselines, cli, load
from gapr_core.benchmark import methods
from gapr_core.cli import main
from gapr_core.config import SensorConfig
from gapr_core.data import parametric, pool
from gapr_core.data.protocols import PROTOCOLS, make_pair
from gapr_core.errors import InvalidPointCloudError
from gapr_core.formats import reading
from gapr_core.geometry import se3
from gapr_core.model.config import ModelConfig
from gapr_core.model.encoding import TRANSFORMERS
from gapr_core.model.network import GAPRNet
from gapr_core.registration.problem import sensor
from gapr_core.results import RegistrationStatus
from gapr_ros.demo.act import write_stl
from gapr_ros.node.outcome import Reason

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
CONTRIBUTING = ROOT / "CONTRIBUTING.md"
PAGES = [README, CONTRIBUTING, *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"(?:^<!-- not run: ([^>]+) -->\n)?^ *```(python|bash)\n(.*?)^ *```", flags=re.MULTILINE | re.DOTALL)
OURS = re.compile(r"^(?:gapr|python) ", flags=re.MULTILINE)  # what a bash block must start a line with to be ours
EXAMPLES = {"overfit_two_bones.py": ["--steps", "2"]}  # arguments that keep an example short; the others have none


class Block(NamedTuple):
    """A block of code of a page; `reason` says why it is not run."""

    reason: str
    language: str
    code: str


def blocks(page):
    """The Python blocks of a page, and those for the shell that use `gapr` or Python."""
    matches = BLOCK.findall(page.read_text(encoding="utf-8"))
    found = [Block(reason, language, dedent(code)) for reason, language, code in matches]
    return [block for block in found if block.language == "python" or OURS.search(block.code)]


def name_of(page):
    return str(page.relative_to(ROOT))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """What the examples name: a femur, and a view of it from the front, moved."""
    folder, bone, rng = tmp_path_factory.mktemp("files"), parametric.make_bone("femur", 1), np.random.default_rng(0)
    points, normals = bone.sample(9000, rng)
    seen = points[normals[:, 1] < -0.2] + rng.normal(0.0, 0.3, (int((normals[:, 1] < -0.2).sum()), 3))
    T_source_target = se3.exp([30.0, -20.0, 50.0, 0.5, -0.4, 1.0])
    partial = se3.apply(T_source_target, seen)
    for name in ("femur_ct.stl", "full.stl"):
        write_stl(bone, folder / name)
    np.save(folder / "partial.npy", partial)
    np.save(folder / "seen.npy", seen)
    np.save(folder / "truth.npy", np.linalg.inv(T_source_target))
    header = f"ply\nformat ascii 1.0\nelement vertex {len(partial)}\n"
    np.savetxt(folder / "partial.ply", partial, "%.6f", header=f"{header}property float x\nproperty float y\n"
               "property float z\nend_header", comments="")  # fmt: skip
    return folder


@pytest.fixture
def here(files, tmp_path, monkeypatch):
    """A folder with these files, to run in."""
    shutil.copytree(files, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(block, names):
    if block.language == "python":
        exec(compile(block.code, "example", "exec"), names)
    else:
        shell(["bash", "-euo", "pipefail", "-c", block.code])


def shell(command):
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    env = {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=env)
    assert done.returncode == 0, done.stdout + done.stderr


def check_readme(names):
    assert names["result"].ok, names["result"]
    assert np.linalg.norm(names["aligned"] - np.load("seen.npy"), axis=1).max() < 2.0


def check_slicer(names):
    assert np.percentile(names["off_mm"], 95) < 1.5, names["off_mm"]
    answer = json.loads(Path("result.json").read_text())
    (entry,) = answer["targets"]
    text = (ROOT / "docs/tutorials/slicer.md").read_text(encoding="utf-8")
    shown = re.findall(r"(?:TRE|entry: expected error) ([.\d]+) mm \(95 %: ([.\d]+) mm\)", text)
    printed = [[answer["tre_mm"], answer["tre95_mm"]], [entry["expected_mm"], entry["bound95_mm"]]]
    assert entry["label"] == "entry" and np.array(shown, dtype=float) == pytest.approx(np.array(printed), abs=0.06)
    assert Path("result/scene.mrml").is_file()


def check_python(names):
    assert names["sure"] == "0.99", "as print(result) says, and no 1.00"


def check_ros(names):
    assert json.loads(Path("first.json").read_text())["status"] == "OK"
    assert 0 < len(names["poses"]) == names["reasons"].count("") <= 12
    _, pose, *_ = names["poses"][-1]
    origin = 1000.0 * np.array(pose.split()[:3], dtype=float)
    assert np.linalg.norm(origin - names["T_camera_bone"][:3, 3]) < 5.0


def check_research(names):
    table = Path("bench/table.md").read_text()
    assert all(method in table for method in ("gapr", "gapr_search", "icp"))
    assert json.loads(Path("poses.json").read_text())["specimen_1"]["status"] == "OK"


CHECKS = {
    "README.md": check_readme,
    "docs/tutorials/slicer.md": check_slicer,
    "docs/tutorials/python.md": check_python,
    "docs/tutorials/ros.md": check_ros,
    "docs/tutorials/research.md": check_research,
}  # what must have come out of a page


@pytest.mark.timeout(400)  # whole commands, on a machine that may be busy
@pytest.mark.parametrize("page", [p for p in PAGES if any(not b.reason for b in blocks(p))], ids=name_of)
def test_the_code_of_a_page_runs_from_top_to_bottom(page, here):
    names = {}
    for block in blocks(page):
        if not block.reason:
            run(block, names)
    CHECKS.get(name_of(page), lambda names: None)(names)


def sensor_errors_are_usable(errors, monkeypatch):
    """Whether registrations with a sensor of these errors have what its covariance needs."""
    monkeypatch.setitem(sensor.KINDS, "laser", errors)
    return sensor.errors(SensorConfig("laser", noise_mm=0.7), 1000) == replace(errors, noise_mm=0.7)


def off_files_are_read(read, folder, monkeypatch):
    """Whether a reader that is entered as the recipe says reads whole files, and refuses cut ones in one line."""
    monkeypatch.setitem(sys.modules, "gapr_core.formats.meshes.off", SimpleNamespace(read=read))
    monkeypatch.setitem(reading.FORMATS, ".off", reading.Format("meshes.off:read"))
    whole = "OFF\n4 2 0\n0 0 0\n50 0 0\n0 40 0\n0 0 30\n3 0 1 2\n3 0 1 3\n"
    (folder / "a.off").write_text(whole)
    (folder / "cut.off").write_text(whole.removesuffix("3 0 1 3\n"))
    with pytest.raises(InvalidPointCloudError, match="a readable OFF file; got cut.off .5 lines where 4 points and 2"):
        load(folder / "cut.off")
    return load(folder / "a.off").faces.tolist() == [[0, 1, 2], [0, 1, 3]]


def test_the_recipes_of_contributing_work(here, monkeypatch):
    names = {}
    for block in blocks(CONTRIBUTING):
        run(block, names)
    monkeypatch.setitem(TRANSFORMERS, "distance", names["layer"])
    monkeypatch.setitem(baselines.REGISTRY, "principal_axes", names["PrincipalAxes"])
    monkeypatch.setitem(PROTOCOLS, "spot", names["spot"])
    assert GAPRNet(ModelConfig(encoding="distance"))
    pair = make_pair("spot", pool.parametric_specimen("femur", 1), 0)
    for method in (methods.make("principal_axes"), names["registrar"]()):
        result = method.register(pair.source, method.prepare(pair.target))
        assert result.ok or result.reason
    assert result.proposer == "centroids"
    assert sensor_errors_are_usable(names["tracked_camera"], monkeypatch)
    assert off_files_are_read(names["read"], here, monkeypatch)
    message = names["polygon"]([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    assert message.header.frame_id
    assert names["INPUT"].points(message).tolist() == [[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]
    assert names["INPUT"].count(message) == 2


@pytest.mark.timeout(400)
@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.py")), ids=name_of)
def test_an_example_runs(path, here):
    shell([sys.executable, str(path), *EXAMPLES.get(path.name, [])])


@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.ipynb")), ids=name_of)
def test_the_cells_of_a_notebook_run(path, here):
    names, cells = {}, json.loads(path.read_text(encoding="utf-8"))["cells"]
    for cell in cells:
        assert not cell.get("outputs"), "clear the outputs: the site has them"
        if cell["cell_type"] == "code":
            run(Block("", "python", "".join(cell["source"])), names)
    assert names["result"].ok and names["planned"].targets, names["result"]
    assert all((here / name).is_file() for name in ("femur.html", "pose.tfm", "pose.json", "femur.png"))


def test_every_example_in_a_folder_has_a_test_of_its_own():
    tests = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "test").rglob("test_examples.py"))
    examples = [path for path in (ROOT / "examples").glob("*/*") if path.is_file() and path.suffix != ".pyc"]
    assert len(examples) >= 3
    assert not [name_of(path) for path in examples if path.stem not in tests]


def test_no_code_hides_in_a_block_without_a_language():
    plain = re.compile(r"^ *```(?:sh|shell|console|text)?\n(.*?)^ *```", flags=re.MULTILINE | re.DOTALL)
    for page in PAGES:
        others = BLOCK.sub("", page.read_text(encoding="utf-8"))
        assert not [code for code in plain.findall(others) if re.search(r"^(gapr |python |import |from )", code, re.M)]


def commands():
    """(page, words) of every line in a block that starts with `gapr` or `python`, run or not."""
    for page in PAGES:
        for block in blocks(page):
            if block.language == "bash":
                for line in block.code.replace("\\\n", " ").splitlines():
                    if OURS.match(line):
                        yield name_of(page), shlex.split(line, comments=True)


def source_of(module):
    """The file that `python -m module` runs."""
    path = Path(*module.split("."))
    return path / "__main__.py" if (ROOT / path).is_dir() else path.with_suffix(".py")


def test_the_options_that_the_pages_show_exist(capsys):
    helps = {}
    for page, (program, name, *words) in commands():
        if program == "gapr" and name not in helps:
            with pytest.raises(SystemExit, match="0"):
                main([name, "--help"])
            helps[name] = capsys.readouterr().out
        script = source_of(words[0]) if name == "-m" else name
        text = helps[name] if program == "gapr" else (ROOT / script).read_text(encoding="utf-8")
        missing = {word for word in words if word.startswith("--") and not re.search(rf"{word}\b", text)}
        assert not missing, f"{page}: {program} {name}"
    assert {"register", "evaluate", "benchmark", "make-pairs"} <= set(helps)


def test_the_commands_that_the_pages_show_name_all_that_is_required():
    """But for the pages of results, which quote what was run then, and lines that leave something out."""
    shown = [words for page, (program, *words) in commands() if program == "gapr" and "docs/results" not in page]
    whole = [words for words in shown if "..." not in words and "--help" not in words]
    for words in whole:
        assert cli._parser(words).run, words
    assert len(whole) > 20


def test_every_link_leads_to_a_file_of_the_repository():
    for page in PAGES:
        for link in re.findall(r"\]\((?!https?:|#)([^)#]+)", page.read_text(encoding="utf-8")):
            assert (page.parent / link).exists(), f"{name_of(page)}: {link}"


def test_every_page_is_on_the_site():
    listed = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    pages = [page.relative_to(ROOT / "docs") for page in (ROOT / "docs").rglob("*.md")]
    assert len(pages) > 20
    assert not [str(page) for page in pages if not re.search(rf"\b{re.escape(str(page))}$", listed, re.MULTILINE)]


def test_every_figure_is_on_a_page():
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES) + (ROOT / "mkdocs.yml").read_text()
    figures = [path for path in (ROOT / "docs" / "figures").rglob("*") if path.is_file()]
    assert len(figures) > 5
    assert not [path.name for path in figures if f"{path.name})" not in text and f"{path.name}\n" not in text]


def test_a_page_that_the_site_fills_says_what_to_read_instead():
    filled = [page for page in PAGES if re.search(r"^(--8<--|:::) ", page.read_text(encoding="utf-8"), re.MULTILINE)]
    assert {page.name for page in filled} == {"parameters.md", "api.md"}
    for page in filled:
        line = page.read_text(encoding="utf-8").splitlines()[2]
        assert line.startswith("Expanded on the site (`make docs`); as Markdown, read "), page


def test_every_status_and_every_reason_is_explained():
    for words, page in ((RegistrationStatus, "reference/conventions.md"), (Reason, "reference/ros.md")):
        text = (ROOT / "docs" / page).read_text(encoding="utf-8")
        assert not [str(word) for word in words if f"`{word}`" not in text], page


def test_every_make_target_that_is_named_exists():
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE))
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    named = set(re.findall(r"(?:^|`)make ([a-z]+)", text, flags=re.MULTILINE))
    assert {"demo", "test", "lint", "docs"} <= named <= targets


def test_the_python_versions_are_those_of_setup_py():
    assert 'python_requires=">=3.10,<3.14"' in (ROOT / "setup.py").read_text()
    assert "Python from 3.10 to 3.13" in README.read_text(encoding="utf-8")
