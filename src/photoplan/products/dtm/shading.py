"""Pictures of a terrain model: hillshade, slope, aspect and height tints as GeoTIFFs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan import __version__
from photoplan.errors import GeometryError, InputError, UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Result
from photoplan.geometry.grid import MapGrid, Window
from photoplan.io.naming import standing, together
from photoplan.io.product import check_output
from photoplan.io.quicklook import write_quicklook
from photoplan.io.storage import Nodata
from photoplan.plain import pick
from photoplan.products.dtm.raster import GridOptions, GridTile, write_grid
from photoplan.project.open_terrain import OpenTerrain, open_terrain
from photoplan.requests.terrain import PictureRequest, ShadeRequest, SlopeRequest, TintRequest
from photoplan.terrain import shading
from photoplan.terrain.options import Lighting
from photoplan.terrain.shading import surface_slopes

#: From flat to steep, for slope classes.
SLOPE_COLOURS = ((255, 255, 212), (254, 217, 142), (254, 153, 41), (204, 76, 2), (120, 30, 10))


@dataclass(frozen=True)
class Picture:
    """One kind of picture: how a tile is computed, and how it is stored."""

    kind: str
    dtype: str
    bands: int
    nodata: Nodata
    settings: dict[str, Any]
    """What it was made with: goes into the file's tags and the key of its run."""
    tile: Callable[[OpenTerrain, MapGrid, Window], GridTile]
    resampling: str = "average"
    colours: dict[int, tuple[int, int, int]] | None = None


@dataclass(frozen=True)
class ShadingFacts(Result):
    """What was made."""

    path: Path
    preview: Path | None
    kind: str
    grid: MapGrid
    settings: dict[str, Any]
    valid_share: float
    """Share of pixels with terrain, 0 to 1."""
    bytes: int

    def json_fields(self) -> dict[str, Any]:
        """Settings and grid flat."""
        own = pick(self, "path", "preview", "kind", "valid_share", "bytes")
        return {**own, **self.settings, **pick(self.grid, "resolution", "width", "height", "bounds")}

    def messages(self) -> Sequence[str]:
        """Return size, coverage and settings."""
        grid, settings = self.grid, ", ".join(f"{k} {v}" for k, v in self.settings.items() if k != "ramp_colours")
        return [
            f"{self.kind}: {grid.width} × {grid.height} pixels of {grid.resolution:g} m, {self.valid_share:.1%} with "
            f"terrain; {settings}"
        ]


def dtm_shade(request: ShadeRequest, events: Events = SILENT) -> ShadingFacts:
    """Write a hillshade: grey values 1 to 255, 0 where there is no terrain; see `make_picture`."""
    return make_picture(request, shade_picture(request.light), events)


def dtm_slope(request: SlopeRequest, events: Events = SILENT) -> ShadingFacts:
    """Write slopes, their classes or the aspect; see `make_picture`."""
    unit = "percent" if request.percent else "degrees"
    picture = aspect_picture() if request.aspect else slope_picture(unit, request.classes)
    return make_picture(request, picture, events)


def dtm_tint(request: TintRequest, events: Events = SILENT) -> ShadingFacts:
    """Write colours by height, with a mask where there is no terrain; see `make_picture`."""
    steps, light = 0 if request.classed else request.classes, request.light if request.shade else None
    return make_picture(request, tint_picture(request.ramp, request.heights, steps, light, request.strength), events)


def make_picture(
    request: PictureRequest, picture: Callable[[OpenTerrain, MapGrid], Picture], events: Events = SILENT
) -> ShadingFacts:
    """Write a picture of a terrain model; a run that was killed is continued by the same request.

    Parameters
    ----------
    request
        What of, where to.
    picture
        Makes the kind of picture for the terrain and the grid: `shade_picture` and its like.
    events
        Told of tiles that are finished.

    Raises
    ------
    UsageError
        The output or the preview exists, or is an input; or a number makes no sense.
    InputError
        The model cannot be used, or has nothing inside the bounds.
    ResourceError
        The disk is full.
    """
    inputs = [request.model]
    check_output(request.output, inputs, overwrite=request.overwrite, raster=True)
    if request.preview is not None:
        if request.preview.resolve() == request.output.resolve():
            raise UsageError(f"{request.preview}: the preview has the name of the output; choose another one")
        check_output(request.preview, inputs, overwrite=request.overwrite)
    terrain = open_terrain(request.model, request.crs)
    grid = _grid(request, terrain)
    made = picture(terrain, grid)
    options = GridOptions.of(
        request,
        made.kind,
        inputs,
        events,
        settings=made.settings,
        resampling=made.resampling,
        colours=made.colours,
        tags={"PHOTOPLAN_VERSION": __version__, "PHOTOPLAN_KIND": made.kind}
        | {f"PHOTOPLAN_{name.upper()}": str(value) for name, value in made.settings.items()},
    )

    def tile(window: Window) -> GridTile:
        return made.tile(terrain, grid, window)

    with together():
        facts = write_grid(request.output, grid.placement, made.dtype, made.bands, made.nodata, tile, options)
        if request.preview is not None:
            write_quicklook(standing(request.output), request.preview, max_side=1200)
    return ShadingFacts(
        path=request.output,
        preview=request.preview,
        kind=made.kind,
        grid=grid,
        settings=made.settings,
        valid_share=facts.valid_share,
        bytes=facts.bytes,
    )


def _grid(request: PictureRequest, terrain: OpenTerrain) -> MapGrid:
    bounds = request.bounds or terrain.bounds
    terrain.refuse_apart(bounds)
    return MapGrid.covering(bounds, request.resolution or terrain.resolution, terrain.crs)


def shade_picture(light: Lighting) -> Callable[[OpenTerrain, MapGrid], Picture]:
    """A hillshade: grey values 1 to 255, 0 where there is no terrain."""

    def tile(terrain: OpenTerrain, grid: MapGrid, window: Window) -> GridTile:
        slopes = surface_slopes(terrain.surface, grid, window)
        return shading.grey(shading.hillshade(slopes, light))[None]

    return lambda terrain, grid: Picture(
        kind="hillshade", dtype="uint8", bands=1, nodata="auto", settings=light.model_dump(), tile=tile
    )


def slope_picture(unit: str = "degrees", classes: tuple[float, ...] = ()) -> Callable[[OpenTerrain, MapGrid], Picture]:
    """Slope in `degrees` or `percent` as float32; or the numbers of its classes, with colours."""
    if unit not in ("degrees", "percent"):
        raise UsageError(f"slope in {unit!r}; allowed are degrees and percent")
    measure = shading.slope_degrees if unit == "degrees" else shading.slope_percent
    if classes:
        shading.slope_classes(np.zeros((1, 1), np.float32), classes)

    def tile(terrain: OpenTerrain, grid: MapGrid, window: Window) -> GridTile:
        values = measure(surface_slopes(terrain.surface, grid, window))
        return (shading.slope_classes(values, classes) if classes else values)[None]

    settings = {"unit": unit, "classes": list(classes)}
    if not classes:
        return lambda terrain, grid: Picture(
            kind="slope", dtype="float32", bands=1, nodata="auto", settings=settings, tile=tile
        )
    at = np.linspace(0, len(SLOPE_COLOURS) - 1, len(classes) + 1)
    mixed = [np.interp(at, range(len(SLOPE_COLOURS)), np.array(SLOPE_COLOURS)[:, k]) for k in range(3)]
    table = {0: (0, 0, 0)} | {
        i + 1: (int(r), int(g), int(b)) for i, (r, g, b) in enumerate(np.column_stack(mixed).tolist())
    }
    return lambda terrain, grid: Picture(
        kind="slope classes",
        dtype="uint8",
        bands=1,
        nodata="auto",
        settings=settings,
        tile=tile,
        resampling="mode",
        colours=table,
    )


def aspect_picture() -> Callable[[OpenTerrain, MapGrid], Picture]:
    """Aspect, degrees clockwise from north, -1 where it is flat."""

    def tile(terrain: OpenTerrain, grid: MapGrid, window: Window) -> GridTile:
        return shading.aspect(surface_slopes(terrain.surface, grid, window))[None]

    return lambda terrain, grid: Picture(
        kind="aspect",
        dtype="float32",
        bands=1,
        nodata="auto",
        settings={"unit": "degrees"},
        tile=tile,
        resampling="nearest",
    )


def tint_picture(
    ramp: str = "hypsometric",
    span: tuple[float, float] | None = None,
    steps: int | None = None,
    light: Lighting | None = None,
    strength: float = 0.6,
) -> Callable[[OpenTerrain, MapGrid], Picture]:
    """Height tints, red, green, blue, with a mask."""
    if not 0 <= strength <= 1:
        raise UsageError(f"strength {strength} of the hillshade; 0 to 1 are allowed")

    def picture(terrain: OpenTerrain, grid: MapGrid) -> Picture:
        colours = _ramp(terrain, grid, ramp, span, steps)

        def tile(terrain: OpenTerrain, grid: MapGrid, window: Window) -> GridTile:
            slopes = surface_slopes(terrain.surface, grid, window)
            tints = colours(slopes.heights)
            if light is not None:
                tints = shading.shaded(tints, shading.hillshade(slopes, light), light.level, strength)
            return _bytes(tints)

        settings = {
            "ramp": ramp,
            "heights": [float(colours.heights[0]), float(colours.heights[-1])],
            "classed": colours.classed,
            "ramp_colours": colours.colours.round(2).tolist(),
        }
        if light is not None:
            settings |= light.model_dump() | {"strength": strength}
        return Picture(kind="tints", dtype="uint8", bands=3, nodata="mask", settings=settings, tile=tile)

    return picture


def _bytes(tints: NDArray[np.float32]) -> GridTile:
    empty = np.isnan(tints).any(axis=0)
    return np.rint(np.where(empty, 0, np.clip(tints, 0, 255))).astype(np.uint8), np.asarray(~empty)


def _ramp(
    terrain: OpenTerrain, grid: MapGrid, name: str, span: tuple[float, float] | None, steps: int | None
) -> shading.Ramp:
    if name not in shading.RAMPS:
        return _ramp_file(Path(name), steps is not None)
    low, high = span if span is not None else terrain.surface.height_range(grid.bounds)
    if not (math.isfinite(low) and math.isfinite(high)):
        raise GeometryError(f"{terrain.path}: no heights inside the bounds; there is nothing to tint")
    if span is None and low == high:
        low, high = low - 0.5, high + 0.5
    return shading.built_in_ramp(name, low, high, steps)


def _ramp_file(path: Path, classed: bool) -> shading.Ramp:
    try:
        if path.stat().st_size > 1 << 20:
            raise InputError(f"{path}: {path.stat().st_size} bytes are no colour ramp; lines `height red green blue`")
        text = path.read_bytes().decode("utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{path}: is no text; a colour ramp has lines `height red green blue`") from None
    except OSError as error:
        built_in = ", ".join(shading.RAMPS)
        raise InputError(f"{path}: no such colour ramp ({error.strerror}); built in are {built_in}") from None
    return shading.parse_ramp(text, str(path), classed)
