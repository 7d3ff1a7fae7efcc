"""Point-wise Geometry-aware Features (paper, section IV-A, Fig. 3), and their cross-cloud form."""

from __future__ import annotations

import torch
from torch import Tensor

from gapr_core.model.vectors import Parts, cross, dot, minus, parts

EMBEDDED = 11  # 3 distances, sine and cosine of 4 angles
_TINY = 1e-12
_FADE = 1e-10  # of the fourth powers of the sides: an angle fades once a side is below 0.3 % of the other
_POINT = 2e-4  # squared length in radii below which three points are one, so that float32 can go back


def pgf(p_i: Tensor, p_j: Tensor, c_h: Tensor, c_k: Tensor, radius: Tensor | float) -> Tensor:
    """Compute seven features l_ij = (d_ij, d_jh, d_jk, b_ijk, b_ijh, b_hjk, theta_h-ik-j).

    Args:
        p_i, p_j, c_h, c_k: (..., 3), broadcast against each other: the centre, its neighbour, and the centroids of the
            larger and of the smaller ball around the centre.
        radius: radius of the larger ball, broadcast to (..., 1); divides the distances.

    Returns:
        (..., 7): three distances in radii, three angles in [0, pi] rad, one signed dihedral angle in (-pi, pi] rad,
        positive when a right-hand turn about p_i -> c_k takes c_h to p_j. Angles that are not defined (a side of length
        zero, three points in a line) are 0.
    """
    e = embed(p_i, p_j, c_h, c_k, radius)
    sine, cosine = e[..., 3::2], e[..., 4::2]
    defined = torch.hypot(sine, cosine) > 0.1
    return torch.cat([e[..., :3], torch.where(defined, torch.atan2(sine, cosine), 0.0)], dim=-1)


def embed(p_i: Tensor, p_j: Tensor, c_h: Tensor, c_k: Tensor, radius: Tensor | float) -> Tensor:
    """Embed each angle as (sine, cosine), both scaled by the angle's certainty.

    A degenerate angle has sine = cosine = 0 and fades in smoothly, so that neither the features nor their gradients
    jump or grow where points coincide or lie in a line.

    Returns:
        (..., 11): d_ij, d_jh, d_jk, then sine and cosine of b_ijk, b_ijh, b_hjk, theta.
    """
    radius, i = torch.as_tensor(radius, device=p_i.device).squeeze(-1), parts(p_i)
    j, h, k = ([x / radius for x in minus(parts(p), i)] for p in (p_j, c_h, c_k))  # seen from p_i
    ji, jh, jk = [-x for x in j], minus(h, j), minus(k, j)  # seen from p_j
    ii, hh, kk = dot(ji, ji), dot(jh, jh), dot(jk, jk)
    distances = [torch.sqrt(squared + _TINY) for squared in (ii, hh, kk)]  # (i) to (iii)
    angles = [*_angle(ji, jk, ii, kk), *_angle(ji, jh, ii, hh), *_angle(jh, jk, hh, kk)]  # (iv) to (vi)
    features = torch.broadcast_tensors(*distances, *angles, *_dihedral(k, h, j))  # the dihedral is (vii)
    return torch.stack(features).movedim(0, -1).contiguous()  # five times faster than to stack along the last axis


def _angle(a: Parts, b: Parts, aa: Tensor, bb: Tensor) -> tuple[Tensor, Tensor]:
    """Sine and cosine of the unsigned angle between vectors with the squared lengths `aa` and `bb`."""
    normal, faded = cross(a, b), _FADE * (aa + bb + _POINT) ** 2
    scale = torch.rsqrt(aa * bb + faded)
    return torch.sqrt(dot(normal, normal) + 1e-8 * faded) * scale, dot(a, b) * scale


def _dihedral(axis: Parts, first: Parts, second: Parts) -> tuple[Tensor, Tensor]:
    """Sine and cosine of the signed turn about `axis` from the half-plane of `first` to that of `second`.

    With n_1 = axis x first and n_2 = axis x second, n_1 x n_2 = axis (n_1 . second).
    """
    n_1, n_2, length = cross(axis, first), cross(axis, second), dot(axis, axis)
    sides = (length + dot(first, first) + _POINT) * (length + dot(second, second) + _POINT)
    scale = torch.rsqrt(dot(n_1, n_1) * dot(n_2, n_2) + _FADE * sides**2)
    return torch.sqrt(length + _TINY) * dot(n_1, second) * scale, dot(n_1, n_2) * scale


def ball_centroids(centres: Tensor, support: Tensor, valid: Tensor, radius: Tensor | float) -> Tensor:
    """Mean of the support points within `radius` of each centre; the nearest support point where there is none.

    Args:
        centres: (B, N, 3). support: (B, M, 3). valid: (B, M) bool. radius: broadcast to (B, N, M).

    Returns:
        (B, N, 3): the c_k of cross-PGF.
    """
    distance = torch.cdist(centres, support, compute_mode="donot_use_mm_for_euclid_dist")
    distance = distance.masked_fill(~valid[:, None], float("inf"))
    inside = (distance <= torch.maximum(distance.amin(-1, keepdim=True), torch.as_tensor(radius))).to(support.dtype)
    return inside @ (support * valid[..., None]) / inside.sum(-1, keepdim=True)
