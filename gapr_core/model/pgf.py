"""Point-wise Geometry-aware Features (paper, section IV-A, Fig. 3), and their cross-cloud form."""

from __future__ import annotations

import torch
from torch import Tensor

EMBEDDED = 11  # 3 distances, sine and cosine of 4 angles
_TINY = 1e-12
_TINY_PLANE = 1e-10


def pgf(p_i: Tensor, p_j: Tensor, c_h: Tensor, c_k: Tensor, radius: Tensor | float) -> Tensor:
    """The seven features l_ij = (d_ij, d_jh, d_jk, b_ijk, b_ijh, b_hjk, theta_h-ik-j).

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
    """The same features with each angle as (sine, cosine), both scaled by how well the angle is defined.

    A degenerate angle has sine = cosine = 0 and fades in smoothly, so that neither the features nor their gradients
    jump or grow where points coincide or lie in a line.

    Returns:
        (..., 11): d_ij, d_jh, d_jk, then sine and cosine of b_ijk, b_ijh, b_hjk, theta.
    """
    ji, jh, jk = (_parts((p - p_j) / radius) for p in (p_i, c_h, c_k))  # seen from p_j
    ih, ik, ij = (_parts((p - p_i) / radius) for p in (c_h, c_k, p_j))  # seen from p_i
    distances = [torch.sqrt(_dot(v, v) + _TINY) for v in (ji, jh, jk)]  # (i) to (iii)
    angles = [*_angle(ji, jk), *_angle(ji, jh), *_angle(jh, jk), *_dihedral(ik, ih, ij)]  # (iv) to (vii)
    return torch.stack(torch.broadcast_tensors(*distances, *angles), dim=-1)


Vectors = tuple[Tensor, Tensor, Tensor]  # x, y and z apart: several times faster than a last axis of three


def _parts(v: Tensor) -> Vectors:
    x, y, z = v.movedim(-1, 0).contiguous()
    return x, y, z


def _dot(a: Vectors, b: Vectors) -> Tensor:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vectors, b: Vectors) -> Vectors:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _angle(a: Vectors, b: Vectors) -> tuple[Tensor, Tensor]:
    """Sine and cosine of the unsigned angle between vectors."""
    cross = _cross(a, b)
    scale = torch.rsqrt(_dot(a, a) * _dot(b, b) + _TINY_PLANE)
    return torch.sqrt(_dot(cross, cross) + _TINY_PLANE * 1e-8) * scale, _dot(a, b) * scale


def _dihedral(axis: Vectors, first: Vectors, second: Vectors) -> tuple[Tensor, Tensor]:
    """Sine and cosine of the signed turn about `axis` from the half-plane of `first` to that of `second`."""
    n_1, n_2 = _cross(axis, first), _cross(axis, second)
    scale = torch.rsqrt(_dot(n_1, n_1) * _dot(n_2, n_2) + _TINY_PLANE)
    sine = _dot(_cross(n_1, n_2), axis) * torch.rsqrt(_dot(axis, axis) + _TINY)
    return sine * scale, _dot(n_1, n_2) * scale


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
