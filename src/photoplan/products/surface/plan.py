"""Plan a surface from images: its grid, how fine its facets are, where it begins. No pixel is touched."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from photoplan.cameras.base import tremor_of
from photoplan.errors import GeometryError, UsageError
from photoplan.events import SILENT, Events
from photoplan.geometry.frames import Frame, ImageFrame
from photoplan.geometry.grid import MapGrid
from photoplan.io.project.model import Project
from photoplan.io.run_record import run_key
from photoplan.matching.facets.reconstruct import Scheme
from photoplan.matching.facets.search import Planes, Search
from photoplan.plain import pick
from photoplan.products.orthophoto.look import extent_text
from photoplan.products.surface.begin import start_apart
from photoplan.products.surface.settings import Bounds, SurfaceSettings, check_bands, check_start, number
from photoplan.products.surface.target import SeenTarget, frame_of, over_frame, over_map, seen_part
from photoplan.project.scenes import ScenesAddress

#: Side of a tile of heights; those of grey values are as many times larger as they are finer.
TILE = 336
#: Grey facets along a side of a height facet at most: images that are finer still are reduced.
MOST_RATIO = 6
#: And cells that a search compares: heights are found to parts of their pixels all the same.
_CELLS = 3
#: Height facets are at least so many ground pixels of the images.
_FINEST = 1.0
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
#: Part of stated bounds that two images see, below which it is told: there are no heights elsewhere.
_MOSTLY = 0.5
HARDLY = 0.01
"""Part of the bounds up to which an image sees so little that its figures tell nothing."""
#: Levels at most.
_LEVELS = 8
#: Pixels of parallax of the reach from which on heights are searched; those for which the coarsest level of a search
#: has planes, up and down; and by how many pixels of parallax the facets may move what was found.
_RELIEF, _PLANES, _ROOM = 24.0, 24.0, 3.0


@dataclass(frozen=True, eq=False)
class SurfacePlan:
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
    """Of the target; None: the map."""
    scheme: Scheme
    gsd: float
    """Median ground sampling distance of the images, metres."""
    height_error: float
    """What one pixel of parallax between the outermost images is in height, metres."""
    apart: float
    """By how much a start that is not the project's terrain lies above that (below: negative), metres; 0: they meet."""
    seen_share: float
    """Part of the bounds that lies inside those of what two images see, 0 to 1."""
    parts: dict[str, float]
    """Part of the bounds that each image sees, 0 to 1; one with 0 may still see margins of tiles."""
    key: str
    """Hash of all that decides the product."""

    @property
    def address(self) -> ScenesAddress:
        """What its images and the ground are opened by."""
        return ScenesAddress.of(self.project, self.images)

    @property
    def axes(self) -> tuple[str, str]:
        """Names of what is along the edges of its files."""
        return ("X", "Y") if self.frame is None else ("u", "v")

    @property
    def grey_grid(self) -> MapGrid:
        """Pixels of the grey values."""
        g, m = self.grid, self.scheme.ratio
        return MapGrid(g.left, g.top, g.resolution / m, g.width * m, g.height * m, g.crs)

    def __str__(self) -> str:
        g, s = self.grid, self.scheme
        reduced = f", images reduced by {2**s.base}" if s.base else ""
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
            *([f"  {self.apart_text}"] if self.apart_text else []),
            *([] if self.frame is None else [f"  target {self.settings.target}{far}: u, v, h instead of X, Y, Z"]),
        ])  # fmt: skip

    @property
    def apart_text(self) -> str:
        """What there is to say of a start that lies farther from the project's terrain than its reach; else empty."""
        if abs(self.apart) <= self.scheme.reach:
            return ""
        side = "above" if self.apart > 0 else "below"
        return (
            f"the start (`start`) lies {abs(self.apart):.4g} m {side} the project's terrain: farther than the reach of "
            f"{self.scheme.reach:.3g} m (`reach`), so one of them cannot be right"
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

    def json_fields(self) -> dict[str, object]:
        """What a dry run tells."""
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
                start_apart_m="apart",
            ),
            **pick(self.grid, "bounds", "resolution", "width", "height"),
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
        Also of images whose orientation `photoplan check` calls a fault.
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
    frame, own = frame_of(project, settings.target)
    if frame is None:
        looked, blind = over_map(project, names, force, events)
    else:
        bounds = settings.bounds or own
        if bounds is None:
            raise UsageError(f"target {settings.target}: it has no end; give `bounds`, u and v on it in metres")
        MapGrid.covering(bounds, settings.resolution, None)
        settings = replace(settings, bounds=bounds, start="0" if settings.start == "terrain" else settings.start)
        looked, blind = over_frame(project, names, frame, bounds, float(settings.start), events)
    check_bands(project, settings.bands, [one.name for one in looked])
    bounds, seen_share = _bounds(settings, looked, blind)
    gsd = float(np.median([one.gsd for one in looked]))
    if settings.resolution < _FINEST * gsd * 0.999:
        raise UsageError(
            f"resolution {settings.resolution:g} m is finer than the images see the {settings.seen} ({gsd:.3g} m): a "
            f"height needs some pixels; choose {3 * gsd:.2g} m, or {gsd:.2g} m at least"
        )
    grid = MapGrid.covering(bounds, settings.resolution, project.crs if frame is None else None)
    if min(grid.width, grid.height) < 2:
        raise UsageError(f"bounds {extent_text(bounds)} hold {grid.width} × {grid.height} heights; 2 × 2 are needed")
    ratio, base = _facets(settings.resolution / gsd, MOST_RATIO, _images_of_a_place(looked, grid))
    height_error, usual = _heights_of_a_pixel(looked, gsd)
    flying = _flying_height(looked)
    if 0 < _MOST_WRONG * flying < (settings.reach or 0.0):
        raise UsageError(
            f"reach {settings.reach:g} m is more than {_MOST_WRONG:g} times the images' height above the ground, "
            f"{flying:.3g} m"
        )
    reach = settings.reach or _WRONG * flying or _SOME * height_error
    apart = 0.0 if frame is not None else start_apart(settings.start, grid.bounds, project.crs, looked)
    if frame is not None:
        reach = _inside(frame, float(settings.start), reach, settings.reach)
    coarsest = _coarsest(reach, looked, height_error, base)
    scheme = Scheme(ratio, coarsest, base, reach)
    # Planes are swept over lattices of cells, between which a turbulent flight shakes by more than a cell.
    shaken = any(tremor_of(one.camera) is not None for one in looked)
    strong = reach > _RELIEF * height_error and not shaken
    wanted = strong if settings.search is None else settings.search
    if wanted:
        search = _search(looked, settings.resolution / gsd, usual, reach, coarsest)
        scheme = Scheme(ratio, 0, base, reach, search)
    used = tuple(one.name for one in looked)
    return SurfacePlan(
        project=project,
        settings=settings,
        images=used,
        blind=tuple(blind),
        grid=grid,
        frame=frame,
        scheme=scheme,
        gsd=gsd,
        height_error=height_error,
        apart=apart,
        seen_share=seen_share,
        parts={one.name: seen_part(one, grid.bounds) for one in looked},
        key=_key(project, used, settings, scheme=scheme, grid=grid, frame=frame),
    )


def _key(project: Project, images: tuple[str, ...], settings: SurfaceSettings, **stated: object) -> str:
    """What all decides about heights: files, what the project says of the images, settings."""
    address = ScenesAddress.of(project, images)
    files = [Path(path) for path, _ in address.digests]
    if settings.start != "terrain" and number(settings.start) is None:
        files.append(Path(settings.start))
    stated |= {"settings": replace(settings, points=()), "facts": address.facts}
    return run_key("surface", stated, files)


def _inside(frame: Frame, start: float, reach: float, stated: float | None) -> float:
    """The reach, not farther than the frame goes; one that a user states is refused."""
    low, high = frame.heights
    most = min(start - low, high - start)
    if most <= 0 or (reach > most and stated is not None):
        ends = [f"{word} {end:.3g} m" for word, end in (("from", low), ("to", high)) if math.isfinite(end)]
        raise UsageError(f"start {start:g} m and reach {reach:g} m: its heights go {' '.join(ends)}")
    return min(reach, most)


def _bounds(settings: SurfaceSettings, looked: Sequence[SeenTarget], blind: Sequence[str]) -> tuple[Bounds, float]:
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
    MapGrid.covering(b, settings.resolution, None)
    if not (b[0] < xmax and xmin < b[2] and b[1] < ymax and ymin < b[3]):
        together = extent_text((xmin, ymin, xmax, ymax))
        raise GeometryError(f"bounds {extent_text(b)}: no two images see anything there; together they see {together}")
    common_area = (min(b[2], xmax) - max(b[0], xmin)) * (min(b[3], ymax) - max(b[1], ymin))
    return b, common_area / ((b[2] - b[0]) * (b[3] - b[1]))


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


def _facets(pixels: float, most: int, images: float = 0.0) -> tuple[int, int]:
    """Facets along a height facet of so many pixels, and the level of the images whose pixels are as large as they.

    Facets are no coarser than pixels where so many images see a place that any two, which tell its height, leave a
    pixel for each facet to the others: coarser ones do not hold what pixels show, which moves heights over whole
    stretches where pixels drift along the facets. Of three images, slopes and finer grey values mix.
    """
    base = max(0, math.ceil(math.log2(pixels / most)))
    pixels /= 2**base
    ratio = max(1, round(pixels))
    finer = ratio < 0.999 * pixels and (images - 2) * (pixels / (ratio + 1)) ** 2 >= 1
    return ratio + finer, base


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
    return Search(Planes(cell, at, ceiling), ratio, base, min(level, most), _ROOM * cell)


def _coarsest(reach: float, looked: Sequence[SeenTarget], height_error: float, base: int) -> int:
    """The level on which a start that is wrong by `reach` is wrong by few pixels, or the images have become small."""
    wanted = math.ceil(math.log2(max(1.0, reach / height_error / _CATCH / 2**base)))
    shortest = min(min(one.camera.size) for one in looked)
    allowed = max(0, math.floor(math.log2(max(1.0, shortest / _LEAST))) - base)
    return int(min(wanted, allowed, _LEVELS))
