"""Cameras and ground of perspective views."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.curvature import EarthBend, Exaggeration, Warp
from photoplan.cameras.framed import oriented_camera, taken_apart
from photoplan.cameras.lenses import Interior, NoLens
from photoplan.errors import GeometryError, InputError, UsageError
from photoplan.geometry.bounds import odd_place
from photoplan.geometry.local import LocalFrame, earth_radius
from photoplan.geometry.pose import Pose, rotation_from_view, view_from_rotation
from photoplan.io.project.file import load_project
from photoplan.io.project.model import Project
from photoplan.project.cameras import central_without_pixels
from photoplan.project.ground import ground_of, open_terrain
from photoplan.project.scene import input_files
from photoplan.requests.view import USUAL_REFRACTION, CameraRequest
from photoplan.surfaces.base import Terrain
from photoplan.surfaces.objects import ObjectSurface, painted_surface
from photoplan.surfaces.seen import SeenSurface
from photoplan.surfaces.shifted import flooded
from photoplan.targets.view import Bundle, FrameBundle, Panorama, ViewTarget


@dataclass(frozen=True, eq=False)
class ViewGround:
    """Terrain, and the project that it belongs to if there is one."""

    terrain: Terrain
    """Terrain with the objects that are painted."""
    bounds: tuple[float, float, float, float] | None
    """Outer edges of the terrain; None: it has no end."""
    crs: str
    height_system: str | None
    """That of all heights; None: not stated."""
    project: Project | None
    files: tuple[Path, ...]
    """That decide the ground."""
    water: float | None = None
    """Height of water that covers what is lower, metres; the terrain has it in it."""

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of the objects, by their numbers from one."""
        return self.terrain.faces.names if isinstance(self.terrain, ObjectSurface) else ()

    @property
    def named(self) -> Project:
        """The project."""
        if self.project is None:
            raise UsageError("a terrain model has no images; give a project, or a standpoint `position`")
        return self.project


def open_view_ground(path: Path, crs: str | None = None, water: float | None = None) -> ViewGround:
    """The ground of a project file (``.toml``) or of a terrain model."""
    ground = _dry_ground(path, crs)
    if water is None:
        return ground
    odd = odd_place((math.nan, math.nan, water), camera=False)
    if odd or not math.isfinite(water):
        raise UsageError(f"`water`: {odd or f'{water}; a height in metres is needed'}")
    return replace(ground, terrain=flooded(ground.terrain, water, ground.bounds), water=water)


def _dry_ground(path: Path, crs: str | None) -> ViewGround:
    if path.suffix.lower() != ".toml":
        model = open_terrain(path, crs, "with `crs` EPSG:nnnn")
        return ViewGround(
            terrain=model.surface,
            bounds=model.bounds,
            crs=model.crs,
            height_system=model.height_system,
            project=None,
            files=(model.path,),
        )
    if not path.is_file():
        raise InputError(f"{path}: is no file; give a project.toml or a terrain model")
    project = load_project(path)
    ground = ground_of(project)
    images = {project.resolve(image.file) for image in project.images}
    files = [file for file in input_files(project) if file not in images and file.is_file()]
    return ViewGround(
        terrain=painted_surface(ground.surface),
        bounds=ground.bounds,
        crs=project.crs,
        height_system=ground.working_system,
        project=project,
        files=tuple(dict.fromkeys([path, *files])),
    )


#: Steepest middle of a panorama on a cylinder, radians: rows are tangents of it.
_STEEPEST = math.radians(89.0)


@dataclass(frozen=True, eq=False)
class ViewCamera:
    """A camera that has found its place."""

    request: CameraRequest
    """Camera in numbers instead of what depends on the ground: the same view, made again, is the same."""
    target: ViewTarget
    above_ground: float
    """Height of the point of view above the ground below it, metres; NaN: there is none."""
    bend: float
    """(1 − k) / 2R, 1/m."""
    earth_radius: float | None

    def json_fields(self) -> dict[str, Any]:
        """Return what a record states of it."""
        c = self.target.center
        return {
            "standpoint": [float(v) for v in c],
            "height_above_ground": self.above_ground,
            "camera": {k: v for k, v in self.request.json_fields().items() if v is not None},
            "earth_radius": self.earth_radius,
            "bend_per_metre": self.bend,
        }


def view_camera(request: CameraRequest, ground: ViewGround, force: bool = False) -> ViewCamera:
    """Put a camera on the ground."""
    made = _of_image(request, ground) if request.image is not None else _of_standpoint(request, ground)
    if made.above_ground < 0 and not force:
        x, y, z = made.target.center
        raise GeometryError(
            f"the point of view {x:.2f} {y:.2f} {z:.2f} lies {-made.above_ground:.2f} m below the ground; check its "
            "height and the height system (or an exaggeration that raises the ground), or say `force`"
        )
    return made


def _of_image(request: CameraRequest, ground: ViewGround) -> ViewCamera:
    assert request.image is not None
    project = ground.named
    camera = central_without_pixels(project, project.select([request.image])[0])
    if taken_apart(camera) is None:
        raise InputError(f"image {request.image!r}: its camera is no frame camera; views know no other yet")
    plain = ViewTarget.of_camera(camera)
    radius = None
    if request.curvature in ("bend", "strict"):
        if plain.warps:
            raise UsageError("the project states its own earth curvature or refraction; leave `curvature` to it")
        warps, bend, radius = _round(request.replace(curvature="bend"), ground, camera.center)
        plain = ViewTarget(plain.bundle, camera.center, warps, bend)
    return _stretched(request, ground, plain.moved(request.aside) if request.aside else plain, radius)


def _round(
    request: CameraRequest, ground: ViewGround, center: NDArray[np.float64]
) -> tuple[tuple[Warp, ...], float, float | None]:
    """The round earth as warps, by how much rays rise over it, and its radius."""
    kind = request.curvature or "bend"
    if kind == "none" and not request.refraction:
        return (), 0.0, None
    radius = request.earth_radius or earth_radius(ground.crs, center[:2])
    k = USUAL_REFRACTION if request.refraction is None else request.refraction
    at = (float(center[0]), float(center[1]))
    lift = -k / (2 * radius)
    if kind == "strict":
        # Refraction first, on the map; the round earth is the local system's.
        return (EarthBend(at, lift), LocalFrame(ground.crs, at)), (1 - k) / (2 * radius), radius
    bend = lift if kind == "none" else (1 - k) / (2 * radius)
    return (EarthBend(at, bend),), bend, radius


def _of_standpoint(request: CameraRequest, ground: ViewGround) -> ViewCamera:
    assert request.position is not None
    X, Y = request.position
    floor = float(ground.terrain.heights(np.array([X, Y])))
    Z = floor + request.height if request.altitude is None else request.altitude
    for what, place in (("standpoint", (X, Y, Z)), ("look-at point", request.look_at)):
        odd = place and odd_place((*place, math.nan)[:3], camera=True)
        if odd:
            raise InputError(f"{what}: {odd}")
    if request.altitude is None and not math.isfinite(floor):
        raise InputError(f"standpoint {X:.10g} {Y:.10g}: the terrain has no height there; give its `altitude`")
    center = np.array([X, Y, Z])
    look_at = None
    if request.look_at is not None:
        look_at = np.array(request.look_at, float)
        if len(look_at) == 2:
            look_at = np.append(look_at, ground.terrain.heights(look_at))
            if not math.isfinite(look_at[2]):
                raise InputError(f"look-at point {look_at[0]:.10g} {look_at[1]:.10g}: the terrain has no height there")
        if request.reference is None and request.exaggeration != 1.0:
            request = request.replace(reference=float(look_at[2]))
    warps, bend, radius = _round(request, ground, center)
    plain = ViewTarget(_bundle(request, center, warps, look_at), center, warps, bend)
    if request.exaggeration != 1.0:
        reference = _reference(plain, ground) if request.reference is None else request.reference
        request = request.replace(reference=reference)
        if request.altitude is None:
            # The eye keeps its height above the ground that is raised.
            stretch = Exaggeration(reference, request.exaggeration)
            lifted = stretch([X, Y, floor]) + np.array([0.0, 0.0, request.height])
            plain = ViewTarget(_bundle(request, lifted, warps, look_at), lifted, warps, bend)
    made = _stretched(request, ground, plain, radius)
    return replace(made, request=_resolved(made, plain.bundle))


def _bundle(
    request: CameraRequest, center: NDArray[np.float64], warps: tuple[Warp, ...], look_at: NDArray[np.float64] | None
) -> Bundle:
    """Rays of a standpoint, in the space that the warps lead to."""
    origin, axes = center, map_axes(warps, center)
    for warp in warps:
        origin = warp(origin)
    if look_at is not None:
        way = look_at
        for warp in warps:
            way = warp(way)
        way = (way - origin) @ axes
        if not np.linalg.norm(way) > 1e-6:
            raise UsageError("the look-at point is the standpoint itself")
        azimuth, pitch = math.atan2(way[0], way[1]), math.atan2(way[2], math.hypot(way[0], way[1]))
    else:
        azimuth, pitch = math.radians(request.azimuth or 0.0), math.radians(request.pitch)
    width, height = request.size
    if request.panorama:
        if request.roll:
            raise UsageError("a panorama has no `roll`")
        if request.panorama == "cylinder" and abs(pitch) > _STEEPEST:
            raise UsageError(
                f"a cylinder does not reach what lies {math.degrees(abs(pitch)):.4g}° above or below; look less "
                "steeply, or take the panorama `sphere`"
            )
        scale = width / math.radians(request.field_of_view or 360.0)
        rise = pitch if request.panorama == "sphere" else math.tan(pitch)
        north = axes @ (0.0, 1.0, 0.0)
        turned = azimuth + math.atan2(north[0], north[1])
        row = (height - 1) / 2 + rise * scale
        return Panorama(
            center=origin,
            size=request.size,
            azimuth=turned,
            scale=scale,
            horizon=row,
            spherical=request.panorama == "sphere",
        )
    focal = width / 2 / math.tan(math.radians(request.field_of_view or 60.0) / 2)
    interior = Interior.digital(request.size, (focal, focal * request.pixel_aspect))
    R = axes @ rotation_from_view(azimuth, pitch, math.radians(request.roll))
    return ViewTarget.of_camera(oriented_camera(interior, NoLens(), Pose(origin, R))).bundle


def map_axes(warps: Sequence[Warp], center: NDArray[np.float64]) -> NDArray[np.float64]:
    """East, north and up of the map at a standpoint in the space that warps lead to, as columns, shape (3, 3)."""
    return next((warp.axes(center) for warp in warps if isinstance(warp, LocalFrame)), np.eye(3))


def _stretched(request: CameraRequest, ground: ViewGround, target: ViewTarget, radius: float | None) -> ViewCamera:
    """The camera with its exaggeration, if there is one; `target` is the one without."""
    bend = target.bend
    if request.exaggeration != 1.0:
        reference = _reference(target, ground) if request.reference is None else request.reference
        stretch = Exaggeration(reference, request.exaggeration)
        request = request.replace(reference=reference)
        center, warps = stretch.inverse(target.center), (stretch, *target.warps)
        target = ViewTarget(target.bundle, center, warps, bend / request.exaggeration)
    above = request.exaggeration * float(target.center[2] - ground.terrain.heights(target.center[:2]))
    return ViewCamera(request=request, target=target, above_ground=above, bend=bend, earth_radius=radius)


def _reference(target: ViewTarget, ground: ViewGround) -> float:
    """Height where the middle of the picture meets the ground (Ecker 1991, §5.7.10)."""
    middle = (np.array([target.bundle.size], float) - 1) / 2
    Z = float(SeenSurface(ground.terrain, ground.bounds).at(target, middle).XYZ[0, 2])
    if not math.isfinite(Z):
        raise GeometryError("the middle of the picture meets no ground; give the `reference` height of `exaggeration`")
    return Z


def _resolved(made: ViewCamera, bundle: Bundle) -> CameraRequest:
    """The request of a standpoint in numbers that no ground decides."""
    request, target = made.request, made.target
    x, y = (float(v) for v in target.center[:2])
    altitude = target.center[2]
    if request.exaggeration != 1.0:
        assert request.reference is not None
        altitude = Exaggeration(request.reference, request.exaggeration)(target.center)[2]
    bare = [warp for warp in target.warps if not isinstance(warp, Exaggeration)]
    axes = map_axes(bare, target.center)
    azimuth, pitch = math.radians(request.azimuth or 0.0), math.radians(request.pitch)
    if request.look_at is not None and isinstance(bundle, Panorama):
        north = axes @ (0.0, 1.0, 0.0)
        azimuth = bundle.azimuth - math.atan2(north[0], north[1])
        rise = (bundle.horizon - (bundle.size[1] - 1) / 2) / bundle.scale
        pitch = rise if bundle.spherical else math.atan(rise)
    elif request.look_at is not None and isinstance(bundle, FrameBundle):
        azimuth, pitch, _ = view_from_rotation(axes.T @ bundle.camera.pose.R_ground_camera)
    kind = request.curvature or "bend"
    usual = None if kind == "none" else USUAL_REFRACTION
    return request.replace(
        position=(x, y),
        altitude=float(altitude),
        look_at=None,
        azimuth=math.degrees(azimuth) % 360,
        pitch=math.degrees(pitch),
        curvature=kind,
        refraction=usual if request.refraction is None else request.refraction,
        earth_radius=made.earth_radius,
    )
