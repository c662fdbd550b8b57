"""Registration: displacements between two images, with subpixel accuracy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.engine.run import steps
from photoplan.errors import GeometryError, InputError, UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Result, columns, noted, with_sigma
from photoplan.geometry.crs import crs_label, same_crs
from photoplan.geometry.grid import Placement, Window
from photoplan.io.product import check_output
from photoplan.io.raster import RasterReader
from photoplan.io.raster_info import RasterInfo, placement_of
from photoplan.io.store import ResultLog, recording, run_key, settings_of, when_named
from photoplan.io.tables import write_table
from photoplan.io.vector_layer import VectorLayer, write_geopackage
from photoplan.matching.features import GreyImage
from photoplan.matching.register import (
    FOUND,
    MISSING,
    MODELS,
    STATES,
    TEXTURELESS,
    PatchDisplacements,
    PatchSettings,
    PixelTransfer,
    SmoothModel,
    contradicting,
    fit_smooth,
    match_grid,
)
from photoplan.plain import pick
from photoplan.products.orthophoto.plan import extent_text
from photoplan.requests.measure import RegisterRequest

_Floats = NDArray[np.float64]

PERCENTILES = (50.0, 90.0, 95.0, 99.0, 99.7)


@dataclass(frozen=True)
class RegisterFigures:
    """Figures of a field of vectors, pixels of the first image."""

    patches: int
    counts: dict[str, int]
    """Patches by what became of them, see `photoplan.matching.register.STATES`."""
    median: tuple[float, float]
    rms: tuple[float, float]
    """Root mean squares of dx and of dy."""
    spread: tuple[float, float]
    """Standard deviation of dx and of dy about their means."""
    percentiles: dict[str, float]
    """Percentiles of the vectors' lengths."""
    largest: float
    """Longest vector."""
    quarter: float
    """Share of the vectors not longer than a quarter of a pixel, 0 to 1."""
    half: float
    """Share not longer than half a pixel."""
    sigma: tuple[float, float]
    """Median standard deviation of dx and of dy."""
    factor: float
    """Median of the factors by which standard deviations of the fits were multiplied: noise of pixels is alike."""
    correlation: float
    """Median."""

    def json_fields(self) -> dict[str, Any]:
        """All of it, with its unit."""
        own = ("patches", "counts", "factor", "correlation")
        pixels = ("median", "rms", "spread", "percentiles", "largest", "sigma")
        shares = {"share_within_quarter_px": self.quarter, "share_within_half_px": self.half}
        return {**pick(self, *own), **{f"{name}_px": getattr(self, name) for name in pixels}, **shares}


def figures_of(found: PatchDisplacements) -> RegisterFigures:
    """Figures of the vectors that were found; there is one at least."""
    good = found.state == FOUND
    d, length = found.moved[good], np.linalg.norm(found.moved[good], axis=1)
    values = np.percentile(length, PERCENTILES).tolist()
    return RegisterFigures(
        patches=len(good),
        counts=dict(zip(STATES, np.bincount(found.state, minlength=len(STATES)).tolist())),
        median=_two(np.median(d, axis=0)),
        rms=_two(np.sqrt((d**2).mean(axis=0))),
        spread=_two(d.std(axis=0)),
        percentiles={f"{p:g}": v for p, v in zip(PERCENTILES, values)},
        largest=float(length.max()),
        quarter=float((length <= 0.25).mean()),
        half=float((length <= 0.5).mean()),
        sigma=_two(np.median(found.sigma[good], axis=0)),
        factor=float(np.median(found.factor[good])),
        correlation=float(np.median(found.correlation[good])),
    )


def _two(values: _Floats) -> tuple[float, float]:
    a, b = values.tolist()
    return a, b


#: Pixels of one image may be so much larger than those of the other.
_SCALE = 2.0


@dataclass(frozen=True, eq=False)
class Pair:
    """Two images that were opened."""

    paths: tuple[Path, Path]
    images: tuple[GreyImage, GreyImage]
    transfer: PixelTransfer
    """From pixels of the first to pixels of the second image."""
    common: Window
    """Pixels of the first image that may have a partner."""
    place: Placement | None
    """Placement of the first image; None if they are compared pixel by pixel."""
    crs: str | None
    notes: tuple[str, ...]

    @property
    def pixel(self) -> float | None:
        """Side of a pixel of the first image in units of the map."""
        return None if self.place is None else float(np.sqrt(abs(np.linalg.det(self.place.linear))))


def open_pair(first: Path, second: Path) -> Pair:
    """Open two images."""
    if first.exists() and second.exists() and first.samefile(second):
        raise UsageError(f"{second}: is the first image, too; give two images")
    readers = RasterReader(first), RasterReader(second)
    a, b = (reader.info for reader in readers)
    notes = [warning for info in (a, b) for warning in info.warnings]
    if a.to_map is None or b.to_map is None:
        if a.size != b.size:
            raise InputError(
                f"{first} has {a.size[0]} × {a.size[1]} pixels, {second} has {b.size[0]} × {b.size[1]}, and not both "
                "have a place on a map: it is not known which pixels belong together. Give images of one size, or "
                "georeferenced ones"
            )
        if a.to_map is not b.to_map:
            alone = second if b.to_map is None else first
            notes.append(f"{alone.name} has no place on a map: the images are compared pixel by pixel")
        place, transfer = None, PixelTransfer()
    else:
        place, transfer = placement_of(a), _between(a, b, notes)
    common = transfer.common(a.size, b.size)
    if common is None:
        extents = "\n  ".join(f"{info.path}: {extent_text(placement_of(info).bounds)}" for info in (a, b) if place)
        raise GeometryError(f"the images have nothing in common:\n  {extents}")
    return Pair(
        paths=(first, second),
        images=(GreyImage(readers[0]), GreyImage(readers[1])),
        transfer=transfer,
        common=common,
        place=place,
        crs=a.crs or b.crs if place is not None else None,
        notes=tuple(notes),
    )


def _between(a: RasterInfo, b: RasterInfo, notes: list[str]) -> PixelTransfer:
    """By the places of both on the map."""
    if a.crs is not None and b.crs is not None and not same_crs(a.crs, b.crs):
        raise InputError(
            f"{a.path} is in {crs_label(a.crs)}, {b.path} in {crs_label(b.crs)}; transform one of them with "
            "gdalwarp -t_srs"
        )
    if (a.crs is None) != (b.crs is None):
        alone = a if a.crs is None else b
        notes.append(f"{alone.path.name} states no reference system: that of the other image is taken")
    transfer = PixelTransfer.between(placement_of(a), placement_of(b))
    if not 1 / _SCALE <= transfer.scale <= _SCALE:
        raise InputError(
            f"pixels of {a.path} are {transfer.scale:.3g} times as large as those of {b.path}; up to {_SCALE:g} times "
            "can be matched. Bring them to one resolution with gdalwarp -tr -r average"
        )
    return transfer


#: Patches of a tile along each side, and of all at most.
_TILE, _MOST = 24, 2_000_000
#: Part of the patches with texture below which those that were found are few.
_FEW = 0.25
_COLUMNS = ("x", "y", "dx", "dy", "sigma_x", "sigma_y", "covariance", "correlation", "state")


@dataclass(frozen=True, eq=False)
class PatchGrid:
    """Middles of the patches in the first image."""

    columns: NDArray[np.int64]
    rows: NDArray[np.int64]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return len(self.rows), len(self.columns)

    def tiles(self) -> list[tuple[slice, slice]]:
        """Rows and columns of parts of about the same size."""
        parts = [np.linspace(0, n, max(1, round(n / _TILE)) + 1).astype(int) for n in self.shape]
        rows, columns = (
            [slice(a, b) for a, b in zip(edges[:-1].tolist(), edges[1:].tolist()) if b > a] for edges in parts
        )
        return [(r, c) for r in rows for c in columns]

    def at(self, tile: tuple[slice, slice]) -> NDArray[np.int64]:
        """Middles of a part, row by row, (n, 2)."""
        x, y = np.meshgrid(self.columns[tile[1]], self.rows[tile[0]])
        return np.stack([x.ravel(), y.ravel()], axis=1)


@dataclass(frozen=True, eq=False)
class RegisterReport(Result):
    """Result of a comparison of two images."""

    output: Path | None
    """None after a dry run."""
    table: Path | None
    pair: Pair
    shape: tuple[int, int]
    """Rows and columns of patches."""
    step: int
    radius: int
    figures: RegisterFigures | None
    model: SmoothModel | None
    found: PatchDisplacements | None
    advice: str = ""
    """Advice, if few patches were found."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Return remarks on the images, and on what was found."""
        return (*self.pair.notes, *([self.advice] if self.advice else []))

    def json_fields(self) -> dict[str, Any]:
        """Figures, without the vectors."""
        images = [str(path) for path in self.pair.paths]
        own = pick(self, "output", "table", "figures", "model", grid="shape", spacing_px="step")
        return {**own, "images": images, "pixel": self.pair.pixel, "notes": list(self.notes)}

    def summary(self) -> Sequence[str]:
        """Return the figures, or how many patches there are after a dry run."""
        f = self.figures
        if f is None:
            rows, across = self.shape
            return [f"{across} × {rows} patches of {2 * self.radius + 1} px, every {self.step} px"]
        left = ", ".join(f"{count} {name}" for name, count in f.counts.items() if count and name != "found")
        shares = ", ".join(f"{name} % {value:.3f}" for name, value in f.percentiles.items())
        metres = "" if self.pair.pixel is None else f"; a pixel is {self.pair.pixel:.4g} on the map"
        lines = [
            ("patches", f"{f.counts['found']} of {f.patches} found" + (f"; left out: {left}" if left else "")),
            ("median", f"dx {f.median[0]:+.4f}, dy {f.median[1]:+.4f} px{metres}"),
            ("rms", f"dx {f.rms[0]:.4f}, dy {f.rms[1]:.4f} px"),
            ("lengths", f"{shares}, longest {f.largest:.3f} px"),
            ("within", f"1/4 px {f.quarter:.2%}, 1/2 px {f.half:.2%}"),
            ("sigma", f"{f.sigma[0]:.4f}, {f.sigma[1]:.4f} px (median), correlation {f.correlation:.3f}"),
        ]
        if self.model is not None:
            m, sigma = self.model, (self.model.covariances[:, 0, 0] ** 0.5).tolist()
            pairs = zip(("dx", "dy"), m.unknowns[:, 0].tolist(), sigma)
            shift = ", ".join(f"{name} {with_sigma(value, s, signed=True)}" for name, value, s in pairs)
            lines.append((m.kind, f"in the middle {shift} px; residuals {m.rms[0]:.4f}, {m.rms[1]:.4f} px (rms)"))
        return columns(lines)

    def messages(self) -> Sequence[str]:
        """Return the notes."""
        return noted(self.notes)


def register(request: RegisterRequest, events: Events = SILENT) -> RegisterReport:
    """Find where the patches of one image lie in the other one.

    Parameters
    ----------
    request : RegisterRequest
    events : Events
        Told of patches that are done.

    Raises
    ------
    UsageError
        An output exists, or a number makes no sense.
    InputError
        An image cannot be used, or they do not belong together.
    GeometryError
        They have nothing in common, or no patch was found again.
    """
    _check(request)
    pair = open_pair(request.first, request.second)
    grid = _grid(pair, request)
    empty = RegisterReport(
        output=None,
        table=None,
        pair=pair,
        shape=grid.shape,
        step=request.step,
        radius=request.radius,
        figures=None,
        model=None,
        found=None,
    )
    if request.dry_run:
        return empty
    for path in (request.output, request.table):
        check_output(path, pair.paths, overwrite=request.overwrite)
    key = run_key("register", settings_of(request), pair.paths)
    with recording("register", request, pair.paths) as record, ResultLog.beside(
        request.output, key, locked=False
    ) as log:  # fmt: skip
        tiles = grid.tiles()
        events.begin("matching", len(tiles))
        settings = PatchSettings(request.radius, request.search, request.correlation, request.sigma)
        match = partial(match_grid, pair.images, pair.transfer, settings=settings)
        with steps(request.output.name, request.workers, events, log) as run:
            parts = list(run(match, [grid.at(tile) for tile in tiles], tiles, lambda at: len(at) * request.step**2))
        found = contradicting(_together(parts, tiles, grid), grid.shape)
        if not (found.state == FOUND).any():
            raise GeometryError(_nothing(found, request))
        figures = figures_of(found)
        model = fit_smooth(found, request.model, ((2 * request.radius + 1) / request.step) ** 2 * math.pi / 4)
        _write(request, pair, found)
        report = RegisterReport(
            output=request.output,
            table=request.table,
            pair=pair,
            shape=grid.shape,
            step=request.step,
            radius=request.radius,
            figures=figures,
            model=model,
            found=found,
            advice=_few(found, request),
        )
        record([request.output, request.table], report)
        when_named(log.remove)
    return report


def _check(request: RegisterRequest) -> None:
    numbers = (
        ("`radius`", request.radius, 4, 50, "pixels"),
        ("`spacing`", request.step, 1, 10_000, "pixels"),
        ("`search`", request.search, 0.1, 30, "pixels"),
        ("`correlation`", request.correlation, 0, 0.999, ""),
        ("`sigma`", request.sigma, 1e-4, 10, "pixels"),
    )
    for what, value, low, high, unit in numbers:
        if not (math.isfinite(value) and low <= value <= high):
            raise UsageError(f"{what} {value:g}; allowed are {low:g} to {high:g} {unit}".rstrip())
    if request.model not in MODELS:
        raise UsageError(f"model {request.model!r}; allowed are {', '.join(MODELS)}")
    if request.output.suffix.lower() != ".gpkg":
        raise UsageError(f"{request.output}: vectors are a GeoPackage; give it a name that ends with .gpkg")


def _grid(pair: Pair, request: RegisterRequest) -> PatchGrid:
    """Patches with a pixel around them, in the middle of what both images show."""
    common, edge = pair.common, request.radius + 1
    lines = []
    for first, length in ((common.col, common.width), (common.row, common.height)):
        count = (length - 2 * edge - 1) // request.step + 1
        if count < 1:
            raise GeometryError(
                f"the images have {common.width} × {common.height} pixels in common, a patch needs {2 * edge + 1}; "
                "give a smaller `radius`"
            )
        spare = length - 2 * edge - 1 - (count - 1) * request.step
        lines.append((first + edge + spare // 2, count))
    if lines[0][1] * lines[1][1] > _MOST:
        raise UsageError(
            f"spacing {request.step} gives {lines[0][1]} × {lines[1][1]} patches, more than {_MOST}; choose a larger "
            "`spacing`"
        )
    columns, rows = (first + request.step * np.arange(count) for first, count in lines)
    return PatchGrid(columns, rows)


def _together(
    parts: Sequence[PatchDisplacements], tiles: Sequence[tuple[slice, slice]], grid: PatchGrid
) -> PatchDisplacements:
    """Vectors of all tiles as one grid, row by row."""
    rows, columns = grid.shape
    number = np.arange(rows * columns).reshape(rows, columns)
    order = np.argsort(np.concatenate([number[tile].ravel() for tile in tiles]))

    def of(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(part, name) for part in parts])[order]

    return PatchDisplacements(
        at=of("at"),
        moved=of("moved"),
        covariance=of("covariance"),
        correlation=of("correlation"),
        state=of("state"),
        factor=of("factor"),
    )


def _nothing(found: PatchDisplacements, request: RegisterRequest) -> str:
    """Return why there is no vector."""
    counts = np.bincount(found.state, minlength=len(STATES))
    listed = ", ".join(f"{count} {name}" for name, count in zip(STATES, counts.tolist()) if count)
    return f"no patch of {request.first} was found in {request.second}: {listed}; {_advice(counts, request)}"


def _few(found: PatchDisplacements, request: RegisterRequest) -> str:
    """Return what helps if few of the patches with pixels and texture were found; empty if there were more."""
    counts = np.bincount(found.state, minlength=len(STATES))
    counts[[MISSING, TEXTURELESS]] = 0
    if counts[FOUND] >= _FEW * counts.sum():
        return ""
    counts[FOUND] = 0
    return f"few patches were found, and these may be chance; most are {_worst(counts)}: {_advice(counts, request)}"


def _worst(counts: NDArray[np.int64]) -> str:
    return STATES[int(counts.argmax())]


def _advice(counts: NDArray[np.int64], request: RegisterRequest) -> str:
    """Return what helps against the most frequent reason."""
    return {
        "missing": "the images have hardly a valid pixel in common; look at their nodata",
        "textureless": f"give a larger `radius` or `sigma`; they are {request.radius} and {request.sigma:g} px",
        "unlike": f"give a larger `search` ({request.search:g} px now) or a smaller `correlation`",
        "uncertain": "give a larger `radius` or `sigma`",
        "apart": "neighbours contradict each other, as where a pattern repeats; give a larger `radius`",
    }.get(_worst(counts), "")


def _write(request: RegisterRequest, pair: Pair, found: PatchDisplacements) -> None:
    """GeoPackage and table of all patches."""
    names = np.array(STATES)[found.state]
    sigma = found.sigma
    values = dict(
        zip(
            _COLUMNS,
            (*found.at.T, *found.moved.T, *sigma.T, found.covariance[:, 0, 1], found.correlation, names),
            strict=True,
        )
    )
    at = found.at.astype(float)
    ends = np.stack([at, at + np.nan_to_num(found.moved)], axis=1)
    if pair.place is not None:
        ends, moved = pair.place.to_plane(ends), found.moved @ pair.place.linear.T
        values |= {"map_dx": moved[:, 0], "map_dy": moved[:, 1]}
    else:
        ends = ends * np.array([1.0, -1.0])
    good = found.state == FOUND
    fields = {name: column[good] for name, column in values.items() if name != "state"}
    layers = [
        VectorLayer("vectors", "LineString", shapely.linestrings(ends[good]), fields),
        VectorLayer("patches", "Point", shapely.points(ends[:, 0]), values),
    ]
    write_geopackage(request.output, layers, pair.crs)
    columns = [
        [f"{v:.6g}" if v == v else "" for v in column.tolist()] if column.dtype.kind == "f" else column.tolist()
        for column in (values[name] for name in _COLUMNS)
    ]
    write_table(request.table, _COLUMNS, zip(*columns))
