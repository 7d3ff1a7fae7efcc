"""Tables of the documentation are what the command wrote, without the paths of a machine."""

import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "scripts" / "publish_table.py"


def publish(folder, *words):
    done = subprocess.run([sys.executable, SCRIPT, "name", *map(str, words), "--folder", folder], capture_output=True)
    assert done.returncode == 0, done.stderr
    return (folder / "name.md").read_text()


def test_the_table_of_a_benchmark_stays_as_it_is_but_for_paths_of_this_machine(tmp_path):
    table = "# Benchmark\n\n## Summary\n\n| a/b | 4 mm/5° |\n| --- | --- |\n\nMade by `gapr benchmark --pairs {}`.\n"
    (tmp_path / "table.md").write_text(table.format("/data/anna/pairs"))
    assert publish(tmp_path, tmp_path) == table.format("pairs").removeprefix("# Benchmark\n\n")


def test_what_a_script_printed_keeps_its_table_and_says_command_and_commit(tmp_path):
    (tmp_path / "printed.txt").write_text("10 %|###\n| a | b |\n|---|---|\n| 1 | 2 |\ndone\n")
    text = publish(tmp_path, tmp_path / "printed.txt", "--command", "python x.py", "--commit", "abc")
    assert text.startswith("| a | b |\n|---|---|\n| 1 | 2 |\n\nMade by `python x.py` at commit abc, ")
    assert "done" not in text and "###" not in text


def test_tables_that_follow_each_other_stay_apart_and_keep_all_their_rows(tmp_path):
    (tmp_path / "printed.txt").write_text("| a |\n| --- |\n| 1 |\n| - |\n\n| b |\n|---|\nnoise\n| 2 |\n")
    text = publish(tmp_path, tmp_path / "printed.txt", "--command", "python x.py", "--commit", "abc")
    assert text.startswith("| a |\n| --- |\n| 1 |\n| - |\n\n| b |\n|---|\n| 2 |\n\nMade by")
