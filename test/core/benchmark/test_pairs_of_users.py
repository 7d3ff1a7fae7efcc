"""Pairs and methods that users bring: what cannot be is refused before the first registration, or is a failure."""

import sys

import numpy as np
import proposals
import pytest
import uncertainty
import viewpoint
from benchmark_cases import make_pair

from gapr_core import cli
from gapr_core.benchmark import records, runner
from gapr_core.commands import benchmark
from gapr_core.data.pair_files import load_facts, load_pair
from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_core.geometry import se3

PAIR = make_pair(0)
TRUE = PAIR.T_target_source
REFLECTED = TRUE @ np.diag([1.0, 1.0, -1.0, 1.0])
GAPPY = np.where(np.eye(4), np.nan, TRUE)
WRONG = [
    ({"transform": TRUE.T}, "a rigid transform (4, 4); got one whose last row is"),
    ({"transform": TRUE @ np.diag([1.1, 1.1, 1.1, 1.0])}, "determinant 1.33"),
    ({"transform": REFLECTED}, "determinant -1"),
    ({"transform": GAPPY}, "a finite transform"),
    ({"transform": TRUE[:3]}, "transform as (4, 4) numbers"),
    ({"landmark_hip": np.zeros(2)}, "landmark_hip as (3,) numbers"),
    ({"landmark_hip": np.array([1.0, np.nan, 2.0])}, "a finite landmark_hip"),
    ({"noise_mm": "x"}, "noise_mm as a number"),
    ({"overlap": np.zeros(2)}, "overlap as a number"),
    ({"cohort": 3}, "cohort as a text"),
    ({"viewpoint": np.zeros(4)}, "viewpoint as (3,) numbers"),
    ({"source": PAIR.source[:, :2]}, "source"),
    ({"target": np.array(["a"])}, "target"),
    ({"source": np.zeros((0, 3))}, "points in source; got none"),
    ({"target": np.zeros((0, 3))}, "points in target; got none"),
]


def written(path, **changes):
    np.savez(path, **{"source": PAIR.source, "target": PAIR.target, "transform": TRUE, **changes})
    return path


@pytest.mark.parametrize(("changes", "said"), WRONG)
def test_a_pair_that_cannot_be_is_refused_with_its_file(tmp_path, changes, said):
    path = written(tmp_path / "odd.npz", **changes)
    for load in (load_pair, load_facts):
        with pytest.raises(InvalidPointCloudError) as raised:
            load(path)
        assert said in str(raised.value) and "odd.npz" in str(raised.value)


def test_a_file_that_is_no_archive_is_said_to_be_none_and_nothing_is_said_of_trust(tmp_path):
    (tmp_path / "odd.npz").write_bytes(b"hello")
    for load in (load_pair, load_facts):
        with pytest.raises(InvalidPointCloudError, match=r"odd.npz \(cut, or no .npz file\)"):
            load(tmp_path / "odd.npz")


def test_points_that_are_not_finite_are_refused_before_they_are_judged(tmp_path):
    source = PAIR.source.copy()
    source[3] = np.nan
    with pytest.raises(InvalidPointCloudError, match=r"finite points in source.*odd.npz"):
        load_pair(written(tmp_path / "odd.npz", source=source))


def test_a_transform_with_few_digits_and_one_without_truth_are_taken(tmp_path):
    assert load_pair(written(tmp_path / "a.npz", transform=TRUE.round(3))).has_truth
    assert not load_pair(written(tmp_path / "b.npz", transform=np.full((4, 4), np.nan))).has_truth
    facts = load_facts(written(tmp_path / "c.npz", landmark_hip=[1, 2, 3], noise_mm=np.float32(0.5), overlap=np.nan))
    assert facts.metadata["noise_mm"] == 0.5 and len(facts.source) == 0


@pytest.mark.parametrize(
    ("transform", "said"),
    [
        (np.linalg.inv(TRUE), "its inverse 0 mm"),
        (np.block([[TRUE[:3, :3], TRUE[:3, 3:] / 1000.0], [TRUE[3:]]]), "in m, and not in mm, it would be 0 mm"),
        (TRUE, ""),
        (se3.random_rotation(np.random.default_rng(9)), ""),
    ],
    ids=["inverse", "metres", "true", "another"],
)
def test_a_truth_that_is_written_in_another_way_is_warned_of(
    pairs, fakes, tmp_path, in_process, caplog, transform, said
):
    for old in pairs.glob("*"):
        old.unlink()
    matrix = np.eye(4)
    matrix[: len(transform), : len(transform)] = transform
    written(pairs / "mine.npz", transform=matrix)
    benchmark.benchmark(pairs, fakes("good"), tmp_path / "out")
    warned = [record.getMessage() for record in caplog.records if "may not be the truth" in record.getMessage()]
    assert len(warned) == bool(said) and all(said in line and "mine.npz" in line for line in warned), warned


def test_nothing_is_registered_when_a_later_pair_cannot_be_judged(pairs, fakes, tmp_path, in_process, monkeypatch):
    monkeypatch.setattr(runner, "run_task", lambda task: pytest.fail("a pair was registered"))
    for name, changes, error in (("y", {"transform": TRUE.T}, InvalidPointCloudError), ("z", {}, ConfigError)):
        path = written(pairs / f"{name}.npz", **changes)
        if error is ConfigError:
            np.savez(path, source=PAIR.source, target=PAIR.target)
        with pytest.raises(error, match=rf"\b{name}\b"):
            benchmark.benchmark(pairs, fakes("good"), tmp_path / "out")
        assert not (tmp_path / "out").exists()
        path.unlink()


def test_a_run_over_a_wrong_pair_ends_in_one_line(pairs, fakes, tmp_path, capsys):
    written(pairs / "z.npz", noise_mm="x")
    words = ["--pairs", str(pairs), "--methods", fakes("good")[0], "--out", str(tmp_path / "out")]
    assert cli.main(["benchmark", *words]) == 1
    said = capsys.readouterr().err
    assert "z.npz" in said and "Traceback" not in said


ODD = {"unsure": "confidence is nan", "percent": "confidence is 97.0, not from 0 to 1",
       "boundless": "confidence is inf", "wordy": "high, no finite number",
       "astray": "T_target_source is no array", "reflecting": "T_target_source is not rigid",
       "vague": "covariance is no array", "dumb": "NoneType, no RegistrationResult"}  # fmt: skip


@pytest.mark.parametrize("name", ODD)
def test_an_answer_that_cannot_be_written_is_a_failure_of_the_method(pairs, fakes, tmp_path, in_process, name):
    benchmark.benchmark(pairs, fakes(name, "good"), tmp_path / "out")
    found = records.read(tmp_path / "out" / records.FILE)
    odd = [record for record in found if record.method != "fakes:good"]
    assert len(odd) == 7 and len(found) == 14
    assert all(record.status == "ERROR" and ODD[name] in record.reason for record in odd)
    benchmark.benchmark(pairs, fakes("good"), tmp_path / "out")  # the records can be read again


def test_a_folder_without_pairs_is_no_empty_table(tmp_path, monkeypatch):
    nowhere = tmp_path / "nowhere"
    monkeypatch.setattr(sys, "argv", ["viewpoint.py", "--pairs", str(nowhere)])
    with pytest.raises(ConfigError, match="nowhere; check the path"):
        viewpoint.main()
    with pytest.raises(ConfigError, match="nowhere; check the path"):
        proposals.chosen(nowhere, None)


def test_a_family_of_which_no_source_can_be_used_has_a_row_without_medians():
    assert uncertainty.line("sweep", [None, None]) == "| sweep | 2 | 0.0 | - | - | - |"
    found = [(5.348, 1.0, 2.0, True), None, (10.696, 3.0, 4.0, False), (16.044, 5.0, 9.0, True)]
    assert uncertainty.line("sweep", found) == "| sweep | 4 | 50.0 | 2.00 | 3.00 | 4.00 |"
