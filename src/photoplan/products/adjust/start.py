"""Where the adjustment of a project begins: known orientations, and those found from control and tie points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from photoplan.errors import GeometryError, InputError
from photoplan.geometry.pose import Pose
from photoplan.io.project.cameras import interior_of
from photoplan.orientation.bundle.block import BlockCamera
from photoplan.orientation.start.block import StartImage, start_block
from photoplan.products.adjust.cameras import block_camera
from photoplan.products.adjust.frame import block_frame
from photoplan.products.adjust.inputs import AdjustInputs
from photoplan.project.posed import stated_pose

#: Farther from its image, no control point is believed, metres.
_SIGHT = 50e3


def known_poses(inputs: AdjustInputs) -> dict[str, Pose]:
    """Orientations (map poses) that the project states, or observed positions together with attitudes."""
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


@dataclass(frozen=True, eq=False)
class EarlierResult:
    """What an adjustment found, as the beginning of another."""

    poses: Mapping[str, Pose]
    """Map poses of the images that took part."""
    cameras: Mapping[str, BlockCamera]
    """As they were calibrated."""


def started(
    inputs: AdjustInputs, *, known: bool = True, earlier: EarlierResult | None = None
) -> tuple[AdjustInputs, dict[str, Pose]]:
    """A map pose for every image; images that cannot be oriented are taken out, with a note that names them.

    Without `known`, orientations that are stated are not used; with `earlier`, its poses and cameras are used instead.
    """
    poses = dict(earlier.poses) if earlier is not None else known_poses(inputs) if known else {}
    _refuse_far(inputs, poses)
    if len(poses) == len(inputs.images):
        return inputs, poses
    found, reasons = _found(inputs, poses, {} if earlier is None else earlier.cameras)
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
    """Control beyond the sight of an image that measures it: of another place, CRS or unit."""
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
