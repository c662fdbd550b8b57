"""The one place where the kind of camera is chosen."""

from __future__ import annotations

from photoplan.cameras.base import CentralCamera, Projection
from photoplan.cameras.corrected import corrected_camera
from photoplan.cameras.curvature import Refraction, Warp, WarpedCamera, curved_camera
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.interior import Interior
from photoplan.cameras.lenses import Lens
from photoplan.errors import UsageError
from photoplan.geometry.local import MEAN_RADIUS, LocalFrame, earth_radius
from photoplan.geometry.pose import Pose

#: How earth curvature may be regarded.
EARTH_CURVATURE = ("none", "correction", "strict")


def oriented_camera(
    interior: Interior,
    lens: Lens,
    pose: Pose,
    *,
    crs: str | None = None,
    earth_curvature: str = "none",
    refraction: bool = False,
    mean_ground: float = 0.0,
) -> CentralCamera:
    """A camera in map coordinates from its interior and exterior orientation.

    Parameters
    ----------
    interior, lens
        Interior orientation and lens.
    pose : Pose
        Projection centre in map coordinates, angles relative to the map's axes at the station.
    crs : str, optional
        The projected CRS; needed for ``"strict"``.
    earth_curvature : str
        ``"none"``: map coordinates are Cartesian (orientations that were adjusted in map coordinates with their own
        correction, small blocks); ``"correction"``: image-coordinate correction (Ecker 1991, eq. 4.16);
        ``"strict"``: through a local tangential system at the station.
    refraction : bool
        Whether the standard atmosphere bends the rays; heights are then those above sea level, roughly.
    mean_ground : float
        Height of the ground below the camera, metres; ``"correction"`` refers to it.

    Raises
    ------
    UsageError
        `earth_curvature` is unknown, or ``"strict"`` without a CRS.
    InputError
        The lens folds back inside the image, or the CRS cannot be used.
    """
    if earth_curvature not in EARTH_CURVATURE:
        raise UsageError(f"earth curvature {earth_curvature!r}; allowed are {', '.join(EARTH_CURVATURE)}")
    X, Y, Z = pose.center.tolist()
    before: tuple[Warp, ...] = (Refraction((X, Y, Z)),) if refraction else ()
    if earth_curvature == "strict":
        if crs is None:
            raise UsageError("strict earth curvature needs the CRS of the map coordinates")
        return curved_camera(interior, lens, pose, LocalFrame(crs, (X, Y), mean_ground), before)
    frame = FrameCamera(interior, lens, pose)
    if earth_curvature == "correction":
        radius = MEAN_RADIUS if crs is None else earth_radius(crs, (X, Y))
        return corrected_camera(frame, mean_ground, radius + mean_ground, before)
    return WarpedCamera(frame, before, pose.center) if before else frame


def taken_apart(camera: Projection) -> tuple[FrameCamera, tuple[Warp, ...], float] | None:
    """A camera as one with straight rays, and the warps and the curvature, 1/m, that lead from the map to its space.

    None: its rays do not meet in a point.
    """
    if isinstance(camera, WarpedCamera):
        return camera.frame, camera.warps, camera.curvature
    return (camera, (), 0.0) if isinstance(camera, FrameCamera) else None
