"""The colours of all plots and pictures."""

SERIES = (
    "#0b5fa5", "#d1495b", "#2e9e6b", "#e0992b", "#7b5ea7", "#3aa6b9", "#8c6d46", "#c06c9c", "#6b7a2f", "#555555"
)  # fmt: skip
FIRST, SECOND = SERIES[:2]  # what is right or ours, and what it is compared with
TARGET = "#9aa2ab"  # points of a target in a flat picture
BONE = "#eadfc8"
OTHERS = "#9aa5b1"  # measured points that are not of the bone
GUIDE = "#bbbbbb"  # limits and diagonals
