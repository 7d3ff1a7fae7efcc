import numpy as np
from shapes import ball_specimen, knob_specimen

from gapr_core.data.protocols import make_pair
from gapr_core.training import calibration


def test_a_stray_sweep_is_of_another_bone_or_person():
    own, other_bone, other_person = ball_specimen(person="p0"), knob_specimen(person="p0"), ball_specimen(person="p1")
    pairs = [calibration.wrong_sweep_pair(own, [own, other_bone, other_person], seed) for seed in range(6)]
    own_sweeps = [make_pair("sweep", own, seed) for seed in range(6)]
    assert not any(pair.has_truth for pair in pairs)
    assert all(np.array_equal(a.target, b.target) for a, b in zip(pairs, own_sweeps, strict=True))
    assert not any(np.array_equal(a.source, b.source) for a, b in zip(pairs, own_sweeps, strict=True))
