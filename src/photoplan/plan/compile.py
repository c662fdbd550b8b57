"""Compile the anchors of a tile: as few strict projections as the tolerance allows."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import Projection, Tremor, project, tremor_of
from photoplan.errors import UsageError
from photoplan.geometry.breaks import Breaks
from photoplan.geometry.grid import Window
from photoplan.kernels.boxes import blocks_in_image, judge_boxes
from photoplan.kernels.weights import KERNELS
from photoplan.plan.anchors import Anchors, Positions, bend_errors
from photoplan.plan.field import FieldGrid, FieldTable, field_grid
from photoplan.plan.ground import CORNERS, MIDDLE, SQUARE, Boxes, TileGround
from photoplan.plan.tremor import TremorTable, tremor_table

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
        judge_boxes(lattice, boxes.rect, image.bounds, float(rule.radius), errors, keep, behind)
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
