"""Images of line cameras in an adjustment: mount and trajectory."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.line_correctable import CorrectableLine, TrackPriors
from photoplan.cameras.line_correction import TURNED, LineCorrection, PoseErrors, map_axes, spline_weights
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
#: Moments at which it is told how exactly a trajectory without splines is known.
_JUDGED = 33
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
    covariance, sigma, free = None, None, image.free
    mount = np.concatenate([correction.boresight, correction.lever_arm, [correction.time_offset]]) * _UNITS
    parameters: tuple[FoundParameter, ...] = ()
    if len(free):
        Q = sets[image.keys[0]].covariance[0]
        roots = np.sqrt(np.diag(Q)) * _UNITS[free]
        parameters = tuple(
            FoundParameter(_CALLED[k], float(mount[k]), float(s), "°" if k < 3 else "m" if k < 6 else "s")
            for k, s in zip(free, roots)
        )
        if np.isfinite(Q).all():
            covariance = np.zeros((7, 7))
            covariance[np.ix_(free, free)] = Q
    over_time = None
    if image.spline is not None and correction.spline is not None:
        found = sets[image.keys[1]]
        sigma = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
        over_time = correction.spline.times, correction.spline.coefficients
    text = line_correction_text(correction, covariance, sigma, _pose_errors(image, correction, sets))
    return FoundCorrection(
        entries={},
        parameters=parameters,
        file=text,
        over_time=over_time,
        seconds=image.plain.track.time,
        angles=_angles(image, correction),
    )


def _pose_errors(
    image: CorrectableLine, correction: LineCorrection, sets: Mapping[str, AdjustedCorrections]
) -> PoseErrors | None:
    """How exactly the poses are known that come of all corrections together; None: nothing is unknown."""
    track, axes = correction.track(image.plain.track), map_axes(image.plain.track)
    spline, mount = image.spline, sets.get(image.keys[0])
    first, last = track.oriented
    count = _JUDGED if spline is None else 2 * len(spline.times)
    rows = np.linspace(first, last, max(2, count))
    rows = rows[track.is_oriented(rows)]
    J = [image.by_mount(track, rows, axes)[:, :, image.free]]
    if spline is None:
        if mount is None:
            return None
        Q = np.broadcast_to(mount.covariance[0], (len(rows), len(image.free), len(image.free)))
    else:
        at, w = spline_weights(track.time(rows), spline.first, spline.step, len(spline.coefficients))
        J.append((w[:, None, :, None] * np.eye(6)[:, None]).reshape(len(rows), 6, 24))
        Q = sets[image.keys[1]].joint[image.keys[0] if mount is not None else ""][at[:, 0]]
    A = np.concatenate(J, axis=2)
    return PoseErrors(track.time(rows), A @ Q @ np.swapaxes(A, 1, 2))


def _angles(image: CorrectableLine, correction: LineCorrection) -> tuple[_Floats, _Floats]:
    """Times and ω, φ, κ of the camera at lines spread over the image, against east, north and up in its middle."""
    track = correction.track(image.plain.track)
    first, last = track.oriented
    rows = np.unique(np.linspace(np.ceil(first), np.floor(last), _DRAWN).round())
    rows = rows[track.is_oriented(rows)]
    R = track(rows)[1] @ TURNED
    return track.time(rows), np.stack([angles_from_rotation(each) for each in map_axes(track).T @ R])


def _output(name: str) -> str:
    return f"{Path(name).stem}.correction.toml"


LINES = Geometry(group="lines", away=lambda image: image.away, correctable=_correctable, found=_found, output=_output)
