"""A bone-like surface without any symmetry, and what a probe sees of it; closed form, so every test knows the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gapr_core.geometry import se3
from gapr_core.surface import Surface


def bone() -> Surface:
    """A bent, tapering shaft of 240 mm with two unequal heads and a ridge, mm."""
    u, v = np.meshgrid(np.linspace(0.0, 1.0, 160), np.linspace(0.0, 2.0 * np.pi, 96, endpoint=False), indexing="ij")
    radius = 11.0 + 13.0 * np.exp(-(((u - 0.04) / 0.10) ** 2)) + 20.0 * np.exp(-(((u - 0.93) / 0.09) ** 2))
    radius *= 1.0 + 0.30 * np.exp(-(((u - 0.93) / 0.10) ** 2)) * np.cos(2.0 * (v - 0.4))
    radius += 9.0 * np.exp(-(((u - 0.25) / 0.07) ** 2)) * np.maximum(np.cos(v - 1.1), 0.0) ** 3
    radius += 6.0 * np.exp(-(((u - 0.70) / 0.10) ** 2)) * np.maximum(np.cos(v - 3.9), 0.0) ** 5
    radius *= np.sqrt(np.clip(1.0 - (2.0 * u - 1.0) ** 12, 1e-6, 1.0))
    x = radius * np.cos(v) + 14.0 * np.sin(2.5 * u)
    y = 0.8 * radius * np.sin(v) + 9.0 * u**2
    return Surface(np.stack([x, y, 240.0 * u], axis=-1).reshape(-1, 3), _tube_faces(160, 96))


def _tube_faces(rows: int, columns: int) -> np.ndarray:
    i, j = (index.ravel() for index in np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij"))
    a, b = i * columns + j, i * columns + (j + 1) % columns
    return np.concatenate([np.stack([a, b, a + columns], axis=1), np.stack([b, b + columns, a + columns], axis=1)])


def save(surface: Surface, path: Path, mm_per_unit: float = 1.0) -> Path:
    """As NPZ, which the node reads."""
    np.savez(path, points=surface.points / mm_per_unit, faces=surface.faces)
    return path


def partial(surface: Surface, T_target_source: np.ndarray, seed: int = 0, count: int = 3000, noise_mm: float = 0.3):
    """(N, 3) points in metres, in the cloud's frame: one side of the lower 60 %, as a camera sees it."""
    rng = np.random.default_rng(seed)
    points, normals = surface.sample(6 * count, rng)
    seen = (normals @ [0.5, 0.8, 0.2] > 0.15) & (points[:, 2] > 95.0)
    chosen = points[seen][:count] + rng.normal(scale=noise_mm, size=(min(count, seen.sum()), 3))
    return se3.apply(se3.inverse(T_target_source), chosen) / 1000.0
