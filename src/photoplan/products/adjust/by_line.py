"""Images of line cameras in an adjustment: mount and trajectory."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.line_correctable import CorrectableLine, TrackPriors
from photoplan.cameras.line_correction import TURNED, LineCorrection, map_axes
from photoplan.geometry.rotation import angles_from_rotation
from photoplan.io.camera.line.correction import line_correction_text, read_line_correction
from photoplan.io.project.line import LineImage
from photoplan.io.project.model import Project, StripAdjustment
from photoplan.orientation.bundle.block import AdjustedCorrections
from photoplan.products.adjust.geometry import FoundCorrection, FoundParameter, Geometry
from photoplan.project.by_line import line_camera
from photoplan.project.ground import Ground

_Floats = NDArray[np.float64]
#: Lines at which angles are drawn, at most.
_DRAWN = 3000
_UNITS = np.repeat([180.0 / np.pi, 1.0, 1.0], [3, 3, 1])
_CALLED = [*(f"{what} {axis}" for what in ("boresight", "lever arm") for axis in "xyz"), "time offset"]


def _correctable(project: Project, image: LineImage, ground: Ground, size: tuple[int, int]) -> CorrectableLine:
    plain: Any = line_camera(project, image.model_copy(update={"correction": None}), ground, size)
    start = LineCorrection.none()
    if image.correction is not None and project.resolve(image.correction).exists():
        start = read_line_correction(project.resolve(image.correction))
    return CorrectableLine(
        plain=plain,
        mount=image.mount or image.line,
        flight=image.line,
        priors=_priors(project.adjustment.strips),
        start=start,
    )


def _priors(stated: StripAdjustment) -> TrackPriors:
    smooth = stated.smooth_position, stated.smooth_attitude
    return TrackPriors(
        boresight=float(np.radians(stated.boresight)),
        lever_arm=stated.lever_arm,
        time_offset=stated.time_offset,
        knots=stated.knots,
        position=stated.position,
        attitude=float(np.radians(stated.attitude)),
        smooth_position=np.inf if smooth[0] is None else smooth[0],
        smooth_attitude=np.inf if smooth[1] is None else float(np.radians(smooth[1])),
    )


def _found(image: CorrectableLine, sets: Mapping[str, AdjustedCorrections]) -> FoundCorrection:
    correction = image.correction({key: each.values for key, each in sets.items()})
    covariance, sigma, joint, over_time, free = None, None, None, None, image.free
    Q = sets[image.keys[0]].covariance[0] if len(free) else None
    mount = np.concatenate([correction.boresight, correction.lever_arm, [correction.time_offset]]) * _UNITS
    parameters: tuple[FoundParameter, ...] = ()
    if Q is not None:
        roots = np.sqrt(np.diag(Q)) * _UNITS[free]
        parameters = tuple(
            FoundParameter(_CALLED[k], float(mount[k]), float(s), "°" if k < 3 else "m" if k < 6 else "s")
            for k, s in zip(free, roots)
        )
        if np.isfinite(Q).all():
            covariance = np.zeros((7, 7))
            covariance[np.ix_(free, free)] = Q
    if image.spline is not None and correction.spline is not None:
        found = sets[image.keys[1]]
        joint = found.joint["" if Q is None else image.keys[0]]
        sigma = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
        over_time = correction.spline.times, correction.spline.coefficients
    text = line_correction_text(correction, covariance, sigma, image.pose_errors(correction, Q, joint))
    return FoundCorrection(
        entries={},
        parameters=parameters,
        file=text,
        over_time=over_time,
        seconds=image.plain.track.time,
        angles=_angles(image, correction),
    )


def _angles(image: CorrectableLine, correction: LineCorrection) -> tuple[_Floats, _Floats]:
    """Times and ω, φ, κ of the camera at lines spread over the image, against east, north and up in its middle."""
    track = correction.track(image.plain.track)
    first, last = track.oriented
    rows = np.unique(np.linspace(np.ceil(first), np.floor(last), _DRAWN).round())
    rows = rows[track.is_oriented(rows)]
    R = track(rows)[1] @ TURNED
    return track.time(rows), np.stack([angles_from_rotation(each) for each in map_axes(track).T @ R])


def _output(stem: str) -> str:
    return f"{stem}.correction.toml"


LINES = Geometry(group="lines", away=lambda image: image.away, correctable=_correctable, found=_found, output=_output)
