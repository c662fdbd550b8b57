"""The skyline of a view: in every column of the picture the highest ground that is seen, to a small part of a pixel."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.io.polygons import write_features
from photoplan.io.product import check_output
from photoplan.io.run_record import recording
from photoplan.io.tables import write_table
from photoplan.products.view.camera import view_camera
from photoplan.products.view.ground import open_view_ground
from photoplan.products.view.job import seen_surface
from photoplan.products.view.make import ViewRequest, camera_request

#: Rows between the rays that look for ground in each column, pixels: what is less high and hangs in the sky is missed.
_COARSE = 8
#: Halvings from there on: a thousandth of a pixel.
_HALVINGS = 13
COLUMNS = ("x", "y", "E", "N", "H", "distance", "azimuth_deg")


@dataclass(frozen=True)
class SkylineRequest:
    """What is asked."""

    view: ViewRequest
    output: Path
    """``.csv``: a table; ``.gpkg``: points on the map."""
    overwrite: bool = False


@dataclass(frozen=True, eq=False)
class Skyline:
    """The skyline of a view."""

    points: NDArray[np.float64]
    """A row for each column that shows both ground and sky above it, by `COLUMNS`: place in the picture (pixels), the
    ground there (metres), its distance (metres), its direction from grid north (degrees); shape (n, 7)."""
    surfaces: tuple[str, ...]
    """What is there: `terrain`, or the name of an object."""
    columns: int
    """Of the picture."""
    output: Path

    def json_fields(self) -> dict[str, Any]:
        """Its points by name."""
        return {"output": self.output, "columns": self.columns, "points": len(self.points)}


def skyline(request: SkylineRequest) -> Skyline:
    """Find the skyline of a view, and write it.

    A column that shows no sky, or no ground, has no point. Terrain without overhangs has one border between ground and
    sky in a vertical plane: it is found by halving.

    Raises
    ------
    UsageError
        The output exists, or is neither a table nor a GeoPackage.
    InputError
        A file cannot be used.
    GeometryError
        The point of view lies below the ground.
    """
    check_output(request.output, [request.view.source], overwrite=request.overwrite)
    with recording("view skyline", request, [request.view.source, request.view.matrix]) as record:
        ground = open_view_ground(request.view.source, request.view.crs)
        camera = view_camera(camera_request(request.view), ground, request.view.force)
        surface = seen_surface(ground, request.view.farthest, request.view.bound)
        width, height = camera.target.bundle.size

        def hit(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.bool_]:
            return np.asarray(surface.at(camera.target, np.stack([x, y], axis=-1)).owner >= 0)

        x, low, high = _bracket(hit, width, height)
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            met = hit(x, middle)
            low, high = np.where(met, middle, low), np.where(met, high, middle)
        seen = surface.at(camera.target, np.stack([x, low], axis=-1))
        away = seen.XYZ - camera.target.center
        azimuth = np.degrees(np.arctan2(away[:, 0], away[:, 1])) % 360.0
        numbers = (x, low, *seen.XYZ.T, camera.target.distance(seen.uvh), azimuth)
        names = ("sky", "terrain", *ground.objects)
        found = Skyline(
            np.column_stack(numbers), tuple(names[owner + 1] for owner in seen.owner), width, request.output
        )
        _write(found, ground.crs)
        record([request.output], {"camera": camera, "points": len(found.points), "columns": width})
    return found


def _bracket(hit: Any, width: int, height: int) -> tuple[NDArray[np.float64], ...]:
    """Columns with ground below sky, the highest row found with ground, and one without it above."""
    rows = np.append(np.arange(-0.5, height - 0.5, _COARSE), height - 0.5)
    x = np.arange(width, dtype=float)
    below, top = np.full(width, np.nan), np.full(width, -0.5)
    for before, row in zip(rows[:1].tolist() + rows[:-1].tolist(), rows.tolist()):
        todo = np.flatnonzero(np.isnan(below))
        if not len(todo):
            break
        met = todo[hit(x[todo], np.full(len(todo), row))]
        below[met], top[met] = row, before
    there = np.isfinite(below) & (below > -0.5)
    return x[there], below[there], top[there]


def _write(found: Skyline, crs: str) -> None:
    if found.output.suffix.lower() == ".csv":
        rows = [[*(f"{v:.4f}" for v in row), name] for row, name in zip(found.points.tolist(), found.surfaces)]
        write_table(found.output, (*COLUMNS, "surface"), rows)
        return
    columns = {name: found.points[:, k] for k, name in enumerate(COLUMNS) if name not in ("E", "N", "H")}
    shapes = [shapely.Point(row) for row in found.points[:, 2:5].tolist()]
    columns["surface"] = np.array(found.surfaces, object)
    write_features(found.output, "Point Z", shapes, columns, crs, "skyline")
