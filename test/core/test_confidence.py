import json
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import torch

from gapr_core.confidence import DEFAULT_CALIBRATION, FEATURES, Calibration
from gapr_core.data.pool import parametric_specimen
from gapr_core.data.protocols import make_pair
from gapr_core.errors import WeightsError
from gapr_core.geometry import se3
from gapr_core.results import RegistrationResult, RegistrationStatus
from gapr_core.training import calibration, calibration_pairs, confidence_fit
from gapr_core.training.confidence_fit import as_json, fit


@pytest.fixture(scope="module")
def records():
    """A world in which a small margin is wrong, nothing else matters."""
    rng = np.random.default_rng(0)
    features = [dict(zip(FEATURES, rng.normal(size=len(FEATURES)), strict=True)) for _ in range(1200)]
    return [{"name": str(i), "features": f, "right": bool(f["margin"] > 0.2), "protocol": "L1"}
            for i, f in enumerate(features)]  # fmt: skip


def test_the_model_learns_what_separates_right_from_wrong(records):
    model = fit(records[:1000], members=4)
    right = [model.probability(r["features"]) > 0.5 for r in records[1000:]]
    assert np.mean(np.array(right) == [r["right"] for r in records[1000:]]) > 0.9


def test_a_written_model_reads_back_the_same(records, tmp_path):
    model = fit(records, members=2, epochs=5)
    path = tmp_path / "confidence.json"
    path.write_text(as_json(model, {"people": "none"}))
    again = Calibration.load(path)
    assert again.probability(records[0]["features"]) == pytest.approx(
        model.probability(records[0]["features"]), abs=1e-3
    )
    assert again.card["pairs"] == 1200


def test_what_is_true_of_half_the_records_is_believed_less_where_the_other_half_are_wrong_bones():
    same = dict.fromkeys(FEATURES, 0.5)
    other = dict.fromkeys(FEATURES, -0.5)
    confidence = {}
    for protocol in ("L1", "wrong_sweep"):
        records = [{"features": f, "right": right, "protocol": "L1" if right else protocol}
                   for f in (same, other) for right in (True, False) for _ in range(150)]  # fmt: skip
        confidence[protocol] = fit(records, members=2, epochs=20).probability(same)
    assert confidence["L1"] == pytest.approx(1 / 3, abs=0.1)  # a wrong pose counts twice
    assert confidence["wrong_sweep"] == pytest.approx(1 / 6, abs=0.07)  # a wrong bone five times


def test_a_model_runs_in_numpy_as_it_is_trained_in_torch(records):
    model = fit(records[:100], members=3, epochs=2)
    x = np.array([[record["features"][name] for name in FEATURES] for record in records])
    layers = [(torch.from_numpy(weights), torch.from_numpy(biases[:, None])) for weights, biases in model.layers]
    trained = confidence_fit._logits(layers, torch.from_numpy(model.standardised(x)), drop=0.0)
    assert np.allclose(model.logits(x), trained.mean(dim=0).numpy(), atol=1e-9)


def test_a_figure_that_never_varies_says_nothing_and_breaks_nothing(records, tmp_path):
    same = [record | {"features": record["features"] | {"extent": 0.7}} for record in records[:200]]
    (tmp_path / "model.json").write_text(as_json(fit(same, members=1, epochs=2), {}))
    assert 0.0 < Calibration.load(tmp_path / "model.json").probability(same[0]["features"]) < 1.0


def test_cross_validation_asks_models_that_have_not_seen_the_person(records, monkeypatch):
    people = [record | {"person": f"p{i % 10}" if i % 3 else "none"} for i, record in enumerate(records[:60])]
    seen = []

    def fit_nothing(known):
        seen.append({record["person"] for record in known} - {"none"})
        return replace(Calibration.undecided(), layers=((np.zeros((1, len(FEATURES), 1)), np.array([[len(seen)]])),))

    monkeypatch.setattr(confidence_fit, "fit", fit_nothing)
    logits = confidence_fit.held_out(people, folds=5)
    assert len(seen) == 5 and set(logits) == {1, 2, 3, 4, 5}
    for record, model in zip(people, logits.astype(int), strict=True):
        assert record["person"] not in seen[model - 1]


def test_the_summary_counts_what_is_accepted_wrongly():
    protocols, right = ["L1", "L1", "wrong", "L1"], [True, True, False, False]
    records = [{"protocol": p, "right": r} for p, r in zip(protocols, right, strict=True)]
    line = confidence_fit.summary(records, np.array([3.0, 0.1, 4.0, 0.5]))
    assert "4 pairs, 2 right" in line and "false accepts 2 (1 at 0.9)" in line
    assert "accepted 100.0 % (50.0 % at 0.9), AUROC 0.2500" in line
    loss = np.log1p(np.exp([-3.0, -0.1, 4.0, 0.5])) @ [1.0, 1.0, 6.0, 2.0] / 10.0
    assert f"loss {loss:.4f}" in line


def test_an_undecided_model_gives_even_odds():
    assert Calibration.undecided().probability(dict.fromkeys(FEATURES, 3.0)) == 0.5


def test_a_missing_model_and_one_of_other_features_are_errors(tmp_path):
    with pytest.raises(WeightsError, match="reinstall"):
        Calibration.load(tmp_path / "none.json")
    data = json.loads(DEFAULT_CALIBRATION.read_text()) | {"names": ["something", *FEATURES[1:]]}
    (tmp_path / "other.json").write_text(json.dumps(data))
    with pytest.raises(WeightsError, match="calibrate again"):
        Calibration.load(tmp_path / "other.json")
    whole = json.dumps(data | {"names": FEATURES})
    for layers in ([], data["layers"][1:], data["layers"][:-1], [[1.0]]):
        (tmp_path / "cut.json").write_text(json.dumps(data | {"names": FEATURES, "layers": layers}))
        with pytest.raises(WeightsError, match="calibrate again"):
            Calibration.load(tmp_path / "cut.json")
    for text in (whole[:-40], "{}", "[]"):
        (tmp_path / "cut.json").write_text(text)
        with pytest.raises(WeightsError, match="cut.json"):
            Calibration.load(tmp_path / "cut.json")


def test_figures_far_outside_the_training_range_do_not_run_away():
    model = Calibration.load()
    usual = dict(zip(FEATURES, model.means, strict=True))
    for name in FEATURES:
        far, farther = (model.probability(usual | {name: usual[name] + k * 1e3}) for k in (1.0, 1e6))
        assert far == farther


def test_a_solid_of_revolution_has_no_right_pose():
    pair = calibration_pairs.turned_pair(5)
    assert not pair.has_truth
    radii = np.linalg.norm(pair.target[:, :2], axis=1)
    order = np.argsort(pair.target[:, 2])
    assert np.abs(np.diff(radii[order])).mean() < 0.2  # the radius depends on the height alone


def test_the_next_source_of_a_stream_is_a_part_of_the_view_and_the_memory_is_off_by_a_small_motion():
    rng = np.random.default_rng(3)
    pair = make_pair("L2", parametric_specimen("femur", 0), 1)
    truth, rival = pair.T_target_source, se3.exp(rng.normal(size=6) * 30.0) @ pair.T_target_source
    result = RegistrationResult(RegistrationStatus.LOW_CONFIDENCE, alternatives=(rival, rival @ rival),
                                details={"best_pose": truth})  # fmt: skip
    forgotten = 0
    for seed in range(40):
        moved, memory = calibration.moved_on(pair, result, seed)
        assert 0.45 * len(pair.source) < len(moved.source) <= len(pair.source)
        kept = {tuple(point) for point in pair.source}
        assert all(tuple(point) in kept for point in moved.source)
        forgotten += len(memory.poses) == 2
        best = truth if len(memory.poses) == 3 else rival
        shift_mm, turn_deg = se3.pose_error(memory.poses[0], best, moved.source)
        assert shift_mm <= calibration.STEP_MM + 1e-6 and turn_deg <= calibration.STEP_DEG + 1e-6
    assert 3 <= forgotten <= 18


def test_finished_records_become_the_three_models_without_registering_anything_again(records, tmp_path, capsys):
    names = [
        f"{protocol}-{bone}-{seed}"
        for seed in range(7, 9)
        for protocol in ("L1", "wrong")
        for bone in ("femur", "tibia")
    ]
    path = tmp_path / "records.jsonl"
    with path.open("w") as file:
        for name, record in zip(names, records, strict=False):
            answer = {"features": record["features"], "right": record["right"]}
            rounds = dict.fromkeys(calibration.MODELS, answer) if name != names[0] else {"search": answer}
            file.write(json.dumps({"name": name, "protocol": name.split("-")[0], "person": name[-3:]} | rounds) + "\n")
    command = [
        "--anatomy",
        str(tmp_path),
        "--seed",
        "7",
        "--count",
        "2",
        "--protocols",
        "L1,wrong",
        "--bones",
        "femur,tibia",
    ]
    assert calibration.main([*command, "--records", str(path), "--out", str(tmp_path), "--cross-validate"]) == 0
    for proposer, shipped in calibration.MODELS.items():
        model = Calibration.load(tmp_path / shipped.name)
        assert model.card["hypotheses"] == proposer
        assert model.card["pairs"] == (8 if proposer == "search" else 7)
    said = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in said] == list(calibration.MODELS)
    assert all("false accepts" in line for line in said)


def test_records_of_other_figures_are_made_again(records, tmp_path, monkeypatch):
    names = ["L1-femur-1", "L1-femur-2"]
    old = {name: value for name, value in records[0]["features"].items() if name != "short_misfit"}
    path = tmp_path / "records.jsonl"
    path.write_text("".join(json.dumps({"name": name, "search": {"features": features, "right": True}}) + "\n"
                            for name, features in zip(names, (old, records[1]["features"]), strict=True)))  # fmt: skip
    asked = []
    monkeypatch.setattr(calibration, "ProcessPoolExecutor", lambda *_, **__: nullcontext(Asked(asked)))
    tasks = [("", "train", *name.rsplit("-", 2)[:2], int(name[-1])) for name in names]
    assert [record["name"] for record in calibration.collect(tasks, path, 1)] == [names[1]]
    assert asked == tasks[:1]


class Asked:
    """A pool that registers nothing."""

    def __init__(self, asked):
        self.asked = asked

    def map(self, _, tasks):
        self.asked += tasks
        return []


def test_models_of_other_figures_do_not_keep_anyone_from_collecting_records(monkeypatch):
    monkeypatch.setattr(Calibration, "shipped", lambda _: pytest.fail("the models that ship were asked for"))
    registrars = calibration._registrars.__wrapped__()
    assert [p.name for p in registrars["search"].proposers] == ["network", "search"]
