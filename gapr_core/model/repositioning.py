"""Repositioning before the last cross-attention (paper, section IV-C): weighted SVD of soft superpoint matches."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from gapr_core.model.config import ModelConfig
from gapr_core.model.superpoint_matching import coarse_scores, top_pairs


class WeightedSVD(nn.Module):
    """T_r from the top dual-normalised matches of the third self-attention's features; carries no gradient.

    Moving the source into the target's frame instead of the target into the source's changes nothing in any PGF.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.temperature, self.top = config.reposition_temperature, config.reposition_top
        self.condition = config.reposition_condition

    @torch.no_grad()
    def forward(self, f_p: Tensor, f_q: Tensor, p: Tensor, q: Tensor, valid_p: Tensor, valid_q: Tensor) -> Tensor:
        """(B, 3, 4) T_target_source in the clouds' units, from features (B, n, C) and points (B, n, 3)."""
        rows, columns, weight = top_pairs(coarse_scores(f_p, f_q, valid_p, valid_q, self.temperature), self.top)
        matched_p, matched_q = _rows(p, rows), _rows(q, columns)
        T, condition = weighted_svd(matched_p, matched_q, weight)
        trusted = (condition < self.condition) & ((weight > 0).sum(1) >= 3)
        return torch.where(trusted[:, None, None], T, stay(p))


class Stay(nn.Module):
    """No repositioning: the null object."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()

    def forward(self, f_p: Tensor, f_q: Tensor, p: Tensor, q: Tensor, valid_p: Tensor, valid_q: Tensor) -> Tensor:
        return stay(p)


REPOSITIONING: dict[str, type[nn.Module]] = {"svd": WeightedSVD, "none": Stay}


def stay(points: Tensor) -> Tensor:
    """(B, 3, 4) identity motions for points (B, n, 3)."""
    return torch.eye(3, 4, device=points.device, dtype=torch.float32).expand(len(points), 3, 4)


def move(T: Tensor, points: Tensor) -> Tensor:
    """Points (B, n, 3) moved by (B, 3, 4)."""
    return points @ T[:, :, :3].transpose(1, 2) + T[:, None, :, 3]


def weighted_svd(p: Tensor, q: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Rigid T minimising sum w |T p - q|^2 (Arun 1987), and how badly it is conditioned.

    Args:
        p, q: (B, k, 3). weight: (B, k), not negative.

    Returns:
        (B, 3, 4) motions, and (B,) how much longer than wide the matched points are (root of the ratio of the first two
        singular values of the covariance): infinite for points in a line, which leave the turn about it open.
    """
    p, q, weight = p.float(), q.float(), weight.float()
    w = (weight / weight.sum(1, keepdim=True).clamp(min=1e-9))[..., None]
    p_mean, q_mean = (w * p).sum(1, keepdim=True), (w * q).sum(1, keepdim=True)
    covariance = (w * (p - p_mean)).transpose(1, 2) @ (q - q_mean)
    u, s, vt = torch.linalg.svd(covariance.nan_to_num())
    flip = torch.ones_like(s)
    flip[:, 2] = torch.sign(torch.linalg.det(u) * torch.linalg.det(vt))
    rotation = vt.transpose(1, 2) @ (flip[..., None] * u.transpose(1, 2))
    translation = q_mean.transpose(1, 2) - rotation @ p_mean.transpose(1, 2)
    return torch.cat([rotation, translation], dim=2), torch.sqrt(s[:, 0] / s[:, 1].clamp(min=1e-12))


def _rows(x: Tensor, index: Tensor) -> Tensor:
    return x.gather(1, index[..., None].expand(-1, -1, x.shape[-1]))
