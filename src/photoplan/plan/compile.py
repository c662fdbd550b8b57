"""Compile the anchors of a tile: as few strict projections as the tolerance allows."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import Projection
from photoplan.errors import UsageError
from photoplan.geometry.breaks import Breaks
from photoplan.geometry.grid import Window
from photoplan.kernels.extent import height_ranges
from photoplan.plan.anchors import Anchors
from photoplan.plan.bends import bend_errors
from photoplan.plan.field import FieldGrid, field_grid
from photoplan.plan.source_window import bend_beyond, blocks_of, scales_of, source_window
from photoplan.targets.base import Target

#: A rectangle that still reaches behind the camera at this side is left out, pixels.
SMALLEST_BEHIND = 4
#: More layers than this over one rectangle do not pay; the residual that is left is reported.
MOST_LAYERS = 64

# The 3 × 3 × 3 lattice of a box in (h, v, u): eight corners, and the nineteen probes between them.
_LATTICE = np.array(list(itertools.product((0.0, 0.5, 1.0), repeat=3)))
_IS_CORNER = (_LATTICE != 0.5).all(axis=1)
_CORNERS = _LATTICE[_IS_CORNER]
_PROBES = _LATTICE[~_IS_CORNER]
# Trilinear weights of the corners (4·ih + 2·iv + iu) at each probe.
_WEIGHTS = np.where(_CORNERS[None] == 1.0, _PROBES[:, None], 1.0 - _PROBES[:, None]).prod(axis=2)
# Middles of the four edges along h, v and u: what they miss tells which way to split.
_EDGES = [(_PROBES[:, axis] == 0.5) & ((_PROBES == 0.5).sum(axis=1) == 1) for axis in range(3)]


@dataclass(frozen=True)
class AnchorRule:
    """How finely a tile is cut."""

    tolerance: float
    """Largest residual of anchors and field together that is accepted, pixels of the source image."""
    radius: int
    """Half the support of the resampling kernel at scale 1, pixels: what the source window adds all round."""
    reduces: bool = True
    """Whether a source that is much finer than the target is read reduced; not if grey values must stay as they are."""

    def __post_init__(self) -> None:
        if not self.tolerance > 0:
            raise UsageError(f"tolerance {self.tolerance} px; a positive number is needed (default 0.02)")

    def level(self, anchors: Anchors) -> int:
        """How often a source is halved before it is resampled.

        At least two pixels of the reduced source stay for every target pixel, also where the source is coarsest: the
        kernel, widened to them, decides what the product looks like, not the means before it.
        """
        finer = anchors.scales[0] / 2.0
        return int(math.log2(finer)) if self.reduces and finer >= 2.0 else 0


@dataclass
class _Work:
    """Rectangles under test, each a pile of `layers` boxes of equal thickness."""

    rects: NDArray[np.int32]
    heights: NDArray[np.float64]
    layers: NDArray[np.int64]


@dataclass(frozen=True)
class _Image:
    """The image as the anchors see it: ideal positions."""

    size: tuple[int, int]
    grid: FieldGrid | None
    tolerance: float
    """What of the tolerance is left for the anchors, in ideal pixels."""

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """x_min, y_min, x_max, y_max of all that lies in the image."""
        return (-0.5, -0.5, self.size[0] - 0.5, self.size[1] - 0.5) if self.grid is None else self.grid.bounds


@dataclass(frozen=True)
class _Mapping:
    """From places in boxes to the image."""

    projection: Projection
    target: Target
    window: Window

    def at(
        self, rects: NDArray[np.int32], heights: NDArray[np.float64], fractions: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Strict homogeneous positions of places (..., 3) in (h, v, u), 0 to 1, of boxes (..., 4) and (..., 2)."""
        fh, fv, fu = np.moveaxis(fractions, -1, 0)
        u = rects[..., 0] - 0.5 + fu * (rects[..., 2] - rects[..., 0]) + self.window.col
        v = rects[..., 1] - 0.5 + fv * (rects[..., 3] - rects[..., 1]) + self.window.row
        h = heights[..., 0] + fh * (heights[..., 1] - heights[..., 0])
        return self.projection.project_homogeneous(self.target.to_ground(np.stack([u, v, h], axis=-1)))

    def places(
        self, rects: NDArray[np.int32], heights: NDArray[np.float64]
    ) -> Callable[[NDArray[np.int64], NDArray[np.float64]], NDArray[np.float64]]:
        """The same of places (k, 3) in the boxes numbered (k,) of some."""
        return lambda box, fractions: self.at(rects[box], heights[box], fractions)


def compile_anchors(
    projection: Projection,
    target: Target,
    window: Window,
    relief: NDArray[np.float32],
    rule: AnchorRule,
    wanted: NDArray[np.float32] | None = None,
) -> Anchors | None:
    """Cut a tile into boxes whose trilinear homogeneous interpolation meets the tolerance, and tabulate the field.

    Parameters
    ----------
    projection : Projection
        The source; its first factor is called on a few thousand points at most.
    target : Target
        Where (u, v, h) lies on the ground.
    window : Window
        The tile, in the target's pixels.
    relief : ndarray, shape (height, width), float32
        h of every pixel of the tile; NaN where there is no surface.
    rule : AnchorRule
        Tolerance and kernel radius. A field gets half of the tolerance; what it leaves is the anchors'.
    wanted : ndarray, shape (height, width), float32, optional
        The relief of those pixels that the source is to paint, NaN elsewhere: they decide what is read of it, and
        nothing else, so that a pixel keeps its position whoever paints the pixels beside it.

    Returns
    -------
    Anchors or None
        None if no pixel that is wanted can lie in the image.
    """
    image = _Image(projection.size, None, rule.tolerance)
    if projection.field is not None:
        grid = field_grid(projection.field, projection.size, rule.tolerance / 2)
        image = _Image(projection.size, grid, (rule.tolerance - min(grid.miss, rule.tolerance / 2)) / grid.stretch)
    mapping = _Mapping(projection, target, window)
    work = _with_heights(_first_rects(window, target.breaks), relief)
    done: list[tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.float64]]] = []
    residual = 0.0
    while len(work.rects):
        lattice, owner, bounds = _project(mapping, work)
        keep, behind = _in_front(lattice, owner, len(work.rects))
        errors = _errors(lattice, owner, len(work.rects))
        if projection.breaks is not None:
            bends = bend_errors(projection.breaks, lattice[:, _IS_CORNER], mapping.places(work.rects[owner], bounds))
            np.maximum.at(errors, owner, bends)
        keep &= _touches_image(image, lattice, owner, rule.radius + 2 * errors[:, 3]) | behind
        errors[behind] = np.inf
        split_u, split_v, thin = _verdict(errors, work, image.tolerance, behind)
        settled = keep & ~(split_u | split_v | thin) & ~behind
        if settled.any():
            box = settled[owner]
            order = np.argsort(owner[box], kind="stable")
            done.append(
                (
                    np.repeat(work.rects, work.layers, axis=0)[box][order],
                    bounds[box][order],
                    lattice[box][:, _IS_CORNER][order],
                )
            )
            residual = max(residual, float(errors[settled].max()))
        work = _next(work, relief, keep, split_u, split_v, thin)
    return _assemble(image, done, relief if wanted is None else wanted, residual, rule.radius) if done else None


def _first_rects(window: Window, breaks: Breaks | None) -> NDArray[np.int32]:
    """The tile, cut where its target is bent: a pixel that a break crosses is alone between smooth rectangles."""
    places = ((), ()) if breaks is None else (breaks.columns, breaks.rows)
    cuts = []
    for at, first, count in zip(places, (window.col, window.row), (window.width, window.height)):
        edges = np.asarray(at, float) + 0.5 - first
        cuts.append(np.unique(np.clip(np.r_[0, np.floor(edges), np.ceil(edges), count], 0, count)).astype(np.int32))
    (c0, r0), (c1, r1) = (np.meshgrid(*(cut[part] for cut in cuts)) for part in (slice(-1), slice(1, None)))
    return np.stack([c0.ravel(), r0.ravel(), c1.ravel(), r1.ravel()], axis=1)


def _with_heights(
    rects: NDArray[np.int32], relief: NDArray[np.float32], layers: NDArray[np.int64] | None = None
) -> _Work:
    """Give rectangles their own height range and drop those without a surface."""
    heights = height_ranges(relief, rects)
    there = np.isfinite(heights).all(axis=1)
    heights = heights[there]
    # A flat rectangle still needs a box with a thickness to divide by; float32 relief is only good to ~1e-7 of itself.
    pad = 0.01 + 1e-6 * np.abs(heights).max(axis=1, initial=0.0)
    heights = heights + np.stack([-pad, pad], axis=1)
    count = np.ones(len(rects), np.int64) if layers is None else layers
    return _Work(rects[there], heights, count[there])


def _project(mapping: _Mapping, work: _Work) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Strict homogeneous projection of every box's lattice: (boxes, 27, 3), its rectangle, its heights."""
    owner = np.repeat(np.arange(len(work.rects)), work.layers)
    layer = np.arange(len(owner)) - np.repeat(np.cumsum(work.layers) - work.layers, work.layers)
    low, high = work.heights[owner].T
    step = (high - low) / work.layers[owner]
    bottom = low + layer * step
    # The last layer ends exactly where the rectangle does.
    top = np.where(layer == work.layers[owner] - 1, high, bottom + step)
    bounds = np.stack([bottom, top], axis=1)
    return mapping.at(work.rects[owner][:, None], bounds[:, None], _LATTICE), owner, bounds


def _any_per_rect(flags: Any, owner: NDArray[np.int64], n: int) -> NDArray[np.bool_]:
    return np.bincount(owner, weights=flags, minlength=n) > 0


def _in_front(
    lattice: NDArray[np.float64], owner: NDArray[np.int64], n: int
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which rectangles have anything in front of the camera, and which reach behind it."""
    front = (lattice[..., 2] > 0) & np.isfinite(lattice).all(axis=-1)
    some = _any_per_rect(front.any(axis=1), owner, n)
    behind = _any_per_rect(~front.all(axis=1), owner, n)
    return some, behind & some


def _touches_image(
    image: _Image, lattice: NDArray[np.float64], owner: NDArray[np.int64], slack: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Which rectangles' corners, widened by `slack` pixels, span a part of the image.

    With w > 0 the corners bound the interpolation; the strict positions lie beside it by the residual, which is part of
    the slack.
    """
    corners = lattice[:, _IS_CORNER] if lattice.shape[1] == len(_IS_CORNER) else lattice
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = corners[..., 0] / corners[..., 2], corners[..., 1] / corners[..., 2]
    around = slack[owner]
    left, top, right, bottom = image.bounds
    inside = (
        (x.max(axis=1) >= left - around)
        & (x.min(axis=1) <= right + around)
        & (y.max(axis=1) >= top - around)
        & (y.min(axis=1) <= bottom + around)
    )
    return _any_per_rect(inside, owner, len(slack))


def _errors(lattice: NDArray[np.float64], owner: NDArray[np.int64], n: int) -> NDArray[np.float64]:
    """Residual in pixels per rectangle: worst probe along h, v, u, and worst of all; shape (n, 4)."""
    corners, probes = lattice[:, _IS_CORNER], lattice[:, ~_IS_CORNER]
    with np.errstate(divide="ignore", invalid="ignore"):
        between = np.einsum("pc,ncj->npj", _WEIGHTS, corners)
        miss = np.hypot(*np.moveaxis(between[..., :2] / between[..., 2:] - probes[..., :2] / probes[..., 2:], -1, 0))
    columns = [miss[:, edge].max(axis=1) for edge in _EDGES] + [miss.max(axis=1)]
    worst = np.zeros((n, 4))
    np.maximum.at(worst, owner, np.nan_to_num(np.stack(columns, axis=1), nan=np.inf))
    return worst


def _verdict(
    errors: NDArray[np.float64], work: _Work, tolerance: float, behind: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """Whether to halve each rectangle in u, in v, or to double its layers."""
    along_h, along_v, along_u, worst = errors.T
    bad = worst > tolerance
    width = work.rects[:, 2] - work.rects[:, 0]
    height = work.rects[:, 3] - work.rects[:, 1]
    # Halving divides a smooth residual by four: whatever has more than a third of the tolerance along it is halved.
    leading = np.maximum(np.maximum(along_u, along_v), along_h)
    share = np.minimum(tolerance / 3, leading)
    least = np.where(behind, SMALLEST_BEHIND, 1)
    split_u = bad & (along_u >= share) & (width > least)
    split_v = bad & (along_v >= share) & (height > least)
    thin = bad & ~behind & (along_h >= share) & ~(split_u | split_v) & (work.layers < MOST_LAYERS)
    return split_u, split_v, thin


def _next(
    work: _Work,
    relief: NDArray[np.float32],
    keep: NDArray[np.bool_],
    split_u: NDArray[np.bool_],
    split_v: NDArray[np.bool_],
    thin: NDArray[np.bool_],
) -> _Work:
    """The rectangles that go into the next round."""
    again = keep & (split_u | split_v)
    rects = np.concatenate(
        [
            _halved(work.rects[again & split_u & split_v], True, True),
            _halved(work.rects[again & split_u & ~split_v], True, False),
            _halved(work.rects[again & ~split_u & split_v], False, True),
            work.rects[keep & thin],
        ]
    )
    split = len(rects) - int((keep & thin).sum())
    layers = np.concatenate([np.ones(split, np.int64), 2 * work.layers[keep & thin]])
    return _with_heights(rects, relief, layers)


def _halved(rects: NDArray[np.int32], in_u: bool, in_v: bool) -> NDArray[np.int32]:
    col0, row0, col1, row1 = rects.T
    cols = [(col0, (col0 + col1) // 2), ((col0 + col1) // 2, col1)] if in_u else [(col0, col1)]
    rows = [(row0, (row0 + row1) // 2), ((row0 + row1) // 2, row1)] if in_v else [(row0, row1)]
    parts = [np.stack([c0, r0, c1, r1], axis=1) for r0, r1 in rows for c0, c1 in cols]
    return np.concatenate(parts).astype(np.int32)


def _assemble(
    image: _Image,
    done: list[tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.float64]]],
    relief: NDArray[np.float32],
    residual: float,
    radius: int,
) -> Anchors | None:
    box_rects = np.concatenate([d[0] for d in done])
    box_heights = np.concatenate([d[1] for d in done])
    corners = np.concatenate([d[2] for d in done])
    # Row by row over the tile, the boxes of a rectangle from low to high.
    order = np.lexsort((box_heights[:, 0], box_rects[:, 0], box_rects[:, 1]))
    box_rects, box_heights, corners = box_rects[order], box_heights[order], corners[order]
    first = np.flatnonzero(np.r_[True, (np.diff(box_rects, axis=0) != 0).any(axis=1)])
    blocks, block_corners = blocks_of(box_rects, box_heights, corners, relief)
    inside = _touches_image(image, block_corners, np.arange(len(blocks)), np.full(len(blocks), radius + 2 * residual))
    if not inside.any():
        return None
    xy = block_corners[inside, :, :2] / block_corners[inside, :, 2:]
    scales = scales_of(blocks[inside], block_corners[inside])
    table, origin, frame = None, np.zeros(2), np.zeros(5)
    slack = 0.0
    if image.grid is not None:
        table = image.grid.table(xy.min(axis=(0, 1)), xy.max(axis=(0, 1)))
        scales = scales[0] * max(0.0, 2.0 - image.grid.stretch), scales[1] * image.grid.stretch
        residual = residual * image.grid.stretch + table.residual
        slack = bend_beyond(image.grid, table, xy)
        xy = image.grid.field(xy)
        origin = table.origin
    source = source_window(xy, slack + radius * max(1.0, scales[1]), image.size)
    origin = np.array([source.col, source.row]) - origin
    if table is not None and image.grid is not None:
        frame = np.array([*(table.first - origin), *(1.0 / np.array(image.grid.spacing)), image.grid.stretch])
    corners = corners / corners[..., 2:].mean(axis=1, keepdims=True)
    corners[..., :2] -= origin * corners[..., 2:]
    return Anchors(
        rects=np.ascontiguousarray(box_rects[first]),
        box_start=np.r_[first, len(box_rects)].astype(np.int32),
        box_heights=np.ascontiguousarray(box_heights),
        corners=np.ascontiguousarray(corners),
        field_frame=frame,
        field=np.empty((0, 0, 2), np.float32) if table is None else table.nodes,
        residual=residual,
        source_window=source,
        scales=scales,
    )
