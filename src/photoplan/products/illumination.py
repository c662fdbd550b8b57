"""Correction of an orthophoto for light on slopes and haze: parameters from its own pixels, then pixel by pixel."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan import __version__
from photoplan.cameras.curvature import SunProjection
from photoplan.errors import InputError
from photoplan.events import SILENT, Events
from photoplan.findings import Estimate, Findings, Result, Table, with_sigma
from photoplan.geometry.frames import triple
from photoplan.geometry.grid import MapGrid, Window
from photoplan.io.product import check_output
from photoplan.io.raster import RasterReader
from photoplan.io.raster_info import form_of, placement_of
from photoplan.plain import pick
from photoplan.plan.ground import TileGround
from photoplan.plan.sources import hidden_pixels
from photoplan.products.dtm.rasters import GridOptions, GridTile, write_grid
from photoplan.project.ground import OpenTerrain, open_terrain
from photoplan.project.steps import kept_nodata
from photoplan.radiometry.illumination import LightModel, LitGround, estimate_light
from photoplan.radiometry.tone import fitted
from photoplan.requests.ortho import IlluminationRequest
from photoplan.targets.map import MapTarget
from photoplan.terrain.shading import Lighting, directions, even_slopes

#: Windows along both axes from which parameters are estimated, and their side, pixels.
_ALONG, _SIDE = 8, 64
#: Pixels of these that are used, at most about.
_MOST = 30_000


@dataclass(frozen=True, eq=False)
class IlluminationReport(Result):
    """Result of a correction of illumination."""

    path: Path | None
    """None after a dry run."""
    model: LightModel
    sample: LitGround
    """Pixels that parameters are estimated from, (n,)."""
    before: NDArray[np.float64]
    """Their grey values, (bands, n)."""
    after: NDArray[np.float64]

    @property
    def correlations(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the correlations of the grey values of lit pixels with cos i, before and after, by band."""
        lit = self.sample.lit
        each = [[np.corrcoef(band[lit], self.sample.cos_i[lit])[0, 1] for band in values] for values in self._both]
        return np.array(each[0]), np.array(each[1])

    @property
    def _both(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return self.before, self.after

    def json_fields(self) -> dict[str, Any]:
        """Parameters and correlations."""
        before, after = self.correlations
        own = pick(self.model, "corrections", "cos_z", "height", "bands")
        shadow = float(np.mean(~self.sample.lit))
        return {"path": self.path, **own, "not_lit": shadow, "correlation_before": before, "correlation_after": after}

    def outcome(self) -> Sequence[Findings]:
        """Return how much lies in shadow, and the parameters of each band with correlations before and after."""
        model = self.model
        sky = "a of c" if "c" in model.corrections else "sky"
        head = ("band", "per cos i", sky, "haze", "haze per 100 m", "correlation with cos i", "then")
        rows = []
        for k, (band, before, after) in enumerate(zip(model.bands, *self.correlations), 1):
            values = zip((band.slope, band.sky, band.haze, band.haze_by_height), band.sigmas)
            texts = (with_sigma(value, sigma) if value or sigma else "" for value, sigma in values)
            rows.append((str(k), *texts, f"{before:+.3f}", f"{after:+.3f}"))
        dark = Estimate(
            "not_lit_percent", 100 * float((~self.sample.lit).mean()), label="sample in shadow or turned away from the "
            "sun", unit="%", remark="slopes are not corrected there",
        )  # fmt: skip
        return [Findings((dark,), tables={"bands": Table(head, tuple(rows), printed=True)})]


@dataclass(frozen=True, eq=False)
class _Place:
    """Picture, terrain and sun."""

    reader: RasterReader
    terrain: OpenTerrain
    grid: MapGrid
    light: Lighting

    def ground(self, window: Window) -> LitGround:
        """Return slopes and light of the terrain in a window of the picture."""
        surface, sun = self.terrain.surface, directions(self.light)[0]
        slopes = even_slopes(surface, self.grid, window)
        tile = TileGround.of(MapTarget(self.grid), window, slopes.heights)
        shadow = hidden_pixels(SunProjection(triple(sun)), tile, surface)
        return LitGround.on(slopes.gradient, slopes.heights, sun, shadow)

    def read(self, window: Window) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Pixels and which of them count."""
        values, valid = self.reader.read(window)
        return values, np.ones(values.shape[1:], bool) if valid is None else valid


def correct_illumination(request: IlluminationRequest, events: Events = SILENT) -> IlluminationReport:
    """Correct an orthophoto; a run that was killed is continued by the same request.

    Raises
    ------
    UsageError
        The output exists, or a correction or the sun cannot be.
    InputError
        Picture or terrain cannot be used.
    GeometryError
        They do not overlap, or the picture's light is not that of this sun.
    """
    inputs = [request.picture, request.terrain]
    LightModel(request.correct, 1.0, 0.0, ())
    if not request.dry_run:
        check_output(request.output, inputs, overwrite=request.overwrite, raster=True)
    place = _open(request)
    cos_z = place.light.level
    values, ground, part = _sample(place, events)
    model = estimate_light(values, ground, part, request.correct, cos_z)
    report = IlluminationReport(
        path=request.output, model=model, sample=ground, before=values, after=model.corrected(values, ground)
    )
    if request.dry_run:
        return IlluminationReport(path=None, model=model, sample=ground, before=values, after=report.after)
    dtype, nodata = place.reader.dtype, kept_nodata(place.reader.info, place.reader.dtype)

    def tile(window: Window) -> GridTile:
        pixels, valid = place.read(window)
        return fitted(model.corrected(pixels, place.ground(window)), dtype), valid

    options = GridOptions.of(
        request,
        "illumination",
        inputs,
        events,
        settings={**pick(request, "sun", "correct"), "bands": [vars(band) for band in model.bands]},
        tags={"PHOTOPLAN_VERSION": __version__, "PHOTOPLAN_KIND": "illumination"},
        form=form_of(place.reader.info),
    )
    write_grid(request.output, place.grid.placement, dtype, place.reader.bands, nodata, tile, options)
    return report


def _open(request: IlluminationRequest) -> _Place:
    light = Lighting(azimuth=request.sun[0], altitude=request.sun[1])
    reader = RasterReader(request.picture)
    placement = placement_of(reader.info)
    if placement.transform is None or placement.crs is None:
        raise InputError(f"{request.picture}: no georeference or no CRS; light is corrected in orthophotos")
    a, b, left, d, e, top = placement.transform
    if b or d or not math.isclose(a, -e, rel_tol=1e-9) or a <= 0:
        raise InputError(f"{request.picture}: its pixels are not square and north up; resample it first")
    grid = MapGrid(left, top, a, *placement.size, placement.crs)
    terrain, _ = open_terrain(request.terrain).in_crs(placement.crs)
    terrain.refuse_apart(grid.bounds)
    return _Place(reader, terrain, grid, light)


def _sample(place: _Place, events: Events) -> tuple[NDArray[np.float64], LitGround, NDArray[np.int64]]:
    """Grey values (bands, n), ground (n,) and window (n,) of pixels all over the picture."""
    width, height = place.grid.width, place.grid.height
    # Windows do not overlap: pixels that several have would leave nothing out with any of them.
    across, down = (max(1, min(_SIDE, side // _ALONG)) for side in (width, height))
    columns, rows = (
        {int(at) for at in np.linspace(0, max(side - own, 0), _ALONG)}
        for side, own in ((width, across), (height, down))
    )
    events.begin("estimating", len(columns) * len(rows), "windows")
    values, grounds, parts = [], [], []
    for number, (col, row) in enumerate((c, r) for r in sorted(rows) for c in sorted(columns)):
        window = Window(col, row, across, down) & place.grid.window
        pixels, valid = place.read(window)
        ground = place.ground(window)
        use = valid & np.isfinite(ground.cos_i)
        values.append(pixels[:, use].astype(float))
        grounds.append([getattr(ground, each.name)[use] for each in fields(LitGround)])
        parts.append(np.full(int(use.sum()), number))
        events.done()
    every = np.concatenate(parts)
    some = np.arange(0, len(every), max(1, len(every) // _MOST))
    joined = LitGround(*(np.concatenate(column)[some] for column in zip(*grounds)))
    return np.concatenate(values, axis=1)[:, some], joined, every[some]
