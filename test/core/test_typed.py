"""A user's script is checked by mypy: the package has types, and `Any` is not among those of its public names."""

import subprocess
import sys
from pathlib import Path

SCRIPT = """
from gapr_core import Registrar, RegistrarConfig, SensorConfig

registrar = Registrar(RegistrarConfig(sensor=SensorConfig(kind="pointer")))
target = registrar.prepare("pelvis.stl", units="mm")
result = registrar.register("probe.ply", target)
error = result.errors_at([[1.0, 2.0, 3.0]])[0]
result.save("pose.tfm")
result.report("page.html")
reveal_type(registrar.register("probe.ply", target))
reveal_type(error.bound95_mm)
reveal_type(result.warnings[0].advice)
wrong: int = result.confidence
"""


def test_a_users_script_has_types(tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    command = [sys.executable, "-m", "mypy", "--strict", "--config-file", "", "--follow-imports=silent", "script.py"]
    root = Path(__file__).parents[2]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env={"MYPYPATH": str(root)})
    said = done.stdout
    assert 'Revealed type is "gapr_core.results.result.RegistrationResult"' in said, said + done.stderr
    assert 'float"' in said and 'str"' in said
    assert said.count("error:") == 1 and "incompatible" in said.lower(), said
    assert (root / "gapr_core/py.typed").is_file()
