"""Images of a project without poses as the adjustment takes them.

A geometry is one file with a `Geometry` and a line in `GEOMETRIES`; the adjustment knows no more of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import Camera
from photoplan.errors import InputError
from photoplan.io.project.image import ImageEntry
from photoplan.io.project.line import LineImage
from photoplan.io.project.model import Project
from photoplan.io.project.rpc import RpcImage
from photoplan.orientation.bundle.block import Adjusted, Block, BlockProjection, OnMap
from photoplan.orientation.bundle.frame import BlockFrame
from photoplan.products.adjust.by_line import LINES
from photoplan.products.adjust.by_rpc import POLYNOMIALS
from photoplan.products.adjust.frame import orientation_system
from photoplan.products.adjust.geometry import FoundCorrection, Geometry
from photoplan.project.cameras import size_of
from photoplan.project.ground import Ground, ground_of
from photoplan.surfaces.level import LevelSurface

_Floats = NDArray[np.float64]

GEOMETRIES: dict[type[ImageEntry], Geometry] = {RpcImage: POLYNOMIALS, LineImage: LINES}
#: Length of a ray by which its direction is carried into the block, metres.
_REACH = 1000.0


def geometry_of(image: ImageEntry) -> Geometry:
    """The geometry of an image's entry; InputError where it is none that can be corrected."""
    if type(image) not in GEOMETRIES:
        raise InputError(
            f"image {image.name!r}: its orientation stands in {image.geometry_file}, and is not corrected by an "
            "adjustment; leave the image out"
        )
    return GEOMETRIES[type(image)]


def block_projections(
    project: Project, images: Sequence[ImageEntry], frame: BlockFrame, level: float | None
) -> tuple[BlockProjection, ...]:
    """The images without poses of a block."""
    return tuple(_projection(project, image, frame, level) for image in images)


def place_of(project: Project, image: ImageEntry) -> _Floats:
    """About where an image looks, (3,), metres."""
    geometry = geometry_of(image).correctable(project, image, _ground(project), size_of(project, image))
    return geometry.camera({each.key: each.values for each in geometry.corrections}).vantage.point


def _ground(project: Project) -> Ground:
    """Whatever cameras are made over: the height system of control."""
    system = orientation_system(project)
    return Ground(
        surface=LevelSurface(0.0),
        bounds=None,
        file=None,
        operations=(),
        height_systems=(system, system),
        working_system=system,
    )


def _projection(project: Project, image: ImageEntry, frame: BlockFrame, level: float | None) -> BlockProjection:
    kind = geometry_of(image)
    geometry = kind.correctable(project, image, _ground(project), size_of(project, image))
    camera = geometry.camera({each.key: each.values for each in geometry.corrections})
    height = _level(project, camera) if level is None else level
    vantage = camera.vantage
    height = float(np.clip(height, vantage.floor + 1.0, vantage.point[2] - 1.0))
    away = kind.away(geometry)
    middle = (np.array(camera.size) - 1.0) / 2.0
    J = camera.derivatives(camera.rays(middle[None], height)[0])[0]
    if not np.isfinite(J).all():
        raise InputError(
            f"image {image.name!r}: its geometry does not hold at a height of {height:.0f} m in its middle"
        )

    def sight(xy: _Floats) -> tuple[_Floats, _Floats]:
        at, tangent = camera.rays(xy, height)
        foot, up = frame.points(at), frame.points(at - _REACH * tangent)
        directions = np.asarray((foot - up) / np.linalg.norm(foot - up, axis=1, keepdims=True), np.float64)
        return foot - away * directions, directions

    metres = float(1.0 / np.sqrt(abs(np.linalg.det(J[:, :2]))))
    return BlockProjection(name=image.name, group=kind.group, geometry=geometry, sight=sight, metres=metres, away=away)


def _level(project: Project, camera: Camera) -> float:
    """Height of the ground about where a camera looks."""
    if project.terrain is not None:
        height = float(ground_of(project).bare.heights(camera.vantage.point[:2]))
        if np.isfinite(height):
            return height
    floor, top = camera.vantage.floor, float(camera.vantage.point[2])
    # Polynomials hold about the ground that they were made for; whoever flies knows more than that.
    return (floor + top) / 2 if top - floor < 2_000.0 else max(floor, 0.0)


def on_map(frame: BlockFrame) -> OnMap | None:
    """Where projections see points of a block."""
    if frame.local is None:
        return None

    def placed(points: _Floats) -> tuple[_Floats, _Floats]:
        at = frame.map_points(points)
        return at, np.asarray(np.linalg.inv(frame.jacobian(at)), np.float64)

    return placed


def found_corrections(
    project: Project, block: Block, adjusted: Adjusted
) -> Iterator[tuple[str, Geometry, FoundCorrection]]:
    """Each image without a pose whose corrections came out: it took part, or shares all of them with one that did."""
    sets = {each.key: each for each in adjusted.corrections}
    for projection in block.projections:
        keys = {each.key for each in projection.geometry.corrections}
        if projection.name in adjusted.projections or (keys and keys <= set(sets)):
            kind = geometry_of(project.any_image(projection.name))
            yield projection.name, kind, kind.found(projection.geometry, sets)
