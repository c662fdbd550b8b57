"""Rational polynomials for programs that know no cameras: fitted to the images of a project, a file for each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from photoplan.cameras.base import Camera
from photoplan.cameras.rpc_fit import fit_rpc
from photoplan.errors import GeometryError, InputError
from photoplan.geometry.geodetic import GeodeticGround
from photoplan.io.camera.rpc.text import rpc_text
from photoplan.io.disk import make_parents
from photoplan.io.names import unique_stems
from photoplan.io.naming import write_atomically
from photoplan.io.product import check_output
from photoplan.io.project.file import load_project
from photoplan.io.project.model import Project
from photoplan.io.run_record import recording
from photoplan.plain import pick
from photoplan.plan.footprint import footprint
from photoplan.project.cameras import camera_without_pixels
from photoplan.project.ground import ground_of
from photoplan.project.scene import input_files

#: Heights are taken further than those of the terrain, by this part of their range or of the distance from the camera.
_ROOM, _OF_DISTANCE = 0.1, 0.02


@dataclass(frozen=True)
class PolynomialsRequest:
    """What is asked."""

    project: Path
    output: Path | None = None
    """Folder of the files; None: that of the project."""
    overwrite: bool = False
    dry_run: bool = False
    """Whether to fit polynomials, and write nothing."""


@dataclass(frozen=True)
class ImagePolynomials:
    """What the polynomials of an image leave of its camera, between the places of the fit."""

    image: str
    file: Path
    rms: tuple[float, float]
    """Of column and row, pixels."""
    worst: float
    """Pixels."""
    heights: tuple[float, float]
    """For which they were fitted, in the ground's height system, metres."""


@dataclass(frozen=True)
class PolynomialsReport:
    """What came out."""

    images: tuple[ImagePolynomials, ...]

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that were written."""
        return tuple(each.file for each in self.images)

    def json_fields(self) -> dict[str, Any]:
        """Files, and the figures of each image."""
        return pick(self, "files", "images")


def write_polynomials(request: PolynomialsRequest) -> PolynomialsReport:
    """Fit polynomials to all images of a project over the heights that they see, and write ``IMAGE_RPC.TXT``.

    Raises
    ------
    UsageError
        A file exists.
    InputError
        The project cannot be used, or an image has no geometry yet.
    GeometryError
        An image sees no terrain, or does not look down.
    """
    project = load_project(request.project)
    folder = request.output or project.folder
    stems = unique_stems(image.file for image in project.images)
    outputs = {image.name: folder / f"{stems[image.file]}_RPC.TXT" for image in project.images}
    inputs = [request.project, *input_files(project)]
    for path in outputs.values():
        check_output(path, inputs, overwrite=request.overwrite)
    with recording("convert", request, inputs) as record:
        fitted = [_fit(project, name, path) for name, path in outputs.items()]
        report = PolynomialsReport(tuple(image for image, _, _ in fitted))
        if request.dry_run:
            return report
        try:
            make_parents(folder)
        except OSError as error:
            raise InputError(f"{folder}: the folder cannot be made ({error.strerror or error})") from None
        for _, path, text in fitted:
            write_atomically(path, text.encode())
        record(report.files, report)
    return report


def _fit(project: Project, name: str, path: Path) -> tuple[ImagePolynomials, Path, str]:
    ground = ground_of(project)
    camera = camera_without_pixels(project, name)
    seen = footprint(camera, ground.bare, ground.bounds)
    if seen.bounds is None:
        raise GeometryError(f"image {name!r} sees nothing of the terrain; `photoplan check` says where it looks")
    heights = _heights(camera, seen.height_range)
    try:
        found = fit_rpc(camera, GeodeticGround(project.crs, ground.working_system), heights)
    except GeometryError as error:
        raise GeometryError(f"image {name!r}: {error}") from None
    return (
        ImagePolynomials(image=name, file=path, rms=found.rms, worst=found.worst, heights=heights),
        path,
        rpc_text(found.functions),
    )


def _heights(camera: Camera, seen: tuple[float, float]) -> tuple[float, float]:
    """Heights of the fit: those that are seen, and some room."""
    (low, high), top = seen, float(camera.vantage.point[2])
    room = max(_ROOM * (high - low), _OF_DISTANCE * (top - low))
    return max(low - room, camera.vantage.floor), min(high + room, (high + top) / 2)
