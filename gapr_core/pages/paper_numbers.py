"""The paper's numbers (arXiv 2606.13488, tables I to III), on its data: printed next to ours, never mixed with them."""

from __future__ import annotations

from typing import NamedTuple


class Figures(NamedTuple):
    """One row of a table of the paper; chamfer_mm is None where the paper gives none."""

    rr_percent: float
    chamfer_mm: float | None
    rmse_mm: float
    r2_rotation: float
    r2_translation: float


TABLE_1: dict[str, dict[str, Figures]] = {
    "femur": {
        "ICP": Figures(8.4, 9.115, 157.942, -0.367, -19.021),
        "Lepard": Figures(7.6, 7.877, 40.146, -0.009, -8.051),
        "Predator": Figures(78.8, 6.115, 3.510, 0.902, 0.950),
        "GeoTransformer": Figures(92.3, 5.762, 2.618, 0.882, 0.976),
        "RoITr": Figures(94.5, 5.644, 2.252, 0.887, 0.983),
        "GAPR-Net": Figures(95.6, 5.679, 2.359, 0.923, 0.984),
    },
    "tibia": {
        "ICP": Figures(4.2, 8.232, 137.278, -0.445, -19.813),
        "Lepard": Figures(7.1, 7.960, 40.364, -0.028, -9.065),
        "Predator": Figures(74.8, 5.476, 5.574, 0.772, 0.535),
        "GeoTransformer": Figures(88.2, 5.099, 2.596, 0.883, 0.959),
        "RoITr": Figures(90.9, 5.024, 2.336, 0.871, 0.966),
        "GAPR-Net": Figures(93.6, 5.032, 2.331, 0.892, 0.971),
    },
    "pelvis": {
        "ICP": Figures(1.5, 10.432, 110.058, -0.396, -41.437),
        "Lepard": Figures(7.2, 7.961, 42.657, 0.013, -9.111),
        "Predator": Figures(58.9, 6.665, 12.963, 0.626, -1.491),
        "GeoTransformer": Figures(99.1, 5.524, 1.493, 0.935, 0.991),
        "RoITr": Figures(84.8, 5.906, 2.802, 0.908, 0.979),
        "GAPR-Net": Figures(99.6, 5.430, 1.293, 0.942, 0.994),
    },
    "thoracic": {
        "ICP": Figures(0.5, 6.010, 50.838, -0.278, -10.015),
        "Lepard": Figures(7.0, 7.933, 42.054, -0.005, -9.027),
        "Predator": Figures(30.3, 3.894, 13.497, 0.003, -0.932),
        "GeoTransformer": Figures(82.3, 2.890, 2.550, 0.878, 0.883),
        "RoITr": Figures(47.1, 3.847, 7.055, 0.681, 0.751),
        "GAPR-Net": Figures(89.6, 2.803, 1.124, 0.962, 0.997),
    },
    "all": {
        "ICP": Figures(2.9, 8.515, 126.460, -0.345, -20.340),
        "Lepard": Figures(7.5, 7.953, 39.839, 0.003, -8.894),
        "Predator": Figures(66.9, 5.571, 7.618, 0.660, -0.178),
        "GeoTransformer": Figures(90.7, 5.001, 2.337, 0.884, 0.955),
        "RoITr": Figures(84.2, 5.171, 3.103, 0.866, 0.935),
        "GAPR-Net": Figures(94.2, 4.937, 1.992, 0.908, 0.974),
    },
}

TABLE_2: dict[str, dict[str, Figures]] = {  # GAPR-Net at a fixed overlap
    "femur": {
        "overlap-40": Figures(92.2, None, 2.582, 0.810, 0.958),
        "overlap-50": Figures(95.6, None, 2.424, 0.949, 0.981),
        "overlap-60": Figures(96.3, None, 2.333, 0.832, 0.986),
        "overlap-70": Figures(94.3, None, 2.594, 0.917, 0.984),
    },
    "tibia": {
        "overlap-40": Figures(85.8, None, 2.703, 0.821, 0.956),
        "overlap-50": Figures(93.3, None, 2.329, 0.854, 0.974),
        "overlap-60": Figures(91.7, None, 2.351, 0.895, 0.979),
        "overlap-70": Figures(96.0, None, 2.123, 0.903, 0.982),
    },
    "pelvis": {
        "overlap-40": Figures(98.3, None, 1.459, 0.905, 0.986),
        "overlap-50": Figures(99.1, None, 1.412, 1.000, 0.993),
        "overlap-60": Figures(99.4, None, 1.295, 0.991, 0.995),
        "overlap-70": Figures(99.9, None, 1.203, 0.913, 0.995),
    },
    "thoracic": {
        "overlap-40": Figures(85.4, None, 1.320, 0.802, 0.996),
        "overlap-50": Figures(84.0, None, 1.514, 0.999, 0.994),
        "overlap-60": Figures(94.7, None, 0.941, 1.000, 0.996),
        "overlap-70": Figures(93.2, None, 1.078, 0.860, 0.997),
    },
}

TABLE_3: dict[str, Figures] = {  # GAPR-Net with an incomplete target
    "femur": Figures(89.7, 6.207, 2.739, 0.945, 0.969),
    "tibia": Figures(91.1, 5.359, 2.397, 0.801, 0.955),
    "pelvis": Figures(98.1, 5.509, 1.317, 0.947, 0.992),
    "thoracic": Figures(86.2, 3.318, 1.562, 0.856, 0.993),
    "all": Figures(90.7, 5.271, 2.206, 0.923, 0.976),
}


def of(protocol: str, bone: str) -> dict[str, Figures]:
    """Look up the paper's rows of one protocol and bones, by method; may be empty."""
    if protocol == "paper":
        return TABLE_1.get(bone, {})
    if protocol == "incomplete":
        return {"GAPR-Net": TABLE_3[bone]} if bone in TABLE_3 else {}
    numbers = TABLE_2.get(bone, {}).get(protocol)
    return {"GAPR-Net": numbers} if numbers else {}
