"""Earth curvature, strictly: the frame camera lives in a local tangential system."""

from __future__ import annotations

from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.interior import Interior
from photoplan.cameras.lenses.base import Lens
from photoplan.cameras.warped import Warp, WarpedCamera
from photoplan.geometry.local import LocalFrame, earth_radius
from photoplan.geometry.pose import Pose


def local_pose(pose: Pose, local: LocalFrame) -> Pose:
    """Pose in the local system of a pose whose angles refer to the map's axes at the station.

    The map's axes (grid east, grid north, height) are turned by the meridian convergence and by the tilt of the
    station's horizon against the origin's.
    """
    return Pose(local.to_local(pose.center), local.axes(pose.center) @ pose.R_ground_camera)


def curved_camera(
    interior: Interior, lens: Lens, pose: Pose, local: LocalFrame, before: tuple[Warp, ...] = ()
) -> WarpedCamera:
    """A camera in map coordinates that projects strictly in a local tangential system (Ecker 1991, §4.6.5.1)."""
    frame = FrameCamera(interior, lens, local_pose(pose, local))
    radius = earth_radius(local.crs, pose.center[:2])
    return WarpedCamera(frame, (*before, local), pose.center, 1.0 / radius)
