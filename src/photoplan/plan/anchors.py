"""Anchors and fields of a tile: projective cells, lens displacements, and the compilation of both."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import ImageField, Projection, Tremor, project, tremor_of
from photoplan.errors import UsageError
from photoplan.geometry.grid import Breaks, Window, level_size
from photoplan.kernels.anchors import blocks_in_image, interpolation_errors
from photoplan.kernels.weights import KERNELS
from photoplan.plan.ground import CORNERS, MIDDLE, SQUARE, Boxes, TileGround
from photoplan.plan.jitter import TremorTable, tremor_table


@dataclass(frozen=True, eq=False)
class Anchors:
    """A tile cut into rectangles, each a pile of boxes in (u, v, h) with eight homogeneous corners.

    A pixel looks up the box of its rectangle that holds its height, interpolates (x·w, y·w, w) trilinearly and
    divides once. For a frame camera over a map this is exact for a box of any size. What the field of the projection
    adds to the position (a lens) is interpolated between nodes.
    """

    rects: NDArray[np.int32]
    """(m, 4): first column, first row, end column, end row of each rectangle, relative to the tile; half-open."""
    box_start: NDArray[np.int32]
    """(m + 1,): boxes of rectangle i are `box_start[i]` to `box_start[i + 1]`, from low to high, without gaps."""
    box_heights: NDArray[np.float64]
    """(n, 2): lowest and highest h of each box, metres."""
    corners: NDArray[np.float64]
    """(n, 8, 3): (x·w, y·w, w) at corner 4·ih + 2·iv + iu. The corners of a rectangle lie on its pixels' outer edges
    (first column − 1/2, end column − 1/2); x and y are relative to the first pixel of `source_window`, without the
    field; w > 0 and is scaled to be about 1 inside a tile."""
    field_frame: NDArray[np.float64]
    """(5,): x and y of the field's first node, in the coordinates of `corners`; nodes per pixel along x and y; largest
    factor by which the field makes a distance longer. With a field that belongs to rows (6,): also the
    height of its values, metres."""
    field: NDArray[np.float32]
    """(rows, columns, 2): what is added to x and y at the nodes; (0, 0, 2): the projection has no field. Positions
    beyond the nodes are not in the image. (rows, columns, 5): a field that belongs to rows (a turbulent flight):
    nodes lie at ideal x and *real* y; then follow the changes per metre of height, and the furthest ideal row, pixels
    from the first node, that any row up to this one sees between this column and the next, whatever the height."""
    residual: float
    """Worst difference to the strict position, pixels: of the boxes, measured at their centre, face and edge middles,
    plus of the field, measured in and beside its cells' middles, and at declared breaks."""
    source_window: Window
    """Part of the source image that holds every position, with the kernel's margin, cut at the image's border."""
    scales: tuple[float, float]
    """Smallest and largest number of source pixels per target pixel along x or y."""

    @property
    def arrays(self) -> tuple[NDArray[Any], ...]:
        """What the kernels take."""
        return self.rects, self.box_start, self.box_heights, self.corners, self.field_frame, self.field

    def at_level(self, level: int, size: tuple[int, int]) -> Anchors:
        """The same for an image of `size` that is reduced by 2 to the power of `level`; the residual stays as it is."""
        if level == 0:
            return self
        f, old = 2.0**level, self.source_window
        limit = level_size(size, level)
        # A pixel more all round: the margin was made for pixels of full size.
        col, row = max((old.col >> level) - 1, 0), max((old.row >> level) - 1, 0)
        right, bottom = (min(-(-stop >> level) + 1, most) for stop, most in zip(old.stop, limit))
        window = Window(col, row, max(0, right - col), max(0, bottom - row))
        corners = self.corners.copy()
        for axis, (before, after) in enumerate(((old.col, col), (old.row, row))):
            corners[..., axis] /= f
            corners[..., axis] += ((before + 0.5) / f - 0.5 - after) * corners[..., 2]
        frame = self.field_frame.copy()
        for axis, (before, after) in enumerate(((old.col, col), (old.row, row))):
            frame[axis] = (frame[axis] + before + 0.5) / f - 0.5 - after
            frame[axis + 2] *= f
        return replace(
            self,
            corners=corners,
            field_frame=frame,
            field=self.field / np.float32(f),
            source_window=window,
            scales=(self.scales[0] / f, self.scales[1] / f),
        )


Positions = Callable[[NDArray[np.int64], NDArray[np.float64]], NDArray[np.float64]]
"""Gives the strict homogeneous positions (k, 3) of places (k, 3) in (h, v, u), 0 to 1, in the boxes numbered (k,)."""

#: A bend that crosses a box askew is missed most between the lines along which it is looked for.
_BESIDE = 1.25
#: Crossings that are looked for together.
_MOST = 2_000_000

# 27 lines through a box in (h, v, u): nine along each axis, at its lower, middle and upper places.
_LINES = [
    (axis, np.insert(np.array(place), axis, 0.0))
    for axis in range(3)
    for place in itertools.product((0.0, 0.5, 1.0), repeat=2)
]
_AXIS = np.array([axis for axis, _ in _LINES])
_START = np.array([start for _, start in _LINES])
_ALONG = np.eye(3)[_AXIS]
_CORNERS = np.array(list(itertools.product((0.0, 1.0), repeat=3)))


def _weights(fractions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Trilinear weights of the corners (4·ih + 2·iv + iu) at places (k, 3) in (h, v, u)."""
    return np.where(_CORNERS[None] == 1.0, fractions[:, None], 1.0 - fractions[:, None]).prod(axis=2)


_FROM, _TO = _weights(_START), _weights(_START + _ALONG)


def bend_errors(breaks: Breaks, corners: NDArray[np.float64], strict: Positions) -> NDArray[np.float64]:
    """Residual of boxes at the breaks that cross them, pixels."""
    errors = np.zeros((len(corners), 4))
    for component, places in enumerate((np.asarray(breaks.columns), np.asarray(breaks.rows))):
        many = max(1, _MOST // (27 * max(1, len(places))))
        for first in range(0, len(corners) if len(places) else 0, many):
            some = slice(first, first + many)
            begin, end = (np.einsum("lc,ncj->nlj", w, corners[some]) for w in (_FROM, _TO))
            step = end - begin
            at = begin[..., component, None] - places * begin[..., 2, None]
            with np.errstate(all="ignore"):
                t = at / (places * step[..., 2, None] - step[..., component, None])
            box, line, place = np.nonzero((t > 0) & (t < 1))
            t = t[box, line, place]
            between = begin[box, line] + t[:, None] * step[box, line]
            found = strict(box + first, _START[line] + t[:, None] * _ALONG[line])
            with np.errstate(all="ignore"):
                miss = np.hypot(*(between[:, :2] / between[:, 2:] - found[:, :2] / found[:, 2:]).T)
            miss = _BESIDE * np.nan_to_num(miss, nan=np.inf)
            np.maximum.at(errors, (box + first, _AXIS[line]), miss)
            np.maximum.at(errors[:, 3], box + first, miss)
    return errors


#: Widest and narrowest spacing of nodes, pixels.
_WIDEST, _NARROWEST = 256.0, 1.0
#: Intervals of nodes along each axis at which the spacing is tried out.
_SAMPLES = 24
#: The residual is that of the middles of cells and of their sides; what a third derivative adds beside them.
_BESIDE_FIELD = 1.1


@dataclass(frozen=True, eq=False)
class FieldGrid:
    """How a field is tabulated, for one image and tolerance, whatever the tile.

    Nodes lie at `phase` plus whole multiples of `spacing`, so that tiles that overlap have them in common.
    """

    field: ImageField
    size: tuple[int, int]
    """Of the image, pixels."""
    phase: tuple[float, float]
    spacing: tuple[float, float]
    """Along x and y, pixels."""
    bounds: tuple[float, float, float, float]
    """Ideal positions x_min, y_min, x_max, y_max of all that lies in the image."""
    stretch: float
    """Largest factor by which the field makes a distance longer."""
    miss: float
    """Worst difference between interpolation and field where it was tried, pixels; that of a tile is measured again."""

    def nodes(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> float:
        """Number of nodes around the ideal positions from `low` to `high`, about."""
        low, high = (np.clip(a, self.bounds[:2], self.bounds[2:]) for a in (low, high))
        return float(np.prod((high - low) / self.spacing + 2.0))

    def table(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> FieldTable:
        """Nodes around the ideal positions from `low` to `high`, (x, y) each, cut at `bounds`."""
        low = np.clip(low, self.bounds[:2], self.bounds[2:])
        high = np.clip(high, self.bounds[:2], self.bounds[2:])
        ends = [
            [int(np.floor((a[axis] - self.phase[axis]) / self.spacing[axis])) for a in (low, high)] for axis in range(2)
        ]
        starts = [p + s * np.arange(e[0], e[1] + 1.0) for p, s, e in zip(self.phase, self.spacing, ends)]
        nodes, residual = (self._smooth if self.field.breaks is None else self._bent)(starts)
        origin = np.round(nodes.mean(axis=(0, 1)))
        kept = (nodes - origin).astype(np.float32)
        rounding = float(np.spacing(np.abs(kept).max()))
        return FieldTable((float(starts[0][0]), float(starts[1][0])), origin, kept, residual + rounding)

    def _smooth(self, starts: list[NDArray[np.float64]]) -> tuple[NDArray[np.float64], float]:
        """Shifts at nodes, and what cells miss by the second differences of the nodes (and those around them)."""
        x, y = (np.r_[a[0] - s, a, a[-1] + s, a[-1] + 2 * s] for a, s in zip(starts, self.spacing))
        shifts, used = _shifts(self.field, self.size, self.spacing, x, y)
        across = shifts[1:-1, :-2] - 2 * shifts[1:-1, 1:-1] + shifts[1:-1, 2:]
        down = shifts[:-2, 1:-1] - 2 * shifts[1:-1, 1:-1] + shifts[2:, 1:-1]
        miss = (np.hypot(across[..., 0], across[..., 1]) + np.hypot(down[..., 0], down[..., 1])) / 8
        return shifts[1:-1, 1:-1], _BESIDE_FIELD * float(miss[used[1:-1, 1:-1]].max(initial=0.0))

    def _bent(self, starts: list[NDArray[np.float64]]) -> tuple[NDArray[np.float64], float]:
        """Shifts at nodes, and what cells miss at their middles or at the breaks that cross them."""
        probed = [_probed(a, s, breaks) for a, s, breaks in zip(starts, self.spacing, _breaks(self.field))]
        x, y = (np.r_[lattice[:, :2].ravel(), lattice[-1, 2]] for lattice, _ in probed)
        shifts, used = _shifts(self.field, self.size, self.spacing, x, y)
        corners = (shifts[:-1:2, :-1:2], shifts[:-1:2, 2::2], shifts[2::2, :-1:2], shifts[2::2, 2::2])
        probes = (shifts[:-1:2, 1::2], shifts[1::2, :-1:2], shifts[1::2, 1::2])
        misses = _misses(corners, probes, (probed[0][1], probed[1][1]), used[1::2, 1::2])
        return shifts[::2, ::2], _BESIDE_FIELD * float(misses.max())


@dataclass(frozen=True, eq=False)
class FieldTable:
    """The nodes that one tile needs."""

    first: tuple[float, float]
    """Ideal position of the first node."""
    origin: NDArray[np.float64]
    """A whole shift (x, y) that is not in `nodes`: what is left is small enough for single precision."""
    nodes: NDArray[np.float32]
    """(rows, columns, 2): real minus ideal position minus `origin`."""
    residual: float
    """Worst difference between interpolation and field, pixels."""


@lru_cache(maxsize=256)
def field_grid(field: ImageField, size: tuple[int, int], tolerance: float) -> FieldGrid:
    """The widest spacing whose bilinear interpolation misses the field by less than the tolerance.

    It is tried at intervals spread over the image, and wherever the field declares a break. Breaks at equal distances
    get nodes on them; others make the spacing as narrow as the bend asks for.
    """
    bounds = _ideal_bounds(field, size)
    phases, spacings = [], []
    for breaks in _breaks(field):
        gaps = np.diff(breaks)
        even = len(gaps) > 0 and np.ptp(gaps) <= 1e-9 * gaps[0]
        widest = min(_WIDEST, float(gaps.min())) if len(gaps) else _WIDEST
        phases.append(float(breaks[0]) if even else 0.0)
        spacings.append(widest if even else 2.0 ** np.floor(np.log2(widest)))
    while True:
        along_x, along_y, worst, stretch = _try_out(field, size, bounds, phases, spacings)
        if worst <= tolerance / _BESIDE_FIELD or min(spacings) <= _NARROWEST:
            break
        share = min(tolerance / 3, max(along_x, along_y))
        finer = [0.5 if len(breaks) else 0.5**0.5 for breaks in _breaks(field)]
        cut = [max(s * f, _NARROWEST) for s, f in zip(spacings, finer)]
        spacings = [c if miss >= share else s for c, s, miss in zip(cut, spacings, (along_x, along_y))]
    return FieldGrid(
        field=field,
        size=size,
        phase=(phases[0], phases[1]),
        spacing=(spacings[0], spacings[1]),
        bounds=bounds,
        stretch=stretch,
        miss=_BESIDE_FIELD * worst,
    )


def _breaks(field: ImageField) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    breaks = field.breaks
    if breaks is None:
        return np.empty(0), np.empty(0)
    return np.asarray(breaks.columns, float), np.asarray(breaks.rows, float)


def _ideal_bounds(field: ImageField, size: tuple[int, int]) -> tuple[float, float, float, float]:
    """Ideal positions of the image's outer edge, and a little more: the edge is sampled."""
    t = np.linspace(0.0, 1.0, 257)[:, None]
    corners = np.array([(-0.5, -0.5), (size[0] - 0.5, -0.5), (size[0] - 0.5, size[1] - 0.5), (-0.5, size[1] - 0.5)])
    edge = np.concatenate([a + t * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0))])
    ideal = field.inverse(edge)
    low, high = np.nanmin(ideal, axis=0), np.nanmax(ideal, axis=0)
    margin = 2.0 + 1e-3 * (high - low)
    (x0, y0), (x1, y1) = (low - margin).tolist(), (high + margin).tolist()
    return x0, y0, x1, y1


def _try_out(
    field: ImageField,
    size: tuple[int, int],
    bounds: tuple[float, float, float, float],
    phases: list[float],
    spacings: list[float],
) -> tuple[float, float, float, float]:
    """Misses along x, along y and anywhere, and the largest stretch, at intervals spread over the bounds."""
    axes, fractions = [], []
    for axis, breaks in enumerate(_breaks(field)):
        spread = np.linspace(bounds[axis], bounds[axis + 2], _SAMPLES)
        some = breaks[:: max(1, len(breaks) // _SAMPLES)]
        some = some[(some > bounds[axis]) & (some < bounds[axis + 2])]
        first = np.unique(np.floor((np.r_[spread, some] - phases[axis]) / spacings[axis]))
        lattice, fraction = _probed(phases[axis] + spacings[axis] * first, spacings[axis], breaks)
        axes.append(lattice.ravel())
        fractions.append(fraction)
    shifts, used = _shifts(field, size, spacings, *axes)
    corners = (shifts[::3, ::3], shifts[::3, 2::3], shifts[2::3, ::3], shifts[2::3, 2::3])
    probes = (shifts[::3, 1::3], shifts[1::3, ::3], shifts[1::3, 1::3])
    along_x, along_y, middle = _misses(corners, probes, (fractions[0], fractions[1]), used[1::3, 1::3])
    by_x, by_y = (corners[1] - corners[0]) / spacings[0], (corners[2] - corners[0]) / spacings[1]
    stretch = 1.0 + float(np.maximum(np.abs(by_x), np.abs(by_y)).sum(axis=-1).max())
    return along_x, along_y, max(along_x, along_y, middle), stretch


def _probed(
    first: NDArray[np.float64], spacing: float, breaks: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Intervals (n, 3): first node, probe, last node; and where the probe lies between them.

    The probe is the middle, or the break nearest to it if there is one inside.
    """
    fraction = np.full(len(first), 0.5)
    if len(breaks):
        middle = first + 0.5 * spacing
        after = np.clip(np.searchsorted(breaks, middle), 1, len(breaks) - 1) if len(breaks) > 1 else 0
        before = np.maximum(np.asarray(after) - 1, 0)
        nearest = np.where(np.abs(breaks[before] - middle) < np.abs(breaks[after] - middle), before, after)
        at = (breaks[nearest] - first) / spacing
        fraction = np.where((at > 1e-9) & (at < 1 - 1e-9), at, 0.5)
    return np.stack([first, first + fraction * spacing, first + spacing], axis=1), fraction


def _shifts(
    field: ImageField, size: tuple[int, int], near: Sequence[float], x: NDArray[np.float64], y: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Real minus ideal positions on a lattice, (rows, columns, 2), and which places lie in the image or `near`."""
    ideal = np.stack(np.broadcast_arrays(x[None], y[:, None]), axis=-1)
    real = field(ideal)
    used = (real > np.subtract(-0.5, near)) & (real < np.add(np.subtract(size, 0.5), near))
    return real - ideal, np.asarray(used.all(axis=-1))


def _misses(
    corners: tuple[Any, ...],
    probes: tuple[Any, ...],
    fractions: tuple[NDArray[np.float64], NDArray[np.float64]],
    used: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Worst miss of bilinear interpolation: on cells' upper sides, left sides, and inside; shape (3,).

    corners: upper left, upper right, lower left, lower right; probes: upper side, left side, inside. Cells that are not
    `used` do not count.
    """
    a, b, c, d = corners
    fx, fy = fractions[0][None, :, None], fractions[1][:, None, None]
    upper, left = a + fx * (b - a), a + fy * (c - a)
    inside = upper + fy * (c + fx * (d - c) - upper)
    places = zip((upper, left, inside), probes)
    return np.array([np.hypot(*np.moveaxis((g - p)[used], -1, 0)).max(initial=0.0) for g, p in places])


#: Pixels of a reduced source that stay for every target pixel at least: the kernel, widened to them, decides what the
#: product looks like, not the means before it.
FINEST = 2.0
#: A rectangle that still reaches behind the camera at this side is left out, pixels.
SMALLEST_BEHIND = 4
#: Strict positions of pixels are computed for so many at once; tiles with fewer pixels may have so many anchors.
AT_ONCE, FEWEST = 16_384, 4_096
#: More layers than this over one rectangle do not pay; the residual that is left is reported.
MOST_LAYERS = 64

#: Where a flight is turbulent, shares of the tolerance are smaller by this: what is missed grows from line to line.
_FINER = 4.0

Piles = tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.float64]]
"""Boxes that are settled: rectangles (n, 4), heights (n, 2), homogeneous corners (n, 8, 3)."""


@dataclass(frozen=True)
class AnchorRule:
    """How finely a tile is cut."""

    tolerance: float
    """Largest residual of anchors and field together that is accepted, pixels of the source image; 0: every pixel is
    computed strictly by its camera."""
    radius: int
    """Half the support of the resampling kernel at scale 1, pixels: what the source window adds all round."""
    reduces: bool = True
    """Whether a source that is much finer than the target is read reduced; not if grey values must stay as they are."""
    tilted: bool = False
    """Whether the change of depth from pixel to pixel decides what a pixel covers: in a view, not on a map."""

    def __post_init__(self) -> None:
        if not self.tolerance >= 0:
            raise UsageError(f"tolerance {self.tolerance} px; it must be 0 (strict) or positive (usual is 0.02)")

    @classmethod
    def of(cls, kernel: str, tolerance: float, tilted: bool = False) -> AnchorRule:
        """The rule of a resampling kernel, by its name; ``nearest`` keeps grey values as they are."""
        averages = kernel != "nearest"
        return cls(tolerance, max(1, math.ceil(KERNELS[kernel].taps / 2)), reduces=averages, tilted=tilted and averages)

    def level(self, anchors: Anchors) -> int:
        """How often a source is halved before it is resampled: by where it is coarsest, see `FINEST`."""
        finer = anchors.scales[0] / FINEST
        return int(math.log2(finer)) if self.reduces and finer >= 2.0 else 0


@dataclass(frozen=True)
class _Image:
    """The image as the anchors see it: ideal positions."""

    size: tuple[int, int]
    grid: FieldGrid | None
    tolerance: float
    """What of the tolerance is left for the anchors, in ideal pixels."""
    tremor: TremorTable | None = None
    """What changes from line to line."""

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """x_min, y_min, x_max, y_max of all that lies in the image."""
        if self.tremor is not None:
            return self.tremor.bounds(self.size)
        return (-0.5, -0.5, self.size[0] - 0.5, self.size[1] - 0.5) if self.grid is None else self.grid.bounds


def compile_anchors(
    projection: Projection,
    ground: TileGround,
    rule: AnchorRule,
    wanted: NDArray[np.float64] | None = None,
    longest: float = 0.0,
) -> Anchors | None:
    """Cut a tile into boxes whose trilinear homogeneous interpolation meets the tolerance, and tabulate the field.

    Notes
    -----
    Every pixel is computed strictly if the tolerance is 0, and if anchors or nodes that meet it would be more than the
    pixels of the tile.
    """
    wanted = ground.ranges if wanted is None else wanted
    if rule.tolerance == 0:
        return _each_pixel(projection, ground, rule.radius, wanted, longest)
    most = max(int(np.isfinite(ground.relief).sum()), FEWEST)
    image = _Image(projection.size, None, rule.tolerance)
    if projection.field is not None:
        grid = field_grid(projection.field, projection.size, rule.tolerance / 2)
        if grid.miss > rule.tolerance:
            return _each_pixel(projection, ground, rule.radius, wanted, longest)
        image = _Image(projection.size, grid, (rule.tolerance - min(grid.miss, rule.tolerance / 2)) / grid.stretch)
    breaks, shaken, strictly = projection.breaks, tremor_of(projection), projection
    if shaken is not None:
        tremor = _tremor(shaken, ground, image)
        if tremor is None:
            return None
        # Shifts belong to a height of the ground: where h is none, boxes have to do.
        if ground.is_height:
            image, projection, breaks = (
                replace(image, tolerance=rule.tolerance / 2, tremor=tremor),
                tremor.part.smooth,
                None,
            )
        else:
            breaks = Breaks(rows=tuple(np.arange(*tremor.part.rows) + 0.0))
    boxes, settled_boxes = ground.first, 0
    done: list[Piles] = []
    residual = 0.0
    while len(boxes.rects):
        lattice = projection.project_homogeneous(boxes.lattice)
        errors = np.zeros((len(boxes.rects), 4))
        if isinstance(breaks, Breaks):
            strict = _strict(projection, ground, boxes)
            np.maximum.at(errors, boxes.rect, bend_errors(breaks, lattice[:, CORNERS], strict))
        keep, behind = np.zeros((2, len(errors)), bool)
        interpolation_errors(lattice, boxes.rect, image.bounds, float(rule.radius), errors, keep, behind)
        errors[behind] = np.inf
        split_u, split_v, thin = _verdict(errors, boxes, image.tolerance, behind)
        again = split_u | split_v | thin
        settled = keep & ~again & ~behind
        if settled.any():
            box = settled[boxes.rect]
            done.append((boxes.rects[boxes.rect[box]], boxes.heights[box], lattice[box][:, CORNERS]))
            residual = max(residual, float(errors[settled].max()))
            settled_boxes += len(done[-1][0])
        if not (keep & again).any():
            break
        rects, layers = _finer(boxes, keep, split_u, split_v, thin)
        if settled_boxes + int(layers.sum()) > most:
            return _each_pixel(strictly, ground, rule.radius, wanted, longest)
        boxes = ground.boxes(rects, layers)
    if not done:
        return None
    try:
        return _assemble(image, done, wanted, residual, rule.radius, longest, most)
    except _TooManyNodes:
        return _each_pixel(strictly, ground, rule.radius, wanted, longest)


def _tremor(tremor: Tremor, ground: TileGround, image: _Image) -> TremorTable | None:
    """The table of a tile; None: it shows nothing of the image."""
    heights = float(ground.first.heights[:, 0].min()), float(ground.first.heights[:, 1].max())
    part = tremor.part(ground.first.lattice.reshape(-1, 3))
    return None if part is None else tremor_table(part, image.size[0], heights, image.tolerance / 2 / _FINER)


def _strict(projection: Projection, ground: TileGround, boxes: Boxes) -> Positions:
    """Strict homogeneous positions of places (k, 3) in (h, v, u), 0 to 1, in the boxes numbered (k,)."""
    rects = boxes.rects[boxes.rect]
    return lambda box, fractions: projection.project_homogeneous(ground.XYZ(rects[box], boxes.heights[box], fractions))


def _verdict(
    errors: NDArray[np.float64], boxes: Boxes, tolerance: float, behind: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """Whether to halve each rectangle in u, in v, or to double its layers."""
    along_h, along_v, along_u, worst = errors.T
    bad = worst > tolerance
    if not bad.any():
        return bad, bad, bad
    width = boxes.rects[:, 2] - boxes.rects[:, 0]
    height = boxes.rects[:, 3] - boxes.rects[:, 1]
    # Halving divides a smooth residual by four: whatever has more than a third of the tolerance along it is halved.
    leading = np.maximum(np.maximum(along_u, along_v), along_h)
    share = np.minimum(tolerance / 3, leading)
    least = np.where(behind, SMALLEST_BEHIND, 1)
    split_u = bad & (along_u >= share) & (width > least)
    split_v = bad & (along_v >= share) & (height > least)
    thin = bad & ~behind & (along_h >= share) & ~(split_u | split_v) & (boxes.layers < MOST_LAYERS)
    return split_u, split_v, thin


def _finer(
    boxes: Boxes,
    keep: NDArray[np.bool_],
    split_u: NDArray[np.bool_],
    split_v: NDArray[np.bool_],
    thin: NDArray[np.bool_],
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """The rectangles that go into the next round, and their layers."""
    again, more = keep & (split_u | split_v), keep & thin
    rects = np.concatenate(
        [
            _halved(boxes.rects[again & split_u & split_v], True, True),
            _halved(boxes.rects[again & split_u & ~split_v], True, False),
            _halved(boxes.rects[again & ~split_u & split_v], False, True),
            boxes.rects[more],
        ]
    )
    split = len(rects) - int(more.sum())
    return rects, np.concatenate([np.ones(split, np.int64), 2 * boxes.layers[more]])


def _halved(rects: NDArray[np.int32], in_u: bool, in_v: bool) -> NDArray[np.int32]:
    col0, row0, col1, row1 = rects.T
    cols = [(col0, (col0 + col1) // 2), ((col0 + col1) // 2, col1)] if in_u else [(col0, col1)]
    rows = [(row0, (row0 + row1) // 2), ((row0 + row1) // 2, row1)] if in_v else [(row0, row1)]
    parts = [np.stack([c0, r0, c1, r1], axis=1) for r0, r1 in rows for c0, c1 in cols]
    return np.concatenate(parts).astype(np.int32)


class _TooManyNodes(Exception):
    """A field would need more nodes than a tile has pixels."""


def _each_pixel(
    projection: Projection, ground: TileGround, radius: int, wanted: NDArray[np.float64], longest: float
) -> Anchors | None:
    """Anchors in which each pixel is a box of its own that gives exactly the strict position of its middle.

    Its corners are strict, too: they give the scale. They are moved as a whole until their mean is the middle.
    """
    size = projection.size
    place = np.array([*CORNERS.tolist(), MIDDLE])
    parts: list[tuple[NDArray[Any], ...]] = []
    rows_at_once = max(1, AT_ONCE // max(1, ground.window.width))
    for first in range(0, ground.window.height, rows_at_once):
        row, col = np.nonzero(np.isfinite(ground.relief[first : first + rows_at_once]))
        row += first
        pixels = np.stack([col, row, col + 1, row + 1], axis=1).astype(np.int32)
        boxes = ground.boxes(pixels, np.ones(len(col), np.int64))
        xy = project(projection, boxes.lattice[:, place])
        middle = xy[:, 8:]
        reach = radius + 1.0
        inside = np.asarray((middle > -0.5 - reach) & (middle < np.array(size) - 0.5 + reach)).all(axis=(1, 2))
        xy, middle = xy[inside, :8], middle[inside]
        xy = np.where(np.asarray(np.isfinite(xy).all(axis=(1, 2), keepdims=True)), xy, middle)
        parts.append((boxes.rects[inside], boxes.heights[inside], xy + middle - xy.mean(axis=1, keepdims=True)))
    rects, heights, xy = (np.concatenate(part) for part in zip(*parts))
    of_squares: NDArray[np.bool_] = np.asarray(np.isfinite(wanted[0]))
    mine: NDArray[np.bool_] = of_squares[rects[:, 1] // SQUARE, rects[:, 0] // SQUARE]
    if not mine.any():
        return None
    along = np.stack([xy[mine][:, [1, 5]] - xy[mine][:, [0, 4]], xy[mine][:, [2, 6]] - xy[mine][:, [0, 4]]])
    scale = np.hypot(along[0], along[1])
    low, high = xy[mine].min(axis=(0, 1)), xy[mine].max(axis=(0, 1))
    source = _source_window(low, high, radius * max(1.0, float(scale.max()), longest), size)
    corners = np.ones((len(xy), 8, 3))
    corners[..., :2] = xy - np.array([source.col, source.row])
    return Anchors(
        rects=rects,
        box_start=np.arange(len(rects) + 1, dtype=np.int32),
        box_heights=heights,
        corners=corners,
        field_frame=np.zeros(5),
        field=np.empty((0, 0, 2), np.float32),
        residual=0.0,
        source_window=source,
        scales=(float(scale.min()), float(scale.max())),
    )


def _assemble(
    image: _Image,
    done: list[Piles],
    ranges: NDArray[np.float64],
    residual: float,
    radius: int,
    longest: float,
    most: int,
) -> Anchors | None:
    rects, heights, corners = (np.concatenate(part) for part in zip(*done))
    starts = [0]
    if len(rects) > 1:
        # Row by row over the tile, the boxes of a rectangle from low to high.
        order = np.lexsort((heights[:, 0], rects[:, 0], rects[:, 1]))
        rects, heights, corners = rects[order], heights[order], corners[order]
        starts += (1 + np.flatnonzero((rects[1:] != rects[:-1]).any(axis=1))).tolist()
    xy, found = _needed(image, (rects, heights, corners), ranges, radius + 2 * residual)
    if not len(xy):
        return None
    (low, high), scales, slack = found[:2].T, (float(found[2, 0]), float(found[2, 1])), 0.0
    table, origin, frame, nodes = None, np.zeros(2), np.zeros(5), np.empty((0, 0, 2), np.float32)
    tremor = image.tremor
    if tremor is not None:
        shaken = tremor.nodes(low, high)
        residual, nodes = residual * shaken.stretch + tremor.residual, shaken.nodes
        low, high = low + shaken.low, high + shaken.high
    if image.grid is not None:
        if image.grid.nodes(low, high) > most:
            raise _TooManyNodes
        table = image.grid.table(low, high)
        scales = scales[0] * max(0.0, 2.0 - image.grid.stretch), scales[1] * image.grid.stretch
        residual = residual * image.grid.stretch + table.residual
        slack = _bend_beyond(image.grid, table, xy)
        xy = image.grid.field(xy)
        low, high = np.nanmin(xy, axis=(0, 1)), np.nanmax(xy, axis=(0, 1))
        origin, nodes = table.origin, table.nodes
    source = _source_window(low, high, slack + radius * max(1.0, scales[1], longest), image.size)
    origin = np.array([source.col, source.row]) - origin
    if table is not None and image.grid is not None:
        frame = np.array([*(table.first - origin), *(1.0 / np.array(image.grid.spacing)), image.grid.stretch])
    if tremor is not None:
        frame = np.array([*(shaken.first - origin), 1.0 / tremor.spacing, 1.0, 1.0, tremor.heights[0]])
    corners /= corners[..., 2:].mean(axis=1, keepdims=True)
    corners[..., :2] -= origin * corners[..., 2:]
    return Anchors(
        rects=rects[starts],
        box_start=np.array([*starts, len(rects)], np.int32),
        box_heights=heights,
        corners=corners,
        field_frame=frame,
        field=nodes,
        residual=residual,
        source_window=source,
        scales=scales,
    )


def _needed(
    image: _Image, boxes: Piles, ranges: NDArray[np.float64], around: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What a tile needs of its source: positions of the corners of blocks with heights of their own, (k, 8, 2).

    A tile may be one box, but what it needs of the source is what its surface needs, not its box. Also the lowest and
    highest x, y and scale at these corners, (3, 2).
    """
    sides = -(-(boxes[0][:, 2:] - boxes[0][:, :2]) // SQUARE)
    xy, found = np.empty((int(sides.prod(axis=1).sum()), 8, 2)), np.array([[np.inf, -np.inf]] * 3)
    count = blocks_in_image(boxes, ranges, SQUARE, image.bounds, around, xy, found)
    return xy[:count], found


def _bend_beyond(grid: FieldGrid, table: FieldTable, xy: NDArray[np.float64]) -> float:
    """By how much the field can bend a block's edges beyond its corners, pixels.

    Linear interpolation misses a smooth function by the square of the distance, a bent one by the distance.
    """
    reach = np.ptp(xy, axis=1).max(axis=0) / np.array(grid.spacing)
    return table.residual * max(1.0, float(reach.max())) ** 2


def _source_window(low: NDArray[np.float64], high: NDArray[np.float64], margin: float, size: tuple[int, int]) -> Window:
    """Whole pixels that hold positions from `low` to `high` with a margin, cut at the image's border."""
    around = math.ceil(min(margin, 1e6)) + 2
    # Clipped before the conversion: far outside the image a position may exceed any integer.
    col0, row0 = (int(min(max(math.floor(a) - around, 0), s)) for a, s in zip(low.tolist(), size))
    col1, row1 = (int(min(max(math.ceil(a) + around + 1, 0), s)) for a, s in zip(high.tolist(), size))
    return Window(col0, row0, max(0, col1 - col0), max(0, row1 - row0))
