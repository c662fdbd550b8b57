"""How fine the facets of a surface are, on how many levels, how far its start may be wrong, whether it is searched."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import tremor_of
from photoplan.errors import GeometryError, UsageError
from photoplan.geometry.frames import Frame
from photoplan.geometry.grid import MapGrid
from photoplan.matching.facets.reconstruct import Scheme
from photoplan.matching.facets.search import Planes, Search
from photoplan.products.surface.settings import SurfaceSettings
from photoplan.products.surface.target import SeenTarget, seen_places

#: Grey facets along a side of a height facet at most: images that are finer still are reduced.
MOST_RATIO = 6
#: And cells that a search compares: heights are found to parts of their pixels all the same.
_CELLS = 3
#: How far the start may be wrong if nobody states it, part of the flying height.
_WRONG = 0.1
#: And if somebody does: a start between camera and ground is farther from the ground than from the camera.
_MOST_WRONG = 3.0
#: Pixels of parallax by which the coarsest level may begin wrong, and pixels along the shorter side of an image there.
_CATCH, _LEAST = 1.0, 16
#: How far the start of satellites may be wrong if nobody states it, pixels of parallax.
_SOME = 32.0
#: Part of the smaller footprint that two images share, whose parallax counts.
_SHARED = 0.2
#: B : H of images that see the ground from the same direction.
_PARALLEL = 1e-4
#: Part of a pixel below which facets are finer.
_AS_FINE = 0.999
#: Part of a pixel from which on facets beat with pixels, for so many images of a place that these count little.
_HARDLY, _MANY = 1.1, 3.5
#: Part of a level by which pixels may be smaller than half of the usual ones.
_NEARLY = 0.1
#: Levels at most.
_LEVELS = 8
#: Pixels of parallax of the reach from which on heights are searched; those for which the coarsest level of a search
#: has planes, up and down; and by how many pixels of parallax the facets may move what was found.
_RELIEF, _PLANES, _ROOM = 24.0, 24.0, 3.0


def scheme_of(
    settings: SurfaceSettings,
    looked: Sequence[SeenTarget],
    grid: MapGrid,
    frame: Frame | None,
    gsd: float,
    pixels_there: NDArray[np.float64],
) -> tuple[Scheme, float]:
    """The scheme of a surface, and what one pixel of parallax between the outermost images is in height, metres."""
    pixels = settings.resolution / gsd
    ratio, base = _facets(pixels, MOST_RATIO, _pixels_beyond_two(pixels_there))
    height_error, usual = _heights_of_a_pixel(looked, gsd)
    reach = _reach(settings, looked, frame, height_error)
    coarsest, search = _coarsest(reach, looked, height_error, base), None
    # Planes are swept over lattices of cells, between which a turbulent flight shakes by more than a cell.
    shaken = any(tremor_of(one.camera) is not None for one in looked)
    strong = reach > _RELIEF * height_error and not shaken
    if strong if settings.search is None else settings.search:
        coarsest, search = 0, _search(looked, pixels, usual, reach, coarsest)
    coarse = ratio < _HARDLY * pixels / 2**base and _images_of_a_place(looked, grid) < _MANY
    scheme = Scheme(ratio=ratio, coarsest=coarsest, base=base, reach=reach, coarse=coarse, search=search)
    return scheme, height_error


def finer_levels(looked: Sequence[SeenTarget], gsd: float) -> tuple[int, ...]:
    """Levels by which each image is reduced whose pixels are smaller than half of the usual ones of `gsd` metres.

    All of them would take memory and time by their square, and facets hold nothing of what they show. As large as the
    usual ones they would be sharper than these, which is seen in their residuals.
    """
    return tuple(max(0, math.ceil(math.log2(gsd / one.gsd) - _NEARLY) - 1) for one in looked)


def pixels_of_places(
    looked: Sequence[SeenTarget], levels: Sequence[int], grid: MapGrid, gsd: float
) -> NDArray[np.float64]:
    """Pixels, so reduced, that each image has of places of a lattice over a grid, for one of a usual image; 0 where it
    sees none, shape (n, k, k)."""
    each = [seen_places(one, grid.bounds) * (gsd / one.gsd / 2**level) ** 2 for one, level in zip(looked, levels)]
    return np.array(each)


def _reach(settings: SurfaceSettings, looked: Sequence[SeenTarget], frame: Frame | None, height_error: float) -> float:
    """How far the start may be wrong, metres."""
    flying = _flying_height(looked)
    if 0 < _MOST_WRONG * flying < (settings.reach or 0.0):
        raise UsageError(
            f"reach {settings.reach:g} m is more than {_MOST_WRONG:g} times the images' height above the ground, "
            f"{flying:.3g} m"
        )
    reach = settings.reach or _WRONG * flying or _SOME * height_error
    return reach if frame is None else _inside(frame, float(settings.start), reach, settings.reach)


def _inside(frame: Frame, start: float, reach: float, stated: float | None) -> float:
    """The reach, not farther than the frame goes; one that a user states is refused."""
    low, high = frame.heights
    most = min(start - low, high - start)
    if most <= 0 or (reach > most and stated is not None):
        ends = [f"{word} {end:.3g} m" for word, end in (("from", low), ("to", high)) if math.isfinite(end)]
        raise UsageError(f"start {start:g} m and reach {reach:g} m: its heights go {' '.join(ends)}")
    return min(reach, most)


def _heights_of_a_pixel(looked: Sequence[SeenTarget], gsd: float) -> tuple[float, float]:
    """Heights that part images by one pixel, GSD · H / B: the outermost, and the usual of those that share enough."""
    rates = []
    for one, other in combinations(looked, 2):
        a, b = one.bounds, other.bounds
        low, high = np.maximum(a[:2], b[:2]), np.minimum(a[2:], b[2:])
        areas = [(c[2] - c[0]) * (c[3] - c[1]) for c in (a, b)]
        if (low < high).all() and float(np.prod(high - low)) > _SHARED * min(areas):
            middle = (low + high) / 2
            rates.append(float(np.linalg.norm(_slope(one, middle) - _slope(other, middle))))
    rates = [rate for rate in rates if rate > _PARALLEL]
    if not rates:
        raise GeometryError("all images see the ground from the same direction: there is no parallax, and no height")
    return gsd / max(rates), gsd / float(np.median(rates))


def _slope(one: SeenTarget, XY: np.ndarray) -> np.ndarray:
    """By how much the ground point of a pixel moves on the map per metre of height, at a place, shape (2,)."""
    low, high = one.heights
    level = (low + high) / 2
    J = one.camera.derivatives(np.array([*XY, level]))
    return np.asarray(-np.linalg.solve(J[:, :2], J[:, 2]))


def _flying_height(looked: Sequence[SeenTarget]) -> float:
    """Median height of the images above the ground, metres; 0 for satellites, which are too far away for that."""
    heights = []
    for one in looked:
        low, high = one.heights
        vantage = one.camera.vantage
        heights.append(float(vantage.point[2]) - (low + high) / 2 if vantage.central else 0.0)
    return float(np.median(heights))


def _facets(pixels: float, most: int, others: float = 0.0) -> tuple[int, int]:
    """Facets along a height facet of so many pixels, and the level of the images whose pixels are as large as they.

    Facets are no coarser than pixels where so many images see a place that any two, which tell its height, leave a
    pixel for each facet to the others, which have `others` pixels for a usual one: coarser ones do not hold what pixels
    show, which moves heights over whole stretches where pixels drift along the facets. Of three images, slopes and
    finer grey values mix.
    """
    base = max(0, math.ceil(math.log2(pixels / most)))
    pixels /= 2**base
    ratio = max(1, round(pixels))
    finer = ratio < _AS_FINE * pixels and others * (pixels / (ratio + 1)) ** 2 >= 1
    return ratio + finer, base


def _pixels_beyond_two(pixels: NDArray[np.float64]) -> float:
    """Pixels that images beyond the two finest have of a place, for one of a usual image, in the mean of the places
    that two see: that many images fewer two, if all have pixels of one size; less, if some are coarser."""
    pixels = np.sort(pixels, axis=0)
    two = pixels[-2] > 0
    return float(pixels[:-2].sum(axis=0)[two].mean()) if two.any() else 0.0


def _images_of_a_place(looked: Sequence[SeenTarget], grid: MapGrid) -> float:
    """How many images see a place of a grid in the mean, by their footprints."""
    b = np.array(grid.bounds)
    seen = np.array([one.bounds for one in looked])
    sides = np.minimum(seen[:, 2:], b[2:]) - np.maximum(seen[:, :2], b[:2])
    return float(np.maximum(sides, 0.0).prod(axis=1).sum() / np.prod(b[2:] - b[:2]))


def _search(looked: Sequence[SeenTarget], pixels: float, height_error: float, reach: float, most: int) -> Search:
    """How heights are searched whose facets have so many pixels of usual images along a side; `most` levels."""
    at = float(np.median([sum(one.heights) / 2 for one in looked]))
    vantages = [one.camera.vantage for one in looked]
    central = all(vantage.central for vantage in vantages)
    ceiling = min(float(vantage.point[2]) for vantage in vantages) if central else math.inf
    ratio, base = _facets(pixels, _CELLS)
    cell = height_error * pixels / ratio
    level = math.ceil(math.log2(max(1.0, reach / cell / _PLANES)))
    return Search(
        planes=Planes(cell, at, ceiling), ratio=ratio, base=base, coarsest=min(level, most), room=_ROOM * cell
    )


def _coarsest(reach: float, looked: Sequence[SeenTarget], height_error: float, base: int) -> int:
    """The level on which a start that is wrong by `reach` is wrong by few pixels, or the images have become small."""
    wanted = math.ceil(math.log2(max(1.0, reach / height_error / _CATCH / 2**base)))
    shortest = min(min(one.camera.size) for one in looked)
    allowed = max(0, math.floor(math.log2(max(1.0, shortest / _LEAST))) - base)
    return int(min(wanted, allowed, _LEVELS))
