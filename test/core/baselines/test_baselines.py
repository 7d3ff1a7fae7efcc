"""Every baseline answers in our order and units, and refuses where its library fails in silence."""

import sys
import types

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gapr_core import baselines
from gapr_core.baselines import base
from gapr_core.baselines.cpd import Cpd
from gapr_core.baselines.fpfh import FpfhRansac
from gapr_core.baselines.icp import Icp
from gapr_core.baselines.kiss_matcher import KissMatcher
from gapr_core.baselines.refined import Refined
from gapr_core.baselines.small_gicp import PointToPlane
from gapr_core.errors import ConfigError, InvalidPointCloudError, MethodUnavailableError
from gapr_core.geometry import se3
from gapr_core.results import RegistrationStatus
from gapr_core.surface import Surface

LOCAL = ["icp", "gicp", "point_to_plane", "cpd"]
GLOBAL = [name for name in baselines.REGISTRY if name.startswith(("fpfh_ransac", "fgr", "kiss"))]
LIBRARY = {
    "icp": "open3d", "gicp": "small_gicp", "point_to_plane": "small_gicp", "cpd": "pycpd", "fpfh_ransac": "open3d",
    "fgr": "open3d", "kiss_matcher": "kiss_matcher", "kiss4": "kiss_matcher",
}  # fmt: skip
PACKAGE = {"kiss_matcher": "kiss-matcher"}


def needs(name):
    for part in name.split("+"):
        pytest.importorskip(
            LIBRARY.get(part, "numpy"), reason=f"{part} is an optional method: pip install '.[baselines]'"
        )


def knobbly(rng, count):
    """Points on a closed surface about 150 mm long without symmetry, with bumps like condyles."""
    unit = rng.normal(size=(count, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    bumps = np.array([[1, 0.2, 0.1], [-0.6, 0.8, 0.3], [-0.3, -0.7, 0.8], [0.1, 0.5, -1], [-0.9, -0.5, -0.4]])
    bumps /= np.linalg.norm(bumps, axis=1, keepdims=True)
    heights = np.array([30.0, 18.0, -14.0, 22.0, 12.0])
    radius = 50.0 + np.exp((unit @ bumps.T - 1.0) * 12.0) @ heights + 6.0 * np.sin(4.0 * unit[:, 0] + 2.0 * unit[:, 1])
    return unit * radius[:, None] * [1.4, 0.9, 0.7]


@pytest.fixture(scope="module")
def bone():
    return knobbly(np.random.default_rng(0), 6000) + [300.0, -200.0, 900.0]  # far from the origin, as scans are


def a_pair(bone, angle_deg, seed=1):
    """A source of 60 % sampled again, 0.3 mm noise, turned about its centroid and 400 mm away."""
    rng = np.random.default_rng(seed)
    fresh = knobbly(rng, 5000) + bone.mean(axis=0) - knobbly(np.random.default_rng(0), 6000).mean(axis=0)
    kept = fresh[np.argsort(np.linalg.norm(fresh - fresh[0], axis=1))[:3000]]
    rotation = Rotation.from_rotvec(np.radians(angle_deg) * np.array([0.6, 0.0, 0.8])).as_matrix()
    centre = kept.mean(axis=0)
    T_source_target = se3.from_rotation_translation(rotation, [400.0, 50.0, -70.0] + centre - rotation @ centre)
    return se3.apply(T_source_target, kept + rng.normal(0, 0.3, kept.shape)), se3.inverse(T_source_target)


@pytest.mark.parametrize("name", GLOBAL)
def test_a_global_method_finds_a_pose_from_any_rotation(name, bone):
    needs(name)
    method = baselines.make(name)
    source, T_true = a_pair(bone, 140.0)
    result = method.register(source, method.prepare(bone))
    rte, rre = se3.pose_error(result.T_target_source, T_true, source)
    assert result.method == name and result.seconds > 0.0
    coarse_only = name in ("fpfh_ransac", "fgr", "kiss_matcher")
    assert rte < (10.0 if coarse_only else 1.0) and rre < (10.0 if coarse_only else 1.0)


@pytest.mark.parametrize("name", [n for n in LOCAL if n != "cpd"])  # CPD drifts on partial sources
def test_a_local_method_improves_a_near_seed(name, bone):
    needs(name)
    method = baselines.make(name)
    source, T_true = a_pair(bone, 50.0)
    seed = se3.exp([3.0, -2.0, 2.0, 0.05, -0.03, 0.06], bone.mean(axis=0)) @ T_true
    result = method.register(source, method.prepare(bone), initial=seed)
    before, after = (se3.pose_error(T, T_true, source) for T in (seed, result.T_target_source))
    assert after[0] < 0.5 * before[0] and after[1] < 0.7 * before[1]


def test_without_a_seed_icp_starts_from_centroid_on_centroid(bone):
    needs("icp")
    source = bone[:4000] + [500.0, 600.0, 700.0]
    result = Icp().register(source, Icp().prepare(bone))
    assert se3.pose_error(result.T_target_source, base.translation([-500.0, -600.0, -700.0]), source)[0] < 1.0


@pytest.mark.parametrize("name", ["fpfh_ransac+point_to_plane", "point_to_plane", "icp"])
def test_the_same_call_twice_gives_the_same_pose(name, bone):
    needs(name)
    source, _ = a_pair(bone, 100.0)
    first, second = (baselines.make(name).register(source, bone) for _ in range(2))
    assert np.array_equal(first.T_target_source, second.T_target_source)


def test_kiss4_twice_gives_nearly_the_same_pose(bone):
    """Not to the last bit: on several cores KISS-Matcher sums in another order every time (its issue 89)."""
    needs("kiss4")
    source, _ = a_pair(bone, 100.0)
    first, second = (baselines.make("kiss4").register(source, bone).T_target_source for _ in range(2))
    rte, rre = se3.pose_error(first, second, source)
    assert rte < 0.5 and rre < 0.5


def test_the_refined_composition_keeps_the_pose_with_the_lowest_residual(bone):
    needs("gicp")
    source, T_true = a_pair(bone, 120.0)
    near = se3.exp([2.0, 0, 0, 0, 0.04, 0], bone.mean(axis=0)) @ T_true
    upside_down = se3.exp([0, 0, 0, np.pi, 0, 0], bone.mean(axis=0)) @ T_true
    coarse = [Fixed(upside_down), Fixed(None), Fixed(near)]
    result = Refined(coarse, PointToPlane(), name="mine").register(source, bone)
    assert result.method == "mine" and set(result.stage_ms) == {"coarse", "refine"}
    assert se3.pose_error(result.T_target_source, T_true, source)[1] < 0.5


def test_the_refined_composition_refuses_when_every_coarse_method_does(bone):
    needs("gicp")
    result = Refined([Fixed(None), Fixed(None)], PointToPlane()).register(bone[:500], bone)
    assert not result.ok and "library" in result.reason


class Fixed(base.Baseline):
    """Answers one pose of the target frame, whatever it is asked."""

    name = "fixed"
    identity_is_failure = True

    def __init__(self, T):
        self.T = T

    def _prepare(self, points, normals):
        return None

    def _align(self, source, target, seed):
        raise AssertionError

    def _pose(self, source, target, initial):
        if self.T is None:
            raise base.NoPose("the library returned nothing")
        return self.T


class Broken(Fixed):
    """Answers a matrix between the centred clouds."""

    def _align(self, source, target, seed):
        return self.T

    _pose = base.Baseline._pose


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (np.full((4, 4), np.nan), "not finite"),
        (np.eye(4), "identity"),
        (np.diag([1.2, 1.2, 1.2, 1.0]), "not a rigid motion"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "not a rigid motion"),
    ],
)
def test_a_silent_failure_of_a_library_becomes_a_refusal(answer, reason, bone):
    result = Broken(answer).register(bone[:200], bone)
    assert result.status is RegistrationStatus.LOW_CONFIDENCE and result.T_target_source is None
    assert reason in result.reason


def test_rounding_of_a_float32_library_is_taken_off(bone):
    rotation = Rotation.from_rotvec([0.3, 0.2, 0.1]).as_matrix().astype(np.float32).astype(np.float64) + 1e-6
    result = Broken(se3.from_rotation_translation(rotation, [1, 2, 3])).register(bone[:200], bone)
    R = result.T_target_source[:3, :3]
    assert np.allclose(R.T @ R, np.eye(3), atol=1e-12)


def test_kiss_matcher_refuses_a_cloud_that_has_nothing_in_common(bone):
    needs("kiss_matcher")
    line = np.c_[np.linspace(0, 300, 400), np.zeros(400), np.zeros(400)]
    result = KissMatcher().register(line, bone)
    assert not result.ok and result.reason


def test_cpd_finds_the_motion_of_the_same_points_exactly(bone):
    needs("cpd")
    T_source_target = se3.exp([10, 20, 30, 0.3, -0.2, 0.2], bone.mean(axis=0))
    source = se3.apply(T_source_target, bone[:300])
    result = Cpd(outlier_weight=0.0).register(source, bone[:300])
    rte, rre = se3.pose_error(result.T_target_source, se3.inverse(T_source_target), source)
    assert rte < 0.05 and rre < 0.05


def test_a_reflected_or_scaled_answer_never_comes_from_cpd(bone):
    needs("cpd")
    source, _ = a_pair(bone, 170.0)
    T = Cpd().register(source, bone).T_target_source
    assert np.allclose(T[:3, :3].T @ T[:3, :3], np.eye(3)) and np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize("name", LIBRARY)
def test_a_missing_library_is_an_error_with_its_install_line(name, bone, monkeypatch):
    monkeypatch.setitem(sys.modules, LIBRARY[name], None)
    if name == "kiss4":
        needs("point_to_plane")
    package = PACKAGE.get(LIBRARY[name], LIBRARY[name])
    with pytest.raises(MethodUnavailableError, match=f"pip install {package}"):
        baselines.make(name).prepare(bone)


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(ConfigError, match="kiss4"):
        baselines.make("ipc")


def test_too_few_points_are_a_status_and_a_wrong_shape_an_error(bone):
    needs("icp")
    method = baselines.make("icp")
    target = method.prepare(bone)
    cloud = np.full((50, 3), np.nan)
    cloud[:5] = bone[:5]
    assert method.register(cloud, target).status is RegistrationStatus.TOO_FEW_POINTS
    assert method.register(np.empty((0, 3)), target).status is RegistrationStatus.TOO_FEW_POINTS
    with pytest.raises(InvalidPointCloudError):
        method.register(bone[:, :2], target)


def test_the_points_of_a_target_that_another_method_prepared_are_used_once(bone):
    needs("icp")
    other = types.SimpleNamespace(points=bone, normals=np.ones_like(bone))
    counted = Counted()
    counted.register(bone[:300], other)
    counted.register(bone[300:600], other)
    assert counted.prepared == 1 and counted.seen_normals is not None


class Counted(Icp):
    prepared = 0
    seen_normals = None

    def _prepare(self, points, normals):
        self.prepared += 1
        self.seen_normals = normals
        return super()._prepare(points, normals)


def test_metres_are_converted_and_a_mesh_is_sampled(bone):
    needs("icp")
    in_metres = Icp().prepare(bone / 1000.0, units="m")
    assert np.allclose(in_metres.points, bone)
    corners = np.array([[0, 0, 0], [80, 0, 0], [0, 60, 0], [0, 0, 50]], dtype=float)
    mesh = Surface(corners, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]))
    target = Icp().prepare(mesh)
    assert len(target.points) == base.TARGET_POINTS and np.array_equal(target.points, Icp().prepare(mesh).points)


@pytest.mark.parametrize("name", baselines.REGISTRY)
def test_every_baseline_satisfies_the_protocol(name):
    assert isinstance(baselines.make(name), baselines.RegistrationMethod)
    assert baselines.make(name).name == name


def test_fpfh_normals_point_out_of_a_closed_surface(bone):
    needs("fpfh_ransac")
    cloud = FpfhRansac(4.0).prepare(bone).static.cloud
    points, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    assert np.mean((points * normals).sum(axis=1) > 0) > 0.98
