"""What of a bone's model becomes a target: its outer shell, and elements that hold at a thin blade."""

import numpy as np
import pytest

from gapr_core.geometry.sampling import fibonacci_directions
from gapr_core.registration.problem import target as targets


@pytest.mark.parametrize(("outer", "inner", "is_shell"), [(4000, 2500, True), (2500, 4000, False)])
def test_a_shell_of_less_than_half_of_the_points_is_not_believed(outer, inner, is_shell):
    balls = [radius_mm * fibonacci_directions(count) for radius_mm, count in ((40.0, outer), (32.0, inner))]
    shell = targets.prepare(np.vstack(balls)).both_cortices
    assert len(shell.points) == (outer if is_shell else outer + inner)


def test_the_curvature_of_a_thin_blade_is_that_of_its_own_side():
    """x^T A x = 1, 6 mm thick: fitted once, with neighbours on the other side too, it errs by .05 / mm."""
    axes_mm = np.array([40.0, 25.0, 3.0])
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(60_000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    area = np.linalg.norm(ball / axes_mm, axis=1)
    found = targets.prepare(axes_mm * ball[rng.random(len(ball)) < area / area.max()])
    A = np.diag(axes_mm**-2.0)
    gradient = found.points @ A
    length = np.linalg.norm(gradient, axis=1)
    normals = gradient / length[:, None]
    curvature = -(np.trace(A) - np.einsum("ni,ij,nj->n", normals, A, normals)) / length
    off = np.abs(found.elements[:, [6, 9, 11]].sum(axis=1) - curvature)
    assert np.median(off) < 1e-3 and off.mean() < 0.035
