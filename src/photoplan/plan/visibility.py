"""Which pixels of a tile a source sees: lines of sight through the product's own coordinates.

A line of sight is where (u, v, h) keeps its image position. For a source at a point over a map it is straight, and its
direction at a pixel, times the depth, is linear in (u, v, h): a few nodes tell all directions of a tile. Posts of the
terrain below the tile and around it, as far as anything there can be in the way, decide, however coarse the product is;
lines that leave that part too low are followed to the terrain itself. A product's depth grows towards whoever looks at
it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import Projection, project, steady
from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.kernels.pyramid import pyramid_of
from photoplan.kernels.visibility import BEYOND, HIDDEN, SEEN, find_behind, find_hidden, quiet_blocks
from photoplan.plan.ground import TileGround
from photoplan.surfaces.base import Surface, Terrain
from photoplan.surfaces.lattice import Lattice
from photoplan.surfaces.objects import ObjectSurface, RaisedSurface, without_objects
from photoplan.targets.base import Target
from photoplan.targets.map import MapTarget

#: Nodes of directions along a side of a tile.
_NODES = 5
#: Posts along a side of what is looked at together, and around that to each side; longer lines are followed to the
#: terrain itself.
MOST_POSTS, MOST_AROUND = 768, 512
#: Fewer nodes do not tell how lines change over a tile.
_LEAST_NODES = 4
#: Points from which derivatives of the projection are taken are so far apart, pixels.
_STEP = 8.0
#: The same where these are not in the image's range.
_NARROW = 0.1
#: A source is at a point only if that is less than this many pixels away; else its lines of sight are parallel.
_FAR = 1e8
#: No line is followed further than this, pixels.
_MOST_PIXELS = 1e6
#: What is met no further than this before a place is the place itself, pixels or posts.
_SHORT = 0.1
#: The same of posts that a place lies between, which are known better: to rounding.
_BESIDE = 0.01
#: Lines that are followed at once.
_BATCH = 200_000


@dataclass(frozen=True, eq=False)
class SightLines:
    """Directions from places of a product to a source."""

    step: NDArray[np.float64]
    """Change of (u, v, h) along the line, shape (..., 3)."""
    depth: NDArray[np.float64]
    """Depth of the place and by how much a step lessens it, shape (..., 2): the source is their quotient in steps away.
    The second is zero where lines are parallel; a depth that is not positive lies behind the source."""

    @property
    def length(self) -> NDArray[np.float64]:
        """Steps to the source, shape (...); infinite where lines are parallel."""
        with np.errstate(divide="ignore"):
            return np.abs(self.depth[..., 0] / self.depth[..., 1])

    @property
    def nodes(self) -> NDArray[np.float64]:
        """Both, shape (..., 5)."""
        return np.concatenate([self.step, self.depth], axis=-1)


def sight_lines(projection: Projection, target: Target, uvh: NDArray[np.float64]) -> SightLines:
    """Directions in which the image position of places (..., 3) stays the same, towards the source.

    Of a turbulent flight those without tremor, which moves positions in the image, but not the place that sees.

    With homogeneous positions (X, Y, w) and their gradients they are w ∇X×∇Y + X ∇Y×∇w + Y ∇w×∇X, which for a central
    projection is linear in (u, v, h) and points to the centre.
    """
    projection = steady(projection)
    metre = np.linalg.norm(target.to_ground(uvh + np.array([1.0, 0, 0])) - target.to_ground(uvh), axis=-1)
    pixel = np.stack(np.broadcast_arrays(1.0, 1.0, metre), axis=-1)
    offsets = np.eye(3)[:, None] * np.array([-1.0, 1.0])[:, None] * pixel[..., None, None, :]
    slopes = np.full((*uvh.shape, 3), np.nan)
    for apart in (_STEP, _NARROW):
        # Where polynomials or a flight end, what lies close by is still known.
        lost = ~np.isfinite(slopes).all(axis=(-1, -2))
        if lost.any():
            places = uvh[lost][:, None, None] + apart * offsets[lost]
            ends = projection.project_homogeneous(target.to_ground(places))
            slopes[lost] = (ends[..., 1, :] - ends[..., 0, :]) / (2 * apart * pixel[lost][..., None])
    # Gradients of X, Y and w by (u, v, h), which is the axis that held the offsets.
    dX, dY, dw = np.moveaxis(slopes, -1, 0)
    X, Y, w = np.moveaxis(projection.project_homogeneous(target.to_ground(uvh)), -1, 0)
    step = w[..., None] * np.cross(dX, dY) + X[..., None] * np.cross(dY, dw) + Y[..., None] * np.cross(dw, dX)
    step /= np.nanmax(np.abs(step), initial=1e-300)
    nearing = -(dw * step).sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = np.abs(w / nearing) * np.linalg.norm(step / pixel, axis=-1)
    known = pixels[np.isfinite(pixels)]
    parallel = not (len(known) and np.median(known) < _FAR)
    sign = np.where(step[..., 2] < 0 if parallel else nearing * w < 0, -1.0, 1.0)
    depth = np.stack([w, np.zeros_like(w) if parallel else sign * nearing], axis=-1)
    return SightLines(sign[..., None] * step, depth)


def hidden_pixels(projection: Projection, ground: TileGround, surface: Surface) -> NDArray[np.bool_]:
    """Pixels of a tile that lie in the image, but that something hides."""
    window, target = ground.window, ground.target
    none = np.zeros((window.height, window.width), bool)
    low, high = float(ground.ranges[0].min()), float(ground.ranges[1].max())
    if not low <= high:
        return none
    if not isinstance(target, MapTarget):
        raise UsageError(f"visibility over {type(target).__name__}; it is known for maps")
    pad = 0.01 + 1e-6 * max(abs(low), abs(high))
    levels = low - pad, high + pad
    lines = _lines_over(projection, target, window, levels)
    if lines is None or not (lines.depth[..., 0] > 0).any():
        return none
    # Over a map every surface is terrain.
    whole: Any = surface.surface if isinstance(surface, RaisedSurface) else surface
    terrain = without_objects(whole)
    over = _OverTerrain(projection, target, terrain, levels)
    found = np.zeros(none.shape, np.uint8)
    for part in window.tiles(max(1, int(MOST_POSTS / terrain.lattice(target.grid, window).per_pixel))):
        at = part.slices(window)
        toward = lines if part == window else _lines_over(projection, target, part, levels)
        if toward is not None:
            found[at] = over.behind(part, np.ascontiguousarray(ground.relief[at]), toward)
    if isinstance(whole, ObjectSurface):
        local, cells, origin = whole.faces.in_cells
        x, y = (target.grid.to_map((window.col, window.row)) - origin[:2]).tolist()
        frame = x, y, target.grid.resolution
        find_behind(local, cells, frame, ground.relief, lines.nodes, levels, _SHORT * target.grid.resolution, found)
    hidden = found == HIDDEN
    there = np.argwhere(hidden)
    xy = project(projection, target.to_ground(_places(window, ground.relief, there)))
    hidden[tuple(there.T)] = ((xy >= -0.5) & (xy <= np.array(projection.size) - 0.5)).all(axis=-1)
    return hidden


@dataclass(frozen=True, eq=False)
class _OverTerrain:
    """Lines of sight from a map to a source, over terrain."""

    projection: Projection
    target: MapTarget
    terrain: Terrain
    levels: tuple[float, float]
    """Heights of the nodes of lines of sight."""

    def behind(self, window: Window, relief: NDArray[np.float32], lines: SightLines) -> NDArray[np.uint8]:
        """`HIDDEN` for the pixels of a window that terrain hides, else `SEEN`; `lines` at the nodes of the window."""
        top, needed = _search(self.terrain, self.target, window, lines, self.levels)
        lattice, m = self.terrain.lattice(self.target.grid, window), MOST_AROUND
        near, every = lattice.around(window), lattice.around(needed)
        around = every & Window(near.col - m, near.row - m, near.width + 2 * m, near.height + 2 * m)
        heights = lattice.read(around)
        # Where the raster ends before the lines do, no part of it is quiet.
        quiet = quiet_blocks(heights, _flattest(lines, lattice) if around == every else 0.0, top)
        found = np.zeros(relief.shape, np.uint8)
        if quiet.all():
            return found
        x, y = (lattice.at((window.col, window.row)) - (around.col, around.row)).tolist()
        frame = x, y, *lattice.steps.ravel().tolist()
        slack = 4 * float(np.finfo(np.float32).eps) * max(*np.abs(self.levels), 1.0)
        limits = slack, float(MOST_AROUND), _BESIDE
        find_hidden(heights, pyramid_of(heights), frame, relief, lines.nodes, self.levels, top, limits, quiet, found)
        far = np.argwhere(found == BEYOND)
        short = _SHORT * self.target.grid.resolution / max(1.0, lattice.per_pixel)
        for part in np.array_split(far, -(-len(far) // _BATCH)) if len(far) else ():
            found[tuple(part.T)] = np.where(self._met(_places(window, relief, part), top, short), HIDDEN, SEEN)
        return found

    def _met(self, uvh: NDArray[np.float64], top: float, short: float) -> NDArray[np.bool_]:
        """Whether terrain is met on the way down from the source to places (n, 3), more than `short` metres before."""
        lines = sight_lines(self.projection, self.target, uvh)
        with np.errstate(divide="ignore"):
            rise = np.where(lines.step[:, 2] > 0, (top - uvh[:, 2]) / lines.step[:, 2], np.inf)
            longest = _MOST_PIXELS / np.abs(lines.step[:, :2]).max(axis=-1)
        start = uvh + np.minimum(np.minimum(rise, lines.length), longest)[:, None] * lines.step
        paths = self.target.to_ground(np.stack([start, uvh], axis=1))
        hits = self.terrain.first_hit(paths)
        before = np.linalg.norm((hits.XYZ - paths[:, 1])[:, :2], axis=1) > short
        return np.asarray(np.isfinite(hits.along) & before)


def _lines_over(
    projection: Projection, target: Target, window: Window, levels: tuple[float, float]
) -> SightLines | None:
    """Lines of sight at the nodes of a tile; None: nothing of it is seen, or too little to tell.

    Where polynomials or a flight end, in the middle of a tile, nodes beyond go on as linear functions of the others:
    pixels beside them are seen along lines between the two.
    """
    nodes = _nodes(window, levels)
    lines = sight_lines(projection, target, nodes)
    values, known = lines.nodes, np.isfinite(lines.nodes).all(axis=-1)
    if known.all():
        return lines
    if known.sum() < _LEAST_NODES:
        return None
    places = nodes - nodes[known].mean(axis=0)
    places = np.concatenate([places / np.abs(places).max(axis=(0, 1, 2)), np.ones((*known.shape, 1))], axis=-1)
    values[~known] = places[~known] @ np.linalg.lstsq(places[known], values[known])[0]
    return SightLines(values[..., :3], values[..., 3:])


def _nodes(window: Window, levels: tuple[float, float]) -> NDArray[np.float64]:
    """Places (2, _NODES, _NODES, 3) over a tile at two levels, from its first to its last pixel."""
    u = np.linspace(window.col, max(window.stop[0] - 1, window.col + 1), _NODES)
    v = np.linspace(window.row, max(window.stop[1] - 1, window.row + 1), _NODES)
    h, v, u = np.meshgrid(levels, v, u, indexing="ij")
    return np.stack([u, v, h], axis=-1)


def _search(
    terrain: Terrain, target: MapTarget, window: Window, lines: SightLines, levels: tuple[float, float]
) -> tuple[float, Window]:
    """A height that nothing on the lines of sight exceeds, and the pixels below them up to that height."""
    foot = _nodes(window, levels)[0]
    step, length = lines.step[0], lines.length[0]
    top = levels[1]
    while True:
        with np.errstate(divide="ignore"):
            rise = np.where(step[..., 2] > 0, (top - levels[0]) / step[..., 2], np.inf)
            longest = _MOST_PIXELS / np.abs(step[..., :2]).max(axis=-1)
        end = foot + np.minimum(np.minimum(rise, length), longest)[..., None] * step
        places = np.concatenate([foot, end])[..., :2].reshape(-1, 2)
        (col, row), (right, bottom) = np.floor(places.min(axis=0)) - 1, np.ceil(places.max(axis=0)) + 2
        needed = Window(int(col), int(row), int(right - col), int(bottom - row))
        corners = target.grid.to_map(np.array([(col, bottom), (right, row)]))
        highest = float(terrain.height_range(corners.ravel())[1])
        if not highest > top:
            return top, needed
        top = highest


def _flattest(lines: SightLines, lattice: Lattice) -> float:
    """Least slope of the lines of sight of a tile, height per post; the quotient of a linear and a convex function is
    least at a node."""
    across = lines.step[..., :2] @ lattice.steps.T
    with np.errstate(divide="ignore"):
        return float((lines.step[..., 2] / np.hypot(across[..., 0], across[..., 1])).min())


def _places(window: Window, relief: NDArray[np.float32], pixels: NDArray[np.int64]) -> NDArray[np.float64]:
    """(u, v, h) of pixels (n, 2) of a window given by row and column."""
    row, col = pixels.T
    return np.stack([col + window.col, row + window.row, relief[row, col].astype(float)], axis=-1)
