"""What a user may choose about a surface, and what is refused of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from photoplan.errors import UsageError
from photoplan.geometry.bounds import MOST_HEIGHT, odd_place
from photoplan.io.names import safe_stem
from photoplan.io.point_cloud import check_cloud
from photoplan.io.project.model import Project
from photoplan.project.open_terrain import open_terrain
from photoplan.project.scene import open_scene

Bounds = tuple[float, float, float, float]


@dataclass(frozen=True)
class SurfaceSettings:
    """What a user may choose about a surface."""

    resolution: float
    """Distance of the height posts, metres."""
    target: str = "map"
    """What heights are over: `map`, `wall:X,Y,Z,AZIMUTH[,TILT]`, `vault:X,Y,Z,AZIMUTH,RADIUS[,TILT]`,
    `column:X,Y,Z,AZIMUTH,RADIUS` or `image:NAME[,DISTANCE]`, see `photoplan.project.target_frame`."""
    bounds: Bounds | None = None
    """xmin, ymin, xmax, ymax; None: all that two images see, or the image that is the target; others need them."""
    start: str = "terrain"
    """`terrain` (the project's), a height in metres, or a file of heights; on a target that is no map a height, for
    `terrain` 0."""
    reach: float | None = None
    """How far the start may be wrong, metres; None: a tenth of the flying height."""
    search: bool | None = None
    """Whether heights are first searched post by post within the reach, for strong relief; None: where the reach is
    many pixels of parallax, and no image was taken on a turbulent flight."""
    bands: tuple[int, ...] = ()
    """Bands of every image whose mean is its grey value, from 1; empty: luminance of three, the mean of others."""
    residuals: bool = False
    """Whether to write the residuals of every image, too."""
    points: tuple[Path, ...] = ()
    """Files that the heights are written to as points, too: .las, .laz or .ply."""
    name: str = "surface"
    """Of the product, and of its files without the extension."""

    @property
    def seen(self) -> str:
        """What images see, as messages call it."""
        return "ground" if self.target == "map" else "target"

    @property
    def start_file(self) -> Path | None:
        """The file of heights with which it begins, if it begins with one."""
        return None if self.start == "terrain" or number(self.start) is not None else Path(self.start)


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
    height = number(settings.start)
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


def check_bands(project: Project, bands: Sequence[int], names: Sequence[str]) -> None:
    """Refuse bands that an image does not have, or that are stated twice."""
    if len(set(bands)) < len(bands) or any(band < 1 for band in bands):
        raise UsageError(f"bands {', '.join(map(str, bands))}; numbers from 1 on are needed, each once")
    for name in names if bands else ():
        own = open_scene(project, name).reader.bands
        if max(bands) > own:
            raise UsageError(f"bands {', '.join(map(str, bands))}: image {name!r} has {own}")


def number(text: str) -> float | None:
    """Of a text; None: it is none."""
    try:
        return float(text)
    except ValueError:
        return None
