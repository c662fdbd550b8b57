"""The measurements of a project, brought together under the project's names and with their accuracy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.observed import GroundPoints, ImagePoints, ObservedAttitudes, ObservedPositions
from photoplan.errors import InputError
from photoplan.geometry.bounds import area_note
from photoplan.io.gcp_list import is_gcp_list, read_gcp_list
from photoplan.io.ground_points import read_ground_points
from photoplan.io.image_points import named_as, read_image_points
from photoplan.io.names import ImageNames, match_key
from photoplan.io.observed_positions import PositionTable, read_observed_positions
from photoplan.io.orientation.exif import image_files
from photoplan.io.orientation.table import TableFormat, angle_in_radians
from photoplan.io.project.cameras import image_size
from photoplan.io.project.image import ImageEntry
from photoplan.io.project.model import Project
from photoplan.io.project.posed import Image
from photoplan.products.init.match import some
from photoplan.project.cameras import size_of
from photoplan.project.posed import stated_pose

Floats = NDArray[np.float64]
#: Standard deviations of orientations that place a block, where none is stated: horizontal, height (metres), angles
#: (degrees).
DATUM_SIGMA, DATUM_ANGLE = (3.0, 5.0), 3.0
#: Part of the measurements that may be wrong in a way that makes one think of the whole file.
_FEW = 0.02


@dataclass(frozen=True, eq=False)
class AdjustInputs:
    """Everything that is measured, in map coordinates and the orientation's height system."""

    project: Project
    images: tuple[Image, ...]
    """Those with poses that are wanted."""
    projected: tuple[ImageEntry, ...]
    """The others that are wanted."""
    points: ImagePoints
    """Measurements in these images, by the project's names, each with a standard deviation."""
    ground: GroundPoints
    table: PositionTable | None
    """Observed positions as their file states them, by the project's names."""
    positions: ObservedPositions | None
    attitudes: ObservedAttitudes | None
    files: tuple[Path, ...]
    notes: tuple[str, ...]
    """What a user should know of how the files were read."""
    lost: tuple[tuple[str, str], ...] = ()
    """Images that cannot be oriented to begin with, and why."""


def read_inputs(project: Project, names: Sequence[str]) -> AdjustInputs:
    """Read all files that [observations] names."""
    observations = project.observations
    if not observations.image_points and not any(is_gcp_list(project.resolve(f)) for f in observations.control):
        raise InputError(
            'the project names no image points; give image_points = ["points.csv"] in [observations], measured by '
            "hand or by `photoplan tie`"
        )
    notes: list[str] = []
    ground_parts, parts, files = _control(project, notes)
    for file in observations.image_points:
        path = project.resolve(file)
        if path not in files:
            files.append(path)
            columns, comma = observations.image_points_columns, bool(observations.decimal_comma)
            parts.append((path, read_image_points(path, columns=columns, decimal_comma=comma, doubtful=notes)))
    points = _image_points(project, parts, names, notes)
    ground = _ground(project, ground_parts)
    measured = set(points.points)
    unmeasured = [n for n in ground.names if n not in measured]
    if unmeasured:
        notes.append(f"{len(unmeasured)} ground points are measured in no image: {some(unmeasured)}")
        keep = np.array([n in measured for n in ground.names], bool)
        names_kept = tuple(n for n in ground.names if n in measured)
        ground = GroundPoints(names_kept, ground.XYZ[keep], ground.sigma[keep], ground.check[keep])
    wanted = set(names)
    images = tuple(image for image in project.posed if image.name in wanted)
    datum = project.adjustment.datum == "orientations"
    table = _positions(project, names, notes)
    if table is not None:
        files += image_files(table.path)
    positions = None if table is None else table.positions(observations.sigma_position)
    unit = project.orientation.angle_unit
    sigma = None if observations.sigma_attitude is None else observations.sigma_attitude
    radians = None if sigma is None else float(angle_in_radians(np.array(sigma), unit))
    attitudes = None if table is None else table.attitudes(radians)
    if datum:
        positions, attitudes = _datum(project, images, radians, notes)
    if table is not None and table.R_ground_camera is not None and attitudes is None:
        notes.append(
            f"{table.path.name}: attitudes are start values only; they become observations with sigma_attitude in "
            "[observations]"
        )
    return AdjustInputs(
        project=project,
        images=images,
        projected=tuple(i for i in project.images if i.name in wanted and not isinstance(i, Image)),
        points=points,
        ground=ground,
        table=table,
        positions=positions,
        attitudes=attitudes,
        files=tuple(files),
        notes=tuple(notes),
    )


def _judge_places(project: Project, path: Path, what: str, names: Sequence[str], XYZ: Floats, notes: list[str]) -> None:
    """Refuse places of a file that are far outside the area of the project's CRS, and note those a little outside."""
    fault = project.area_fault(XYZ, names)
    if fault is not None:
        raise InputError(f"{path}: {what} {fault}")
    note = None if project.beyond_area else area_note(project.crs, XYZ, names)
    if note is not None:
        notes.append(f"{path.name}: {what} {note}")


def _control(
    project: Project, notes: list[str]
) -> tuple[list[GroundPoints], list[tuple[Path, ImagePoints]], list[Path]]:
    """Ground points of all files, and the measurements that come with a gcp_list.txt."""
    grounds, points, files = [], [], []
    for file in project.observations.control:
        path = project.resolve(file)
        files.append(path)
        if is_gcp_list(path):
            gcps = read_gcp_list(path, project.crs, project.orientation.height_system)
            grounds.append(gcps.ground)
            points.append((path, gcps.points))
        else:
            columns, comma = project.observations.control_columns, bool(project.observations.decimal_comma)
            grounds.append(
                read_ground_points(
                    path,
                    crs=project.crs,
                    height_system=project.orientation.height_system,
                    columns=columns,
                    decimal_comma=comma,
                )
            )
        _judge_places(project, path, "control point", grounds[-1].names, grounds[-1].XYZ, notes)
    return grounds, points, files


def _image_points(
    project: Project, parts: list[tuple[Path, ImagePoints]], names: Sequence[str], notes: list[str]
) -> ImagePoints:
    every = [image.name for image in project.images]
    renamed, unknown, total = [], [], 0
    for path, part in parts:
        own, lost = named_as(part, every)
        total += len(part.images)
        unknown += [n for n in lost if n not in unknown]
        if len(lost) == len(part.images) and any(match_key(n) in {match_key(p) for p in part.points} for n in every):
            raise InputError(
                f"{path}: the column of points holds images; its header names the columns point and image in the wrong "
                "order, or it has none and the order is image, point"
            )
        renamed.append(own)
    try:
        merged = ImagePoints.merged(renamed).of_images(names)
    except InputError as error:
        raise InputError(f"{', '.join(path.name for path, _ in parts)}: {error}") from None
    if not len(merged):
        raise InputError(
            f"{', '.join(str(path) for path, _ in parts)}: none of the images is in the project: measured are "
            f"{some(unknown)}; the project has {some(every)}"
        )
    merged = _inside(project, merged, notes)
    if unknown:
        notes.append(f"{len(unknown)} images of the measurements are not in the project: {some(unknown)}")
    return _with_sigma(merged, project.observations.sigma_image)


def _inside(project: Project, points: ImagePoints, notes: list[str]) -> ImagePoints:
    """The measurements in their images; a few outside (half a pixel beyond the border) are set aside by name.

    Many are of images of another size, or columns and rows are exchanged.
    """
    sizes = np.array([_size(project, project.any_image(name)) for name in points.images])
    width_height = sizes[points.image]
    beyond = ((points.xy < -1.0) | (points.xy > width_height)).any(axis=1)
    # The geometry of a crop holds around it, where points were measured in the whole image.
    total, lost = (np.bincount(points.image[k], minlength=len(points.images)) for k in (slice(None), beyond))
    posed = np.array([isinstance(project.any_image(name), Image) for name in points.images], bool)
    crops = ~posed & (lost > 0) & (2 * lost < total)
    notes += [
        f"image {points.images[k]!r}: {lost[k]} of {total[k]} measurements lie outside of it; its geometry is that of "
        "a larger image, and they take part"
        for k in np.flatnonzero(crops)
    ]
    outside = np.flatnonzero(beyond & ~crops[points.image])
    if not len(outside):
        return points
    k = int(outside[0])
    width, height = width_height[k]
    x, y = points.xy[k]
    what = f"{points.label(k)}: column {x:g}, row {y:g} lies outside the image of {width} × {height} pixels"
    if len(outside) > _FEW * len(points):
        raise InputError(
            f"{what} ({len(outside)} of {len(points)} measurements do); were they measured in images of another size, "
            "or are x and y exchanged?"
        )
    notes.append(f"{what}; {len(outside)} such measurements take no part")
    return points.where(np.setdiff1d(np.arange(len(points)), outside))


def _size(project: Project, image: ImageEntry) -> tuple[int, int]:
    return image_size(project.cameras[image.camera], image) if isinstance(image, Image) else size_of(project, image)


def _with_sigma(points: ImagePoints, sigma: float) -> ImagePoints:
    full = np.where(np.isnan(points.sigma), sigma, points.sigma)
    return ImagePoints(
        images=points.images, points=points.points, image=points.image, point=points.point, xy=points.xy, sigma=full
    )


def _ground(project: Project, parts: list[GroundPoints]) -> GroundPoints:
    names = tuple(name for part in parts for name in part.names)
    none = np.empty((0, 3))
    XYZ = np.concatenate([none, *(p.XYZ for p in parts)])
    sigma = np.concatenate([none, *(p.sigma for p in parts)])
    check = np.concatenate([np.empty(0, bool), *(p.check for p in parts)])
    if project.observations.sigma_control is not None:
        plane, height = project.observations.sigma_control
        sigma = np.where(np.isnan(sigma), [plane, plane, height], sigma)
    lost = np.isnan(sigma) & np.isfinite(XYZ) & ~check[:, None]
    if lost.any():
        name = names[int(np.flatnonzero(lost.any(axis=1))[0])]
        raise InputError(
            f"control point {name!r}: its accuracy is not stated; give sigma_control = [horizontal, height] in metres "
            "in [observations], or columns sigma_xy and sigma_z with the points (0: held fixed)"
        )
    return GroundPoints(names, XYZ, sigma, check)


def _datum(
    project: Project, images: Sequence[Image], sigma_attitude: float | None, notes: list[str]
) -> tuple[ObservedPositions, ObservedAttitudes]:
    """The orientations that the project states, as what places the block."""
    if project.observations.positions is not None:
        raise InputError(
            "`datum` is set to orientations, and the project has observed positions, which place the block already; "
            "leave `datum` out, or remove positions from [observations]"
        )
    oriented = [image for image in images if image.center is not None and image.angles is not None]
    if not oriented:
        raise InputError(
            "`datum` is set to orientations, and no image of the project has center and angles; give control points "
            "or observed positions instead"
        )
    names = tuple(image.name for image in oriented)
    poses = [stated_pose(project, image) for image in oriented]
    plane, height = project.observations.sigma_position or DATUM_SIGMA
    angle = np.radians(DATUM_ANGLE) if sigma_attitude is None else sigma_attitude
    notes.append(
        f"the block lies where the orientations of {len(names)} images place it: a position counts as known to "
        f"{plane:g} m, {height:g} m in height, angles to {np.degrees(angle):g}°; other values are sigma_position and "
        "sigma_attitude in [observations]"
    )
    return (
        ObservedPositions(
            images=names,
            XYZ=np.array([pose.center for pose in poses]),
            sigma=np.array([plane, plane, height]),
            strip=("",) * len(names),
            time=np.arange(len(names), dtype=float),
        ),
        ObservedAttitudes(names, np.array([pose.R_ground_camera for pose in poses]), np.full(3, angle)),
    )


def _positions(project: Project, names: Sequence[str], notes: list[str]) -> PositionTable | None:
    if project.observations.positions is None:
        return None
    orientation = project.orientation
    form = TableFormat(angle_unit=orientation.angle_unit, rotation=orientation.rotation)
    table = read_observed_positions(
        project.resolve(project.observations.positions), form, crs=project.crs, height_system=orientation.height_system
    )
    notes += table.notes
    _judge_places(project, table.path, "position of", table.images, table.XYZ, notes)
    try:
        found = ImageNames(image.name for image in project.images).match(table.images)
    except InputError as error:
        raise InputError(f"{table.path}: {error}") from None
    wanted = set(names)
    keep = [k for k, name in enumerate(found) if name in wanted]
    unknown = [name for name, known in zip(table.images, found) if known is None]
    if not keep:
        raise InputError(
            f"{table.path}: none of its images is in the project: it has {some(list(table.images))}; the project has "
            f"{some(list(names))}"
        )
    if unknown:
        notes.append(f"{table.path.name}: {len(unknown)} positions are of images that are not in the project")
    at: NDArray[np.int64] = np.array(keep, np.int64)
    return PositionTable(
        path=table.path,
        images=tuple(found[k] or "" for k in keep),
        XYZ=table.XYZ[at],
        sigma=table.sigma[at],
        R_ground_camera=None if table.R_ground_camera is None else table.R_ground_camera[at],
        sigma_angle=table.sigma_angle[at],
        strip=tuple(table.strip[k] for k in keep),
        time=table.time[at],
    )
