"""The skyline of a view: in every column of the picture the highest ground that is seen, to a small part of a pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.io.product import check_output
from photoplan.io.store import recording
from photoplan.io.tables import write_table
from photoplan.io.vector_layer import check_vectors, write_features
from photoplan.products.view.camera import ViewCamera, ViewGround, open_view_ground, view_camera
from photoplan.products.view.make import ViewRequest, camera_request, seen_surface
from photoplan.products.view.photo import (
    PhotoMatch,
    PhotoSkylineRequest,
    RefinedCamera,
    against_photo,
    draw_match,
    refined_camera,
    write_refined,
)
from photoplan.surfaces.seen import Seen, skyline_of
from photoplan.targets.view import ViewTarget

COLUMNS = ("x", "y", "E", "N", "H", "distance", "azimuth_deg")
#: Columns of a photograph: row of the sky's edge, and how far below the skyline of the terrain it lies.
OF_PHOTO = ("y_photo", "residual")


@dataclass(frozen=True)
class SkylineRequest:
    """What is asked."""

    view: ViewRequest
    output: Path
    """``.csv``: a table; ``.gpkg``: points on the map."""
    overwrite: bool = False
    photo: PhotoSkylineRequest | None = None
    """A photograph that it is compared with."""


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
    before: PhotoMatch | None = None
    match: PhotoMatch | None = None
    """A photograph beside it, with the camera as stated and with the one that this skyline belongs to; None: there is
    none."""
    refined: RefinedCamera | None = None
    """The camera that the photograph asks for; None: it was not asked."""

    def json_fields(self) -> dict[str, Any]:
        """Counts, and what the photograph says."""
        out = {"output": self.output, "columns": self.columns, "points": len(self.points)}
        if self.before is not None and self.match is not None:
            out |= {"photo": self.before.figures, "control": self.match.control}
        if self.refined is not None and self.match is not None:
            out |= {"refined": self.refined, "photo_refined": self.match.figures, "doubt": self.match.doubt}
        return out


def skyline(request: SkylineRequest) -> Skyline:
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
    view, photo = request.view, request.photo
    inputs = [view.source, view.matrix, *([] if photo is None else [photo.photo, photo.control])]
    outputs = [request.output, *([] if photo is None else [photo.picture, photo.refined])]
    for each in outputs:
        if each is not None:
            check_output(each, [name for name in inputs if name is not None], overwrite=request.overwrite)
    if request.output.suffix.lower() != ".csv":
        check_vectors(request.output)
    with recording("view skyline", request, inputs) as record:
        ground = open_view_ground(view.source, view.crs, view.water)
        camera = view_camera(camera_request(view), ground, view.force)
        surface = seen_surface(ground, view.farthest, view.bound)
        if photo is None:
            found = _skyline(request, ground, camera.target, skyline_of(camera.target, surface))
        else:
            matches = against_photo(photo, camera, lambda target, beyond: skyline_of(target, surface, beyond))
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
    return Skyline(np.column_stack(numbers), surfaces, target.bundle.size[0], request.output)


def _beside(
    request: SkylineRequest, ground: ViewGround, camera: ViewCamera, before: PhotoMatch, after: PhotoMatch | None
) -> Skyline:
    """A skyline with what a photograph says of it; the files of both are written."""
    assert request.photo is not None
    last = before if after is None else after
    refined = None if after is None else refined_camera(camera, after, ground, request.photo.refined)
    if request.photo.refined is not None and refined is not None:
        write_refined(request.photo.refined, refined)
    if request.photo.picture is not None:
        draw_match(request.photo.picture, request.photo.photo, last)
    found = _skyline(request, ground, last.target, last.line)
    return replace(found, before=before, match=last, refined=refined)


def _write(found: Skyline, crs: str) -> None:
    if found.output.suffix.lower() == ".csv":
        rows = [[*(f"{v:.4f}" for v in row), name] for row, name in zip(found.points.tolist(), found.surfaces)]
        if found.match is not None:
            for row, y, apart in zip(rows, found.points[:, 1], found.match.residuals.tolist()):
                row += [f"{y + apart:.4f}", f"{apart:.4f}"] if apart == apart else ["", ""]
        write_table(found.output, (*COLUMNS, "surface", *([] if found.match is None else OF_PHOTO)), rows)
        return
    columns = {name: found.points[:, k] for k, name in enumerate(COLUMNS) if name not in ("E", "N", "H")}
    shapes = [shapely.Point(row) for row in found.points[:, 2:5].tolist()]
    if found.match is not None:
        apart = found.match.residuals
        columns |= dict(zip(OF_PHOTO, (found.points[:, 1] + apart, apart)))
    columns["surface"] = np.array(found.surfaces, object)
    write_features(found.output, "Point Z", shapes, columns, crs, "skyline")
