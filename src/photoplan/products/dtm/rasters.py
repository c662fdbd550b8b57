"""Terrain models as rasters: shading, slope, tints, export."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan import __version__
from photoplan.engine.executors import available_cpus, threads
from photoplan.engine.run import Made, Runner, Tally, Work
from photoplan.errors import GeometryError, InputError, ResourceError, UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Result
from photoplan.geometry.grid import MapGrid, Placement, Window, refuse_absurd
from photoplan.geometry.heights import crs_with_heights
from photoplan.io.disk import Nodata, free_megabytes
from photoplan.io.product import ProductFacts, ProductFile, check_output, write_quicklook
from photoplan.io.raster_info import ImageForm
from photoplan.io.store import input_entry, run_key, run_times, settings_of, standing, together, write_run_record
from photoplan.io.terrain.model_write import TIN_SUFFIXES, replacing, write_points, write_tin
from photoplan.plain import pick
from photoplan.plan.footprint import Tile, Tiles
from photoplan.project.ground import OpenTerrain, open_terrain
from photoplan.requests.terrain import ExportRequest, PictureRequest, ShadeRequest, SlopeRequest, TintRequest
from photoplan.targets.map import MapTarget
from photoplan.terrain import shading
from photoplan.terrain.shading import Lighting, surface_slopes

GridTile = NDArray[Any] | tuple[NDArray[Any], NDArray[np.bool_]] | None
"""Values (bands, h, w); or values and validity (h, w), True = valid; or None: nothing is valid."""
GridTiles = Callable[[Window], GridTile]
"""Computes a window of the grid; called from several threads."""


@dataclass(frozen=True)
class GridOptions:
    """Options of writing a grid, and the entries of its record."""

    _: KW_ONLY
    kind: str
    """Kind of the grid, such as "hillshade"."""
    settings: Mapping[str, Any]
    """All that decides its values beside the inputs and the place: goes into the record and the run's key."""
    inputs: Sequence[Path]
    """Files that decide its values; none may be overwritten, also by a link."""
    tile: int = 512
    """Side of the windows and of the blocks in the file, pixels; a multiple of 16, at least 128."""
    workers: int | None = None
    """Windows computed at once; None: as many as there are cores."""
    overwrite: bool = False
    """Replace an output that exists."""
    events: Events = SILENT
    """Told of windows that are finished."""
    compress: str = "deflate"
    """`none`, `deflate`, `zstd`, `lzw` or `jpeg`."""
    overviews: bool = True
    """Reduced copies inside the file."""
    resampling: str = "average"
    """Reduction of its overviews: `average`; `mode` or `nearest` for classes and directions, which have no mean."""
    colours: Mapping[int, tuple[int, int, int]] | None = None
    """Colour table of one band of uint8: red, green, blue, 0 to 255, of each value."""
    tags: Mapping[str, str] | None = None
    """Tags of the file."""
    form: ImageForm | None = None
    """Names, units and offsets of its bands."""

    @classmethod
    def of(cls, request: Any, kind: str, inputs: Sequence[Path], events: Events, **more: Any) -> GridOptions:
        """Return those of a request: its fields that may decide values are the settings; its files are inputs or
        outputs."""
        # How exactly volumes are integrated does not change the raster beside them.
        settings = {name: value for name, value in settings_of(request).items() if name != "tolerance"}
        given = {"settings": settings, "workers": request.workers, "overwrite": request.overwrite, "events": events}
        return cls(kind=kind, inputs=inputs, **(given | more))

    @property
    def key(self) -> str:
        """The digest of all that decides its values beside the place."""
        return run_key(self.kind, self.settings, self.inputs)


def write_grid(
    path: Path, placement: Placement, dtype: Any, bands: int, nodata: Nodata, tiles: GridTiles, options: GridOptions
) -> ProductFacts:
    """Write a raster as a cloud-optimised GeoTIFF with its run record, crash-safe, with bounded memory.

    Windows are computed in threads; no more than two for each worker are held at once. The file appears under its name
    only when it is complete and has been read again (see `ProductFile`). A run that was killed is continued by the
    next one with the same inputs, settings and version.
    """
    path, dtype, times = Path(path), np.dtype(dtype), run_times()
    check_output(path, options.inputs, overwrite=options.overwrite)
    refuse_absurd(placement.size, options.tile, f"{path}: pixels of {abs(placement.coefficients[0]):g} m")
    workers = available_cpus() if options.workers is None else options.workers
    pool = threads(workers)
    if options.colours is not None and (dtype != np.uint8 or bands != 1):
        raise UsageError(f"{path}: a colour table for {bands} bands of {dtype}; it needs one band of uint8")
    key, inputs = options.key, [input_entry(each) for each in options.inputs]
    file = ProductFile(
        path,
        placement,
        bands,
        dtype,
        run_key=key,
        nodata=nodata,
        compress=options.compress,
        overviews=options.overviews,
        tile=options.tile,
        overwrite=options.overwrite,
        inputs=options.inputs,
        threads=workers,
        resampling=options.resampling,
        colours=options.colours,
        form=options.form,
    )
    windows = Tiles.every(file.placement.window, file.tile)
    kept = file.log_path.stat().st_size if file.log_path.exists() else 0
    _check_space(path, max(0, len(windows) * options.tile**2 * bands * dtype.itemsize - kept))
    work = Work(
        name=path.stem,
        job=GridJob(tiles, None if file.nodata_value is None else dtype.type(file.nodata_value)),
        tiles=windows,
        count=len(windows),
        sinks=(file,),
        complete=partial(_complete, file, dict(options.tags or {})),
    )
    options.events.begin(path.name, len(windows))
    with pool, together():
        (facts,) = Runner[ProductFacts](pool, None, options.events).run([work])
        write_run_record(
            path,
            key=key,
            inputs=inputs,
            run={"workers": workers, **times()},
            kind=options.kind,
            product=facts,
            settings=options.settings,
            grid=placement,
        )
    return facts


@dataclass(frozen=True)
class GridJob:
    """Computes a window, and what of it is valid."""

    tiles: GridTiles
    nodata: Any
    """Value of an invalid pixel; NaN: NaN; None: there is none."""

    def __call__(self, tile: Tile) -> Made:
        """Values and validity of a window."""
        found = self.tiles(tile.window)
        if found is None:
            return Made((None,))
        values, valid = found if isinstance(found, tuple) else (found, None)
        if valid is None and self.nodata is not None:
            missing = np.isnan(values) if values.dtype.kind == "f" else values == self.nodata
            valid = np.asarray(~missing.all(axis=0))
        return Made(((values, valid),))


def _complete(file: ProductFile, tags: dict[str, str], tally: Tally) -> ProductFacts:
    tally.check(file.path)
    return file.complete(tags)


def _check_space(path: Path, raw: int) -> None:
    """Refuse at once what cannot fit: the tiles and a plain copy of them stand on the disk at the same time."""
    free = free_megabytes(path)
    if 0 <= free < 2 * raw // 1_000_000:
        raise ResourceError(
            f"{path}: needs up to {2 * raw // 1_000_000} MB while it is made, {free} MB are free there; free some "
            "space, or choose a coarser resolution or smaller bounds"
        )


#: From flat to steep, for slope classes.
SLOPE_COLOURS = ((255, 255, 212), (254, 217, 142), (254, 153, 41), (204, 76, 2), (120, 30, 10))


@dataclass(frozen=True)
class TerrainPicture:
    """One kind of picture: how a tile is computed, and how it is stored."""

    kind: str
    dtype: str
    bands: int
    nodata: Nodata
    settings: dict[str, Any]
    """Settings that it was made with, for the file's tags and the key of its run."""
    tile: Callable[[OpenTerrain, MapGrid, Window], GridTile]
    resampling: str = "average"
    colours: dict[int, tuple[int, int, int]] | None = None


@dataclass(frozen=True)
class ShadingFacts(Result):
    """Result of a hillshade, slope or tint."""

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
    request: PictureRequest, picture: Callable[[OpenTerrain, MapGrid], TerrainPicture], events: Events = SILENT
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


def shade_picture(light: Lighting) -> Callable[[OpenTerrain, MapGrid], TerrainPicture]:
    """A hillshade: grey values 1 to 255, 0 where there is no terrain."""

    def tile(terrain: OpenTerrain, grid: MapGrid, window: Window) -> GridTile:
        slopes = surface_slopes(terrain.surface, grid, window)
        return shading.grey(shading.hillshade(slopes, light))[None]

    return lambda terrain, grid: TerrainPicture(
        kind="hillshade", dtype="uint8", bands=1, nodata="auto", settings=light.model_dump(), tile=tile
    )


def slope_picture(
    unit: str = "degrees", classes: tuple[float, ...] = ()
) -> Callable[[OpenTerrain, MapGrid], TerrainPicture]:
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
        return lambda terrain, grid: TerrainPicture(
            kind="slope", dtype="float32", bands=1, nodata="auto", settings=settings, tile=tile
        )
    at = np.linspace(0, len(SLOPE_COLOURS) - 1, len(classes) + 1)
    mixed = [np.interp(at, range(len(SLOPE_COLOURS)), np.array(SLOPE_COLOURS)[:, k]) for k in range(3)]
    table = {0: (0, 0, 0)} | {
        i + 1: (int(r), int(g), int(b)) for i, (r, g, b) in enumerate(np.column_stack(mixed).tolist())
    }
    return lambda terrain, grid: TerrainPicture(
        kind="slope classes",
        dtype="uint8",
        bands=1,
        nodata="auto",
        settings=settings,
        tile=tile,
        resampling="mode",
        colours=table,
    )


def aspect_picture() -> Callable[[OpenTerrain, MapGrid], TerrainPicture]:
    """Aspect, degrees clockwise from north, -1 where it is flat."""

    def tile(terrain: OpenTerrain, grid: MapGrid, window: Window) -> GridTile:
        return shading.aspect(surface_slopes(terrain.surface, grid, window))[None]

    return lambda terrain, grid: TerrainPicture(
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
) -> Callable[[OpenTerrain, MapGrid], TerrainPicture]:
    """Height tints, red, green, blue, with a mask."""
    if not 0 <= strength <= 1:
        raise UsageError(f"strength {strength} of the hillshade; 0 to 1 are allowed")

    def picture(terrain: OpenTerrain, grid: MapGrid) -> TerrainPicture:
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
        return TerrainPicture(kind="tints", dtype="uint8", bands=3, nodata="mask", settings=settings, tile=tile)

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


RASTERS = (".tif", ".tiff")
POINTS = (".xyz", ".csv")
EXPORTS = (*RASTERS, *TIN_SUFFIXES, *POINTS)
"""Suffixes that are written."""
_TILE = 512


@dataclass(frozen=True)
class ExportReport(Result):
    """Result of an export."""

    paths: tuple[Path, ...]
    figures: dict[str, Any]
    """Counts, or size and resolution of the raster."""

    def json_fields(self) -> dict[str, Any]:
        """Figures beside the files."""
        return {"files": self.paths, **self.figures}

    def written(self) -> Sequence[Path]:
        """Return the files."""
        return self.paths

    def messages(self) -> Sequence[str]:
        """Return the figures in a line."""
        return [" · ".join(f"{key.replace('_', ' ')} {value:.6g}" for key, value in self.figures.items())]


def dtm_export(request: ExportRequest, events: Events = SILENT) -> ExportReport:
    """Write a terrain model in another format.

    Raises
    ------
    UsageError
        The suffix is not known, the output exists or is an input, or options do not fit the format.
    InputError
        The file is no terrain model, or bounds lie outside of it.
    ResourceError
        The disk is full.
    """
    kind = _kind(request)
    for path in filter(None, (request.output, request.sigma)):
        check_output(path, [request.model], overwrite=request.overwrite)
    if request.sigma is not None and request.sigma.resolve() == request.output.resolve():
        raise UsageError(f"{request.sigma}: heights and standard deviations need a file each")
    terrain = open_terrain(request.model, request.crs)
    if kind in RASTERS:
        return _export_raster(request, terrain, events)
    if terrain.model is None:
        raise UsageError(f"{request.model}: a raster has no triangles or lines; export it as .tif, or with gdal2xyz")
    reader = terrain.model
    events.begin(request.output.name, sum(1 for _ in reader.units()), "units")
    with replacing(request.output, [request.model], request.overwrite) as part:
        if kind in POINTS:
            figures = write_points(part, kind, reader, reader.lines(), events)
            counts = {"posts": figures.vertices, "line_points": figures.line_points}
        else:
            system = {"crs": terrain.crs, "height_system": terrain.height_system}
            figures = write_tin(part, kind, reader, request.model.stem, events, **system)
            counts = {"vertices": figures.vertices, "triangles": figures.faces, "wall_triangles": figures.walls}
    return ExportReport((request.output,), counts)


def _kind(request: ExportRequest) -> str:
    kind = request.output.suffix.lower()
    if kind not in EXPORTS:
        raise UsageError(f"{request.output}: {kind or 'no suffix'}; by the suffix is written: {', '.join(EXPORTS)}")
    raster_only = (request.resolution, request.bounds, request.sigma)
    if kind not in RASTERS and any(option is not None for option in raster_only):
        raise UsageError(f"{request.output}: resolution, bounds and sigma belong to a raster (.tif)")
    return kind


def _grid_export(request: ExportRequest, terrain: OpenTerrain) -> MapGrid:
    crs = crs_with_heights(terrain.crs, terrain.height_system)
    bounds = request.bounds or terrain.bounds
    terrain.refuse_apart(bounds)
    if request.resolution is not None or request.bounds is not None:
        return MapGrid.covering((*bounds[:2], *bounds[2:]), request.resolution or terrain.resolution, crs)
    width = terrain.resolution
    xmin, ymin, xmax, ymax = terrain.bounds
    # Pixels of a raster are its own; those of a model lie centred on its posts, the outer ones included.
    edge = width / 2 if terrain.model is not None else 0.0
    columns, rows = (round((b - a + 2 * edge) / width) for a, b in ((xmin, xmax), (ymin, ymax)))
    return MapGrid(left=xmin - edge, top=ymax + edge, resolution=width, width=columns, height=rows, crs=crs)


def _export_raster(request: ExportRequest, terrain: OpenTerrain, events: Events) -> ExportReport:
    grid, surface, errors = _grid_export(request, terrain), terrain.surface, terrain.errors
    target = MapTarget(grid)
    options = GridOptions.of(request, "heights", [request.model], events, tile=_TILE)

    def heights(window: Window) -> NDArray[np.float32]:
        return surface.relief(target, window)[None]

    def sigmas(window: Window) -> NDArray[np.floating]:
        assert errors is not None
        return errors(target, window)[None]

    if request.sigma is not None and errors is None:
        raise UsageError(f"{request.model}: a raster of heights has no standard deviations; leave `sigma` out")
    paths = [request.output]
    with together():
        facts = write_grid(request.output, grid.placement, np.float32, 1, "auto", heights, options)
        if request.sigma is not None:
            of_sigmas = replace(options, kind="standard deviations")
            write_grid(request.sigma, grid.placement, np.float32, 1, "auto", sigmas, of_sigmas)
            paths.append(request.sigma)
    size = {"columns": grid.width, "rows": grid.height, "resolution": grid.resolution}
    return ExportReport(tuple(paths), {**size, "share_with_height": facts.valid_share})
