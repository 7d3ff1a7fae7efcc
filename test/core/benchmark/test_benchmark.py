"""A run is repeatable, resumable and can be split; failures and false accepts are counted, never dropped."""

import argparse
import importlib
import json
import shutil
import tracemalloc
import weakref
from dataclasses import replace

import numpy as np
import pytest
from benchmark_cases import make_pair, ok, record, timeless

from gapr_core.benchmark import methods as known_methods
from gapr_core.benchmark import records, runner
from gapr_core.commands import benchmark
from gapr_core.config import RegistrarConfig, SearchConfig
from gapr_core.data.pair_files import facts_hash, load_facts, load_pair, pair_hash, save_pair
from gapr_core.errors import ConfigError, MethodUnavailableError
from gapr_core.geometry import se3


def row_of(rows, protocol, method, bone="all"):
    return next(r for r in rows if (r["protocol"], r["bone"], r["method"]) == (protocol, bone, f"fakes:{method}"))


def test_two_shards_merged_equal_one_run_and_the_same_run_again(pairs, fakes, tmp_path, in_process):
    methods = fakes("good", "turned")
    whole = benchmark.benchmark(pairs, methods, tmp_path / "whole")
    for k in (1, 2):
        benchmark.benchmark(pairs, methods, tmp_path / f"shard{k}", shard=(k, 2))
    merged = benchmark.merge([tmp_path / "shard2", tmp_path / "shard1"], tmp_path / "merged")
    assert timeless(merged) == timeless(whole)
    assert len(records.read(tmp_path / "shard1" / records.FILE)) == 8  # four of seven pairs, two methods
    assert timeless(benchmark.benchmark(pairs, methods, tmp_path / "again")) == timeless(whole)
    assert "results are missing" in (tmp_path / "shard1" / "table.md").read_text()
    assert "results are missing" not in (tmp_path / "merged" / "table.md").read_text()


def test_merging_into_one_of_the_folders_keeps_its_records(pairs, fakes, tmp_path, in_process):
    out = [tmp_path / name for name in ("a", "b")]
    for k in (1, 2):
        benchmark.benchmark(pairs, fakes("good"), out[k - 1], shard=(k, 2))
    both = [record for folder in out for record in records.read(folder / records.FILE)]
    benchmark.merge(out, out[0])
    assert sorted(r.pair for r in records.read(out[0] / records.FILE)) == sorted(r.pair for r in both)
    assert len(both) == 7


def test_others_are_compared_with_a_method_that_has_run(pairs, fakes, tmp_path, in_process):
    methods = fakes("good", "turned")
    with pytest.raises(ConfigError, match="--ours with one of fakes:good, fakes:turned; got fakes:god"):
        benchmark.benchmark(pairs, methods, tmp_path / "out", ours="fakes:god")
    benchmark.benchmark(pairs, methods, tmp_path / "out", ours="fakes:turned")
    assert "beats fakes:turned" in (tmp_path / "out" / "table.md").read_text()
    benchmark.merge([tmp_path / "out"], tmp_path / "merged", ours="fakes:good")
    assert "beats fakes:good" in (tmp_path / "merged" / "table.md").read_text()
    with pytest.raises(ConfigError, match="--ours"):
        benchmark.merge([tmp_path / "out"], tmp_path / "other", ours="icp")


def test_worker_processes_give_the_same_table_in_any_number(pairs, fakes, tmp_path, no_report, request):
    pytest.importorskip("small_gicp", reason="gicp is an optional method: pip install '.[baselines]'")
    methods = [*fakes("good"), "point_to_plane"]
    two = benchmark.benchmark(pairs, methods, tmp_path / "two", jobs=2, threads=1)
    request.getfixturevalue("in_process")
    assert timeless(benchmark.benchmark(pairs, methods, tmp_path / "one")) == timeless(two)


def test_an_interrupted_run_is_taken_up_where_it_was_killed(pairs, fakes, tmp_path, in_process, monkeypatch):
    methods = fakes("good", "shy")
    whole = benchmark.benchmark(pairs, methods, tmp_path / "out")
    file = tmp_path / "out" / records.FILE
    lines = file.read_text().splitlines(keepends=True)
    file.write_text("".join(lines[:5]) + lines[5][:40])  # killed while it wrote the sixth record
    asked = []
    run = runner.run_task
    monkeypatch.setattr(runner, "run_task", lambda task: asked.append(task) or run(task))
    assert timeless(benchmark.benchmark(pairs, methods, tmp_path / "out")) == timeless(whole)
    assert len(asked) == len(lines) - 5
    assert len(file.read_text().splitlines()) == len(lines)


def test_every_way_to_answer_ends_in_its_own_column(pairs, fakes, tmp_path, in_process):
    rows = benchmark.benchmark(pairs, fakes("good", "turned", "shy", "raising"), tmp_path / "out")
    good, turned, shy, raising = (row_of(rows, "all", m) for m in ("good", "turned", "shy", "raising"))
    assert (good["rr_1_1"], good["rr_4_5"], good["rr_paper"]) == (1.0, 1.0, 1.0)
    assert (good["accepted"], good["false_accepts"], good["false_accepts_sure"]) == (7, 2, 2)  # the two wrong pairs
    assert (turned["rr_4_5"], turned["false_accepts"], turned["false_accepts_sure"]) == (0.0, 7, 7)
    assert (shy["refused"], shy["false_accepts"], shy["rr_4_5"], shy["errors"]) == (7, 0, 0.0, 0)
    assert (raising["refused"], raising["errors"], raising["rr_paper"]) == (7, 7, 0.0)
    assert shy["rmse_mm"] == raising["rmse_mm"] > 10.0  # centroid on centroid stands in
    assert row_of(rows, "wrong", "good")["false_accept_rate"] == 1.0
    assert row_of(rows, "wrong", "good")["rr_4_5"] is None
    text = (tmp_path / "out" / "table.md").read_text()
    assert "Failed: fakes:raising on L1_tibia_0000 (RuntimeError: no luck)" in text


def test_a_process_that_dies_costs_its_own_pair_only(pairs, fakes, tmp_path, no_report):
    rows = benchmark.benchmark(pairs, fakes("deadly", "good"), tmp_path / "out", jobs=2)
    deadly = row_of(rows, "L1", "deadly")
    assert (deadly["pairs"], deadly["errors"], deadly["rr_4_5"]) == (4, 1, 0.75)
    assert row_of(rows, "L1", "good")["rr_4_5"] == 1.0


def test_a_method_that_ends_its_process_or_says_several_lines_fails_on_that_pair(
    pairs, fakes, tmp_path, in_process, monkeypatch
):
    method = known_methods.make(*fakes("good"))
    monkeypatch.setattr(runner, "_methods", {(*fakes("good"), RegistrarConfig()): method})
    errors = iter([SystemExit(4), ValueError("oops\nline | two")])

    def register(source, target):
        raise next(errors, RuntimeError("no luck"))

    monkeypatch.setattr(method, "register", register)
    benchmark.benchmark(pairs, fakes("good"), tmp_path / "out")
    found = {record.reason for record in records.read(tmp_path / "out" / records.FILE)}
    assert found == {"SystemExit: 4", "ValueError: oops line | two", "RuntimeError: no luck"}


@pytest.mark.parametrize(("name", "error", "said"), [
    ("fakes:missing", MethodUnavailableError, "pip install nope"),
    *[(name, ConfigError, "expected") for name in ("fakes:nobody", "no_such_module:good", "fakes:nothing", "ipc")],
])  # fmt: skip
def test_a_method_that_cannot_be_made_stops_the_run(name, error, said, pairs, fakes, tmp_path, in_process):
    with pytest.raises(error, match=said):
        benchmark.benchmark(pairs, [name], tmp_path / "out")
    with pytest.raises(ConfigError, match="gapr_search"):  # settings without a method that has some
        benchmark.benchmark(pairs, fakes("good"), tmp_path / "out", config=RegistrarConfig(num_threads=1))


def test_results_of_pairs_of_other_names_are_refused(pairs, fakes, tmp_path, in_process):
    benchmark.benchmark(pairs, fakes("good"), tmp_path / "out")
    more = shutil.copytree(pairs, tmp_path / "more")
    save_pair(more / "extra.npz", make_pair(9))
    assert row_of(benchmark.benchmark(more, fakes("good"), tmp_path / "out"), "all", "good")["pairs"] == 8
    before = (tmp_path / "out" / records.FILE).read_bytes()
    with pytest.raises(ConfigError, match="records of these pairs; got some of extra; choose another --out"):
        benchmark.benchmark(pairs, fakes("good"), tmp_path / "out")
    assert (tmp_path / "out" / records.FILE).read_bytes() == before


def test_a_pair_without_truth_cannot_be_judged(tmp_path, fakes, in_process):
    folder = tmp_path / "bare"
    folder.mkdir()
    pair = make_pair(0)
    np.savez(folder / "a.npz", source=pair.source, target=pair.target)
    with pytest.raises(ConfigError, match="gapr evaluate"):
        benchmark.benchmark(folder, fakes("good"), tmp_path / "out")


def test_methods_can_be_added_to_a_finished_run(pairs, fakes, tmp_path, in_process):
    benchmark.benchmark(pairs, fakes("good"), tmp_path / "out")
    with pytest.raises(ConfigError):
        benchmark.benchmark(pairs, fakes("nobody"), tmp_path / "out")  # leaves nothing behind
    rows = benchmark.benchmark(pairs, fakes("shy"), tmp_path / "out")
    assert "missing" not in (tmp_path / "out" / "table.md").read_text()
    assert {row["method"] for row in rows} == {"fakes:good", "fakes:shy"}
    assert all(row["pairs"] == 7 for row in rows if row["protocol"] == "all" and row["bone"] == "all")


@pytest.mark.parametrize("text", ["0/2", "3/2", "2", "a/b", "1/0"])
def test_a_shard_is_one_of_n(text):
    with pytest.raises(ConfigError, match="shard"):
        benchmark._shard(text)


def test_the_command_line_runs_merges_and_says_where_the_report_is(pairs, fakes, tmp_path, in_process, capsys):
    parser = argparse.ArgumentParser()
    benchmark.add_arguments(parser)
    out = [str(tmp_path / name) for name in ("a", "b", "c")]
    methods = ",".join(fakes("good"))
    for k in (1, 2):
        arguments = ["--pairs", str(pairs), "--methods", methods, "--out", out[k - 1], "--shard", f"{k}/2"]
        assert benchmark.run(parser.parse_args(arguments)) == 0
    assert benchmark.run(parser.parse_args(["merge", *out[:2], "--out", out[2]])) == 0
    assert "report.html" in capsys.readouterr().out
    table = json.loads((tmp_path / "c" / "table.json").read_text())
    assert len(table["run"]["pairs"]) == 7 and table["rows"][-1]["pairs"] == 7
    assert len((tmp_path / "c" / "table.csv").read_text().splitlines()) == len(table["rows"]) + 1
    with pytest.raises(ConfigError, match="merge"):
        benchmark.run(parser.parse_args(["join", out[0], "--out", out[2]]))
    with pytest.raises(ConfigError, match="make-pairs"):
        benchmark.run(parser.parse_args(["--out", out[2]]))
    with pytest.raises(ConfigError, match="plan.json"):
        benchmark.merge([tmp_path], tmp_path / "d")


def test_a_damaged_line_in_the_middle_is_no_silent_loss(tmp_path):
    (tmp_path / records.FILE).write_text('{"a": 1}\n{"a": \n{"a": 3}\n')
    with pytest.raises(ConfigError, match="damaged"):
        records.read(tmp_path / records.FILE)


def test_of_two_records_of_one_pair_and_method_the_first_one_counts():
    """A later one was made while the first was not on disk yet; the order of the methods is that of the table."""
    first, other = (record(make_pair(k), ok(np.eye(4)), "a") for k in (0, 1))
    again, second = replace(first, seconds=9.0), replace(first, method="b")
    found = records.sort([other, first, again, second], ["b", "a"])
    assert [(r.pair, r.method, r.seconds) for r in found] == [
        (first.pair, "b", 0.5), (first.pair, "a", 0.5), (other.pair, "a", 0.5),
    ]  # fmt: skip


def test_the_seconds_of_a_record_are_without_the_first_call_and_without_preparing(
    pairs, in_process, monkeypatch, on_own_clock
):
    method = on_own_clock(runner)
    monkeypatch.setitem(known_methods.OWN, "gapr", lambda config, weights: method)
    for path in sorted(pairs.glob("L1*.npz"))[:2]:
        found = runner.run_task(runner.Task(path, "gapr"))
        assert (found.prepare_seconds, found.seconds) == (2.0, 7.0)


def test_results_of_two_commits_are_said_to_be_so(pairs, fakes, tmp_path, in_process):
    """As where one shard ran before an update and the other one after it."""
    folders = [tmp_path / name for name in ("a", "b")]
    for k, folder in enumerate(folders, 1):
        benchmark.benchmark(pairs, fakes("good"), folder, shard=(k, 2))
        found = records.read(folder / records.FILE)
        records.write(folder / records.FILE, [replace(each, commit=f"c0ffee{k}") for each in found])
    benchmark.merge(folders, tmp_path / "both")
    assert "Results of different commits: c0ffee1, c0ffee2." in (tmp_path / "both" / "table.md").read_text()
    assert "different commits" not in (folders[0] / "table.md").read_text()


def test_a_table_names_what_its_records_ran_on_whatever_asked_for_it_last(
    pairs, fakes, tmp_path, in_process, monkeypatch
):
    ran = {"commit": "c0ffee", "machine": "an old one", "threads": 4}
    monkeypatch.setattr(benchmark, "_commit", lambda: "c0ffee")
    monkeypatch.setattr(runner.origin, "machine", lambda: "an old one")
    benchmark.benchmark(pairs, fakes("good"), tmp_path / "out", threads=4)
    monkeypatch.setattr(benchmark, "_commit", lambda: "decade")
    monkeypatch.setattr(runner.origin, "machine", lambda: "a new one")
    benchmark.benchmark(pairs, fakes("good"), tmp_path / "out", threads=8)
    for folder in (tmp_path / "out", tmp_path / "merged"):
        text = (folder / "table.md").read_text()
        assert text.endswith("at commit c0ffee, 4 thread(s), an old one.\n") and "different" not in text
        run = json.loads((folder / "table.json").read_text())["run"]
        assert {name: run[name] for name in ran} == {name: str(value) for name, value in ran.items()}
        benchmark.merge([tmp_path / "out"], tmp_path / "merged")
    benchmark.benchmark(pairs, fakes("turned"), tmp_path / "out", threads=8)
    text = (tmp_path / "out" / "table.md").read_text()
    assert "at commit c0ffee and decade, 4 and 8 thread(s), a new one and an old one." in text
    assert "> Results of different machines: a new one, an old one." in text
    assert "> Results of different numbers of threads: 4, 8." in text


def test_a_method_that_is_added_changes_neither_the_order_nor_what_the_others_are_compared_with(
    pairs, fakes, tmp_path, in_process
):
    turned, good, shy = fakes("turned", "good", "shy")
    benchmark.benchmark(pairs, [turned, good], tmp_path / "out", ours=good)
    benchmark.benchmark(pairs, [shy], tmp_path / "out")
    plan = records.read_plan(tmp_path / "out")
    assert (plan.ours, plan.methods) == (good, [turned, good, shy])
    benchmark.benchmark(pairs, [shy], tmp_path / "out", ours=turned)
    assert records.read_plan(tmp_path / "out").ours == turned


def other_pair(pairs, folder):
    save_pair(pairs / "L1_femur_0001.npz", make_pair(9))


def other_code(pairs, folder):
    module = folder / "modules" / "fakes.py"
    module.write_text(module.read_text() + "# changed\n")


@pytest.mark.parametrize(("change", "said", "merged"), [
    (other_pair, "L1_femur_0001", "other clouds"),
    (other_code, "fakes:good as it is now; got some of other weights, or other code", "fakes:good as it is now"),
])  # fmt: skip
def test_records_of_other_pairs_or_code_are_refused(pairs, fakes, tmp_path, in_process, change, said, merged):
    benchmark.benchmark(pairs, fakes("good"), tmp_path / "out")
    change(pairs, tmp_path)
    with pytest.raises(ConfigError, match=said):
        benchmark.benchmark(pairs, fakes("good"), tmp_path / "out")
    benchmark.benchmark(pairs, fakes("good"), tmp_path / "new")
    with pytest.raises(ConfigError, match=merged):
        benchmark.merge([tmp_path / "out", tmp_path / "new"], tmp_path / "merged")


def test_what_a_method_is_made_of(tmp_path, fakes):
    weights = tmp_path / "weights.safetensors"
    weights.write_bytes(b"1")
    names = [f"gapr_paper@{weights}", f"predator@{weights}+point_to_plane", *fakes("good")]
    before = [known_methods.made_of(name) for name in names]
    weights.write_bytes(b"2")
    module = tmp_path / "modules" / "fakes.py"
    module.write_text(module.read_text() + "# changed\n")
    after = [known_methods.made_of(name) for name in names]
    assert all(before) and all(after) and not set(before) & set(after)
    shipped = {
        known_methods.made_of(name) for name in ("gapr", "gapr_search", "gapr_paper", "gapr_paper+point_to_plane")
    }
    assert len(shipped) == 1 and not shipped & {"", *before, *after}
    nothing = ("icp", "no_such_module:good", "no.such:good", "gapr_paper@nowhere", "sys:good")
    assert {known_methods.made_of(name) for name in nothing} == {""}


@pytest.mark.parametrize("change", [
    {"T_target_source": se3.exp([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])}, {"protocol": "L3"}, {"person": "another"},
    {"metadata": {"noise_mm": 0.2}},
    {"metadata": {"noise_mm": 0.3, "overlap": 0.15, "viewpoint": np.array([0.0, 0.0, 500.0])}},
    {"metadata": {"noise_mm": 0.3, "overlap": 0.15, "landmark_a": np.zeros(3)}},
])  # fmt: skip
def test_records_of_a_pair_whose_file_says_something_else_now_are_refused(change, pairs, fakes, tmp_path, in_process):
    benchmark.benchmark(pairs, fakes("good"), tmp_path / "out")
    path = pairs / "L1_femur_0001.npz"
    save_pair(path, load_pair(path))
    benchmark.benchmark(pairs, fakes("good"), tmp_path / "out")
    before = facts_hash(load_facts(path))
    assert before == facts_hash(load_pair(path))
    save_pair(path, replace(load_pair(path), **change))
    assert facts_hash(load_facts(path)) != before
    said = "other clouds named" if "T_target_source" in change else "whose file said something else of it"
    with pytest.raises(ConfigError, match=f"L1_femur_0001, {said}|{said} L1_femur_0001"):
        benchmark.benchmark(pairs, fakes("good"), tmp_path / "out")


def test_reading_and_writing_records_needs_no_more_memory_than_they_do(tmp_path):
    each = record(make_pair(0), ok(np.eye(4)))
    records.write(tmp_path / records.FILE, (replace(each, reason=f"{number:09d}" * 1000) for number in range(300)))
    tracemalloc.start()
    found = records.read(tmp_path / records.FILE)
    kept, most = tracemalloc.get_traced_memory()
    tracemalloc.reset_peak()
    records.write(tmp_path / records.FILE, found)
    wrote = tracemalloc.get_traced_memory()[1] - kept
    tracemalloc.stop()
    assert most < 1.3 * kept and wrote < 0.3 * kept


def test_records_of_earlier_runs_do_not_stay_in_memory(pairs, fakes, tmp_path, in_process, monkeypatch):
    benchmark.benchmark(pairs, fakes("good"), tmp_path / "a")
    read, run, known, alive = records.read, runner.run, [], []

    def noted(path):
        found = read(path)
        known.extend(map(weakref.ref, found))
        return found

    def looking(call):
        def look(*arguments):
            alive.append(sum(each() is not None for each in known))
            known.clear()
            return call(*arguments)

        return look

    monkeypatch.setattr(records, "read", noted)
    monkeypatch.setattr(runner, "run", looking(run))
    monkeypatch.setattr(benchmark, "write", looking(benchmark.write))
    benchmark.benchmark(pairs, fakes("turned"), tmp_path / "a")
    benchmark.merge([tmp_path / "a"], tmp_path / "b")
    assert alive == [0, 0, 0]


@pytest.fixture
def ours(fakes, monkeypatch):
    """A method of ours, `mine`, that notes the settings it is made with."""
    seen = []

    def make(config, weights):
        seen.append(config)
        return importlib.import_module("fakes").good()

    monkeypatch.setitem(known_methods.OWN, "mine", make)
    monkeypatch.setattr(runner, "_methods", {})
    return seen


def test_settings_reach_our_methods_alone_and_stand_in_records_and_table(pairs, fakes, ours, tmp_path, in_process):
    parser = argparse.ArgumentParser()
    benchmark.add_arguments(parser)
    (tmp_path / "settings.yaml").write_text("search: {spins: 12}\nnum_threads: 3\n")
    words = ["--pairs", pairs, "--methods", f"mine,{fakes('good')[0]}", "--out", tmp_path / "out"]
    chosen = ["--config", tmp_path / "settings.yaml", "--set", "num_threads=4"]
    assert benchmark.run(parser.parse_args([str(word) for word in [*words, *chosen]])) == 0
    assert ours == [RegistrarConfig(search=SearchConfig(spins=12), num_threads=4)]
    found = records.read(tmp_path / "out" / records.FILE)
    assert {r.settings for r in found if r.method == "mine"} == {"search.spins=12, num_threads=4"}
    assert {r.settings for r in found if r.method != "mine"} == {""}
    assert "Settings of mine: search.spins=12, num_threads=4." in (tmp_path / "out" / "table.md").read_text()


def test_records_of_other_settings_do_not_pass_for_new_ones(pairs, fakes, ours, tmp_path, in_process):
    benchmark.benchmark(pairs, ["mine"], tmp_path / "out")
    shutil.copytree(tmp_path / "out", tmp_path / "old")
    other = RegistrarConfig(num_threads=1)
    with pytest.raises(ConfigError, match=r"mine with num_threads=1; got records with the default"):
        benchmark.benchmark(pairs, ["mine"], tmp_path / "out", config=other)
    benchmark.benchmark(pairs, fakes("good"), tmp_path / "out")  # its settings are the same: none
    benchmark.benchmark(pairs, ["mine"], tmp_path / "new", config=other)
    with pytest.raises(ConfigError, match="settings"):
        benchmark.merge([tmp_path / "old", tmp_path / "new"], tmp_path / "merged")


def listed(pairs, monkeypatch):
    """Write a manifest for the folder; afterwards no pair may be hashed for the plan."""
    entries = [{"name": p.stem, "sha256": pair_hash(load_pair(p))} for p in sorted(pairs.glob("*.npz"))]
    (pairs / "manifest.json").write_text(json.dumps({"recipe": {}, "hash": "h", "pairs": entries}))
    monkeypatch.setattr(benchmark, "load_pair", None)


def test_a_folder_with_a_manifest_is_planned_without_reading_its_pairs(pairs, fakes, tmp_path, in_process, monkeypatch):
    read = benchmark.benchmark(pairs, fakes("good"), tmp_path / "read")
    listed(pairs, monkeypatch)
    assert timeless(benchmark.benchmark(pairs, fakes("good"), tmp_path / "listed")) == timeless(read)


def test_a_pair_that_is_not_what_the_manifest_lists_stops_the_run(pairs, fakes, tmp_path, in_process, monkeypatch):
    listed(pairs, monkeypatch)
    first, second = sorted(pairs.glob("*.npz"))[:2]
    first.write_bytes(second.read_bytes())
    with pytest.raises(ConfigError, match="manifest.json lists"):
        benchmark.benchmark(pairs, fakes("good"), tmp_path / "out")
