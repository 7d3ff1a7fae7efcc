"""Methods of others behind the interface of `Registrar`; each library is imported when the method is used."""

from __future__ import annotations

from collections.abc import Callable

from gapr_core.baselines.base import Baseline, BaselineTarget, RegistrationMethod
from gapr_core.baselines.cpd import Cpd
from gapr_core.baselines.fpfh import Fgr, FpfhRansac
from gapr_core.baselines.icp import Icp
from gapr_core.baselines.kiss_matcher import KissMatcher, kiss4
from gapr_core.baselines.refined import Refined
from gapr_core.baselines.small_gicp import Gicp, PointToPlane
from gapr_core.errors import ConfigError

REGISTRY: dict[str, Callable[[], RegistrationMethod]] = {
    "icp": Icp,
    "gicp": Gicp,
    "point_to_plane": PointToPlane,
    "cpd": Cpd,
    "fpfh_ransac": FpfhRansac,
    "fpfh_ransac+point_to_plane": lambda: Refined(FpfhRansac(), PointToPlane()),
    "fgr": Fgr,
    "fgr+point_to_plane": lambda: Refined(Fgr(), PointToPlane()),
    "kiss_matcher": KissMatcher,
    "kiss_matcher+point_to_plane": lambda: Refined(KissMatcher(), PointToPlane()),
    "kiss4": kiss4,
}


def make(name: str) -> RegistrationMethod:
    """Make a new instance of a registered method.

    Raises:
        ConfigError: for a name that is not in `REGISTRY`.
    """
    if name not in REGISTRY:
        raise ConfigError(f"one of {', '.join(sorted(REGISTRY))}", repr(name), "name one of them")
    return REGISTRY[name]()


__all__ = ["REGISTRY", "Baseline", "BaselineTarget", "PointToPlane", "RegistrationMethod", "Refined", "make"]
