"""From a project's measurements to a block, and from the adjusted block to map coordinates."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.observed import GroundPoints
from photoplan.errors import InputError
from photoplan.geometry.pose import Pose
from photoplan.geometry.rotation import ANGLE_UNITS, angles_from_rotation
from photoplan.io.project.cameras import interior_of
from photoplan.io.project.model import Project
from photoplan.orientation.bundle.adjust import adjust_block
from photoplan.orientation.bundle.block import Adjusted, AdjustSettings, Block, BlockCamera, BlockImage, BlockProjection
from photoplan.orientation.bundle.frame import BlockFrame, angle_derivatives, make_bend
from photoplan.products.adjust.cameras import Calibrated, Free, block_camera, calibrated
from photoplan.products.adjust.frame import block_frame, nadir_heights
from photoplan.products.adjust.geometry import FoundCorrection, Geometry
from photoplan.products.adjust.inputs import AdjustInputs
from photoplan.products.adjust.projections import block_projections, found_corrections, on_map, place_of

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
    """Of each image: projection centre (metres), angles in the unit and order of the project, then the parameters of
    its camera that were unknowns, in the project's units, (6 + k, 6 + k)."""
    XYZ: _Floats
    """All adjusted points, (m, 3)."""
    covariance: _Floats
    """(m, 3, 3), m²."""
    ground_residuals: _Floats
    """Adjusted minus given, (g, 3), metres; NaN: not known or not adjusted."""
    position_residuals: _Floats
    """Computed minus observed, (p, 3), metres."""
    cameras: tuple[Calibrated, ...]
    """Those that had unknowns."""
    corrections: tuple[tuple[str, Geometry, FoundCorrection], ...]
    """Of the images without poses: name, kind, and what came out."""

    @property
    def sigma_center(self) -> _Floats:
        """(n, 3), metres."""
        return np.array([_roots(c)[:3] for c in self.covariances]).reshape(-1, 3)

    @property
    def sigma_angles(self) -> _Floats:
        """(n, 3), in the project's unit."""
        return np.array([_roots(c)[3:6] for c in self.covariances]).reshape(-1, 3)


def prepare(inputs: AdjustInputs, starts: Mapping[str, Pose], free: Free) -> Prepared:
    """The block of a project in its Cartesian system."""
    project = inputs.project
    centers = np.array([starts[image.name].center for image in inputs.images]).reshape(-1, 3)
    frame = block_frame(project, np.concatenate([centers, _about(inputs), inputs.ground.XYZ]))
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
    """The inputs without measurements whose rays no geometry knows; the first of them is named."""
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


def _about(inputs: AdjustInputs) -> _Floats:
    """About where images without poses look, (n, 3), for a system of its own; without one nothing asks."""
    strict = inputs.project.orientation.earth_curvature == "strict"
    return np.array([place_of(inputs.project, image) for image in inputs.projected if strict]).reshape(-1, 3)


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
    """Places, in `near` (g, 3), of ground points with a height only that images without poses alone have measured."""
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
    """Adjust, again where a control point with an unknown coordinate lies elsewhere than was thought."""
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
    """The adjusted block in map coordinates."""
    frame, project = prepared.frame, prepared.inputs.project
    poses = tuple(frame.map_pose(pose) for pose in adjusted.poses)
    centers = np.array([pose.center for pose in poses]).reshape(-1, 3)
    unit, order = project.orientation.angle_unit, project.orientation.rotation
    to_unit = ANGLE_UNITS[unit] / (2 * np.pi)
    angles = np.array([angles_from_rotation(pose.R_ground_camera, order) for pose in poses]).reshape(-1, 3) * to_unit
    T = np.zeros((len(poses), 6, 6))
    T[:, :3, :3] = np.linalg.inv(frame.jacobian(centers))
    for k, pose in enumerate(poses):
        T[k, 3:, 3:] = angle_derivatives(pose.R_ground_camera, order) * to_unit
    XYZ = frame.map_points(adjusted.XYZ)
    cameras = _cameras(project, prepared.block, adjusted)
    return MapResult(
        prepared=prepared,
        adjusted=adjusted,
        poses=poses,
        angles=angles,
        covariances=tuple(_joint(prepared, adjusted, cameras, k, T[k]) for k in range(len(poses))),
        XYZ=XYZ,
        covariance=frame.map_covariance(adjusted.point_covariance, XYZ),
        ground_residuals=_ground_residuals(prepared, adjusted, XYZ),
        position_residuals=_position_residuals(prepared, adjusted),
        cameras=cameras,
        corrections=tuple(found_corrections(project, prepared.block, adjusted)),
    )


def _joint(prepared: Prepared, adjusted: Adjusted, cameras: Sequence[Calibrated], k: int, T: _Floats) -> _Floats:
    """Covariance of an image and its camera; T takes the block's position and small rotations to the project's."""
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
    """Entries of an image in the project for its covariance (6 + k, 6 + k); None where nothing is known.

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
    """Decimals of a position with these standard deviations, metres: 5, and more where they are below 0.1 mm."""
    least = float(np.nanmin(sigma)) if np.isfinite(sigma).any() else 1.0
    return int(min(max(5, 2 - math.floor(math.log10(least))), 15)) if least > 0 else 15
