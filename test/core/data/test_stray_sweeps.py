import numpy as np
from shapes import ball_specimen, knob_specimen

from gapr_core.data.pool import parametric_specimen
from gapr_core.data.protocols import make_pair
from gapr_core.geometry import se3
from gapr_core.training import calibration_pairs


def test_a_stray_sweep_is_of_another_bone_or_person():
    own, other_bone, other_person = ball_specimen(person="p0"), knob_specimen(person="p0"), ball_specimen(person="p1")
    pairs = [calibration_pairs.wrong_sweep_pair(own, [own, other_bone, other_person], seed) for seed in range(6)]
    own_sweeps = [make_pair("sweep", own, seed) for seed in range(6)]
    assert not any(pair.has_truth for pair in pairs)
    assert all(np.array_equal(a.target, b.target) for a, b in zip(pairs, own_sweeps, strict=True))
    assert not any(np.array_equal(a.source, b.source) for a, b in zip(pairs, own_sweeps, strict=True))


def test_a_patch_is_small_and_with_others_it_is_one_of_theirs():
    own = parametric_specimen("femur", 0)
    others = [parametric_specimen("femur", 1), parametric_specimen("tibia", 0)]
    patch, wrong = calibration_pairs.patch_pair(own, [], 3), calibration_pairs.patch_pair(own, others, 3)
    assert patch.has_truth and not wrong.has_truth
    assert patch.metadata["overlap"] <= 0.12 and len(patch.source) <= 1500
    gaps = own.distance(se3.apply(patch.T_target_source, patch.source) + patch.metadata["origin_mm"])
    assert np.median(gaps) < 2.0
    assert not np.array_equal(patch.source[:20], wrong.source[:20])


def test_somebody_elses_bone_is_of_the_same_kind_and_seen_as_at_l2_or_l3():
    own, stranger = (parametric_specimen("femur", number) for number in (0, 1))
    others = [own, stranger, parametric_specimen("tibia", 0)]
    pairs = [calibration_pairs.wrong_person_pair(own, others, seed) for seed in range(6)]
    assert {pair.metadata["source_person"] for pair in pairs} == {stranger.person}
    assert {pair.metadata["degraded_as"] for pair in pairs} == {"L2", "L3"}
    assert not any(pair.has_truth for pair in pairs) and {pair.protocol for pair in pairs} == {"wrong_person"}
