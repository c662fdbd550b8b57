"""Compile the anchors of a tile: as few strict projections as the tolerance allows."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import Camera
from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.kernels.extent import height_ranges
from photoplan.plan.anchors import Anchors
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
    """Largest residual of the anchors that is accepted, pixels of the source image."""
    radius: int
    """Half the support of the resampling kernel at scale 1, pixels: what the source window adds all round."""
    cell: int
    """Side of the first rectangles, target pixels; halved where the residual asks for it."""
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


def compile_anchors(
    camera: Camera, target: Target, window: Window, relief: NDArray[np.float32], rule: AnchorRule
) -> Anchors | None:
    """Cut a tile into boxes whose trilinear homogeneous interpolation meets the tolerance.

    Parameters
    ----------
    camera : Camera
        The source; called on a few thousand points at most.
    target : Target
        Where (u, v, h) lies on the ground.
    window : Window
        The tile, in the target's pixels.
    relief : ndarray, shape (height, width), float32
        h of every pixel of the tile; NaN where there is no surface.
    rule : AnchorRule
        Tolerance, kernel radius and first cell.

    Returns
    -------
    Anchors or None
        None if no pixel of the tile can lie in the image.
    """
    work = _with_heights(_first_rects(window, rule.cell), relief)
    done: list[tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.float64]]] = []
    residual = 0.0
    while len(work.rects):
        lattice, owner, bounds = _project(camera, target, window, work)
        keep, behind = _in_front(lattice, owner, len(work.rects))
        errors = _errors(lattice, owner, len(work.rects))
        keep &= _touches_image(camera, lattice, owner, rule.radius + 2 * errors[:, 3]) | behind
        errors[behind] = np.inf
        split_u, split_v, thin = _verdict(errors, work, rule.tolerance, behind)
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
    if not done:
        return None
    return _assemble(camera, done, residual, rule.radius)


def initial_cell(camera: Camera, target: Target, uv: ArrayLike, height: float, side: int, rule: AnchorRule) -> int:
    """Side of the cells that flat ground needs near (u, v), so that tiles need not find it again by halving.

    It depends on the camera and the target alone, not on the order in which tiles are computed, so that every run
    gives the same bytes.
    """
    u, v = (int(a) for a in np.asarray(uv, float))
    window = Window(u - side // 2, v - side // 2, side, side)
    flat = np.full((side, side), height, np.float32)
    anchors = compile_anchors(camera, target, window, flat, rule)
    if anchors is None:
        return side
    sides = np.sort(anchors.rects[:, 2] - anchors.rects[:, 0])
    # The side that half of the area needs: starting with it costs the fewest projections.
    half = np.searchsorted(np.cumsum(sides.astype(float) ** 2), 0.5 * float((sides.astype(float) ** 2).sum()))
    return int(sides[half])


def _first_rects(window: Window, cell: int) -> NDArray[np.int32]:
    col = np.arange(0, window.width, max(cell, 1))
    row = np.arange(0, window.height, max(cell, 1))
    c, r = (g.ravel() for g in np.meshgrid(col, row))
    ends = np.minimum(c + cell, window.width), np.minimum(r + cell, window.height)
    return np.stack([c, r, *ends], axis=1).astype(np.int32)


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


def _project(
    camera: Camera, target: Target, window: Window, work: _Work
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Strict homogeneous projection of every box's lattice: (boxes, 27, 3), its rectangle, its heights."""
    owner = np.repeat(np.arange(len(work.rects)), work.layers)
    layer = np.arange(len(owner)) - np.repeat(np.cumsum(work.layers) - work.layers, work.layers)
    low, high = work.heights[owner].T
    step = (high - low) / work.layers[owner]
    bottom = low + layer * step
    # The last layer ends exactly where the rectangle does.
    top = np.where(layer == work.layers[owner] - 1, high, bottom + step)
    rect = work.rects[owner].astype(float)
    fh, fv, fu = _LATTICE.T
    u = rect[:, :1] - 0.5 + fu * (rect[:, 2:3] - rect[:, :1]) + window.col
    v = rect[:, 1:2] - 0.5 + fv * (rect[:, 3:] - rect[:, 1:2]) + window.row
    h = bottom[:, None] + fh * (top - bottom)[:, None]
    lattice = camera.project_homogeneous(target.to_ground(np.stack([u, v, h], axis=-1)))
    return lattice, owner, np.stack([bottom, top], axis=1)


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
    camera: Camera, lattice: NDArray[np.float64], owner: NDArray[np.int64], slack: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Which rectangles' corners, widened by `slack` pixels, span a part of the image.

    With w > 0 the corners bound the interpolation; the strict positions lie beside it by the residual, which is part of
    the slack.
    """
    corners = lattice[:, _IS_CORNER]
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = corners[..., 0] / corners[..., 2], corners[..., 1] / corners[..., 2]
    around = slack[owner]
    width, height = camera.size
    inside = (
        (x.max(axis=1) >= -0.5 - around)
        & (x.min(axis=1) <= width - 0.5 + around)
        & (y.max(axis=1) >= -0.5 - around)
        & (y.min(axis=1) <= height - 0.5 + around)
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
    camera: Camera,
    done: list[tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.float64]]],
    residual: float,
    radius: int,
) -> Anchors:
    box_rects = np.concatenate([d[0] for d in done])
    box_heights = np.concatenate([d[1] for d in done])
    corners = np.concatenate([d[2] for d in done])
    # Row by row over the tile, the boxes of a rectangle from low to high.
    order = np.lexsort((box_heights[:, 0], box_rects[:, 0], box_rects[:, 1]))
    box_rects, box_heights, corners = box_rects[order], box_heights[order], corners[order]
    first = np.flatnonzero(np.r_[True, (np.diff(box_rects, axis=0) != 0).any(axis=1)])
    scales = _scales(box_rects, corners)
    xy = corners[..., :2] / corners[..., 2:]
    low, high = xy.min(axis=(0, 1)), xy.max(axis=(0, 1))
    margin = int(np.ceil(radius * max(1.0, scales[1]))) + 2
    width, height = camera.size
    # Clipped before the conversion: far outside the image a position may exceed any integer.
    col0, row0 = (int(np.clip(np.floor(a) - margin, 0, s)) for a, s in zip(low, (width, height)))
    col1, row1 = (int(np.clip(np.ceil(a) + margin + 1, 0, s)) for a, s in zip(high, (width, height)))
    source = Window(col0, row0, max(0, col1 - col0), max(0, row1 - row0))
    corners = corners / corners[..., 2:].mean(axis=1, keepdims=True)
    corners[..., 0] -= source.col * corners[..., 2]
    corners[..., 1] -= source.row * corners[..., 2]
    return Anchors(
        rects=np.ascontiguousarray(box_rects[first]),
        box_start=np.r_[first, len(box_rects)].astype(np.int32),
        box_heights=np.ascontiguousarray(box_heights),
        corners=np.ascontiguousarray(corners),
        residual=residual,
        source_window=source,
        scales=scales,
    )


def _scales(rects: NDArray[np.int32], corners: NDArray[np.float64]) -> tuple[float, float]:
    """Smallest and largest length of (∂x/∂u, ∂x/∂v) and (∂y/∂u, ∂y/∂v) at the corners, pixels per pixel."""
    c = corners.reshape(-1, 2, 2, 2, 3)
    width = (rects[:, 2] - rects[:, 0]).astype(float)[:, None, None, None]
    height = (rects[:, 3] - rects[:, 1]).astype(float)[:, None, None, None]
    du = np.repeat(np.diff(c, axis=3), 2, axis=3) / width[..., None]
    dv = np.repeat(np.diff(c, axis=2), 2, axis=2) / height[..., None]
    w = c[..., 2:]
    xy = c[..., :2] / w
    slope_u = (du[..., :2] - xy * du[..., 2:]) / w
    slope_v = (dv[..., :2] - xy * dv[..., 2:]) / w
    lengths = np.hypot(slope_u, slope_v)
    return float(lengths.min()), float(lengths.max())
