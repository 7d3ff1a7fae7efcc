"""The colours of all plots and pictures."""

SERIES = (
    "#0b5fa5", "#d1495b", "#2e9e6b", "#e0992b", "#7b5ea7", "#3aa6b9", "#8c6d46", "#c06c9c", "#6b7a2f", "#555555"
)  # fmt: skip
DASHES = ("-", "--", ":", "-.")  # of the first ten lines, the next ten, and so on
FIRST, SECOND = SERIES[:2]  # what is right or ours, and what it is compared with
TARGET = "#9aa2ab"  # points of a target in a flat picture
BONE = "#eadfc8"
OTHERS = "#9aa5b1"  # measured points that are not of the bone
GUIDE = "#bbbbbb"  # limits and diagonals
INK, SOFT = "#1d2733", "#5d6b7a"  # text and marks, and what is less important
SIGNED = ("#123c9c", "#6f9be8", "#f7f7f7", "#f08a80", "#b71c1c")  # inside the bone, on it, outside
GAIN = (BONE, "#f2a541", "#7a1fa2")  # of a further look: none, ever more


def dash(number: int) -> str:
    """Choose the style of line `number`; colours repeat after ten lines, with other dashes."""
    return DASHES[number // len(SERIES) % len(DASHES)]
