import json

import numpy as np
import pytest

from gapr_core.confidence import DEFAULT_CALIBRATION, FEATURES, Calibration
from gapr_core.data.pool import parametric_specimen
from gapr_core.data.protocols import make_pair
from gapr_core.errors import WeightsError
from gapr_core.geometry import se3
from gapr_core.results import RegistrationResult, RegistrationStatus
from gapr_core.training import calibration
from gapr_core.training.confidence_fit import as_json, fit


@pytest.fixture(scope="module")
def records():
    """A world in which a small margin is wrong, nothing else matters."""
    rng = np.random.default_rng(0)
    features = [dict(zip(FEATURES, rng.normal(size=len(FEATURES)), strict=True)) for _ in range(600)]
    return [{"name": str(i), "features": f, "right": bool(f["margin"] > 0.2), "protocol": "L1"}
            for i, f in enumerate(features)]  # fmt: skip


def test_the_model_learns_what_separates_right_from_wrong(records):
    model = fit(records[:400], members=4)
    right = [model.probability(r["features"]) > 0.5 for r in records[400:]]
    assert np.mean(np.array(right) == [r["right"] for r in records[400:]]) > 0.85


def test_a_written_model_reads_back_the_same(records, tmp_path):
    model = fit(records, members=2, epochs=5)
    path = tmp_path / "confidence.json"
    path.write_text(as_json(model, {"people": "none"}))
    again = Calibration.load(path)
    assert again.probability(records[0]["features"]) == pytest.approx(
        model.probability(records[0]["features"]), abs=1e-3
    )
    assert again.card["pairs"] == 600


def test_what_is_true_of_half_the_records_is_believed_less_where_the_other_half_are_wrong_bones():
    same = dict.fromkeys(FEATURES, 0.5)
    other = dict.fromkeys(FEATURES, -0.5)
    confidence = {}
    for protocol in ("L1", "wrong_sweep"):
        records = [{"features": f, "right": right, "protocol": "L1" if right else protocol}
                   for f in (same, other) for right in (True, False) for _ in range(150)]  # fmt: skip
        confidence[protocol] = fit(records, members=2, epochs=20).probability(same)
    assert confidence["L1"] == pytest.approx(1 / 3, abs=0.1)  # a wrong pose counts twice
    assert confidence["wrong_sweep"] == pytest.approx(1 / 9, abs=0.05)  # a wrong bone eight times


def test_a_model_runs_in_numpy_as_it_was_trained_in_torch(records):
    torch = pytest.importorskip("torch")
    model = fit(records[:100], members=3, epochs=2)
    x = np.array([[record["features"][name] for name in FEATURES] for record in records])
    z = torch.from_numpy(model.standardised(x))
    logits = []
    for member in range(3):
        parts: list = []
        for weights, biases in model.layers:
            linear = torch.nn.Linear(*weights.shape[1:], dtype=torch.float64)
            linear.load_state_dict(
                {"weight": torch.from_numpy(weights[member].T), "bias": torch.from_numpy(biases[member])}
            )
            parts += [linear, torch.nn.SiLU()]
        logits.append(torch.nn.Sequential(*parts[:-1])(z)[:, 0].detach().numpy())
    assert np.allclose(model.logits(x), np.mean(logits, axis=0), atol=1e-9)


def test_an_undecided_model_gives_even_odds():
    assert Calibration.undecided().probability(dict.fromkeys(FEATURES, 3.0)) == 0.5


def test_a_missing_model_and_one_of_other_features_are_errors(tmp_path):
    with pytest.raises(WeightsError, match="reinstall"):
        Calibration.load(tmp_path / "none.json")
    data = json.loads(DEFAULT_CALIBRATION.read_text()) | {"names": ["something"]}
    (tmp_path / "other.json").write_text(json.dumps(data))
    with pytest.raises(WeightsError, match="calibrate again"):
        Calibration.load(tmp_path / "other.json")


def test_figures_far_outside_the_training_range_do_not_run_away():
    model = Calibration.load()
    usual = dict(zip(FEATURES, model.means, strict=True))
    for name in FEATURES:
        far, farther = (model.probability(usual | {name: usual[name] + k * 1e3}) for k in (1.0, 1e6))
        assert far == farther


def test_a_solid_of_revolution_has_no_right_pose():
    pair = calibration.turned_pair(5)
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


def test_finished_records_become_the_three_models_without_registering_anything_again(records, tmp_path):
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
            file.write(json.dumps({"name": name, "protocol": name.split("-")[0]} | rounds) + "\n")
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
    assert calibration.main([*command, "--records", str(path), "--out", str(tmp_path)]) == 0
    for proposer, shipped in calibration.MODELS.items():
        model = Calibration.load(tmp_path / shipped.name)
        assert model.card["hypotheses"] == proposer
        assert model.card["pairs"] == (8 if proposer == "search" else 7)
