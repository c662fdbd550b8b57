"""Source image of each pixel of a mosaic: hidden pixels, visibility, score, seams and feathering."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import Projection, project, steady
from photoplan.cameras.framed import FramedCamera
from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.kernels.anchors import interpolate_positions, source_costs
from photoplan.kernels.rays import pyramid_of
from photoplan.kernels.visibility import BEYOND, HIDDEN, SEEN, find_behind, find_hidden, free_blocks
from photoplan.plan.ground import TileGround
from photoplan.plan.options import Weights
from photoplan.surfaces.base import Lattice, Surface, Terrain
from photoplan.surfaces.objects import ObjectSurface, RaisedSurface, without_objects
from photoplan.targets.map import MapTarget, Target

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
#: Pieces of a bent line of sight are straight to this part of a pixel.
_STRAIGHT = 0.25
#: Lines that are followed at once, straight and in pieces.
_BATCH, _PATHS = 200_000, 20_000


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
    """Return the pixels of a tile that lie in the image, but that terrain or an object hides."""
    window, target = ground.window, ground.target
    none = np.zeros((window.height, window.width), bool)
    low, high = float(ground.ranges[0].min()), float(ground.ranges[1].max())
    if not low <= high:
        return none
    if not isinstance(target, MapTarget):
        raise UsageError(f"visibility over {type(target).__name__}; it is known for maps, walls, vaults and columns")
    if isinstance(projection, FramedCamera) and math.isfinite(projection.frame.turn):
        return _hidden_along_paths(projection, ground, surface)
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


def _hidden_along_paths(camera: FramedCamera, ground: TileGround, surface: Surface) -> NDArray[np.bool_]:
    """Pixels of a tile on a frame that bends lines that lie in the image, but that something hides: each line of sight
    is followed in pieces."""
    window, target = ground.window, ground.target
    assert isinstance(target, MapTarget)
    hidden = np.zeros((window.height, window.width), bool)
    there = np.argwhere(np.isfinite(ground.relief))
    places = target.to_ground(_places(window, ground.relief, there))
    xy = project(camera, places)
    inside = ((xy >= -0.5) & (xy <= np.array(camera.size) - 0.5)).all(axis=-1)
    short = _SHORT * target.grid.resolution
    whole: Any = surface.surface if isinstance(surface, RaisedSurface) else surface
    for part in np.array_split(np.flatnonzero(inside), max(1, -(-int(inside.sum()) // _PATHS))):
        hits = whole.first_hit(camera.sight_paths(places[part], _STRAIGHT * target.grid.resolution)[:, ::-1])
        before = np.linalg.norm(hits.XYZ - places[part], axis=1) > short
        hidden[tuple(there[part].T)] = np.isfinite(hits.along) & before
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
        quiet = free_blocks(heights, _flattest(lines, lattice) if around == every else 0.0, top)
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
        """Return whether terrain is met on the way down from the source to places (n, 3), more than `short` metres
        before."""
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


@dataclass(frozen=True, eq=False)
class Share:
    """Source images of the pixels of a tile."""

    owner: NDArray[np.uint16] | None
    """Row of the table of sources, plus one, for every pixel, shape (height, width); 0: no source. None: there is one
    source, and it paints whatever it shows."""
    hidden: NDArray[np.bool_] | None = None
    """Pixels that lie in images, but that no source sees, painted or not; None: nobody has asked."""
    clear: Mapping[int, NDArray[np.bool_]] = field(default_factory=dict)
    """By row, of the sources that paint at least: pixels that they see, and away from their border and from what they
    do not see."""


class Ownership(Protocol):
    """A rule that gives every pixel of a product to one source, before any pixel moves.

    What a pixel gets depends on the pixel alone, never on the window in which it is asked for, so that tiles join.
    """

    def share(self, ground: TileGround, cameras: Mapping[int, Projection], surface: Surface) -> Share:
        """Return the source image of each pixel of a tile."""
        ...


@dataclass(frozen=True, eq=False)
class GivenOwners:
    """Owners that somebody has drawn: a raster over the whole product."""

    raster: NDArray[np.uint16]
    """Row of the table of sources, plus one; 0: nobody. Shape (height, width) of the product."""

    def __post_init__(self) -> None:
        if self.raster.ndim != 2 or self.raster.dtype != np.uint16:
            raise UsageError(f"owners of shape {self.raster.shape} and type {self.raster.dtype}; a raster of uint16")

    def share(self, ground: TileGround, cameras: Mapping[int, Projection], surface: Surface) -> Share:
        """The part of the raster that lies in the tile's window."""
        target, window = ground.target, ground.window
        right, bottom = window.stop
        if window & target.window != window or self.raster.shape != (target.window.height, target.window.width):
            raise UsageError(f"owners of shape {self.raster.shape} do not cover {window} of {target.window}")
        return Share(np.ascontiguousarray(self.raster[window.row : bottom, window.col : right]))


@dataclass(frozen=True)
class InSight:
    """One source, and a look at which pixels it sees."""

    paints_hidden: bool = False
    """True if it paints those too that something hides, with what hides them."""

    def share(self, ground: TileGround, cameras: Mapping[int, Projection], surface: Surface) -> Share:
        """The only source paints what it sees, or all."""
        ((row, camera),) = cameras.items()
        hidden = hidden_pixels(camera, ground, surface)
        return Share(None if self.paints_hidden else np.where(hidden, 0, row + 1).astype(np.uint16), hidden)


#: Pixels between nodes; they lie at multiples of it in pixels counted from the map's origin, whatever the tile.
_SPACING = 32
#: Part of an image's shorter side in which its border counts.
_RIM = 0.1
#: Pixels at an image's border that it does not paint where others can: kernels need what is around a position.
_MARGIN = 3.0
#: The same beside what it does not see: pixels of the image, or of the product if they are larger.
_BESIDE_CHOICE = 2.0
#: Penalty of lines of sight that do not come from above.
_LEVEL = 100.0
#: Pixels to both sides over which the slope of the ground is taken, the smaller one counts: edges and rough ground
#: then have none. What a slope makes of the area of a pixel in the image, between these factors.
_REACH, _FLATTEST, _STEEPEST = 4, 1 / 64, 2.0
#: Lines of sight that are flatter than by so many pixels a metre count as these.
_MOVES = 1e4
#: Distance in which what hides ground counts, pixels of the product.
_AROUND = 24
#: What a drawn region is worth, more than all penalties; and what the margin costs, more than that.
_DRAWN, _RIMMED = 1e6, 1e7


class Drawn(Protocol):
    """Regions that somebody has given to images."""

    def rows(self, window: Window) -> NDArray[np.uint16]:
        """Row of the table of sources, plus one, for each pixel of a window of the product; 0: nobody was given it."""
        ...

    def digest(self, margin: float) -> str:
        """Return the digest of what lies in the product and `margin` metres around it."""
        ...


@dataclass(frozen=True, eq=False)
class BestImage:
    """Each pixel is painted by the image of the least penalty among those that see it."""

    levels: tuple[float, float]
    """Lowest and highest ground of the product, metres: between them positions are interpolated."""
    weights: Weights = field(default_factory=Weights)
    ranks: tuple[float, ...] = ()
    """A penalty of each source, by row: the user's own ranking, and its blur; none if empty."""
    drawn: Drawn | None = None
    """Regions that come before the score, where their image sees them."""
    paints_hidden: bool = False
    """True if ground that none of its images sees is painted with what hides it."""

    def share(self, ground: TileGround, cameras: Mapping[int, Projection], surface: Surface) -> Share:
        """The least penalty of those that see a pixel; visibility is asked only of images that come first somewhere.

        Where regions are drawn, others are asked only if those that were drawn do not see all that there is.
        """
        drawn = None if self.drawn is None else self.drawn.rows(ground.window)
        wide = _wide(ground, surface)
        slope = _slope(wide, ground.window)
        costs: dict[int, NDArray[np.float32]] = {}
        scales: dict[int, NDArray[np.float32]] = {}
        clear: dict[int, NDArray[np.bool_]] = {}
        inside = np.zeros(ground.relief.shape, np.bool_)

        def among(rows: list[int]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
            """Penalties (images, height, width) before it is asked what hides the ground from images, and after."""
            for row in rows:
                if row not in costs:
                    costs[row], scales[row] = self._penalty(row, cameras[row], ground, slope, drawn)
                    np.logical_or(inside, np.isfinite(costs[row]), out=inside)
            cost = np.stack([costs[row] for row in rows])
            blind = cost if not self.paints_hidden else cost.copy()
            while True:
                best, known = _least(cost)
                ahead = [rows[k] for k in np.flatnonzero(np.bincount(best[known])).tolist()]
                asked = [row for row in ahead if row not in clear]
                for row in asked:
                    costs[row] = cost[rows.index(row)]
                    self._look(costs[row], scales[row], cameras[row], (ground, wide), surface)
                    clear[row] = costs[row] < 0.5 * _RIMMED
                if not asked:
                    return blind, cost

        given = [] if drawn is None or self.paints_hidden else np.flatnonzero(np.bincount(drawn.ravel())).tolist()
        rows = [value - 1 for value in given if value - 1 in cameras] or sorted(cameras)
        blind, cost = among(rows)
        # No penalty of others is below this one.
        least = min(self.ranks, default=0.0) - self.weights.coarseness * (_LEVEL + _STEEPEST)
        if len(rows) < len(cameras) and not ((cost.min(axis=0) < least) | np.isnan(ground.relief)).all():
            rows = sorted(cameras)
            blind, cost = among(rows)
        best, seen = _least(cost)
        if self.paints_hidden:
            best = np.where(seen, best, _least(blind)[0])
        paints = inside if self.paints_hidden else seen
        owner = np.where(paints, np.array(rows)[best] + 1, 0).astype(np.uint16)
        return Share(owner, inside & ~seen, clear)

    def _look(
        self,
        cost: NDArray[np.float32],
        scale: NDArray[np.float32],
        camera: Projection,
        grounds: tuple[TileGround, TileGround],
        surface: Surface,
    ) -> None:
        """Add to an image's penalty what it does not see, and what is near that; `scale`: its coarseness."""
        ground, wide = grounds
        # Orthophotos of single images do without it: a tenth of a second of their start.
        from scipy.ndimage import distance_transform_edt  # noqa: PLC0415

        hidden = hidden_pixels(camera, wide, surface)
        if not hidden.any():
            return
        at = ground.window.slices(wide.window)
        away = distance_transform_edt(~hidden)[at]
        near = np.clip(1.0 - away / _AROUND, 0.0, 1.0)
        cost += np.float32(self.weights.occlusion) * near.astype(np.float32)
        # Kernels mix what hides ground into what lies beside it, as far as they do at the image's border.
        cost[away <= np.maximum(_BESIDE_CHOICE, _BESIDE_CHOICE * np.exp2(scale))] += np.float32(_RIMMED)
        cost[hidden[at]] = np.inf

    def _penalty(
        self,
        row: int,
        camera: Projection,
        ground: TileGround,
        slope: NDArray[np.float32],
        drawn: NDArray[np.uint16] | None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Penalty of each pixel without what hides it; infinite outside the image, and without a surface. Also its
        coarseness."""
        shape, (width, height) = ground.relief.shape, camera.size
        xy, near, values = np.empty((*shape, 2)), np.empty(shape), np.empty((4, *shape), np.float32)
        nodes, levels, corner = self._nodes(camera, ground)
        interpolate_positions(
            ground.relief, nodes, levels, corner, _SPACING, (float(width), float(height)), xy, near, values
        )
        rim = _RIM * min(camera.size)
        if camera.field is not None:
            # The field moves positions a little; only where that decides, or where the border counts, it is asked.
            there = np.abs(near) < 2 * rim
            x, y = np.moveaxis(np.abs(camera.field(xy[there]) - (np.array(camera.size) - 1) / 2), -1, 0)
            near[there] = np.minimum(width / 2 - x, height / 2 - y)
        border = float(self.weights.border), float(rim), _MARGIN, _RIMMED
        sloped = 0.5 * float(self.weights.coarseness), _FLATTEST, _STEEPEST
        mine = np.zeros((0, 0), np.uint16) if drawn is None else np.ascontiguousarray(drawn)
        ahead = float(self.ranks[row]) if self.ranks else 0.0, row + 1, _DRAWN
        source_costs(near, values, slope, mine, border, sloped, ahead)
        return values[0], values[1]

    def _nodes(
        self, camera: Projection, ground: TileGround
    ) -> tuple[NDArray[np.float64], tuple[float, float], tuple[int, int]]:
        """Homogeneous positions, smooth penalties, coarseness, and how many columns and rows a line of sight moves per
        metre, at nodes of two levels (2, rows, columns, 7), the levels, and by how many pixels the first node lies
        before the tile."""
        target, window = ground.target, ground.window
        assert isinstance(target, MapTarget)
        (right, bottom), (low, high) = window.stop, self.levels
        pad = 0.01 + 1e-6 * max(abs(low), abs(high))
        levels = low - pad, high + pad
        grid = target.grid
        # At multiples of the spacing from the map's own origin: parts of a map agree, whatever their bounds.
        shift = round(grid.left / grid.resolution) % _SPACING, round(-grid.top / grid.resolution) % _SPACING
        first = (window.col + shift[0]) // _SPACING, (window.row + shift[1]) // _SPACING
        u, v = (
            np.arange(start, max(-(-(end + off) // _SPACING), start + 1) + 1) * float(_SPACING) - off
            for start, end, off in zip(first, (right, bottom), shift)
        )
        h, v, u = np.meshgrid(levels, v, u, indexing="ij")
        uvh = np.stack([u, v, h], axis=-1)
        step = np.moveaxis(sight_lines(camera, target, uvh).step, -1, 0)
        across, up = np.hypot(step[0], step[1]) * target.grid.resolution, step[2]
        with np.errstate(divide="ignore", invalid="ignore"):
            slant = np.where(up > 0, np.minimum(across / up, _LEVEL), _LEVEL)
        around = uvh[..., None, :] + np.array([(-0.5, 0, 0), (0.5, 0, 0), (0, -0.5, 0), (0, 0.5, 0)])
        position = steady(camera).project_homogeneous(target.to_ground(around))
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = position[..., :2] / position[..., 2:]
            size = np.sqrt(
                np.abs(np.linalg.det(np.stack([xy[..., 1, :] - xy[..., 0, :], xy[..., 3, :] - xy[..., 2, :]], -1)))
            )
            coarse = np.clip(np.nan_to_num(-np.log2(size), nan=_LEVEL, posinf=_LEVEL), -_LEVEL, _LEVEL)
        smooth = self.weights.slant * slant + self.weights.coarseness * coarse
        with np.errstate(divide="ignore", invalid="ignore"):
            moves = np.where(up > 0, np.clip(step[:2] / up, -_MOVES, _MOVES), 0.0)
        values = np.stack([smooth, coarse, *moves], axis=-1)
        nodes = np.concatenate([camera.project_homogeneous(target.to_ground(uvh)), values], axis=-1)
        return nodes, levels, (window.col + shift[0] - first[0] * _SPACING, window.row + shift[1] - first[1] * _SPACING)


def _wide(ground: TileGround, surface: Surface) -> TileGround:
    """A tile with what is around it."""
    at, r = ground.window, _AROUND
    window = Window(at.col - r, at.row - r, at.width + 2 * r, at.height + 2 * r)
    return TileGround.of(ground.target, window, surface.relief(ground.target, window))


def _slope(wide: TileGround, window: Window) -> NDArray[np.float32]:
    """Slope of the ground of a window along columns and rows, metres per pixel, shape (2, height, width); 0 where it is
    not known."""
    rows, cols = window.slices(wide.window)
    found = []
    for axis in (1, 0):
        before, after = (
            wide.relief[(_moved(rows, by), cols) if axis == 0 else (rows, _moved(cols, by))] for by in (-_REACH, _REACH)
        )
        here = wide.relief[rows, cols]
        back, on = (here - before) / _REACH, (after - here) / _REACH
        found.append(np.where(back * on > 0, np.where(np.abs(back) < np.abs(on), back, on), 0.0))
    return np.asarray(found, np.float32)


def _moved(some: slice, by: int) -> slice:
    return slice(some.start + by, some.stop + by)


def _least(cost: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Place of the least of penalties (images, height, width) at each pixel, and whether it is finite."""
    best = np.argmin(cost, axis=0) if len(cost) > 1 else np.zeros(cost.shape[1:], np.int64)
    return best, np.isfinite(cost.min(axis=0) if len(cost) > 1 else cost[0])


@dataclass(frozen=True)
class Feather:
    """Weights of images along seams."""

    width: int
    """Width of the strip in which images pass into each other, pixels."""
    bands: bool = False
    """True if finer detail passes in narrower strips: each half as wide as the next."""

    @property
    def reach(self) -> int:
        """Pixels around a tile that decide about its weights."""
        return 2 * ((self.width + 2) // 4)

    @property
    def reaches(self) -> tuple[int, ...]:
        """`reach` of each band, from the finest; of one, if all detail passes alike."""
        found = [self.reach]
        while self.bands and found[0] >= 4:
            found.insert(0, 2 * (found[0] // 4))
        return tuple(found)

    def around(self, window: Window) -> Window:
        """A window of a product with what decides about it, also beyond the product."""
        r = self.reach
        return Window(window.col - r, window.row - r, window.width + 2 * r, window.height + 2 * r)

    def weights(
        self, share: Share, wide: Window, window: Window
    ) -> dict[int, tuple[NDArray[np.float32], NDArray[np.bool_]]]:
        """Weights of the images that share pixels of a window, by row of the table of sources, shape (bands, height,
        width); all 0 where one alone paints. With each the pixels of `wide` that it sees or owns.
        """
        owner = share.owner
        assert owner is not None
        rows = [int(value) - 1 for value in np.unique(owner) if value]
        at = window.slices(wide)
        if len(rows) < 2 or not self.reach:
            return {}
        painted = owner[at] > 0
        found = {}
        for row in rows:
            mine = owner == row + 1
            parts = [_twice(mine, reach // 2)[at] for reach in self.reaches]
            if not parts[-1].any():
                continue
            sees = share.clear[row]
            weights = np.stack([part * _from_edge(sees, r)[at] for part, r in zip(parts, self.reaches)])
            weights[:, ~painted] = 0.0
            # Whom nobody else can stand in for keeps what is his.
            weights[mine[at] & (weights == 0)] = np.finfo(np.float32).tiny
            found[row] = weights.astype(np.float32), sees | mine
        several = sum((weights[-1] > 0).astype(np.uint8) for weights, _ in found.values()) > 1
        shared = {row: (np.where(several, weights, np.float32(0)), seen) for row, (weights, seen) in found.items()}
        return {row: (weights, seen) for row, (weights, seen) in shared.items() if weights.any()}


def feather_of(metres: float, resolution: float, tile: int, bands: bool = False) -> Feather | None:
    """The feather of a width in metres, by bands or not; None: it is less than a pixel to both sides."""
    if not (np.isfinite(metres) and metres >= 0):
        raise UsageError(f"`feather` {metres:g}; a width in metres is needed, 0 for none")
    made = Feather(round(min(metres / resolution, 1e9)), bands)
    if made.reach > tile:
        raise UsageError(
            f"`feather` {metres:g} m is {made.width} pixels; at most {2 * tile} are possible with tiles of {tile}: "
            "give a smaller width, or a larger `tile`"
        )
    return made if made.reach else None


def _twice(mine: NDArray[np.bool_], half: int) -> NDArray[np.float64]:
    """Mean over a window of 2 · half + 1 pixels, of the mean over such windows; in whole numbers, so that it does not
    depend on where an array begins. Beyond the array there is nothing."""
    total = mine.astype(np.int64)
    for axis in (0, 1, 0, 1):
        sums = np.cumsum(np.pad(total, [(half + 1, half) if k == axis else (0, 0) for k in (0, 1)]), axis=axis)
        n = total.shape[axis]
        total = np.take(sums, np.arange(2 * half + 1, n + 2 * half + 1), axis) - np.take(sums, np.arange(n), axis)
    return np.asarray(total / float(2 * half + 1) ** 4)


def _from_edge(sees: NDArray[np.bool_], reach: int) -> NDArray[np.float64]:
    """0 where an image does not see, growing with the distance from there to 1 at `reach` pixels."""
    if sees.all():
        return np.ones(sees.shape)
    # Products without seams do without it: a tenth of a second of their start.
    from scipy.ndimage import distance_transform_edt  # noqa: PLC0415

    return np.asarray(np.minimum(distance_transform_edt(sees) / (reach + 1), 1.0))
