"""Plan a surface from images: its grid, how fine its facets are, where it begins. No pixel is touched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from photoplan.errors import GeometryError, UsageError
from photoplan.events import SILENT, Events
from photoplan.geometry.bounds import bounds_fault
from photoplan.geometry.frames import Frame, ImageFrame
from photoplan.geometry.grid import MapGrid
from photoplan.io.fingerprint import fingerprint
from photoplan.io.project.model import Project
from photoplan.io.run_record import run_key
from photoplan.matching.facets.reconstruct import Scheme
from photoplan.plain import advised, pick
from photoplan.plan.tiles import Tiles
from photoplan.products.orthophoto.look import extent_text
from photoplan.products.surface.begin import StartGap, start_gap
from photoplan.products.surface.job import TILE
from photoplan.products.surface.scheme import finer_levels, pixels_of_places, scheme_of
from photoplan.products.surface.settings import Bounds, SurfaceSettings, check_bands, check_start
from photoplan.products.surface.target import SeenTarget, over_frame, over_map
from photoplan.project.ground import ground_of
from photoplan.project.scenes import ScenesAddress
from photoplan.project.target_frame import target_frame

#: Height facets are at least so many ground pixels of the images.
_FINEST = 1.0
#: Part of stated bounds that two images see, below which it is told: there are no heights elsewhere.
_MOSTLY = 0.5
#: Part of the places at which a start may lie farther from the terrain than its reach before the plan reports it.
_BESIDE = 0.02
HARDLY = 0.01
"""Part of the bounds up to which an image sees so little that its figures tell nothing."""


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
    """Of the target, in the height system of the cameras; None: the map."""
    scheme: Scheme
    begun: tuple[str, str] | None
    """Path and content digest of the file of heights with which it begins; None: it begins with none."""
    finer: tuple[int, ...]
    """Levels by which each image takes part reduced beyond the scheme, as its pixels are so much smaller than usual."""
    gsd: float
    """Median ground sampling distance of the images, metres."""
    height_error: float
    """What one pixel of parallax between the outermost images is in height, metres."""
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
    """Whether it is also written if the images contradict it."""

    @property
    def address(self) -> ScenesAddress:
        """What its images and the ground are opened by."""
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
        assert settings.bounds is not None
        looked, blind = over_frame(project, names, frame, settings.bounds, float(settings.start), events)
    check_bands(project, settings.bands, [one.name for one in looked])
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
        gap = start_gap(settings.start, scheme.reach, grid.bounds, project.crs, looked, ground_of(project))
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
    return replace(settings, bounds=bounds, start="0" if settings.start == "terrain" else settings.start)


def _key(project: Project, images: tuple[str, ...], settings: SurfaceSettings, **stated: object) -> str:
    """What all decides about heights: files, what the project says of the images, settings."""
    address = ScenesAddress.of(project, images)
    files = [Path(path) for path, _ in address.digests]
    if settings.start_file is not None:
        files.append(settings.start_file)
    stated |= {"settings": replace(settings, points=()), "facts": address.facts}
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
