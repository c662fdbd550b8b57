"""Inputs of the bundle adjustment: files, initial values, block."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.observed import GroundPoints, ImagePoints, ObservedAttitudes, ObservedPositions
from photoplan.errors import GeometryError, InputError
from photoplan.geometry.bounds import area_note
from photoplan.geometry.pose import Pose, angle_in_radians, angle_in_unit, angles_from_rotation
from photoplan.io.files import ImageNames, match_key
from photoplan.io.image_metadata import image_files
from photoplan.io.orientation.block import TableFormat
from photoplan.io.points import (
    PositionTable,
    is_gcp_list,
    named_as,
    read_gcp_list,
    read_ground_points,
    read_image_points,
    read_observed_positions,
)
from photoplan.io.project.model import Image, ImageEntry, Project, image_size, interior_of
from photoplan.orientation.bundle.adjust import BlockFrame, adjust_block, angle_derivatives, make_bend
from photoplan.orientation.bundle.model import Adjusted, AdjustSettings, Block, BlockCamera, BlockImage, BlockProjection
from photoplan.orientation.start import StartImage, start_block
from photoplan.products.adjust.sensors import (
    Calibrated,
    FoundCorrection,
    Free,
    Geometry,
    block_camera,
    block_frame,
    block_projections,
    calibrated,
    found_corrections,
    nadir_heights,
    on_map,
    place_of,
)
from photoplan.products.init import some
from photoplan.project.cameras import size_of, stated_pose

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
    """Images with poses that are wanted."""
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
    """Remarks on how the files were read."""
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
    """Read the ground points of all files, and the measurements that come with a gcp_list.txt."""
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
    """Return the measurements in their images; a few outside (half a pixel beyond the border) are set aside by name.

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
    """Return the orientations that the project states as observations that place the block."""
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
    form = TableFormat.of(orientation.angle_unit, orientation.rotation)
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


#: Farther from its image, no control point is believed, metres.
_SIGHT = 50e3


def known_poses(inputs: AdjustInputs) -> dict[str, Pose]:
    """Return the map poses that the project states, or observed positions together with attitudes."""
    found: dict[str, Pose] = {}
    table = inputs.table
    row = {} if table is None or table.R_ground_camera is None else {n: k for k, n in enumerate(table.images)}
    for image in inputs.images:
        if image.center is not None and image.angles is not None:
            found[image.name] = stated_pose(inputs.project, image)
        elif image.name in row and table is not None and table.R_ground_camera is not None:
            k = row[image.name]
            found[image.name] = Pose(table.XYZ[k], table.R_ground_camera[k])
    return found


def started(
    inputs: AdjustInputs, *, known: bool = True, earlier: MapResult | None = None
) -> tuple[AdjustInputs, dict[str, Pose]]:
    """Return a map pose for every image; images that cannot be oriented are taken out, with a note that names them.

    Without `known`, orientations that are stated are not used; with `earlier`, its poses and cameras are used instead.
    """
    poses = earlier.pose_of if earlier is not None else known_poses(inputs) if known else {}
    _refuse_far(inputs, poses)
    if len(poses) == len(inputs.images):
        return inputs, poses
    found, reasons = _found(inputs, poses, {} if earlier is None else earlier.block_cameras)
    images = tuple(image for image in inputs.images if image.name in found)
    if not images and not inputs.projected:
        why = "; ".join(f"{name}: {reason}" for name, reason in list(reasons.items())[:3])
        raise GeometryError(
            f"no image can be oriented ({why}); give more control or tie points, observed positions, or center and "
            "angles to start from"
        )
    notes = list(inputs.notes)
    without = [image.name for image in inputs.images if image.name not in poses]
    oriented = [name for name in without if name in found]
    if oriented:
        notes.append(f"{len(oriented)} images were oriented from control and tie points to begin with")
    lost = tuple((name, reasons.get(name, "no reason is known")) for name in without if name not in found)
    names = [image.name for image in (*images, *inputs.projected)]
    points = inputs.points.of_images(names)
    return replace(inputs, images=images, points=points, notes=tuple(notes), lost=lost), found


def _refuse_far(inputs: AdjustInputs, known: Mapping[str, Pose]) -> None:
    """Refuse control beyond the sight of an image that measures it: of another place, CRS or unit."""
    ground, points = inputs.ground, inputs.points
    row = {name: k for k, name in enumerate(ground.names)}
    for image, point in zip(points.image, points.point):
        k, name = row.get(points.points[point], -1), points.images[image]
        if k < 0 or ground.check[k] or name not in known:
            continue
        away = float(np.hypot(*(ground.XYZ[k, :2] - known[name].center[:2])))
        if away > _SIGHT:
            raise InputError(
                f"control point {ground.names[k]!r} lies {away / 1000:.0f} km from image {name!r}, in which it is "
                f"measured; are X and Y exchanged, or is it in another CRS or unit than {inputs.project.crs}?"
            )


def _found(
    inputs: AdjustInputs, known: Mapping[str, Pose], calibrated: Mapping[str, BlockCamera]
) -> tuple[dict[str, Pose], dict[str, str]]:
    project, ground = inputs.project, inputs.ground
    places = [ground.XYZ, *(pose.center[None] for pose in known.values())]
    if inputs.positions is not None:
        places.append(inputs.positions.XYZ)
    every = np.concatenate(places)
    if not np.isfinite(every[:, :2]).all(axis=1).any():
        raise GeometryError(
            "nothing says where the block is: give control points, observed positions, or center and angles of images"
        )
    frame = block_frame(project, every)
    cameras = dict(calibrated)
    images = []
    for image in inputs.images:
        camera = project.cameras[image.camera]
        interior = interior_of(camera, image)
        if image.camera not in cameras:
            cameras[image.camera] = block_camera(image.camera, camera, interior)
        pose = frame.pose(known[image.name]) if image.name in known else None
        images.append(StartImage(image.name, image.camera, interior.plane_to_pixel, pose))
    full = ground.where(np.isfinite(ground.XYZ).all(axis=1))
    positions = None if inputs.positions is None else frame.positions(inputs.positions)
    sigma = float(np.median(inputs.points.sigma))
    points = inputs.points.of_images([image.name for image in images])
    result = start_block(cameras, images, points, frame.ground(full, full.XYZ), positions, sigma)
    poses = {name: frame.map_pose(pose) for name, pose in result.poses.items()}
    return {**poses, **known}, dict(result.left_out)


_Floats = NDArray[np.float64]
Adjuster = Callable[[Block, AdjustSettings], Adjusted]

#: How far a control point with an unknown coordinate may be from where it was thought, before its other coordinates
#: are computed again for the new place: times the slope between the block's horizons, metres.
_PLACE = 1e-3
_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class Prepared:
    """A block with what leads back from it."""

    inputs: AdjustInputs
    frame: BlockFrame
    block: Block
    near: _Floats
    """About where each ground point lies in the map, (g, 3)."""


@dataclass(frozen=True, eq=False)
class MapResult:
    """An adjustment in map coordinates; standard deviations hold sigma0."""

    prepared: Prepared
    adjusted: Adjusted
    poses: tuple[Pose, ...]
    """Map poses, angles about the map's axes at each station, in the order of `adjusted.images`."""
    angles: _Floats
    """(n, 3), in the unit and order of the project."""
    covariances: tuple[_Floats, ...]
    """Covariances of each image, (6 + k, 6 + k): projection centre (metres), angles in the unit and order of the
    project, then the parameters of its camera that were unknowns, in the project's units."""
    XYZ: _Floats
    """All adjusted points, (m, 3)."""
    covariance: _Floats
    """(m, 3, 3), m²."""
    ground_residuals: _Floats
    """Adjusted minus given, (g, 3), metres; NaN: not known or not adjusted."""
    position_residuals: _Floats
    """Computed minus observed, (p, 3), metres."""
    cameras: tuple[Calibrated, ...]
    """Cameras that had unknowns."""
    corrections: tuple[tuple[str, Geometry, FoundCorrection], ...]
    """Corrections of the images without poses: name, kind, and what was found."""

    @property
    def pose_of(self) -> dict[str, Pose]:
        """Map poses by the names of images."""
        return dict(zip(self.adjusted.images, self.poses))

    @property
    def block_cameras(self) -> dict[str, BlockCamera]:
        """Cameras of the block as they were calibrated."""
        known = self.prepared.block.cameras
        return {
            c.name: replace(known[c.name], c=c.c, principal_point=c.principal_point, lens=c.lens)
            for c in self.adjusted.cameras
        }

    @property
    def sigma_center(self) -> _Floats:
        """(n, 3), metres."""
        return np.array([_roots(c)[:3] for c in self.covariances]).reshape(-1, 3)

    @property
    def sigma_angles(self) -> _Floats:
        """(n, 3), in the project's unit."""
        return np.array([_roots(c)[3:6] for c in self.covariances]).reshape(-1, 3)


def prepare(inputs: AdjustInputs, starts: Mapping[str, Pose], free: Free) -> Prepared:
    """Return the block of a project in its Cartesian system."""
    project = inputs.project
    centers = np.array([starts[image.name].center for image in inputs.images]).reshape(-1, 3)
    # About where images without poses look, for a system of the block's own.
    strict = project.orientation.earth_curvature == "strict"
    about = np.array([place_of(project, image) for image in inputs.projected if strict]).reshape(-1, 3)
    frame = block_frame(project, np.concatenate([centers, about, inputs.ground.XYZ]))
    cameras: dict[str, BlockCamera] = {}
    images = []
    for image in inputs.images:
        camera = project.cameras[image.camera]
        interior = interior_of(camera, image)
        if image.camera not in cameras:
            cameras[image.camera] = block_camera(image.camera, camera, interior, free.get(image.camera))
        pose = frame.pose(starts[image.name])
        images.append(BlockImage(image.name, image.camera, interior.plane_to_pixel, pose))
    unused = [name for name in free if name not in cameras]
    if unused:
        raise InputError(f"camera {unused[0]!r} is to be calibrated, but none of the images is of it")
    known = inputs.ground.XYZ[np.isfinite(inputs.ground.XYZ[:, 2]), 2]
    projections = block_projections(project, inputs.projected, frame, float(known.mean()) if len(known) else None)
    inputs = _sighted(inputs, projections)
    near = _places(inputs, starts, images, cameras)
    _places_by_projections(inputs, projections, frame, near)
    adjustment = project.adjustment
    stations = {image.name: starts[image.name].center for image in inputs.images}
    positions, attitudes = inputs.positions, inputs.attitudes
    nadir = nadir_heights(project, centers[:, :2], _mean_height(inputs.ground))
    curved = project.orientation.earth_curvature == "correction"
    block = Block(
        cameras=cameras,
        images=tuple(images),
        observations=inputs.points,
        ground=frame.ground(inputs.ground, near),
        positions=None if positions is None else frame.positions(positions),
        attitudes=None
        if attitudes is None
        else frame.attitudes(attitudes, np.array([stations[name] for name in attitudes.images])),
        lever_arm=adjustment.lever_arm,
        lever_arm_sigma=adjustment.lever_arm_sigma,
        drift=adjustment.drift,
        boresight=adjustment.boresight,
        bend=make_bend(frame, images, cameras, nadir, curved=curved, refracted=project.orientation.refraction),
        projections=projections,
        on_map=on_map(frame),
        datum=adjustment.datum == "orientations",
    )
    return Prepared(inputs, frame, block, near)


def _sighted(inputs: AdjustInputs, projections: Sequence[BlockProjection]) -> AdjustInputs:
    """Return the inputs without measurements whose rays are unknown; the first of them is named."""
    points, lost = inputs.points, np.zeros(len(inputs.points), bool)
    for p in projections:
        mine = np.flatnonzero(points.image == (points.images.index(p.name) if p.name in points.images else -1))
        lost[mine] = ~np.isfinite(p.sight(points.xy[mine])[1]).all(axis=1)
    if not lost.any():
        return inputs
    k = int(np.flatnonzero(lost)[0])
    x, y = points.xy[k]
    note = (
        f"{points.label(k)}: column {x:g}, row {y:g} has no ray: the line was taken outside of what is known of the "
        f"flight, or polynomials do not hold there; {lost.sum()} such measurements take no part"
    )
    if lost.all():
        raise InputError(note)
    return replace(inputs, points=points.where(~lost), notes=(*inputs.notes, note))


def _mean_height(ground: GroundPoints) -> float:
    known = ground.XYZ[np.isfinite(ground.XYZ[:, 2]), 2]
    return float(known.mean()) if len(known) else 0.0


def _places(
    inputs: AdjustInputs, starts: Mapping[str, Pose], images: Sequence[BlockImage], cameras: Mapping[str, BlockCamera]
) -> _Floats:
    """About where each ground point lies: unknown heights are the mean of the known ones, unknown places are where the
    ray of the first measurement reaches that height."""
    ground, points = inputs.ground, inputs.points
    near = np.array(ground.XYZ)
    near[np.isnan(near[:, 2]), 2] = _mean_height(ground)
    of = {image.name: image for image in images}
    number = {name: k for k, name in enumerate(points.points)}
    middle = np.mean([pose.center[:2] for pose in starts.values()] or [np.full(2, np.nan)], axis=0)
    for k in np.flatnonzero(np.isnan(near[:, 0])):
        near[k, :2] = middle
        rows = np.flatnonzero(points.point == number.get(ground.names[k], -1))
        rows = rows[[points.images[k] in of for k in points.image[rows]]]
        if not len(rows):
            continue
        image = of[points.images[points.image[rows[0]]]]
        camera, pose = cameras[image.camera], starts[image.name]
        plane = image.plane_to_pixel.inverse(points.xy[rows[0]])
        t = camera.lens.undistort((plane - np.array(camera.principal_point)) / camera.c)
        d = pose.R_ground_camera @ np.array([t[0], t[1], -1.0])
        if d[2] < 0:
            near[k, :2] = pose.center[:2] + d[:2] / d[2] * (near[k, 2] - pose.center[2])
    return near


def _places_by_projections(
    inputs: AdjustInputs, projections: Sequence[BlockProjection], frame: BlockFrame, near: _Floats
) -> None:
    """Set the places, in `near` (g, 3), of ground points with only a height that images without poses alone measure."""
    points, number = inputs.points, {name: k for k, name in enumerate(inputs.points.points)}
    for k in np.flatnonzero(~np.isfinite(inputs.ground.XYZ[:, 0])):
        for p in projections:
            image = points.images.index(p.name) if p.name in points.images else -1
            mine = (points.image == image) & (points.point == number.get(inputs.ground.names[k], -1))
            if not mine.any():
                continue
            origin, direction = (v[0] for v in p.sight(points.xy[mine]))
            high, low = (
                frame.map_points(origin + 0.9 * p.away * direction),
                frame.map_points(origin + p.away * direction),
            )
            near[k, :2] = low[:2] + (high - low)[:2] * ((near[k, 2] - low[2]) / (high[2] - low[2]))
            break


def adjust_prepared(
    prepared: Prepared, settings: AdjustSettings, adjuster: Adjuster = adjust_block
) -> tuple[Prepared, Adjusted]:
    """Adjust; do so again if a control point with an unknown coordinate lies elsewhere than expected."""
    adjusted = adjuster(prepared.block, settings)
    ground = prepared.inputs.ground
    partial = ~np.isfinite(ground.XYZ).all(axis=1)
    if prepared.frame.local is None or not partial.any():
        return prepared, adjusted
    row = {name: k for k, name in enumerate(adjusted.points)}
    for _ in range(_ROUNDS):
        near = prepared.near.copy()
        for k in np.flatnonzero(partial):
            if ground.names[k] in row:
                near[k] = prepared.frame.map_points(adjusted.XYZ[row[ground.names[k]]])
        moved = np.linalg.norm(near - prepared.near, axis=1)
        J = prepared.frame.jacobian(near)
        slope = np.maximum(np.abs(J[:, 2, :2]).max(axis=1), np.abs(J[:, :2, 2]).max(axis=1))
        if not (moved * slope > _PLACE).any():
            break
        poses = dict(zip(adjusted.images, adjusted.poses))
        images = tuple(replace(image, pose=poses.get(image.name, image.pose)) for image in prepared.block.images)
        block = replace(prepared.block, images=images, ground=prepared.frame.ground(ground, near))
        prepared = replace(prepared, block=block, near=near)
        adjusted = adjuster(block, settings)
        row = {name: k for k, name in enumerate(adjusted.points)}
    return prepared, adjusted


def map_result(prepared: Prepared, adjusted: Adjusted) -> MapResult:
    """Return the adjusted block in map coordinates."""
    frame, project = prepared.frame, prepared.inputs.project
    poses = tuple(frame.map_pose(pose) for pose in adjusted.poses)
    centers = np.array([pose.center for pose in poses]).reshape(-1, 3)
    unit, order = project.orientation.angle_unit, project.orientation.rotation
    angles = np.array([angles_from_rotation(pose.R_ground_camera, order) for pose in poses]).reshape(-1, 3)
    T = np.zeros((len(poses), 6, 6))
    T[:, :3, :3] = np.linalg.inv(frame.jacobian(centers))
    for k, pose in enumerate(poses):
        T[k, 3:, 3:] = angle_in_unit(angle_derivatives(pose.R_ground_camera, order), unit)
    XYZ = frame.map_points(adjusted.XYZ)
    cameras = _cameras(project, prepared.block, adjusted)
    return MapResult(
        prepared=prepared,
        adjusted=adjusted,
        poses=poses,
        angles=angle_in_unit(angles, unit),
        covariances=tuple(_joint(prepared, adjusted, cameras, k, T[k]) for k in range(len(poses))),
        XYZ=XYZ,
        covariance=frame.map_covariance(adjusted.point_covariance, XYZ),
        ground_residuals=_ground_residuals(prepared, adjusted, XYZ),
        position_residuals=_position_residuals(prepared, adjusted),
        cameras=cameras,
        corrections=tuple(found_corrections(project, prepared.block, adjusted)),
    )


def _joint(prepared: Prepared, adjusted: Adjusted, cameras: Sequence[Calibrated], k: int, T: _Floats) -> _Floats:
    """Return the covariance of an image and its camera; T takes position and small rotations to the project's."""
    name = prepared.inputs.project.image(adjusted.images[k]).camera
    pose = T @ adjusted.pose_covariance[k] @ T.T
    found = next((c for c in cameras if c.name == name), None)
    if found is None:
        return pose
    both = T @ adjusted.pose_camera_covariance[k] @ found.of_block.T
    return np.block([[pose, both], [both.T, found.covariance]])


def _roots(covariance: _Floats) -> _Floats:
    return np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))


def _ground_residuals(prepared: Prepared, adjusted: Adjusted, XYZ: _Floats) -> _Floats:
    ground = prepared.inputs.ground
    row = {name: k for k, name in enumerate(adjusted.points)}
    out = np.full((len(ground), 3), np.nan)
    for k, name in enumerate(ground.names):
        if name in row:
            out[k] = XYZ[row[name]] - ground.XYZ[k]
    return out


def _position_residuals(prepared: Prepared, adjusted: Adjusted) -> _Floats:
    positions = prepared.inputs.positions
    if positions is None:
        return np.asarray(adjusted.position_residuals)
    return prepared.frame.map_vectors(adjusted.position_residuals, positions.XYZ)


def _cameras(project: Project, block: Block, adjusted: Adjusted) -> tuple[Calibrated, ...]:
    return tuple(
        calibrated(project.cameras[found.name], block.cameras[found.name], found)
        for found in adjusted.cameras
        if found.free
    )


def stated_accuracy(covariance: _Floats) -> dict[str, list[float] | None]:
    """Return entries of an image in the project for its covariance (6 + k, 6 + k); None where it is unknown.

    Position and angles may be correlated to one part in 100 000 and less; what then is left of their effects on the
    ground needs the digits.
    """
    sigma = np.sqrt(np.diag(covariance))
    if not (np.isfinite(sigma) & (sigma > 0)).all():
        known = np.isfinite(sigma).all()
        center, angles = (_figures(part) if known else None for part in (sigma[:3], sigma[3:6]))
        return {"sigma_center": center, "sigma_angles": angles, "correlation": None}
    correlation = (covariance / np.outer(sigma, sigma))[np.tril_indices(len(sigma), -1)]
    return {
        "sigma_center": _figures(sigma[:3]),
        "sigma_angles": _figures(sigma[3:6]),
        "correlation": [round(float(v), 8) + 0.0 for v in np.clip(correlation, -1.0, 1.0)],
    }


def _figures(values: _Floats) -> list[float]:
    return [float(f"{v:.6g}") for v in values]


def decimals_of(sigma: _Floats) -> int:
    """Return decimals of a position with these standard deviations, metres: 5, and more below 0.1 mm."""
    least = float(np.nanmin(sigma)) if np.isfinite(sigma).any() else 1.0
    return int(min(max(5, 2 - math.floor(math.log10(least))), 15)) if least > 0 else 15
