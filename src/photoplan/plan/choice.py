"""Which of many images paints which pixel: the best of those that see it, by a stated score.

The score is a sum of penalties, each without a unit; the least wins, of equal ones the first image. All of them change
slowly over an even ground but for the last, so that one image paints a region and not single pixels:

- slant: tangent of the angle between the line of sight and the vertical, by which an error of the height moves a pixel;
- coarseness: logarithm to base 2 of the ground sampling distance in pixels of the product, on the slope that the image
  sees: a roof that falls away from it is coarse;
- border: 1 at the image's border, falling with the square of the distance to 0 at a tenth of the image's shorter side;
- sharpness: by how many powers of two fine detail is weaker than in the sharpest image, one figure for each image;
- occlusion: 1 beside ground that the image does not see, falling to 0 at some distance on the map. Behr (1989, section
  6.3.2.1) takes the image whose line of sight passes furthest from what hides ground; here the distance is that of the
  pixels on the map.

What an image does not see it does not paint, whatever its score.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import Projection, steady
from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.kernels.choose import add_penalties, between_nodes
from photoplan.plan.ground import TileGround
from photoplan.plan.owner import Share
from photoplan.plan.visibility import hidden_pixels, sight_lines
from photoplan.surfaces.base import Surface
from photoplan.targets.map import MapTarget

#: Pixels between nodes; they lie at multiples of it in pixels counted from the map's origin, whatever the tile.
_SPACING = 32
#: Part of an image's shorter side in which its border counts.
_RIM = 0.1
#: Pixels at an image's border that it does not paint where others can: kernels need what is around a position.
_MARGIN = 3.0
#: The same beside what it does not see: pixels of the image, or of the product if they are larger.
_BESIDE = 2.0
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


@dataclass(frozen=True)
class Weights:
    """What each penalty counts."""

    slant: float = 1.0
    coarseness: float = 1.0
    border: float = 1.0
    occlusion: float = 0.5
    sharpness: float = 0.0

    def __post_init__(self) -> None:
        odd = [f"{name}={value:g}" for name, value in vars(self).items() if not 0 <= value <= 1000]
        if odd or not any(vars(self).values()):
            what = f"weight {', '.join(odd)}" if odd else "all weights are 0"
            raise UsageError(f"score: {what}; allowed are numbers from 0 to 1000, not all of them 0")


class Drawn(Protocol):
    """Regions that somebody has given to images."""

    def rows(self, window: Window) -> NDArray[np.uint16]:
        """Row of the table of sources, plus one, for each pixel of a window of the product; 0: nobody was given it."""
        ...

    def digest(self, margin: float) -> str:
        """Of what lies in the product and `margin` metres around it."""
        ...


@dataclass(frozen=True, eq=False)
class BestImage:
    """Each pixel is painted by the image of the least penalty among those that see it."""

    levels: tuple[float, float]
    """Lowest and highest ground of the product, metres: between them positions are interpolated."""
    weights: Weights = Weights()
    ranks: tuple[float, ...] = ()
    """A penalty of each source, by row: the user's own ranking, and its blur; none if empty."""
    drawn: Drawn | None = None
    """Regions that come before the score, where their image sees them."""
    paints_hidden: bool = False
    """Whether ground that none of its images sees is painted with what hides it."""

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
        cost[away <= np.maximum(_BESIDE, _BESIDE * np.exp2(scale))] += np.float32(_RIMMED)
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
        between_nodes(ground.relief, nodes, levels, corner, _SPACING, (float(width), float(height)), xy, near, values)
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
        add_penalties(near, values, slope, mine, border, sloped, ahead)
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
