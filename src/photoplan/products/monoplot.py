"""Monoplotting with files: points or lines of an image of a project become ground points."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Result, noted
from photoplan.geometry.pose import angle_in_radians, axes_of_angles
from photoplan.io.files import ImageNames
from photoplan.io.product import check_output
from photoplan.io.project.file import load_project
from photoplan.io.project.model import Image, ImageEntry, Project
from photoplan.io.store import recording
from photoplan.io.tables import Columns, read_table, write_table
from photoplan.io.vector_layer import check_vectors, read_features, write_features
from photoplan.plain import counted, pick
from photoplan.plan.footprint import footprint
from photoplan.project.cameras import camera_without_pixels, pose_of
from photoplan.project.error_model import known_height_errors
from photoplan.project.ground import Ground, ground_of, open_terrain
from photoplan.project.scene import input_files
from photoplan.requests.measure import MonoplotRequest
from photoplan.terrain.analysis import REASONS, MonoplotErrors, MonoplotPoints, monoplot

#: Points higher than this above the bare ground lie on objects, metres.
_ON_OBJECT = 0.01
#: Flatter than this the ray grazes the terrain: small errors move the point far, and not linearly. Radians.
GRAZING = math.radians(5.0)
ROLES = {"x": ("x", "column", "col"), "y": ("y", "row", "line"), "name": ("name", "id", "point")}
COLUMNS = ("X", "Y", "Z", "sigma_X", "sigma_Y", "sigma_Z", "angle_deg", "reason")


@dataclass(frozen=True)
class MonoplotReport(Result):
    """Result of monoplotting."""

    output: Path
    vectors: Path | None
    points: int
    met: int
    reasons: dict[str, int]
    """Numbers of points without ground point, by reason."""
    grazing: int
    through_holes: int
    median_sigma: tuple[float, float, float] | None
    height_system: str
    notes: tuple[str, ...]

    def json_fields(self) -> dict[str, Any]:
        """Reasons by how many points have them."""
        counts = pick(self, "points", "met", "grazing", "through_holes", without_ground_point="reasons")
        return {**pick(self, "output", "vectors", "median_sigma", "height_system", "notes"), **counts}

    def summary(self) -> Sequence[str]:
        """Return counts, reasons, and standard deviations."""
        lines = [f"{self.met} of {counted(self.points, 'point')} on the ground"]
        lines += [f"  {count} without: {reason}" for reason, count in self.reasons.items()]
        if self.grazing or self.through_holes:
            lines.append(f"  {self.grazing} under less than 5° to the terrain, {self.through_holes} through holes")
        if self.median_sigma is not None:
            lines.append("median standard deviation X {:.3f} Y {:.3f} Z {:.3f} m".format(*self.median_sigma))
        return lines

    def messages(self) -> Sequence[str]:
        """Return the height system and the notes."""
        return [f"height system: {self.height_system}", *noted(self.notes)]


@dataclass(frozen=True, eq=False)
class _Given:
    """Image points as the file has them."""

    xy: NDArray[np.float64]
    header: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    line: NDArray[np.int64] | None
    """Number of the line that each point belongs to; None: single points."""
    names: tuple[str, ...]
    """Names of points, or of lines."""


def monoplot_file(request: MonoplotRequest, events: Events = SILENT) -> MonoplotReport:
    """Ground points of all image points of a file, written as a table.

    Raises
    ------
    UsageError
        An output exists or is an input, or a standard deviation makes no sense.
    InputError
        Project, image or points cannot be used.
    """
    project = load_project(request.project)
    inputs = [request.project, request.points, *input_files(project)]
    for path in (request.output, request.vectors):
        if path is not None:
            check_output(path, inputs, overwrite=request.overwrite)
    if request.vectors is not None:
        check_vectors(request.vectors)
    terrain = project.terrain and project.terrain.file
    ground_files = [terrain, *(objects.file for objects in project.objects)]
    used = [*inputs[:2], *(file and project.resolve(file) for file in ground_files)]
    with recording("monoplot", request, used) as record:
        name = _image_name(project, request.image)
        given = _read(request)
        camera, ground = camera_without_pixels(project, name), ground_of(project)
        mesh, sigma = _mesh_and_sigma(project, ground)
        if request.sigma_terrain is not None:
            sigma = request.sigma_terrain
        notes = []
        if sigma is None:
            notes.append("no standard deviations: the terrain has none of its own; give `sigma_terrain` METRES")
        unit = project.orientation.angle_unit
        errors = MonoplotErrors(
            image=request.sigma_image,
            terrain=sigma,
            position=request.sigma_position,
            angles=tuple(float(a) for a in angle_in_radians(np.array(request.sigma_angles), unit)),  # type: ignore[arg-type]
            axes=_axes_of(project, project.any_image(name), ground, request),
        )
        seen = footprint(camera, ground.surface, ground.bounds)
        found = monoplot(camera, given.xy, ground.surface, seen.height_range, errors, mesh)
        if sigma is not None and request.sigma_terrain is None:
            notes += _unknown_on_objects(found, ground)
        if (found.reasons != "").all():
            bounds = "nowhere" if seen.bounds is None else " ".join(f"{v:.8g}" for v in seen.bounds)
            center = " ".join(f"{v:.8g}" for v in camera.vantage.point)
            notes.append(f"no point is on the ground; camera at {center}, terrain in its reach {bounds}")
        system, step = ground.height_systems[1], ground.out_of_working(project.crs)
        found.XYZ[:, 2] = step.where_defined(found.XYZ)
        _write_table(request.output, given, found)
        if request.vectors is not None:
            _write_vectors(request.vectors, given, found, project.crs)
        report = _report(request, found, system, notes)
        record([request.output, request.vectors], report)
    return report


def _image_name(project: Project, name: str) -> str:
    """The project's name of an image that may be given with or without its suffix."""
    return ImageNames(image.name for image in project.images).find(name) or project.image(name).name


def _mesh_and_sigma(
    project: Project, ground: Ground
) -> tuple[float, Callable[[NDArray[np.float64]], NDArray[np.float64]] | float | None]:
    """Mesh width of the project's terrain and its standard deviation, if that is known."""
    errors = known_height_errors(project)
    sigma = None if errors is None else errors.sigmas
    if ground.file is None:
        return 1.0, sigma
    return open_terrain(ground.file, project.ground.crs, height_system=project.ground.height_system).resolution, sigma


def _unknown_on_objects(found: MonoplotPoints, ground: Ground) -> list[str]:
    """Take standard deviations, which are those of the terrain, from points that lie on objects; a note if there are
    such."""
    on_object = found.XYZ[:, 2] > ground.bare.heights(found.XYZ[:, :2]) + _ON_OBJECT
    if not on_object.any():
        return []
    found.covariance[on_object] = np.nan
    return [
        f"{int(on_object.sum())} points lie on objects, whose accuracy is not known: no standard deviations; "
        "`sigma_terrain` METRES counts for objects, too"
    ]


def _axes_of(
    project: Project, image: ImageEntry, ground: Ground, request: MonoplotRequest
) -> NDArray[np.float64] | None:
    """Axes about which an image's orientation may be wrong; None: it has none."""
    if isinstance(image, Image):
        return axes_of_angles(pose_of(project, image, ground).R_ground_camera, project.orientation.rotation)
    if any((*request.sigma_position, *request.sigma_angles)):
        raise UsageError(
            f"image {image.name!r} has no projection centre and no angles that could have standard deviations; state "
            "the accuracy of its geometry with `sigma_image`"
        )
    return None


def _read(request: MonoplotRequest) -> _Given:
    """Image points of a table, or of all vertices of a vector file."""
    if request.points.suffix.lower() in (".csv", ".txt", ".tsv", ".dat"):
        table = read_table(request.points, Columns(roles=ROLES, needed=("x", "y"), row="point"))
        labels = tuple(table.labels("name", "{row}"))
        return _Given(xy=table.numbers("x", "y"), header=table.layout.names, rows=table.rows, line=None, names=labels)
    items = read_features(request.points, "Point", "LineString").items
    kinds = {"Line" in item.geometry.geom_type for item in items}
    if len(kinds) > 1:
        raise InputError(f"{request.points}: holds points and lines; put them into two files")
    parts = [(item.name, part) for item in items for part in shapely.get_parts(item.geometry)]
    xy, line = shapely.get_coordinates([part for _, part in parts], return_index=True)
    if request.gis_axes:
        xy = np.column_stack([xy[:, 0] - 0.5, -xy[:, 1] - 0.5])
    names = [parts[k][0] for k in line]
    rows = [(name, repr(float(x)), repr(float(y))) for name, (x, y) in zip(names, xy)]
    return _Given(
        xy=xy,
        header=("name", "x", "y"),
        rows=rows,
        line=line if True in kinds else None,
        names=tuple(name for name, _ in parts),
    )


def _write_table(path: Path, given: _Given, found: MonoplotPoints) -> None:
    """The columns of the input, then `COLUMNS`; fields without a value are empty."""
    rows = []
    degrees = np.degrees(found.angle)
    for i, row in enumerate(given.rows):
        numbers = [_text(v, 4) for v in (*found.XYZ[i], *found.sigmas[i])]
        rows.append([*row, *numbers, _text(degrees[i], 2), _remark(found, i)])
    write_table(path, [*given.header, *COLUMNS], rows)


def _text(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else ""


def _remark(found: MonoplotPoints, i: int) -> str:
    """Return why there is no point, or what is to be said about it."""
    if found.reasons[i]:
        return REASONS[str(found.reasons[i])]
    said = ["grazing"] if found.angle[i] < GRAZING else []
    return "; ".join(said + (["through a hole"] if found.hole[i] else []))


def _write_vectors(path: Path, given: _Given, found: MonoplotPoints, crs: str) -> None:
    there = np.isfinite(found.XYZ[:, 0])
    sigma = found.sigmas
    if given.line is None:
        columns = {"name": np.array(given.names, object)[there]}
        columns |= {f"sigma_{axis}": sigma[there, k] for k, axis in enumerate("XYZ")}
        write_features(path, "Point Z", list(shapely.points(found.XYZ[there])), columns, crs, "ground_points")
        return
    shapes, names, worst = [], [], []
    for run in _runs(given.line, there):
        shapes.append(shapely.LineString(found.XYZ[run]))
        names.append(given.names[given.line[run[0]]])
        worst.append(float(np.linalg.norm(sigma[run], axis=1).max()))
    columns = {"name": np.array(names, object), "largest_sigma": np.array(worst, float)}
    write_features(path, "LineString Z", shapes, columns, crs, "ground_lines")


def _runs(line: NDArray[np.int64], there: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """Vertices of one line that follow each other and have ground points; two at least."""
    index = np.flatnonzero(there)
    breaks = np.flatnonzero((np.diff(index) > 1) | (np.diff(line[index]) != 0)) + 1
    return [run for run in np.split(index, breaks) if len(run) > 1]


def _report(
    request: MonoplotRequest, found: MonoplotPoints, height_system: str, notes: Sequence[str]
) -> MonoplotReport:
    met = found.reasons == ""
    missed = {str(key): int((found.reasons == key).sum()) for key in np.unique(found.reasons[~met])}
    sigmas = found.sigmas[np.isfinite(found.sigmas).all(axis=1)]
    median = tuple(float(v) for v in np.median(sigmas, axis=0)) if len(sigmas) else None
    return MonoplotReport(
        output=request.output,
        vectors=request.vectors,
        points=len(met),
        met=int(met.sum()),
        reasons={REASONS[key]: count for key, count in missed.items()},
        grazing=int((found.angle[met] < GRAZING).sum()),
        through_holes=int(found.hole[met].sum()),
        median_sigma=median,  # type: ignore[arg-type]
        height_system=height_system,
        notes=tuple(notes),
    )
