"""The skyline of a view: the highest visible ground in every column of the rendering, with subpixel accuracy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.events import SILENT, Events
from photoplan.findings import Result, with_sigma
from photoplan.io.product import check_output
from photoplan.io.store import recording
from photoplan.io.tables import write_table
from photoplan.io.vector_layer import check_vectors, write_features
from photoplan.products.view.camera import ViewCamera, ViewGround, open_view_ground, view_camera
from photoplan.products.view.make import camera_request, seen_surface
from photoplan.products.view.photo import (
    PhotoMatch,
    RefinedCamera,
    against_photo,
    draw_match,
    refined_camera,
    write_refined,
)
from photoplan.requests.view import SkylineRequest
from photoplan.surfaces.seen import Seen, skyline_of
from photoplan.targets.view import ViewTarget

COLUMNS = ("x", "y", "E", "N", "H", "distance", "azimuth_deg")
#: Columns of a photograph: row of the sky's edge, and how far below the skyline of the terrain it lies.
OF_PHOTO = ("y_photo", "residual")


@dataclass(frozen=True, eq=False)
class Skyline(Result):
    """The skyline of a view."""

    points: NDArray[np.float64]
    """A row for each column that shows both ground and sky above it, by `COLUMNS`: place in the picture (pixels), the
    ground there (metres), its distance (metres), its direction from grid north (degrees); shape (n, 7)."""
    surfaces: tuple[str, ...]
    """Surface there: `terrain`, or the name of an object."""
    columns: int
    """Width of the picture, pixels."""
    request: SkylineRequest
    before: PhotoMatch | None = None
    match: PhotoMatch | None = None
    """A photograph beside it, with the camera as stated and with the one that this skyline belongs to; None: there is
    none."""
    refined: RefinedCamera | None = None
    """The camera that the photograph asks for; None: it was not asked."""

    def written(self) -> Sequence[Path]:
        """Return the skyline, the photograph with both lines, and the camera that was found."""
        asked = self.request
        return [path for path in (asked.output, asked.picture, asked.refined) if path is not None]

    def remarks(self) -> Sequence[str]:
        """Return what speaks against a turn."""
        return [] if self.match is None or self.match.doubt is None else [self.match.doubt]

    def summary(self) -> Sequence[str]:
        """Return how much is seen, how far away, and what the photograph says."""
        lines = [f"none of {self.columns} columns shows ground with sky above it"]
        if len(self.points):
            away = self.points[:, 5]
            lines = [f"{len(self.points)} of {self.columns} columns, {away.min():.0f} to {away.max():.0f} m away"]
        for name, match in (("as stated", self.before), ("turned", self.match if self.refined else None)):
            if match is None:
                continue
            f = match.figures
            if "median_px" in f:
                lines.append(
                    f"{name}: edge of the sky in {f['columns_compared']} columns, {f['median_distance_px']:.2f} px "
                    f"from the skyline in the median, shifted by {f['median_px']:+.2f} px, spread "
                    f"{f['spread_px']:.2f} px"
                )
            else:
                lines.append(f"{name}: no edge of the sky was found near the skyline")
            if "control_points" in f:
                worst = max(match.control, key=lambda c: (c.dx == c.dx, abs(c.dx) + abs(c.dy)))
                lines.append(
                    f"{name}: {f['control_points']} control points, rms {f['control_rms_px']:.2f} px per coordinate, "
                    f"largest {worst.name}: {worst.dx:+.2f} {worst.dy:+.2f} px"
                )
        if (r := self.refined) is not None:
            for name, after, sigma, before in zip(r.names, r.after, r.sigma, r.before):
                lines.append(f"{name} {with_sigma(after, sigma, r.unit)} (was {before:.4f})")
            if r.constant is not None:
                lines.append(f"camera constant {with_sigma(*r.constant)} times that of its camera")
            err = f"of which about {r.correlated:.0f} err together; the standpoint was held"
            lines.append(f"from {r.used} columns, {err}")
        return lines

    def json_fields(self) -> dict[str, Any]:
        """Return counts, and what the photograph says."""
        out = {"output": self.request.output, "columns": self.columns, "points": len(self.points)}
        if self.before is not None and self.match is not None:
            out |= {"photo": self.before.figures, "control": self.match.control}
        if self.refined is not None and self.match is not None:
            out |= {"refined": self.refined, "photo_refined": self.match.figures, "doubt": self.match.doubt}
        return out


def skyline(request: SkylineRequest, events: Events = SILENT) -> Skyline:
    """Find the skyline of a view, compare it with that of a photograph if there is one, and write it.

    Raises
    ------
    UsageError
        An output exists, or is neither a table nor a GeoPackage.
    InputError
        A file cannot be used.
    GeometryError
        The point of view lies below the ground, or the skyline does not determine the camera that is to be turned.
    """
    inputs = request.files_read()
    outputs = [path for path in (request.output, request.picture, request.refined) if path is not None]
    for each in outputs:
        check_output(each, inputs, overwrite=request.overwrite)
    if request.output.suffix.lower() != ".csv":
        check_vectors(request.output)
    with recording("view skyline", request, inputs) as record:
        ground = open_view_ground(request.source, request.crs, request.water)
        camera = view_camera(camera_request(request, request.matrix), ground, request.force)
        surface = seen_surface(ground, request.farthest, request.bound)
        if request.photo is None:
            found = _skyline(request, ground, camera.target, skyline_of(camera.target, surface))
        else:
            matches = against_photo(request, camera, lambda target, beyond: skyline_of(target, surface, beyond))
            found = _beside(request, ground, camera, *matches)
        _write(found, ground.crs)
        record(outputs, {"camera": camera, **found.json_fields()})
    return found


def _skyline(request: SkylineRequest, ground: ViewGround, target: ViewTarget, seen: Seen) -> Skyline:
    """Numbers of the points of a skyline."""
    away = seen.XYZ - target.center
    azimuth = np.degrees(np.arctan2(away[:, 0], away[:, 1])) % 360.0
    numbers = (seen.uvh[:, 0], seen.uvh[:, 1], *seen.XYZ.T, target.distance(seen.uvh), azimuth)
    names = ("sky", "terrain", *ground.objects)
    surfaces = tuple(names[owner + 1] for owner in seen.owner)
    return Skyline(np.column_stack(numbers), surfaces, target.bundle.size[0], request)


def _beside(
    request: SkylineRequest, ground: ViewGround, camera: ViewCamera, before: PhotoMatch, after: PhotoMatch | None
) -> Skyline:
    """A skyline with what a photograph says of it; the files of both are written."""
    assert request.photo is not None
    last = before if after is None else after
    refined = None if after is None else refined_camera(camera, after, ground, request.refined)
    if request.refined is not None and refined is not None:
        write_refined(request.refined, refined)
    if request.picture is not None:
        draw_match(request.picture, request.photo, last)
    found = _skyline(request, ground, last.target, last.line)
    return replace(found, before=before, match=last, refined=refined)


def _write(found: Skyline, crs: str) -> None:
    if found.request.output.suffix.lower() == ".csv":
        rows = [[*(f"{v:.4f}" for v in row), name] for row, name in zip(found.points.tolist(), found.surfaces)]
        if found.match is not None:
            for row, y, apart in zip(rows, found.points[:, 1], found.match.residuals.tolist()):
                row += [f"{y + apart:.4f}", f"{apart:.4f}"] if apart == apart else ["", ""]
        write_table(found.request.output, (*COLUMNS, "surface", *([] if found.match is None else OF_PHOTO)), rows)
        return
    columns = {name: found.points[:, k] for k, name in enumerate(COLUMNS) if name not in ("E", "N", "H")}
    shapes = [shapely.Point(row) for row in found.points[:, 2:5].tolist()]
    if found.match is not None:
        apart = found.match.residuals
        columns |= dict(zip(OF_PHOTO, (found.points[:, 1] + apart, apart)))
    columns["surface"] = np.array(found.surfaces, object)
    write_features(found.request.output, "Point Z", shapes, columns, crs, "skyline")
