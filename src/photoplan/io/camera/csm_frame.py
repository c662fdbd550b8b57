"""Support data of the Community Sensor Model (ISD, JSON): frame cameras of planetary missions.

The camera looks along z; x and y of its focal plane, millimetres, lead to lines and samples of the detector from the
outer corner of its first pixel, so that the middle of that pixel is at 0.5. Line and sample of the image are those of
the detector less the first that was read, over how many were summed. Distortions are those of `isd_lens`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from photoplan.cameras.body_frame import BodyFrameCamera
from photoplan.cameras.fiducials import Affine2D
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.interior import Interior
from photoplan.cameras.lenses import NoLens
from photoplan.cameras.pushbroom_rays import to_sphere
from photoplan.errors import InputError
from photoplan.geometry.local import BodyGround
from photoplan.geometry.pose import Pose, conjugate, cubic, rotations, times
from photoplan.io.camera.isd import FORM, FRAME_MODEL, Isd
from photoplan.io.camera.isd_lens import LENSES, lens_of, not_known
from photoplan.io.files import read_json

#: Support data of a frame are small.
_MAX_BYTES = 20_000_000
#: Suffixes of support data.
SUFFIXES = (".json", ".isd")
#: From the axes of an ISD's camera (x, y, forwards) to those of a camera here (x, y up, backwards).
_TURNED = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class StatedFrame:
    """A frame camera with its orientation, as a file states them."""

    file: Path
    frame: FrameCamera
    """In the axes of the body."""
    radii: tuple[float, float]
    """Equatorial and polar radius of the body, metres."""
    focal: float
    """Focal length, millimetres."""
    distortion: str | None
    """Its name; None: there is none."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        return self.frame.size

    def camera(self, crs: str, heights: str) -> BodyFrameCamera:
        """The camera over a ground; a CRS of another body is an InputError."""
        return BodyFrameCamera(self.frame, BodyGround(crs, heights, self.radii))

    def describe(self) -> dict[str, str]:
        """In words, by name."""
        x, y = self.size[0] / 2.0 - 0.5, self.size[1] / 2.0 - 0.5
        d = self.frame.rays(np.array([(x - 0.5, y), (x + 0.5, y)]))[1]
        away = float(np.linalg.norm(self.frame.center))
        return {
            "frame camera": FORM,
            "image": f"{self.size[0]} columns, {self.size[1]} lines",
            "focal length": f"{self.focal:.6g} mm, distortion {self.distortion or 'none'}",
            "directions": f"{1e6 * float(np.linalg.norm(d[1] - d[0])):.4g} µrad from column to column in the middle",
            "position": f"{away / 1000:.3f} km from the middle of the body",
            "body": f"radii {self.radii[0] / 1000:.3f} and {self.radii[1] / 1000:.3f} km",
        }


def read_frame(path: Path) -> StatedFrame:
    """The frame camera of an ISD."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: not a file of a frame camera with its orientation ({', '.join(SUFFIXES)})")
    return read(read_json(path, _MAX_BYTES), path)


def is_frame(path: Path) -> bool:
    """Whether a file states a frame camera; a file that cannot be read does not."""
    if path.suffix.lower() not in SUFFIXES:
        return False
    try:
        isd = read_json(path, _MAX_BYTES)
    except InputError:
        return False
    return isinstance(isd, dict) and isd.get("name_model") == FRAME_MODEL


def read(isd: Any, path: Path) -> StatedFrame:
    """The frame camera of the contents of a file; see `read_frame`."""
    name = isd.get("name_model") if isinstance(isd, dict) else None
    if name != FRAME_MODEL:
        advice = "; state the file as `line`" if isinstance(isd, dict) and "line_scan_rate" in isd else ""
        raise InputError(f"{path}: support data of {name or 'no name_model'}, not of {FRAME_MODEL}{advice}")
    source = Isd(isd, path)
    try:
        if source.has("jitter"):
            raise InputError("its lines were exposed one after the other (jitter); such cameras are not known")
        kind = source.distortion
        if kind is not None and kind not in LENSES:
            raise not_known(kind, list(LENSES))
        c, lens = lens_of(source, kind)
        focal = source.focal_plane().focal
        frame = FrameCamera(_interior(source, c), lens, _pose(source))
        _refuse_away(frame, max(source.radii))
        distortion = kind if lens != NoLens() else None
        return StatedFrame(file=path, frame=frame, radii=source.radii, focal=focal, distortion=distortion)
    except InputError as error:
        text = str(error)
        raise InputError(text if text.startswith(str(path)) else f"{path}: {text}") from None


def _interior(isd: Isd, c: float) -> Interior:
    """From tangents to pixels, with a camera constant in millimetres."""
    plane = isd.focal_plane()
    summing = np.array([isd.summing("line"), isd.summing("sample")])
    # Rows: line and sample. The middle of the first pixel is 0 here; y of tangents is up.
    A = plane.to_detector * (1.0, -1.0) / summing[:, None]
    line, sample = ((plane.axis - plane.first) / summing - 0.5).tolist()
    (a4, a5), (a1, a2) = A.tolist()
    return Interior(c, (0.0, 0.0), Affine2D(a1=a1, a2=a2, a3=sample, a4=a4, a5=a5, a6=line), (isd.samples, isd.lines))


def _pose(isd: Isd) -> Pose:
    """Projection centre and axes in those of the body, at the middle of the exposure."""
    t = np.array([isd.numbers("center_ephemeris_time", ())])
    for name in ("instrument_position", "instrument_pointing", "body_rotation"):
        at = isd.moments(name)
        # A single value holds always; a table only as far as it goes.
        if len(at) > 1 and not at[0] <= t[0] <= at[-1]:
            raise InputError(f"{name} is stated from {at[0]:.3f} to {at[-1]:.3f} s, the image is of {t[0]:.3f} s")
    at = isd.moments("instrument_position")
    positions, speeds = isd.positions()
    inertial = positions if len(at) == 1 else cubic(at, positions, speeds, t)
    body = isd.turns("body_rotation", t)
    center = rotations(body)[0] @ inertial[0]
    return Pose(center, rotations(times(body, conjugate(isd.turns("instrument_pointing", t))))[0] @ _TURNED)


def _refuse_away(frame: FrameCamera, radius: float) -> None:
    """Refuse a camera that would see its body if it looked the other way."""
    columns, rows = (np.linspace(-0.5, side - 0.5, 9) for side in frame.size)
    S, d = frame.rays(np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2))
    if not (to_sphere(S, d, radius) > 0).any() and (to_sphere(S, -d, radius) > 0).any():
        raise InputError(
            "the camera looks away from its body: positions and pointing are not in the same axes, or the focal plane "
            "is meant to lie behind the lens, which is not known here"
        )
