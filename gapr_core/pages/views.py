"""The bone from several sides, with the measured points: the picture of pages, notebooks and posters."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gapr_core.data.picture import BONE, VIEWS, Picture, View, draw
from gapr_core.geometry import se3
from gapr_core.pages import palette
from gapr_core.results import Guidance, RegistrationResult
from gapr_core.surface import Surface

Array = NDArray[np.float64]
SIGNED = LinearSegmentedColormap.from_list("signed", palette.SIGNED)
GAIN = LinearSegmentedColormap.from_list("gain", palette.GAIN)
SCALES_MM = (0.1, 0.2, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0)  # where the colours of distances may end
WITHIN = 90.0  # percent of the points
EDGE = "#1d273366"
LETTERS = ("LR", "PA", "SI")  # towards and against x, y, z in LPS
NAMES = {"anterior": "from the front", "posterior": "from behind", "left": "from the left", "right": "from the right",
         "superior": "from above", "inferior": "from below"}  # fmt: skip
PIXELS, SHOWN, DPI = 900, 3, 110
LONG = 2.0  # times as high as wide
LYING_PT, STANDING_PT = 17.0, 19.0  # letters and numbers: of those that stand, three share the width of a page
MOST_POINTS = 3000  # drawn of a cloud


@dataclass(frozen=True, eq=False)
class OnBone:
    """Parts of a drawing, target frame, mm.

    Attributes:
        bone: the bone.
        points: (N, 3) measured points.
        distance_mm: (N,) their signed distances to the bone; NaN is drawn grey.
        targets: (K, 3) places that are numbered.
        gain: gain of a further look at each place of the bone, as its colour; None for a plain bone.
        newest: (M, 3) points of the last look.
    """

    bone: Surface
    points: Array
    distance_mm: Array
    targets: Array
    gain: Guidance | None = None
    newest: Array | None = None

    @cached_property
    def is_long(self) -> bool:
        """Whether the bone is shown lying, from its sides alone: a shaft along z."""
        size = np.ptp(self.bone.points, axis=0)
        return bool(size[2] > LONG * size[:2].max())

    def view(self, side: str) -> View:
        """Return a side, with a long bone lying."""
        return VIEWS[side].lying if self.is_long else VIEWS[side]

    def side_facing(self, direction: Array | None) -> str:
        """Choose the side nearest to a direction (3,) towards the eye; without one, the best."""
        if direction is None:
            return self.sides(1)[0]
        return max(VIEWS, key=lambda name: float(np.dot(VIEWS[name].eye, direction)))

    @property
    def scale_mm(self) -> float:
        """Where the colours end: nine of ten points are within."""
        sizes = np.abs(self.distance_mm[np.isfinite(self.distance_mm)])
        most = float(np.percentile(sizes, WITHIN)) if len(sizes) else 0.0
        return next((scale for scale in SCALES_MM if most <= scale), SCALES_MM[-1])

    def sides(self, count: int = SHOWN) -> list[str]:
        """Choose the sides with most points and places, best first, each of another outline."""
        wanted = np.vstack([self.targets if self.gain is not None else self.points[:: len(self.points) // 300 + 1]])
        wanted = wanted if len(wanted) else self.bone.points[:1]
        names = [name for name, view in VIEWS.items() if not (self.is_long and view.eye[2])]
        coarse = max(1.0, self.bone.extent_mm / 200.0)
        seen = {name: float(draw(self.bone, VIEWS[name], coarse).sees(wanted).mean()) for name in names}
        chosen: list[str] = []
        for name in sorted(names, key=lambda name: -seen[name]):
            if all(np.dot(VIEWS[name].eye, VIEWS[other].eye) == 0 for other in chosen):
                chosen.append(name)
        return chosen[:count]


def of_result(result: RegistrationResult, with_gain: bool = False) -> OnBone:
    """Draw points under the best hypothesis, accepted or not; `with_gain`: where to measure next."""
    if result.bone is None:
        raise ValueError("a picture needs a result that knows its bone: take it from `register`")
    points, distance_mm = np.zeros((0, 3)), np.zeros(0)
    if result.best is not None and result.residuals is not None:
        points, distance_mm = result.residuals.points, result.residuals.distance_mm
    elif result.best is not None and result.source is not None:
        points, distance_mm = result.source, np.full(len(result.source), np.nan)
    some = slice(None, None, len(points) // MOST_POINTS + 1)
    moved = points[some] if result.best is None else se3.apply(result.best, points[some])
    places = [target.position_mm for target in result.targets]
    if with_gain and result.guidance is not None:
        places = [tuple(spot.centre) for spot in result.guidance.spots()]
    gain = result.guidance if with_gain else None
    return OnBone(result.bone, moved, distance_mm[some], np.array(places).reshape(-1, 3), gain)


def figure(result: RegistrationResult) -> Figure:
    """Draw the result from up to three sides, for a notebook or a file."""
    on = of_result(result)
    pictures = [picture_of(on, side) for side in on.sides()]
    aspects = [picture.light.shape[1] / picture.light.shape[0] for picture in pictures]
    if on.is_long:
        made, shape = Figure((9.0, 9.0 * sum(1.0 / each for each in aspects) + 1.2), DPI, layout="constrained"), (-1, 1)
    else:
        made, shape = Figure((4.0 * sum(aspects) + 1.2, 4.6), DPI, layout="constrained"), (1, -1)
    FigureCanvasAgg(made)
    made.suptitle(str(result).partition("  inliers")[0], fontsize=11)
    grid = np.arange(len(pictures)).reshape(shape)
    ratios = None if on.is_long else aspects
    all_axes: Any = made.subplots(len(grid), len(grid[0]), width_ratios=ratios)
    for axes, picture in zip(np.ravel(all_axes), pictures, strict=True):
        dots = paint(axes, on, picture)
    made.colorbar(dots, ax=made.axes, label="distance to the bone, mm (red: outside)", shrink=0.7)
    return made


def png(on: OnBone, side: str) -> bytes:
    """Draw one side as a PNG."""
    picture = picture_of(on, side)
    height, width = picture.light.shape
    made = Figure((width / DPI, height / DPI), DPI)
    FigureCanvasAgg(made)
    paint(made.add_axes((0.0, 0.0, 1.0, 1.0)), on, picture)
    return as_png(made)


def as_png(made: Figure) -> bytes:
    """Save a figure as a PNG of few colours: about half of the bytes."""
    from PIL import Image

    out = BytesIO()
    canvas: Any = made.canvas
    canvas.draw()
    drawn = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    drawn.quantize(256, Image.Quantize.FASTOCTREE).save(out, format="png")  # others lose the few coloured points
    return out.getvalue()


def picture_of(on: OnBone, side: str) -> Picture:
    """Draw the bone alone, with room for all points on it, in `PIXELS` at most."""
    values, view = None, on.view(side)
    if on.gain is not None:
        values = on.gain.gain_mm[cKDTree(on.gain.points).query(on.bone.points)[1]]
    size = float(np.ptp(on.bone.points @ view.axes.T, axis=0)[:2].max())
    return draw(on.bone, view, size * 1.1 / PIXELS, 0.05 * size, values)


def paint(axes: Any, on: OnBone, picture: Picture) -> Any:
    """Draw one side: the bone, the points by distance, hidden ones faint, places with numbers, letters of the sides."""
    light = picture.light[..., None]
    colour = BONE / 255.0
    if on.gain is not None and picture.values is not None:
        colour = GAIN(np.nan_to_num(picture.values) / max(float(on.gain.gain_mm.max()), 1e-9))[..., :3]
    axes.imshow(np.where(np.isnan(light), 1.0, light * colour), extent=picture.extent_mm, interpolation="bilinear")
    dots = _points(axes, on, picture)
    size = LYING_PT if on.is_long else STANDING_PT
    for number, (x, y, _) in enumerate(on.targets @ picture.view.axes.T, 1):
        axes.scatter(x, y, s=2.2 * size**2, c=palette.INK, edgecolors="white", linewidths=1.5, zorder=5)
        axes.text(x, y, str(number), color="white", ha="center", va="center", fontsize=size, weight="bold", zorder=6)
    _letters(axes, picture.view, size)
    left, right, bottom, top = picture.extent_mm
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    axes.axis("off")
    return dots


def _points(axes: Any, on: OnBone, picture: Picture) -> Any:
    size = float(np.clip(24_000.0 / max(len(on.points), 1), 9.0, 90.0)) * (0.5 if on.is_long else 1.0)
    seen, near = picture.sees(on.points), np.isfinite(on.distance_mm)
    x, y, _ = (on.points @ picture.view.axes.T).T
    plain = on.gain is not None
    axes.scatter(x[~seen], y[~seen], s=0.5 * size, c=palette.OTHERS, alpha=0.35, linewidths=0)
    off = seen & ~near
    axes.scatter(x[off], y[off], s=size, c=palette.OTHERS, edgecolors=EDGE, linewidths=0.5)
    on_it, scale = seen & near, on.scale_mm
    shade = palette.INK if plain else on.distance_mm[on_it]
    how: dict[str, Any] = {} if plain else {"cmap": SIGNED, "vmin": -scale, "vmax": scale}
    dots = axes.scatter(x[on_it], y[on_it], s=size, c=shade, edgecolors=EDGE, linewidths=0.5, **how)
    if on.newest is not None and len(on.newest):
        x, y, _ = (on.newest @ picture.view.axes.T).T
        axes.scatter(x, y, s=size, c=palette.SECOND, edgecolors="white", linewidths=0.3)
    return dots


def _letters(axes: Any, view: View, size: float) -> None:
    """R and L, A and P, S and I at the four edges."""
    across, up, _ = view.axes
    for x, y, direction in ((0.985, 0.5, across), (0.015, 0.5, -across), (0.5, 0.985, up), (0.5, 0.015, -up)):
        axis = int(np.abs(direction).argmax())
        letter = LETTERS[axis][0 if direction[axis] > 0 else 1]
        look = {"ha": "right" if x > 0.9 else "left" if x < 0.1 else "center",
                "va": "top" if y > 0.9 else "bottom" if y < 0.1 else "center"}  # fmt: skip
        axes.text(x, y, letter, transform=axes.transAxes, fontsize=size, weight="bold", color=palette.SOFT, **look)


def place_in_words(centre: Array, normal: Array, bone: Surface) -> str:
    """Name a patch's place on a bone, such as "upper third, front"; LPS."""
    low, high = bone.points[:, 2].min(), bone.points[:, 2].max()
    third = ("lower third", "middle", "upper third")[int(np.clip(3.0 * (centre[2] - low) / (high - low), 0, 2))]
    axis = int(np.abs(normal).argmax())
    side = (("left", "right"), ("back", "front"), ("top", "underside"))[axis][0 if normal[axis] > 0 else 1]
    return f"{third}, {side}"
