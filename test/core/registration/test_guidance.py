"""Where to look next: the information of a look, what it excludes, and what it is worth."""

from dataclasses import replace

import numpy as np
import pytest

from gapr_core import Registrar, RegistrarConfig
from gapr_core.config import SensorConfig
from gapr_core.geometry import se3, twists
from gapr_core.registration import guidance
from gapr_core.registration.confidence.classifier import Judgement
from gapr_core.registration.guidance import guide, information
from gapr_core.registration.problem import target as targets
from gapr_core.registration.problem.sensor import offset_surface
from gapr_core.results import Hypothesis

DOUBTFUL = Judgement(float(np.log(0.4 / 0.6)), 3.0)


@pytest.fixture(autouse=True, scope="module")
def few_patches():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(guidance, "PATCHES", 120)
        yield


def test_the_information_of_a_look_is_that_of_its_noise_and_of_the_bias_that_its_points_share():
    rng = np.random.default_rng(0)
    J, noise_mm, bias_mm = rng.normal(size=(40, 6)), 1.5, 0.7
    R = noise_mm**2 * np.eye(40) + bias_mm**2
    assert np.allclose(information(J, 40, noise_mm, bias_mm), J.T @ np.linalg.solve(R, J))


def test_more_points_than_places_count_as_more_points():
    rng = np.random.default_rng(1)
    J = rng.normal(size=(20, 6))
    R = 1.5**2 * np.eye(60) + 0.7**2
    tripled = np.vstack([J, J, J])
    assert np.allclose(information(J, 60, 1.5, 0.7), tripled.T @ np.linalg.solve(R, tripled))


@pytest.fixture(scope="module")
def distal(femur, registrar, target):
    """A third of the femur from one end: its far end is known badly."""
    rng = np.random.default_rng(2)
    points, normals = femur.sample(16_000, rng)
    seen = (normals[:, 1] < -0.2) & (points[:, 2] < np.quantile(points[:, 2], 0.3))
    source = points[seen][:1500] + rng.normal(0.0, 0.8, (min(1500, int(seen.sum())), 3))
    return registrar.assess(source, target)


def test_the_far_end_of_the_bone_is_where_a_look_helps_most(distal):
    found = guide(distal)
    best, seen = found.patches[0], distal.fit.moved
    assert best.centre[2] > seen[:, 2].max() + 30.0
    assert best.tre95_mm < 0.8 * distal.tre95_mm
    gains = [patch.gain_mm for patch in found.patches]
    assert gains == sorted(gains, reverse=True)
    assert found.gain_mm.shape == (len(found.points),) and found.gain_mm.min() >= 0.0
    assert str(found).startswith("look at (")


def test_what_was_seen_is_not_looked_at_again(distal):
    found = guide(distal)
    tree = guidance.cKDTree(distal.fit.moved)
    for patch in found.patches:
        members = distal.target.tree.query_ball_point(patch.centre, 5.0)
        assert np.median(tree.query(distal.target.points[members])[0]) > 3.0
    everything = replace(
        distal, fit=replace(distal.fit, moved=distal.target.points, weights=np.ones(len(distal.target.points)))
    )
    assert guide(everything) is None


def test_the_expected_bound_is_that_of_the_updated_covariance(distal):
    found = guide(distal)
    target, centre = distal.target, distal.centre_mm
    patch = found.patches[0]
    members = np.array(target.tree.query_ball_point(patch.centre, guidance.PATCH_MM / 2.0))
    members = members[target.normals[members] @ patch.normal > 0.3]
    normals = target.normals[members]
    J = np.hstack([normals, np.cross(target.points[members] - centre, normals)])
    noise_mm, bias_mm = max(distal.fit.sigma_mm, guidance.NOISE_MM), max(distal.uncertainty.bias_mm, guidance.BIAS_MM)
    after = np.linalg.inv(distal.uncertainty.covariance)
    after = np.linalg.inv(after + information(J, guidance.LOOK_POINTS, noise_mm, bias_mm))
    bound_mm = twists.bound_mm(after, target.points[target.anchors], centre)
    over_all = distal.tre95_mm / distal.bound_mm(target.points[target.anchors])
    assert patch.tre95_mm == pytest.approx(over_all * distal.factor95 * bound_mm)


def test_a_rival_sends_the_probe_to_where_it_differs(distal):
    """A rival turned about the shaft leaves the shaft where it is and moves the head."""
    found = guide(rivalled(distal, 1.5))
    assert found.now_mm > 2.0 * distal.tre95_mm
    assert found.patches[0].rivals_excluded > 0.95
    assert min(patch.rivals_excluded for patch in found.patches) < 0.7


def test_a_rival_that_slides_a_patch_along_the_bone_is_not_excluded_there():
    """However far it goes: what lies on the surface under both poses says nothing of either."""
    around = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
    angle, height = map(np.ravel, np.meshgrid(around, np.arange(-60.0, 60.1, 2.0)))
    radial = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
    tube = targets.prepare(20.0 * radial + np.outer(height, [0.0, 0.0, 1.0]))
    poses = [np.eye(4), se3.from_rotation_translation(np.eye(3), [0.0, 0.0, 7.0])]
    poses += [se3.from_rotation_translation(np.eye(3), [0.0, 3.0, 0.0])]
    hypotheses = tuple(Hypothesis(pose, 0.3) for pose in poses)
    members = np.flatnonzero(np.linalg.norm(tube.points - [0.0, 20.0, 0.0], axis=1) < 15.0)
    slid, lifted = guidance._excluded(tube.points[members], hypotheses[1:], tube, 0.8**2 + 0.7**2)
    assert slid < 0.05 and lifted > 0.9


def test_a_stand_off_excludes_no_rival_that_fits_as_well(distal):
    """The patch is where the sensor sees the bone: from its bare surface every rival was one stand-off away."""
    off = offset_surface(distal.target, SensorConfig(kind="pointer", standoff_mm=3.0))
    same = Hypothesis(distal.fit.T, 0.3)
    for target in (distal.target, off):
        there = replace(distal, target=target)
        members = [np.flatnonzero(np.linalg.norm(target.points - target.points[k], axis=1) < 15.0) for k in (0, 500)]
        patches = dict(zip((0, 500), members, strict=True))
        excluded = guidance._of_rivals(there, [same], patches, 0.8, 0.7)[2]
        assert excluded.max() < 0.02


def test_a_look_that_says_nothing_gains_nothing(distal, monkeypatch):
    """What is known now is the bound over the same points as what would be known then."""
    monkeypatch.setattr(guidance, "NOISE_MM", 100.0)
    monkeypatch.setattr(guidance, "LOOK_POINTS", 1)
    found = guide(distal)
    gains = np.array([patch.gain_mm for patch in found.patches])
    assert np.all(gains >= 0.0) and gains.max() < 1e-3 * found.now_mm


def test_what_is_handed_out_is_nobody_else_s(distal):
    points = distal.target.points.copy()
    found = guide(distal)
    found.points[:] /= 1000.0
    found.patches[0].centre[:] = found.patches[0].normal[:] = 0.0
    np.testing.assert_array_equal(distal.target.points, points)


def rivalled(distal, turn_rad):
    turn = se3.exp([0.0, 0.0, 0.0, 0.0, 0.0, turn_rad], distal.fit.moved.mean(axis=0))
    poses = np.stack([distal.candidates.poses[0], turn @ distal.fit.T])
    scores = np.repeat(distal.candidates.scores[0], 2)
    return replace(
        distal,
        candidates=replace(distal.candidates, poses=poses, scores=scores),
        judgement=DOUBTFUL,
        other_bone_prior=0.0,
    )


def test_the_bias_that_was_found_makes_a_look_exclude_less(distal):
    """1 - exp(-d^2 / 2 (s^2 + b^2)), b the larger one of what was found and what is assumed."""
    rival, shares = rivalled(distal, 0.1), {}
    for bias_mm in (0.1, guidance.BIAS_MM, 3.0):
        uncertain = replace(rival, uncertainty=replace(rival.uncertainty, bias_mm=bias_mm))
        found = guide(uncertain)
        shares[bias_mm] = {tuple(patch.centre): patch.rivals_excluded for patch in found.patches}
    assert shares[0.1] == shares[guidance.BIAS_MM]
    variances = (max(distal.fit.sigma_mm, guidance.NOISE_MM) ** 2 + bias_mm**2 for bias_mm in (guidance.BIAS_MM, 3.0))
    ratio = next(variances) / next(variances)
    for centre, share in shares[3.0].items():
        assert share == pytest.approx(1.0 - (1.0 - shares[guidance.BIAS_MM][centre]) ** ratio, abs=1e-9)


def test_what_the_rivals_leave_open_counts_by_their_probability(distal):
    """now^2 = bound^2 + sum of p d^2; after a look the same with what it leaves of each."""
    rival = rivalled(distal, 1.5)
    found, target = guide(rival), distal.target
    best, other = rival.hypotheses
    motion = best.T_target_source @ se3.inverse(other.T_target_source)
    apart_mm2 = se3.rms_apart_mm(np.eye(4), motion, target.points[target.anchors]) ** 2
    assert 0.0 < other.probability < 0.9
    assert found.now_mm == pytest.approx(np.sqrt(rival.tre95_mm**2 + other.probability * apart_mm2))
    for patch in found.patches[:5]:
        left = other.probability * apart_mm2 * (1.0 - patch.rivals_excluded)
        assert found.now_mm - patch.gain_mm == pytest.approx(np.sqrt(patch.tre95_mm**2 + left))


def test_what_points_that_are_not_fitted_show_is_seen_too(distal):
    everywhere = replace(distal.fit, moved=distal.target.points, weights=np.ones(len(distal.target.points)))
    assert guide(distal) is not None
    assert guide(replace(distal, fit=replace(distal.fit, whole=everywhere))) is None


def test_a_sensor_that_stands_off_has_seen_the_bone_under_it(distal):
    """Everything was seen, 8 mm outside: with the stand-off there is nothing left to look at."""
    target, far_mm = distal.target, 8.0
    assert far_mm > guidance.SEEN_MM
    outside = target.points + far_mm * target.normals
    lifted = replace(distal, fit=replace(distal.fit, moved=outside, weights=np.ones(len(outside))))
    assert guide(lifted) is not None
    sensor = SensorConfig(standoff_mm=far_mm)
    assert guide(replace(lifted, target=offset_surface(target, sensor))) is None


def test_only_the_likeliest_rivals_count(distal, monkeypatch):
    """A ball has thousands of rivals; the second one here is the likelier, so that alone it decides."""
    turns = [se3.exp([0.0, 0.0, 0.0, 0.0, 0.0, angle], distal.fit.moved.mean(axis=0)) for angle in (0.2, 1.5)]
    poses = np.stack([distal.fit.T, *(turn @ distal.fit.T for turn in turns)])
    scores = distal.candidates.scores[0] * np.array([1.0, 1.3, 1.01])
    many = replace(
        distal,
        candidates=replace(distal.candidates, poses=poses, scores=scores),
        judgement=DOUBTFUL,
        other_bone_prior=0.0,
    )
    first, second = (rival.probability for rival in many.hypotheses[1:])
    assert 0.0 < first < second
    alone = replace(many, candidates=replace(many.candidates, poses=poses[[0, 2]], scores=scores[[0, 2]]))
    of_one, guided = guide(alone).patches[0].rivals_excluded, []
    for count in (2, 1, 0):
        monkeypatch.setattr(guidance, "MOST_RIVALS", count)
        guided.append(guide(many))
    found, one, none = guided
    assert one.patches[0].rivals_excluded == of_one
    assert found.now_mm > one.now_mm > none.now_mm == pytest.approx(many.tre95_mm)


def test_the_registrar_says_where_to_look_only_when_asked(target, distal):
    for asked in (False, True):
        registrar = Registrar(RegistrarConfig(num_threads=1, guide=asked))
        result = registrar.register(distal.source.points, target)
        assert (result.guidance is not None) is asked
