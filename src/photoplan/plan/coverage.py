"""Where an image lies on the map, before any tile is compiled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import CentralCamera, Projection, project
from photoplan.geometry.grid import MapGrid, Window
from photoplan.surfaces.base import Surface
from photoplan.surfaces.intersect import intersect

#: Points per side of the lattice on which coverage is sampled.
LATTICE = 192
#: A tile this far beside the image is not compiled, pixels.
SLACK = 16.0


@dataclass(frozen=True, eq=False)
class Coverage:
    """What one image sees of the surface."""

    outline: NDArray[np.float64]
    """Footprint: ground points X, Y, Z of the image's border, shape (n, 3); NaN where the ray meets no surface."""
    bounds: tuple[float, float, float, float] | None
    """Map bounds xmin, ymin, xmax, ymax of everything the image sees of the surface; None: nothing."""
    on_surface: float
    """Part of the image's border points and middle whose rays meet the surface, 0 to 1."""


def image_border(size: tuple[int, int], per_side: int = 16) -> NDArray[np.float64]:
    """Points along the outer edge of an image, clockwise from the upper-left corner, shape (4·per_side, 2), pixels."""
    width, height = size
    t = np.arange(per_side) / per_side
    left, top, right, bottom = -0.5, -0.5, width - 0.5, height - 0.5
    ones = np.ones(per_side)
    sides = [
        np.stack([left + t * width, top * ones], axis=1),
        np.stack([right * ones, top + t * height], axis=1),
        np.stack([right - t * width, bottom * ones], axis=1),
        np.stack([left * ones, bottom - t * height], axis=1),
    ]
    return np.concatenate(sides)


def cover(camera: CentralCamera, surface: Surface, terrain_bounds: tuple[float, float, float, float]) -> Coverage:
    """Footprint of an image on a surface.

    Parameters
    ----------
    camera : CentralCamera
    surface : Surface
    terrain_bounds : (float, float, float, float)
        Where the surface may be, in the product's CRS: rays are not followed beyond it.

    Returns
    -------
    Coverage
        Its `bounds` come from a lattice over the terrain around the footprint, projected into the image, so that
        they hold also where the surface is rough, has holes or ends inside the image.
    """
    heights = surface.height_range(terrain_bounds)
    border = np.concatenate([image_border(camera.size), [[(s - 1) / 2 for s in camera.size]]])
    outline = intersect(camera, border, surface, heights)
    on_surface = float(np.isfinite(outline[:, 0]).mean())
    bounds = _seen_bounds(camera, surface, terrain_bounds)
    return Coverage(outline[:-1], bounds, on_surface)


def _seen_bounds(
    camera: CentralCamera, surface: Surface, search: tuple[float, float, float, float]
) -> tuple[float, float, float, float] | None:
    """Bounds of the lattice points that fall into the image, refined until they no longer shrink much."""
    bounds: tuple[float, float, float, float] | None = search
    for _ in range(6):
        assert bounds is not None
        seen = _one_look(camera, surface, bounds)
        if seen is None:
            return None
        shrunk = (seen[2] - seen[0]) * (seen[3] - seen[1]) / ((bounds[2] - bounds[0]) * (bounds[3] - bounds[1]))
        bounds = seen
        if shrunk > 0.7:
            break
    return bounds


def _one_look(
    camera: CentralCamera, surface: Surface, bounds: tuple[float, float, float, float]
) -> tuple[float, float, float, float] | None:
    xmin, ymin, xmax, ymax = bounds
    x, y = np.linspace(xmin, xmax, LATTICE), np.linspace(ymin, ymax, LATTICE)
    XY = np.stack(np.meshgrid(x, y), axis=-1)
    inside = _inside(camera, np.concatenate([XY, surface.heights(XY)[..., None]], axis=-1))
    if not inside.any():
        # The footprint may fall between the lattice points: look where the middle of the image would be.
        return _around_nadir(camera, surface, bounds)
    rows, cols = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    # A corner of the image is narrow at its tip: the outermost lattice point inside can be two steps away from it.
    dx, dy = 2 * (x[1] - x[0]), 2 * (y[1] - y[0])
    return (
        max(xmin, float(x[cols[0]] - dx)),
        max(ymin, float(y[rows[0]] - dy)),
        min(xmax, float(x[cols[-1]] + dx)),
        min(ymax, float(y[rows[-1]] + dy)),
    )


def _around_nadir(
    camera: CentralCamera, surface: Surface, bounds: tuple[float, float, float, float]
) -> tuple[float, float, float, float] | None:
    border = intersect(camera, image_border(camera.size), surface, surface.height_range(bounds))
    there = border[np.isfinite(border[:, 0])]
    if not len(there):
        return None
    low, high = there[:, :2].min(axis=0), there[:, :2].max(axis=0)
    margin = 0.25 * float((high - low).max()) + 1e-3
    left, bottom, right, top = (float(a) for a in (*(low - margin), *(high + margin)))
    smaller = (left, bottom, right, top)
    return smaller if (smaller[2] - smaller[0]) < 0.5 * (bounds[2] - bounds[0]) else None


def _inside(camera: Projection, XYZ: NDArray[np.float64]) -> NDArray[np.bool_]:
    xy = project(camera, XYZ)
    width, height = camera.size
    with np.errstate(invalid="ignore"):
        return (xy[..., 0] >= -0.5) & (xy[..., 0] <= width - 0.5) & (xy[..., 1] >= -0.5) & (xy[..., 1] <= height - 0.5)


def covered_tiles(camera: Projection, surface: Surface, grid: MapGrid, tiles: list[Window]) -> list[bool]:
    """Which tiles can hold a pixel of the image, judged from the heights' range under each tile.

    A tile is a box in X, Y and height, sampled by a lattice on its top and bottom. If the whole lattice lies beyond
    the same side of the image, nothing inside does: collinearity maps the box into the hull of its corners, and what
    a lens bends between two points of the lattice stays far below `SLACK`.
    """
    ranges = np.array([surface.height_range(grid.bounds_of(tile)) for tile in tiles])
    bounds = np.array([grid.bounds_of(tile) for tile in tiles])
    t = np.linspace(0, 1, 5)
    x = bounds[:, :1] + t * (bounds[:, 2] - bounds[:, 0])[:, None]
    y = bounds[:, 1:2] + t * (bounds[:, 3] - bounds[:, 1])[:, None]
    lattice = np.empty((len(tiles), 2, 5, 5, 3))
    lattice[..., 0] = x[:, None, None, :]
    lattice[..., 1] = y[:, None, :, None]
    lattice[..., 2] = ranges[:, :, None, None]
    xy = project(camera, lattice.reshape(len(tiles), -1, 3))
    front = np.asarray(np.isfinite(xy).all(axis=-1))
    with np.errstate(invalid="ignore"):
        near = (xy.max(axis=1) >= -SLACK).all(axis=-1) & (xy.min(axis=1) <= np.array(camera.size) + SLACK).all(axis=-1)
    # A box that reaches behind the camera is looked at when it is compiled.
    partly = front.any(axis=1) & ~front.all(axis=1)
    keep = np.isfinite(ranges).all(axis=1) & ((front.all(axis=1) & near) | partly)
    return keep.tolist()
