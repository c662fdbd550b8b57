"""Plans of surface reconstruction: targets, initial surface, scheme of grids, job."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import Camera, tremor_of
from photoplan.cameras.base import project as project_points
from photoplan.cameras.framed import FramedCamera
from photoplan.engine.run import Made, Output
from photoplan.errors import GeometryError, InputError, UsageError
from photoplan.events import SILENT, Events, stretch
from photoplan.findings import Result
from photoplan.geometry.bounds import MOST_HEIGHT, bounds_fault, odd_place
from photoplan.geometry.frames import CylinderFrame, Frame, ImageFrame
from photoplan.geometry.grid import MapGrid, Window
from photoplan.io.files import fingerprint, safe_stem
from photoplan.io.points import check_cloud
from photoplan.io.project.model import Project
from photoplan.io.store import run_key
from photoplan.matching.facets.observe import Pyramid, View
from photoplan.matching.facets.reconstruct import MARGIN, Planes, Scheme, Search, reconstruct
from photoplan.matching.features import GreyImage
from photoplan.plain import advised, pick
from photoplan.plan.footprint import Tile, Tiles
from photoplan.products.orthophoto.plan import extent_text, look_at
from photoplan.project.ground import Ground, ground_of, open_terrain
from photoplan.project.scene import (
    Scene,
    ScenesAddress,
    map_order,
    open_scene,
    refuse_unusable,
    surface_of,
)
from photoplan.project.target import stated_target, target_frame
from photoplan.requests.surface import SurfaceSettings
from photoplan.surfaces.objects import without_objects

Bounds = tuple[float, float, float, float]


def check_start(project: Project, settings: SurfaceSettings) -> None:
    """Refuse a start that is none."""
    if settings.reach is not None and not 0 < settings.reach <= MOST_HEIGHT:
        raise UsageError(f"reach {settings.reach}; a positive number of metres is needed, {MOST_HEIGHT:g} at most")
    name = settings.name
    if not any(c.isalnum() for c in name) or safe_stem(name) != name.replace(" ", "_"):
        raise UsageError(
            f"name {name!r}; give the name of a file without folder and extension, of letters, digits, - and _"
        )
    for path in settings.points:
        check_cloud(path)
    if settings.start == "terrain":
        return
    height = settings.start_height
    if height is not None and not math.isfinite(height):
        raise UsageError(f"start {settings.start}; give `terrain`, a height in metres, or a file of heights")
    odd = None if height is None else odd_place((0.0, 0.0, height), camera=True)
    if odd is not None:
        raise UsageError(f"start: {odd}")
    if height is None and settings.target != "map":
        raise UsageError(f"start {settings.start!r}: on a target that is no map give a height in metres")
    if height is None:
        if not Path(settings.start).exists():
            raise UsageError(f"start {settings.start!r}: is no height and no file; give `terrain`, a height, or a file")
        open_terrain(Path(settings.start)).in_crs(project.crs)


#: Classes, the binary logarithms of their least and largest standard deviation, metres.
_CLASSES, _LEAST, _LARGEST = 256, -24.0, 8.0


def counted(sigmas: NDArray[np.floating]) -> list[int]:
    """Count the standard deviations (metres, NaN: none) in each class; those beyond lie in the last."""
    known = sigmas[np.isfinite(sigmas)].astype(float)
    exponents = np.log2(np.clip(known, 2.0**_LEAST, 2.0**_LARGEST))
    return np.histogram(exponents, _CLASSES, (_LEAST, _LARGEST))[0].tolist()


def median(counts: Sequence[int]) -> float | None:
    """Median standard deviation, metres, to 4 %; None: there are none."""
    below = np.concatenate([[0], np.cumsum(counts)])
    if not below[-1]:
        return None
    exponents = np.linspace(_LEAST, _LARGEST, _CLASSES + 1)
    return float(2.0 ** np.interp(below[-1] / 2, below, exponents))


#: Points along a side of a target that are projected to see which images show it.
_POINTS = 33
#: Metres by which a place of a target lies beside a ray that meets it.
_SAME = 1e-3


@dataclass(frozen=True, eq=False)
class SeenTarget:
    """View of an image on a target."""

    name: str
    camera: Camera
    """In the target's coordinates."""
    bounds: Bounds
    """Bounds of everything that it sees there."""
    heights: tuple[float, float]
    """Heights between which that lies."""
    gsd: float
    """Its mean ground sampling distance, metres."""


def seen_places(one: SeenTarget, bounds: Bounds) -> NDArray[np.bool_]:
    """Return True for points of a lattice over the bounds, the same for all, that an image sees on its mean height."""
    u, v = (bounds[k] + (bounds[k + 2] - bounds[k]) * (np.arange(_POINTS) + 0.5) / _POINTS for k in (0, 1))
    at = project_points(one.camera, np.stack([*np.meshgrid(u, v), np.full((_POINTS,) * 2, sum(one.heights) / 2)], -1))
    return _inside(one.camera, at)


def _inside(camera: Camera, at: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return True for image points (..., 2) that lie on pixels; NaN does not."""
    return np.asarray(((at > -0.5) & (at < np.array(camera.size) - 0.5)).all(axis=-1))


def over_map(project: Project, names: Sequence[str], force: bool, events: Events) -> tuple[list[SeenTarget], list[str]]:
    """Images that see terrain, and a line for each that sees none; see `look_at`."""
    looked, blind = look_at(project, names, force, events)
    prints = [(one, one.look.footprint) for one in looked]
    seen = [
        SeenTarget(
            name=one.name,
            camera=one.scene.camera,
            bounds=print_.bounds,
            heights=print_.height_range,
            gsd=one.look.gsd,
        )
        for one, print_ in prints
        if print_.bounds is not None
    ]
    return seen, blind


def over_frame(
    project: Project, names: Sequence[str], frame: Frame, bounds: Bounds, height: float, events: Events
) -> tuple[list[SeenTarget], list[str]]:
    """Images that see a part of a target at a height, and a line for each that sees none."""
    u, v = (np.linspace(bounds[k], bounds[k + 2], _POINTS) for k in (0, 1))
    uvh = np.stack([*np.meshgrid(u, v), np.full((_POINTS, _POINTS), height)], axis=-1).reshape(-1, 3)
    names, blind = project.oriented(names)
    events.done(len(blind))
    seen, behind = {}, 0
    for name in (names[place] for place in map_order(project, names)):
        camera = FramedCamera(open_scene(project, name).camera, frame, bounds)
        at = project_points(camera, uvh)
        # From behind nothing of a wall is seen, nor the far side of a column.
        point, way = camera.rays(at, height)
        along = np.abs((uvh - point) - ((uvh - point) * way).sum(axis=1)[:, None] * way).max(axis=1)
        inside = _inside(camera, at) & (way[:, 2] < 0) & (along < _SAME)
        events.done()
        if not inside.any():
            stands = frame.inverse(camera.camera.vantage.point)
            behind += bool(stands[2] <= height)
            here = ", from u {:.6g}, v {:.6g}, h {:.6g}".format(*stands) if np.isfinite(stands).all() else ""
            blind.append(f"{name}: shows nothing of the target inside the bounds at the height {height:g}{here}")
            continue
        low, high = uvh[inside, :2].min(axis=0).tolist(), uvh[inside, :2].max(axis=0).tolist()
        areas = np.abs(np.linalg.det(camera.derivatives(uvh[inside])[..., :2]))
        gsd = float(np.mean(areas**-0.5))
        seen[name] = SeenTarget(name=name, camera=camera, bounds=(*low, *high), heights=(height, height), gsd=gsd)
    if behind == len(names):
        helps = "the azimuth of a wall is that of its outward normal, towards them"
        if isinstance(frame, CylinderFrame):
            helps = "a vault is seen from inside its radius, a column from outside"
        elif isinstance(frame, ImageFrame):
            helps = "they stand nearer to what is seen than its distance"
        raise GeometryError(
            f"all images stand behind the target at the height {height:g}: {helps}\n  " + "\n  ".join(blind[:12])
        )
    return [seen[name] for name in names if name in seen], blind


#: Places along a side of the bounds at which a start is compared with the project's terrain.
_PLACES = 33


@dataclass(frozen=True)
class StartGap:
    """Heights of a start less those of the project's terrain inside the bounds of a surface."""

    median: float = 0.0
    """Median of all places where both have a height, metres; 0 if there is none, or the start is the terrain."""
    share: float = 0.0
    """Part of these places at which they differ by more than the reach, 0 to 1."""


def start_gap(
    settings: SurfaceSettings, reach: float, bounds: Bounds, crs: str, looked: Sequence[SeenTarget], ground: Ground
) -> StartGap:
    """Compare a start with the project's terrain, place by place inside the bounds."""
    start, height, stated = settings.start, settings.start_height, None
    if start == "terrain":
        return StartGap()
    x0, y0, x1, y1 = bounds
    part = (np.arange(_PLACES) + 0.5) / _PLACES
    XY = np.stack(np.meshgrid(x0 + part * (x1 - x0), y0 + part * (y1 - y0)), axis=-1)
    if height is None:
        opened = open_terrain(Path(start)).in_crs(crs)[0]
        stated, begun = opened.height_system, np.asarray(opened.surface.heights(XY), float)
    else:
        begun = np.full(XY.shape[:-1], height)
    if not np.isfinite(begun).any():
        return StartGap()  # the run reports that the start has no height there
    lifted = ground.into_working(crs, stated).where_defined(np.concatenate([XY, begun[..., None]], axis=-1))
    shift = float(np.nanmedian(lifted - begun))
    ceilings = sorted(((float(one.camera.vantage.point[2]) - shift, one.name) for one in looked), reverse=True)
    low = float(np.nanmin(begun))
    if sum(ceiling > low for ceiling, _ in ceilings) < 2:
        (first, name), (last, other) = ceilings[0], ceilings[-1]
        raise UsageError(
            f"start {start}: {low:.6g} m is above the images, which look down from {last:.6g} m ({other}) to "
            f"{first:.6g} m ({name})"
        )
    gaps = lifted - np.asarray(ground.bare.heights(XY), float)
    gaps = gaps[np.isfinite(gaps)]
    if not gaps.size:
        return StartGap()
    return StartGap(float(np.median(gaps)), float((np.abs(gaps) > reach).mean()))


#: Grey facets along a side of a height facet at most: images that are finer still are reduced.
MOST_RATIO = 6
#: And cells that a search compares: heights are found to parts of their pixels all the same.
_CELLS = 3
#: How far the start may be wrong if nobody states it, part of the flying height.
_WRONG = 0.1
#: And if somebody does: a start between camera and ground is farther from the ground than from the camera.
_MOST_WRONG = 3.0
#: Pixels of parallax by which the coarsest level may begin wrong, and pixels along the shorter side of an image there.
_CATCH, _LEAST_SCHEME = 1.0, 16
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
    """Return by how much the start may be wrong, metres."""
    flying = _flying_height(looked)
    if 0 < _MOST_WRONG * flying < (settings.reach or 0.0):
        raise UsageError(
            f"reach {settings.reach:g} m is more than {_MOST_WRONG:g} times the images' height above the ground, "
            f"{flying:.3g} m"
        )
    reach = settings.reach or _WRONG * flying or _SOME * height_error
    return reach if frame is None else _inside_scheme(frame, float(settings.start), reach, settings.reach)


def _inside_scheme(frame: Frame, start: float, reach: float, stated: float | None) -> float:
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
    """Return the move of the ground point of a pixel on the map per metre of height, at a place, shape (2,)."""
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
    """Return the mean number of images that see a place of a grid, by their footprints."""
    b = np.array(grid.bounds)
    seen = np.array([one.bounds for one in looked])
    sides = np.minimum(seen[:, 2:], b[2:]) - np.maximum(seen[:, :2], b[:2])
    return float(np.maximum(sides, 0.0).prod(axis=1).sum() / np.prod(b[2:] - b[:2]))


def _search(looked: Sequence[SeenTarget], pixels: float, height_error: float, reach: float, most: int) -> Search:
    """Return the search for heights whose facets have so many pixels of usual images along a side; `most` levels."""
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
    allowed = max(0, math.floor(math.log2(max(1.0, shortest / _LEAST_SCHEME))) - base)
    return int(min(wanted, allowed, _LEVELS))


_Doubles = NDArray[np.float64]

TILE = 336
"""Side of a tile of heights; those of grey values are as many times larger as they are finer."""
#: Grey facets along a part that is reconstructed at once, and blocks of image pyramids that are kept, bytes in all.
_PART, _KEPT = 1008, 256 << 20
MISFIT = 2.0
"""Heights around which residuals are so many times larger than expected are told of: they may be wrong."""
#: Bytes of a grey facet while it is adjusted: its equations, and what its pixel of each image needs.
_FACET, _PIXEL = 140, 60


@dataclass(frozen=True, kw_only=True)
class SurfaceJob:
    """All that a worker is told."""

    address: ScenesAddress
    grid: MapGrid
    scheme: Scheme
    start: str
    """See `SurfaceSettings.start`."""
    begun: tuple[str, str] | None = None
    """See `SurfacePlan.begun`."""
    residuals: bool = False
    """See `SurfaceSettings.residuals`."""
    frame: Frame | None = None
    """Frame of the target; None for the map."""
    bands: tuple[int, ...] = ()
    """See `SurfaceSettings.bands`."""
    finer: tuple[int, ...] = ()
    """See `SurfacePlan.finer`; empty: none is."""
    seen: float = 0.0
    """See `SurfacePlan.most`; 0: all."""

    @property
    def part(self) -> int:
        """Posts along a part of a tile that is reconstructed at once."""
        return max(16, min(TILE, _PART // self.scheme.ratio))

    @property
    def bytes(self) -> int:
        """Memory that a tile takes."""
        m, images = self.scheme.ratio, len(self.address.scenes)

        def facets(side: int, around: int = 0) -> int:
            return m**2 * (min(side, self.grid.width) + 2 * around) * (min(side, self.grid.height) + 2 * around)

        residuals = images if self.residuals else 0
        made = 4 * ((2 + residuals) * facets(TILE) + residuals * facets(self.part))
        each = _FACET + _PIXEL * (self.seen or images)
        return int(facets(self.part, MARGIN) * each) + 2 * _PART**2 * images + made

    def __call__(self, tile: Tile) -> Made:
        """Heights, their standard deviations, number of images, fit; grey values, theirs, perhaps residuals."""
        views = _views(self.address, self.finer, self.frame, self.grid.bounds, self.bands)
        start = _start(self.address, self.start, self.begun, self.grid.crs)
        crs, ground = self.grid.crs, self.address.scenes[0].open().ground
        outward = None if crs is None else ground.out_of_working(crs)
        window, m = tile.window, self.scheme.ratio
        shape, finest = (window.height, window.width), (m * window.height, m * window.width)
        heights, sigmas, fit = (np.full((1, *shape), np.nan, np.float32) for _ in range(3))
        count = np.zeros((1, *shape), np.uint8)
        grey, grey_sigmas = (np.full((1, *finest), np.nan, np.float32) for _ in range(2))
        residuals = np.full((len(views) if self.residuals else 0, *finest), np.nan, np.float32)
        sums, noise = np.zeros((len(views), 2)), np.zeros((len(views), 3))
        moves, parts, astray = np.zeros(self.scheme.coarsest + 1), 0, 0
        every = tuple(window.tiles(self.part))
        for k, part in enumerate(every):
            name = f"part {k + 1} of {len(every)}" if len(every) > 1 else ""
            with stretch(k / len(every), (k + 1) / len(every), name):
                found = reconstruct(views, self.grid, part, self.scheme, start, self.residuals)
            if found is None:
                continue
            at = (0, *part.slices(window))
            heights[at], sigmas[at], count[at], fit[at] = found.heights, found.sigmas, found.count, found.fit
            finer = Window(m * part.col, m * part.row, m * part.width, m * part.height)
            there = finer.slices(Window(m * window.col, m * window.row, m * window.width, m * window.height))
            grey[(0, *there)], grey_sigmas[(0, *there)] = found.grey, found.grey_sigmas
            if found.residuals is not None:
                residuals[(slice(None), *there)] = found.residuals
            sums, noise = sums + found.sums, noise + found.noise
            moves, parts, astray = moves + found.moves, parts + 1, astray + found.astray
        record = {
            "squares": sums[:, 0].tolist(),
            "redundancy": sums[:, 1].tolist(),
            "noise": noise.ravel().tolist(),
            "moves": moves.tolist(),
            "parts": parts,
            "sigmas": counted(sigmas),
            "heights": int(np.isfinite(sigmas).sum()),
            "astray": astray,
            "misfits": int((fit > MISFIT).sum()),
            "greys": [float(np.isfinite(grey).sum()), *(float(np.nansum(grey.astype(float) ** n)) for n in (1, 2))],
        }
        known, seen = np.isfinite(heights[0]), np.isfinite(grey[0])
        if outward is not None and outward.definition is not None:
            XY = self.grid.to_map(np.argwhere(known)[:, ::-1] + (window.col, window.row))
            heights[0, known] = outward(np.column_stack([XY, heights[0, known]]))
        layers: list[Output] = [
            (heights, known), (sigmas, known), (count, count[0] > 0), (fit, known), (grey, seen), (grey_sigmas, seen)
        ]  # fmt: skip
        if self.residuals:
            layers.append((residuals, seen & np.isfinite(residuals).any(axis=0)))
        return Made(tuple(layers) if known.any() else (None,) * len(layers), record)


@lru_cache(maxsize=2)
def _views(
    address: ScenesAddress, finer: tuple[int, ...], frame: Frame | None, bounds: Bounds, bands: tuple[int, ...]
) -> tuple[View, ...]:
    """The images and their pyramids, kept for the next tile; those of products before go."""
    kept = _KEPT // len(address.scenes)

    def view(scene: Scene, levels: int) -> View:
        camera = scene.camera if frame is None else FramedCamera(scene.camera, frame, bounds)
        return View(camera, Pyramid(GreyImage(scene.reader, bands=bands), kept=kept), levels)

    levels = finer or (0,) * len(address.scenes)
    return tuple(view(scene.open(), level) for scene, level in zip(address.scenes, levels, strict=True))


@lru_cache(maxsize=4)
def _start(
    address: ScenesAddress, start: str, begun: tuple[str, str] | None, crs: str
) -> Callable[[_Doubles], _Doubles]:
    """Heights with which a surface begins, in the system of the cameras; those of a user are in the one that their file
    states, or in the orientation's.
    """
    if begun is not None:
        path, digest = begun
        if fingerprint(path).digest != digest:
            raise InputError(f"{path}: has changed since the run was planned; plan it again")
        opened = open_terrain(Path(path)).in_crs(crs)[0]
        return _in_working(address, crs, opened.surface.heights, opened.height_system)
    if start == "terrain":
        return without_objects(surface_of(address)).heights
    height = float(start)
    return _in_working(address, crs, lambda XY: np.full(XY.shape[:-1], height))


def _in_working(
    address: ScenesAddress, crs: str | None, heights: Callable[[_Doubles], _Doubles], stated: str | None = None
) -> Callable[[_Doubles], _Doubles]:
    """Heights of a map, perhaps in a stated system, in that of the cameras; those over another target (no CRS) are in
    none."""
    step = None if crs is None else address.scenes[0].open().ground.into_working(crs, stated)
    if step is None or step.definition is None:
        return heights
    return lambda XY: step.where_defined(np.concatenate([XY, np.asarray(heights(XY))[..., None]], axis=-1))


#: Height facets are at least so many ground pixels of the images.
_FINEST = 1.0
#: Part of stated bounds that two images see, below which it is told: there are no heights elsewhere.
_MOSTLY = 0.5
#: Part of the places at which a start may lie farther from the terrain than its reach before the plan reports it.
_BESIDE = 0.02
HARDLY = 0.01
"""Part of the bounds up to which an image sees so little that its figures tell nothing."""


@dataclass(frozen=True, eq=False)
class SurfacePlan(Result):
    """A surface before its heights."""

    project: Project
    settings: SurfaceSettings
    images: tuple[str, ...]
    """Images that see the ground."""
    blind: tuple[str, ...]
    """A line for each image that sees none of it."""
    grid: MapGrid
    """Its pixels are the height posts."""
    frame: Frame | None
    """Frame of the target, in the height system of the cameras; None for the map."""
    scheme: Scheme
    begun: tuple[str, str] | None
    """Path and content digest of the file of heights with which it begins; None: it begins with none."""
    finer: tuple[int, ...]
    """Levels by which each image takes part reduced beyond the scheme, as its pixels are so much smaller than usual."""
    gsd: float
    """Median ground sampling distance of the images, metres."""
    height_error: float
    """Height of one pixel of parallax between the outermost images, metres."""
    gap: StartGap
    """Heights of a start that is not the project's terrain less those of the terrain."""
    seen_share: float
    """Part of the bounds that lies inside those of what two images see, 0 to 1."""
    parts: dict[str, float]
    """Part of the bounds that each image sees, 0 to 1; one with 0 may still see margins of tiles."""
    most: float
    """Images that see the place in the bounds that most see, each counting by how many pixels it has of usual ones."""
    key: str
    """Hash of all that decides the product."""
    force: bool = False
    """True if it is also written if the images contradict it."""

    @property
    def address(self) -> ScenesAddress:
        """Address by which its images and the ground are opened."""
        return ScenesAddress.of(self.project, self.images)

    @property
    def inputs(self) -> tuple[tuple[str, str], ...]:
        """Path and content digest of each file that it is made of, that with which it begins among them."""
        return self.address.digests if self.begun is None else (*self.address.digests, self.begun)

    @property
    def axes(self) -> tuple[str, str]:
        """Names of what is along the edges of its files."""
        return ("X", "Y") if self.frame is None else ("u", "v")

    @property
    def grey_grid(self) -> MapGrid:
        """Pixels of the grey values."""
        g, m = self.grid, self.scheme.ratio
        return replace(g, resolution=g.resolution / m, width=g.width * m, height=g.height * m)

    @property
    def tiles(self) -> Tiles:
        """Tiles of the heights."""
        return Tiles.every(self.grid.window, TILE)

    def __str__(self) -> str:
        g, s = self.grid, self.scheme
        reduced = f", images reduced by {2**s.base}" if s.base else ""
        small = sum(level > 0 for level in self.finer)
        reduced += f", {small} image{'s' * (small > 1)} with far smaller pixels reduced" if small else ""
        pixels = f"{s.ratio**2} pixel{'s' * (s.ratio > 1)} of each image per height"
        far = f" at {self.frame.distance:.4g} m" if isinstance(self.frame, ImageFrame) else ""
        seeing = sum(part > HARDLY for part in self.parts.values())
        images = f"{len(self.images)} images"
        if seeing < len(self.images):
            images += f", {seeing} of which see more than {HARDLY:.0%} of it"
        return "\n".join([
            f"surface of {images}: {g.width} × {g.height} heights of {g.resolution:g} m, grey values "
            f"of {g.resolution / s.ratio:.3g} m",
            f"  GSD {self.gsd:.3g} m, {pixels}{reduced}; one pixel of parallax is {self.height_error:.3g} m of height",
            f"  {s.coarsest + 1} level{'s' * (s.coarsest > 0)}, the coarsest with heights of "
            f"{g.resolution * 2**s.coarsest:g} m; start: {self.settings.start}{self._searched}",
            *([f"  two images see {self.seen_share:.2%} of these bounds at most"] if self.seen_share < _MOSTLY else []),
            *([f"  {self.gap_text}"] if self.gap_text else []),
            *([] if self.frame is None else [f"  target {self.settings.target}{far}: u, v, h instead of X, Y, Z"]),
        ])  # fmt: skip

    @property
    def gap_text(self) -> str:
        """Sentence about a start that lies farther from the project's terrain than its reach; empty if it does not."""
        if self.gap.share <= _BESIDE:
            return ""
        side = "above" if self.gap.median > 0 else "below"
        where, median = "", ""
        if self.gap.share < 1 - _BESIDE:
            where, median = f" at {self.gap.share:.0%} of the places inside the bounds", " in the median"
        return (
            f"the start (`start`) lies {abs(self.gap.median):.3g} m {side} the project's terrain{median}: farther than "
            f"the reach of {self.scheme.reach:.3g} m (`reach`){where}, so one of them cannot be right there"
        )

    @property
    def _searched(self) -> str:
        s = self.scheme
        if s.search is None:
            return ""
        pixels, levels = s.reach / self.height_error, s.search.coarsest + 1
        return (
            f", heights searched within {s.reach:.3g} m ({pixels:.0f} px) of it on {levels} level{'s' * (levels > 1)}"
        )

    def written(self) -> Sequence[Path]:
        """Return no file: none is written."""
        return ()

    def summary(self) -> Sequence[str]:
        """Return the plan."""
        return [str(self)]

    def messages(self) -> Sequence[str]:
        """Return the images that are left out."""
        return [f"note: left out: {line}" for line in self.blind]

    def raise_failures(self) -> None:
        """Name the images that could not be used."""
        refuse_unusable(self.project.unusable, len(self.images) + len(self.blind))

    def json_fields(self) -> dict[str, object]:
        """Return what a dry run prints."""
        return {
            **pick(
                self,
                "images",
                "blind",
                "gsd",
                "key",
                "seen_share",
                "parts",
                height_of_a_pixel="height_error",
            ),
            **pick(self.grid, "bounds", "resolution", "width", "height"),
            "tiles": len(self.tiles),
            "start_gap_m": self.gap.median,
            "start_gap_share": self.gap.share,
            "target": self.settings.target,
            "frame": self.frame,
            "levels": self.scheme.coarsest + 1,
            "search_levels": 0 if self.scheme.search is None else self.scheme.search.coarsest + 1,
            "grey_resolution": self.grey_grid.resolution,
        }


def plan_surface(
    project: Project,
    settings: SurfaceSettings,
    images: Sequence[str] | None = None,
    *,
    force: bool = False,
    events: Events = SILENT,
) -> SurfacePlan:
    """Plan a surface.

    Parameters
    ----------
    project : Project
    settings : SurfaceSettings
    images : sequence of str, optional
        Names or patterns; None: all.
    force : bool
        Also of images whose orientation `photoplan check` calls a fault, and although images contradict the surface.
    events : Events
        Told of each image.

    Raises
    ------
    InputError
        An input cannot be used.
    GeometryError
        Fewer than two images see a common piece of ground, or an orientation cannot be right.
    UsageError
        An unknown image, or a resolution or bounds that make no sense.
    """
    names = project.select(images)
    if len(names) < 2:
        raise UsageError(f"images {', '.join(names)}: heights need two images at least")
    check_start(project, settings)
    events.begin("planning", len(names), "images")
    frame, own = target_frame(project, settings.target)
    if frame is None:
        looked, blind = over_map(project, names, force, events)
    else:
        settings = _on_frame(settings, settings.bounds or own)
        settings = settings.replace(target=stated_target(project, settings.target).frame)
        assert settings.bounds is not None
        looked, blind = over_frame(project, names, frame, settings.bounds, float(settings.start), events)
    for one in looked if settings.bands else ():
        if max(settings.bands) > (own_bands := open_scene(project, one.name).reader.bands):
            raise UsageError(f"bands {', '.join(map(str, settings.bands))}: image {one.name!r} has {own_bands}")
    bounds, seen_share = _bounds(settings, None if frame is not None else project.crs, looked, blind)
    gsd = float(np.median([one.gsd for one in looked]))
    if settings.resolution < _FINEST * gsd * 0.999:
        raise UsageError(
            f"resolution {settings.resolution:g} m is finer than the images see the {settings.seen} ({gsd:.3g} m): a "
            f"height needs some pixels; choose {advised(3 * gsd)} m, or {advised(_FINEST * gsd)} m at least"
        )
    grid = MapGrid.covering(bounds, settings.resolution, project.crs if frame is None else None)
    if min(grid.width, grid.height) < 2:
        raise UsageError(f"bounds {extent_text(bounds)} hold {grid.width} × {grid.height} heights; 2 × 2 are needed")
    finer = finer_levels(looked, gsd)
    pixels = pixels_of_places(looked, finer, grid, gsd)
    scheme, height_error = scheme_of(settings, looked, grid, frame, gsd, pixels)
    gap = StartGap()
    if frame is None:
        gap = start_gap(settings, scheme.reach, grid.bounds, project.crs, looked, ground_of(project))
    used, file = tuple(one.name for one in looked), settings.start_file
    return SurfacePlan(
        project=project,
        settings=settings,
        images=used,
        blind=tuple(blind),
        grid=grid,
        frame=frame,
        scheme=scheme,
        begun=None if file is None else (str(file.resolve()), fingerprint(file).digest),
        finer=finer,
        gsd=gsd,
        height_error=height_error,
        gap=gap,
        seen_share=seen_share,
        parts={one.name: float((seen > 0).mean()) for one, seen in zip(looked, pixels)},
        most=float(pixels.sum(axis=0).max()),
        key=_key(project, used, settings, scheme=scheme, grid=grid, frame=frame),
        force=force,
    )


def _on_frame(settings: SurfaceSettings, bounds: Bounds | None) -> SurfaceSettings:
    """Settings of a target that is no map: with its bounds, and a height as start."""
    if bounds is None:
        raise UsageError(f"target {settings.target}: it has no end; give `bounds`, u and v on it in metres")
    MapGrid.covering(bounds, settings.resolution, None)
    return settings.replace(bounds=bounds, start="0" if settings.start == "terrain" else settings.start)


def _key(project: Project, images: tuple[str, ...], settings: SurfaceSettings, **stated: object) -> str:
    """Return the key of all that decides heights: files, what the project says of the images, settings."""
    address = ScenesAddress.of(project, images)
    files = [Path(path) for path, _ in address.digests]
    if settings.start_file is not None:
        files.append(settings.start_file)
    stated |= {"settings": settings.replace(points=()), "facts": address.facts}
    return run_key("surface", stated, files)


def _bounds(
    settings: SurfaceSettings, crs: str | None, looked: Sequence[SeenTarget], blind: Sequence[str]
) -> tuple[Bounds, float]:
    """The bounds that were chosen, or around all that two images see by their footprints; the part of them they see."""
    seen = [one.bounds for one in looked]
    common = []
    for a, b in combinations(seen, 2):
        low, high = np.maximum(a[:2], b[:2]), np.minimum(a[2:], b[2:])
        if (low < high).all():
            common.append((*low.tolist(), *high.tolist()))
    if not common:
        lines = [f"{one.name}: sees {extent_text(one.bounds)}" for one in looked]
        raise GeometryError(
            f"no two images see a common piece of the {settings.seen}, so there are no heights:\n  "
            + "\n  ".join([*lines, *blind][:12])
        )
    around = np.array(common)
    (xmin, ymin), (xmax, ymax) = around[:, :2].min(axis=0).tolist(), around[:, 2:].max(axis=0).tolist()
    if settings.bounds is None:
        return (xmin, ymin, xmax, ymax), 1.0
    b = settings.bounds
    if (fault := bounds_fault(b, crs, (xmin, ymin, xmax, ymax))) is not None:
        raise UsageError(fault)
    MapGrid.covering(b, settings.resolution, None)
    if not (b[0] < xmax and xmin < b[2] and b[1] < ymax and ymin < b[3]):
        together = extent_text((xmin, ymin, xmax, ymax))
        raise GeometryError(f"bounds {extent_text(b)}: no two images see anything there; together they see {together}")
    common_area = (min(b[2], xmax) - max(b[0], xmin)) * (min(b[3], ymax) - max(b[1], ymin))
    return b, common_area / ((b[2] - b[0]) * (b[3] - b[1]))
