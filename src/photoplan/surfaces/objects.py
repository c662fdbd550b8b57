"""Objects over terrain, which hide what is behind them: faces, polygons in space, quadtree squares."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import UsageError
from photoplan.geometry.grid import MapGrid, Window
from photoplan.kernels.rays import SURFACE
from photoplan.kernels.visibility import Cells, count_in_cells, fill_cells, first_hits, highest_triangles
from photoplan.surfaces.base import Hits, Lattice, Surface, Terrain, chords
from photoplan.targets.map import MapTarget, Target

"""A polygon in space: its outer ring and its holes, each (k, 3), X, Y, Z in metres; the first point may come again."""


#: Triangles are entered into no more cells than so many times their number, and a number more.
_ENTRIES, _MORE = 32, 65536
#: Sides of cells, in median extents of the triangles.
_SIDES = 0.5


@dataclass(frozen=True, eq=False)
class Faces:
    """Triangles of objects, and which of them a product shows."""

    corners: NDArray[np.float64]
    """X, Y, Z of the corners, shape (n, 3, 3), metres."""
    paints: NDArray[np.bool_]
    """Whether each is part of the surface that is painted, shape (n,); the others only hide what is behind them."""
    owner: NDArray[np.int32]
    """Object of each, its place in `names`, shape (n,)."""
    names: tuple[str, ...]
    """Faces of the objects."""
    _cells: Cells = field(init=False, repr=False)
    _local: NDArray[np.float64] = field(init=False, repr=False)
    _corner: NDArray[np.float64] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        corners = np.ascontiguousarray(self.corners, np.float64)
        n = len(corners)
        if corners.shape != (n, 3, 3) or self.paints.shape != (n,) or self.owner.shape != (n,):
            raise UsageError(f"faces of shape {corners.shape}; n triangles (n, 3, 3), each with role and owner, needed")
        if not n or not np.isfinite(corners).all():
            raise UsageError("faces without a triangle, or with coordinates that are no numbers")
        corner = np.array([*corners[..., :2].min(axis=(0, 1)), 0.0])
        local = corners - corner
        for name, value in (("corners", corners), ("_corner", corner), ("_local", local), ("_cells", _sorted(local))):
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.corners)

    @cached_property
    def painted(self) -> Faces | None:
        """Those that are painted; None: there are none."""
        return self if self.paints.all() else self.only(self.paints)

    def only(self, use: NDArray[np.bool_]) -> Faces | None:
        """Some of them, chosen (n,), all painted; None: there are none."""
        if not use.any():
            return None
        return Faces(self.corners[use], np.ones(int(use.sum()), bool), self.owner[use], self.names)

    @property
    def in_cells(self) -> tuple[NDArray[np.float64], Cells, NDArray[np.float64]]:
        """Corners from an origin, their cells, and the origin X, Y, 0: for kernels."""
        return self._local, self._cells, self._corner

    def heights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Height of the highest face at map points (..., 2), shape (...); −inf where there is none.

        Exact on the plane of a triangle; upright faces are above no point.
        """
        return self.highest(XY)[0]

    def highest(self, XY: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Heights as of `heights`, and which face has them, shape (...); −1 where there is none."""
        XY = np.asarray(XY, float)
        out, faces = np.empty(XY.shape[:-1]), np.empty(XY.shape[:-1], np.int64)
        local = np.ascontiguousarray((XY - self._corner[:2]).reshape(-1, 2))
        highest_triangles(self._local, self._cells, local, out.reshape(-1), faces.reshape(-1))
        return out, faces

    def height_range(self, bounds: ArrayLike) -> NDArray[np.float64]:
        """Bounds of the heights of all cells of faces that map bounds (..., 4) touch, shape (..., 2); NaN: none."""
        boxes = np.asarray(bounds, float)
        _, _, ranges, (side, columns, rows, *_) = self._cells
        at = (boxes.reshape(-1, 2, 2) - self._corner[:2]) / side
        count = np.array([columns, rows])
        with np.errstate(invalid="ignore"):
            touched = ((at[:, 0] <= count) & (at[:, 1] >= 0)).all(axis=1)
        low, high = np.clip(np.floor(np.where(touched[:, None, None], at, 0)), 0, count - 1).astype(int).swapaxes(0, 1)
        grid = ranges.reshape(int(rows), int(columns), 2)
        out = np.full((len(at), 2), np.nan)
        for i in np.flatnonzero(touched):
            part = grid[low[i, 1] : high[i, 1] + 1, low[i, 0] : high[i, 0] + 1]
            found = part[..., 0].min(), part[..., 1].max()
            if found[0] <= found[1]:
                out[i] = found
        return out.reshape(*boxes.shape[:-1], 2)

    def normals(self, face: NDArray[np.int64], ways: NDArray[np.float64]) -> NDArray[np.float64]:
        """Normals of faces (n,), of length one, against ways (n, 3); of −1 whatever there is."""
        a, b, c = np.moveaxis(self._local[face], 1, 0)
        n = np.cross(b - a, c - a)
        n[(n * ways).sum(axis=1) > 0] *= -1.0
        with np.errstate(invalid="ignore"):
            return np.asarray(n / np.linalg.norm(n, axis=1, keepdims=True))

    def first_hit(
        self, paths: ArrayLike, bend: float = 0.0
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
        """The face that rays meet first, whichever way they run and whichever side of it they meet."""
        given = np.asarray(paths, float)
        fine = chords(given, bend, lambda XYZ: XYZ)[0] if bend else given
        n, pieces = len(fine), fine.shape[1] - 1
        along, XYZ, face = np.full(n, np.nan), np.full((n, 3), np.nan), np.full(n, -1)
        for piece in range(pieces):
            todo = np.flatnonzero(face < 0)
            start, step = fine[todo, piece], fine[todo, piece + 1] - fine[todo, piece]
            t, which = np.empty(len(todo)), np.empty(len(todo), np.int64)
            first_hits(self._local, self._cells, np.concatenate([start - self._corner, step], axis=1), t, which)
            met = which >= 0
            face[todo[met]], along[todo[met]] = which[met], (piece + t[met]) * (given.shape[1] - 1) / pieces
            XYZ[todo[met]] = start[met] + t[met, None] * step[met]
        return along, XYZ, face


def _sorted(local: NDArray[np.float64]) -> Cells:
    """Triangles in cells as small as the triangles are, but not many more than there are triangles."""
    low, high = local.min(axis=1), local.max(axis=1)
    extent = high[:, :2].max(axis=0)
    size = np.maximum(high[:, :2] - low[:, :2], 1e-3)
    side = max(_SIDES * float(np.median(size)), float(extent.max()) / 30_000, 0.01)
    most = _ENTRIES * len(local) + _MORE
    while True:
        # The outermost cells end a little beyond the triangles.
        columns, rows = (int(e / side + 1e-6) + 1 for e in extent)
        if columns * rows <= most and (np.prod(size // side + 2, axis=1)).sum() <= 2 * most:
            break
        side *= 1.5
    pad = 1e-6 * side
    boxes = np.concatenate([low[:, :2] - pad, high[:, :2] + pad], axis=1)
    heights = np.stack([low[:, 2] - 1e-6, high[:, 2] + 1e-6], axis=1)
    frame = (side, columns, rows)
    count = np.zeros(columns * rows, np.int64)
    count_in_cells(boxes, frame, count)
    start = np.concatenate([[0], np.cumsum(count)])
    members, ranges = np.empty(int(start[-1]), np.int32), np.tile(np.array([np.inf, -np.inf]), (columns * rows, 1))
    fill_cells(boxes, heights, frame, start[:-1].copy(), members, ranges)
    bounds = np.array([side, columns, rows, heights[:, 0].min(), heights[:, 1].max()])
    return start, members, ranges, bounds


#: Metres; and between which heights above the ground an object stands there, metres.
_FOOT, _STANDS = 0.3048, (-3.0, 25.0)


@dataclass(frozen=True)
class SingleObject:
    """Content of a product of a single object."""

    objects: tuple[int, ...]
    """The object, by its places in `Faces.names`: some are made of several features."""
    below: bool = False
    """Whether what lies below it is shown, as if it only hid, and not itself."""


@dataclass(frozen=True, eq=False)
class ObjectSurface:
    """Terrain that is raised by the objects which a product shows, and from which rays are kept by all of them.

    What overhangs has ground below it: a bridge that is painted gives its deck, one that only hides leaves the road.
    """

    ground: Terrain
    """Without objects."""
    faces: Faces
    part: SingleObject | None = None
    """Object that is shown; None for the ground and all that is painted. All of it hides what is behind it."""
    entries: tuple[int, ...] = ()
    """Entry of the project that each object is of, by place in `Faces.names`."""

    @property
    def painted(self) -> Terrain:
        """The surface without objects that only hide: what a product is an image of."""
        faces = self.faces.painted
        return self.ground if faces is None else replace(self, faces=faces, part=None)

    @cached_property
    def shown(self) -> Faces | None:
        """Faces that a product shows."""
        if self.part is None:
            return self.faces.painted
        own = np.isin(self.faces.owner, self.part.objects)
        return self.faces.only(self.faces.paints & ~own if self.part.below else own)

    @property
    def shows_ground(self) -> bool:
        """Return whether a product shows the ground beside them."""
        return self.part is None or self.part.below

    def relief(self, target: Target, window: Window) -> NDArray[np.float32]:
        """Height of the ground or of the highest shown face above it at the pixel centres of a window of a map
        target, shape (height, width), metres; NaN where there is neither. Of a single object that of its own faces,
        also where they are below the ground."""
        return self.top(target, window)[0]

    def top(self, target: Target, window: Window) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Relief of a window, and which of the faces `shown` is there, shape (height, width); −1: none."""
        faces, none = self.shown, np.full((window.height, window.width), -1)
        relief = self.ground.relief(target, window) if self.shows_ground else np.full(none.shape, np.nan, np.float32)
        if faces is None:
            return relief, none
        if not isinstance(target, MapTarget):
            raise UsageError(f"objects give relief for map targets, not for {type(target).__name__}")
        v, u = np.mgrid[window.row : window.stop[1], window.col : window.stop[0]].astype(float)
        raised, face = faces.highest(target.grid.to_map(np.stack([u, v], axis=-1)))
        face[raised < relief] = -1
        return np.where(face < 0, relief, raised).astype(np.float32), face

    def heights(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Return heights at map points (..., 2), shape (...), as `relief` does at pixels."""
        faces = self.shown
        heights = self.ground.heights(XY) if self.shows_ground else np.full(np.shape(XY)[:-1], np.nan)
        if faces is None:
            return heights
        raised = faces.heights(XY)
        return np.where(np.isneginf(raised), heights, np.fmax(heights, raised))

    def height_range(self, bounds: ArrayLike) -> NDArray[np.float64]:
        """Bounds of ground and faces, painted or not, inside map bounds (..., 4), shape (..., 2)."""
        ground, faces = self.ground.height_range(bounds), self.faces.height_range(bounds)
        return np.stack([np.fmin(ground[..., 0], faces[..., 0]), np.fmax(ground[..., 1], faces[..., 1])], axis=-1)

    def lattice(self, grid: MapGrid, window: Window) -> Lattice:
        """Return that of the ground: faces are no raster."""
        return self.ground.lattice(grid, window)

    def first_hit(self, paths: ArrayLike, bend: float = 0.0) -> Hits:
        """Return what rays meet first: the ground, as `Terrain.first_hit` has it, or a face, from either side."""
        ground = self.ground.first_hit(paths, bend)
        along, XYZ, face = self.faces.first_hit(paths, bend)
        nearer = np.isfinite(along) & ~(ground.along < along)
        return Hits(
            XYZ=np.where(nearer[:, None], XYZ, ground.XYZ),
            along=np.where(nearer, along, ground.along),
            result=np.where(nearer, SURFACE, ground.result),
            below=ground.below & ~nearer,
            normal=np.where(
                nearer[:, None], self.faces.normals(face, XYZ - np.asarray(paths, float)[:, 0]), ground.normal
            ),
            owner=np.where(nearer, self.faces.owner[face] + 1, ground.owner),
        )


@dataclass(frozen=True, eq=False)
class RaisedSurface:
    """A surface that is shown higher than it stands: it hides what it hides, but is looked at above itself."""

    surface: Surface
    window: Window
    """Window in which it is raised, pixels of a target."""
    by: NDArray[np.floating]
    """Metres for each pixel there."""

    def relief(self, target: Target, window: Window) -> NDArray[np.float32]:
        """Relief of the surface, raised."""
        relief, common = np.array(self.surface.relief(target, window), np.float32), self.window & window
        if common.size:
            relief[common.slices(window)] += self.by[common.slices(self.window)].astype(np.float32)
        return relief


def without_objects(surface: Terrain) -> Terrain:
    """The ground alone."""
    return surface.ground if isinstance(surface, ObjectSurface) else surface


def as_if_in_feet(surface: Terrain, height: float) -> dict[str, float]:
    """Objects that rise above a height, metres, and would stand on the ground if their own were in feet: how high they
    rise; of a surface without objects none."""
    if not isinstance(surface, ObjectSurface):
        return {}
    faces = surface.faces
    owner = np.repeat(faces.owner, 3)
    top, lowest = np.full(len(faces.names), -np.inf), np.full(len(faces.names), np.inf)
    np.maximum.at(top, owner, faces.corners[..., 2].ravel())
    corners = faces.corners.reshape(-1, 3)
    np.fmin.at(lowest, owner, _FOOT * corners[:, 2] - surface.ground.heights(corners[:, :2]))
    stands = (lowest > _STANDS[0]) & (lowest < _STANDS[1])
    return {faces.names[k]: float(top[k]) for k in np.flatnonzero((top > height) & stands)}


def painted_surface(surface: Terrain) -> Terrain:
    """Return what a product shows, without what only hides."""
    return surface.painted if isinstance(surface, ObjectSurface) else surface
