"""Profiles over lines of a file, as values and as a table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Result
from photoplan.io.polygons import read_features
from photoplan.io.product import check_output
from photoplan.io.table_lines import csv_line
from photoplan.io.tables import Dialect
from photoplan.io.terrain.export import replacing
from photoplan.io.terrain.points import PointTable, PointTableFormat
from photoplan.project.open_terrain import OpenTerrain, open_terrain
from photoplan.requests.terrain import ProfileRequest
from photoplan.surfaces.profile import profile

TABLES = (".csv", ".txt")
MOST_POINTS = 1_000_000
"""Points of the lines at most."""
_LINE_NAMES = ("line", "line_id", "profile")


@dataclass(frozen=True, eq=False)
class Profile:
    """The surface over one line; straight between its points."""

    name: str
    distance: NDArray[np.float64]
    """Along the line, ascending, metres; twice the same at a wall."""
    xy: NDArray[np.float64]
    heights: NDArray[np.float64]
    """Metres; NaN at the first and last point where there is no surface."""
    sigmas: NDArray[np.float64]
    """Standard deviations of the heights, metres; NaN: unknown."""

    @property
    def length(self) -> float:
        """Metres."""
        return float(self.distance[-1])

    @property
    def range(self) -> tuple[float, float] | None:
        """Lowest and highest, metres; None: there is no surface."""
        known = self.heights[np.isfinite(self.heights)]
        return (float(known.min()), float(known.max())) if known.size else None

    def json_fields(self) -> dict[str, Any]:
        """Figures."""
        low, high = self.range or (None, None)
        return {"line": self.name, "length": self.length, "points": len(self.distance), "low": low, "high": high}


@dataclass(frozen=True)
class Profiles(Result):
    """Profiles over lines, and the tables that were written."""

    files: tuple[Path, ...]
    profiles: tuple[Profile, ...]

    def __iter__(self) -> Iterator[Profile]:
        return iter(self.profiles)

    def __len__(self) -> int:
        return len(self.profiles)

    def written(self) -> Sequence[Path]:
        """Return the tables."""
        return self.files

    def messages(self) -> Sequence[str]:
        """Return length, points and range of heights of each profile."""
        return [
            f"{p.name}: {p.length:.2f} m, {len(p.distance)} points, "
            + ("no surface" if p.range is None else "{:.3f} to {:.3f} m".format(*p.range))
            for p in self.profiles
        ]


def dtm_profile(request: ProfileRequest, events: Events = SILENT) -> Profiles:
    """Compute the profiles and write them.

    Raises
    ------
    UsageError
        An output exists, is an input, or of no known kind.
    InputError
        The terrain or the lines cannot be used, or they are in different CRSs.
    """
    inputs = [request.model, request.lines]
    tables = tuple(path for path in request.outputs if path.suffix.lower() != ".png")
    for path in tables:
        if path.suffix.lower() not in TABLES:
            raise UsageError(f"{path}: {path.suffix or 'no suffix'}; profiles are written as .csv and .png")
        check_output(path, inputs, overwrite=request.overwrite)
    terrain = open_terrain(request.model, request.crs)
    found = profiles_of(terrain, _lines(request, terrain), request.tolerance)
    for path in tables:
        with replacing(path, inputs, request.overwrite) as part:
            _write_table(part, found)
    return Profiles(tables, tuple(found))


def profiles_of(
    terrain: OpenTerrain, lines: Sequence[tuple[str, NDArray[np.float64]]], tolerance: float = 0.001
) -> list[Profile]:
    """Profiles over lines (name, vertices (n, 2)) in the terrain's CRS."""
    found = []
    for name, vertices in lines:
        try:
            distance, X, Y, Z = profile(terrain.surface, vertices, tolerance)
        except UsageError as error:
            raise UsageError(f"line {name!r}: {error}") from None
        xy = np.column_stack([X, Y])
        sigmas = np.full(len(xy), np.nan) if terrain.errors is None else terrain.errors.sigmas(xy)
        found.append(
            Profile(name=name, distance=distance, xy=xy, heights=Z, sigmas=np.where(np.isnan(Z), np.nan, sigmas))
        )
    return found


def _lines(request: ProfileRequest, terrain: OpenTerrain) -> list[tuple[str, NDArray[np.float64]]]:
    """Name and vertices of each line."""
    if request.lines.suffix.lower() in (*TABLES, ".xyz"):
        return _lines_of_table(request)
    lines = []
    for item in read_features(request.lines, "LineString", crs=terrain.crs).items:
        parts = shapely.get_parts(item.geometry)
        for number, part in enumerate(parts, 1):
            name = item.name if len(parts) == 1 else f"{item.name}.{number}"
            lines.append((name, shapely.get_coordinates(part)))
    return lines


def _lines_of_table(request: ProfileRequest) -> list[tuple[str, NDArray[np.float64]]]:
    dialect = Dialect(decimal_comma=request.decimal_comma)
    table = PointTable(request.lines, PointTableFormat(request.x, request.y, dialect))
    column = _line_column(request, table)
    names: list[str] = []
    points = []
    for part in table.parts(100_000):
        names += ["1" if column is None else row[column] for row in part.rows]
        points.append(part.xy)
        if len(names) > MOST_POINTS:
            raise InputError(f"{request.lines}: more than {MOST_POINTS} points; give fewer lines at a time")
    xy = np.concatenate(points)
    groups: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        groups.setdefault(name, []).append(i)
    short = [name for name, which in groups.items() if len(np.unique(xy[which], axis=0)) < 2]
    if short:
        raise InputError(f"{request.lines}: line {short[0]!r} has fewer than two different points")
    return [(name, xy[which]) for name, which in groups.items()]


def _line_column(request: ProfileRequest, table: PointTable) -> int | None:
    lower = [name.casefold() for name in table.names]
    if request.line_column is None:
        wanted = next((name for name in _LINE_NAMES if name in lower), None)
        return None if wanted is None else lower.index(wanted)
    if request.line_column.casefold() not in lower:
        raise InputError(
            f"{request.lines}: no column {request.line_column!r}; the columns are {', '.join(table.names)[:200]}"
        )
    return lower.index(request.line_column.casefold())


def _write_table(part: Path, profiles: Sequence[Profile]) -> None:
    with part.open("w", encoding="utf-8", newline="") as file:
        file.write(csv_line(["line", "distance", "x", "y", "height", "sigma"]))
        for p in profiles:
            for d, (x, y), z, s in zip(p.distance, p.xy, p.heights, p.sigmas):
                height, sigma = (f"{v:.4f}" if np.isfinite(v) else "" for v in (z, s))
                file.write(csv_line([p.name, f"{d:.4f}", f"{x:.4f}", f"{y:.4f}", height, sigma]))
