"""Heights and their standard deviations at points of a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Result
from photoplan.geometry.crs import crs_label
from photoplan.geometry.heights import height_label
from photoplan.io.product import check_output
from photoplan.io.table_lines import csv_line
from photoplan.io.tables import Dialect
from photoplan.io.terrain.export import replacing
from photoplan.io.terrain.points import PointTable, PointTableFormat
from photoplan.plain import pick
from photoplan.project.open_terrain import OpenTerrain, open_terrain
from photoplan.requests.terrain import SampleRequest

PART = 100_000
"""Points that are in memory at once."""
_DELIMITERS = {"comma": ",", "semicolon": ";", "tab": "\t", "\\t": "\t", "space": " "}


@dataclass(frozen=True)
class SampleReport(Result):
    """What came out."""

    path: Path
    points: int
    outside: int
    """Points where there is no model: their columns are empty."""
    low: float
    high: float
    sigma: float
    """Root mean square of the standard deviations, metres; NaN: unknown."""
    crs: str
    height_system: str | None

    def json_fields(self) -> dict[str, Any]:
        """The path as file."""
        own = ("points", "outside", "low", "high", "sigma", "crs", "height_system")
        return pick(self, *own, file="path")

    def messages(self) -> Sequence[str]:
        """Return counts and the range of heights."""
        sigma = f", sigma {self.sigma:.3f} m" if self.sigma == self.sigma else ""
        heights = f" · {self.low:.3f} to {self.high:.3f} m{sigma}" if self.outside < self.points else ""
        return [
            f"{self.points} points, {self.outside} without a model{heights} · {crs_label(self.crs)} · "
            f"heights {height_label(self.height_system)}"
        ]


def dtm_sample(request: SampleRequest, events: Events = SILENT) -> SampleReport:
    """Write the points' table with two more columns, part by part.

    Raises
    ------
    UsageError
        The output exists or is an input; a column has the name of a new one.
    InputError
        The terrain or the table cannot be used; a line that cannot be read is named.
    """
    inputs = [request.model, request.points]
    check_output(request.output, inputs, overwrite=request.overwrite)
    terrain = open_terrain(request.model, request.crs)
    if request.points_crs is not None:
        terrain, _ = terrain.in_crs(request.points_crs)
    dialect = Dialect(delimiter=_DELIMITERS.get(request.delimiter or "", request.delimiter),
                      decimal_comma=request.decimal_comma)  # fmt: skip
    table = PointTable(request.points, PointTableFormat(request.x, request.y, dialect, request.header))
    taken = [name for name in request.names if name in table.names]
    if taken:
        raise UsageError(f"{request.points}: has a column {taken[0]} already; name the new ones: `names` HEIGHT SIGMA")
    count = outside = known = 0
    low, high, squares = np.inf, -np.inf, 0.0
    delimiter = table.delimiter
    with (
        replacing(request.output, inputs, request.overwrite) as part,
        part.open("w", encoding="utf-8", newline="") as file,
    ):
        if request.header:
            file.write(csv_line([*table.names, *request.names], delimiter))
        for points in table.parts(PART):
            heights, sigmas = _values(terrain, points.xy)
            texts = [_texts(values, request, delimiter) for values in (heights, sigmas)]
            file.writelines(csv_line([*row, h, s], delimiter) for row, h, s in zip(points.rows, *texts))
            there = np.isfinite(heights)
            count, outside = count + len(heights), outside + int((~there).sum())
            if there.any():
                low, high = min(low, float(heights[there].min())), max(high, float(heights[there].max()))
            good = sigmas[np.isfinite(sigmas)]
            known, squares = known + len(good), squares + float((good**2).sum())
    sigma = float(np.sqrt(squares / known)) if known else np.nan
    if outside == count:
        low = high = np.nan
    return SampleReport(
        path=request.output,
        points=count,
        outside=outside,
        low=low,
        high=high,
        sigma=sigma,
        crs=terrain.crs,
        height_system=terrain.height_system,
    )


def _values(terrain: OpenTerrain, XY: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    errors = terrain.errors
    return terrain.surface.heights(XY), np.full(len(XY), np.nan) if errors is None else errors.sigmas(XY)


def _texts(values: NDArray[np.float64], request: SampleRequest, delimiter: str) -> list[str]:
    """Numbers as the table writes them; empty (between spaces: nan) where there is none."""
    form = f"%.{request.digits}f"
    texts = ["" if value != value else form % value for value in values.tolist()]
    # A field of spaces between spaces would vanish.
    if delimiter == " ":
        texts = [text or "nan" for text in texts]
    return [text.replace(".", ",") for text in texts] if request.decimal_comma else texts
