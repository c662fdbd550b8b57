"""Corrections of a trajectory as a file: TOML, written by `photoplan adjust`, read by whatever makes the camera."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from photoplan.cameras.line_correction import LineCorrection, PoseErrors, TrackSpline
from photoplan.errors import InputError
from photoplan.io.camera.line import MAX_BYTES
from photoplan.io.camera.model import Entry, Number, Positive, Triple
from photoplan.io.files import read_entries

_Floats = NDArray[np.float64]
_Row = tuple[Number, Number, Number, Number, Number, Number]
_Triangle = Annotated[tuple[Number, ...], Field(min_length=21, max_length=21)]


class _SplineEntries(Entry):
    """``[spline]``: coefficients of uniform cubic splines."""

    first: Number
    step: Positive
    coefficients: Annotated[tuple[_Row, ...], Field(min_length=4, max_length=1_000_000)]
    sigma: tuple[_Row, ...] | None = None


class _AccuracyEntries(Entry):
    """``[accuracy]``: how exactly the corrected trajectory is known."""

    times: Annotated[tuple[Number, ...], Field(min_length=1, max_length=100_000)]
    covariance: Annotated[tuple[_Triangle, ...], Field(min_length=1, max_length=100_000)]


#: Standard deviations beyond which nothing is known of a trajectory, metres and radians.
_MOST = np.repeat([1e6, 1.0], 3)
#: What is larger is no error of a mount but another mount, which belongs into the strip.
_Turn = Annotated[Number, Field(ge=-10.0, le=10.0)]


class CorrectionFile(Entry):
    """A whole file."""

    format: Literal["photoplan line correction 1"]
    boresight_deg: tuple[_Turn, _Turn, _Turn] = (0.0, 0.0, 0.0)
    lever_arm_m: Triple = (0.0, 0.0, 0.0)
    time_offset_s: Number = 0.0
    covariance: Annotated[tuple[Number, ...], Field(max_length=28)] | None = None
    """Covariances of boresight, lever arm and time offset in these units: the lower triangle by rows, 28 numbers."""
    spline: _SplineEntries | None = None
    accuracy: _AccuracyEntries | None = None


def read_pose_errors(path: Path) -> PoseErrors | None:
    """Return the standard deviations of a corrected trajectory; None if the file does not state them."""
    found = read_entries(path, CorrectionFile, MAX_BYTES).accuracy
    if found is None:
        return None
    when, C = np.array(found.times), np.zeros((len(found.times), 6, 6))
    if len(found.covariance) != len(when) or not (np.diff(when) > 0).all():
        raise InputError(
            f"{path}: [accuracy]: {len(when)} times, {len(found.covariance)} rows; needed is a row for "
            "each, later and later"
        )
    row, column = np.tril_indices(6)
    C[:, row, column] = C[:, column, row] = np.array(found.covariance)
    C *= _units()[:, None] * _units()
    sigma = np.sqrt(np.maximum(np.diagonal(C, axis1=1, axis2=2), 0.0))
    bad = np.flatnonzero(
        (np.linalg.eigvalsh(C / np.maximum(sigma[:, :, None] * sigma[:, None], 1e-300))[:, 0] < -1e-3)
        | (sigma > _MOST).any(axis=1)
    )
    if len(bad):
        raise InputError(
            f"{path}: [accuracy]: row {bad[0] + 1} is no covariance of a trajectory; `photoplan adjust` writes it"
        )
    return PoseErrors(when, C)


def read_line_correction(path: Path) -> LineCorrection:
    """Corrections of a trajectory."""
    found = read_entries(path, CorrectionFile, MAX_BYTES)
    spline = None
    if found.spline is not None:
        values = np.array(found.spline.coefficients) * _units()
        try:
            spline = TrackSpline(found.spline.first, found.spline.step, values)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
    return LineCorrection(np.radians(found.boresight_deg), np.array(found.lever_arm_m), found.time_offset_s, spline)


def line_correction_text(
    found: LineCorrection, covariance: _Floats | None, sigma: _Floats | None, errors: PoseErrors | None = None
) -> str:
    """The file."""
    lines = [
        'format = "photoplan line correction 1"',
        "# About x (along the flight), y (to the left) and z (up) of the camera; degrees.",
        f"boresight_deg = {_list(np.degrees(found.boresight))}",
        "# Added to the way from the recorded point to the projection centre, along the same axes; metres.",
        f"lever_arm_m = {_list(found.lever_arm)}",
        "# Added to the times of the flight's record; seconds.",
        f"time_offset_s = {found.time_offset!r}",
    ]
    if covariance is not None:
        unit = np.repeat([180.0 / np.pi, 1.0, 1.0], [3, 3, 1])
        lines.append("# Lower triangle by rows, of these seven.")
        lines.append(f"covariance = {_list((covariance * np.outer(unit, unit))[np.tril_indices(7)], 9)}")
    if found.spline is not None:
        lines += [
            "",
            "# Cubic splines: coefficients from `first` (seconds from the image's own zero) every `step` seconds;",
            "# east, north, up of the flight's middle (metres), then small rotations about x, y, z (degrees).",
            "[spline]",
            f"first = {found.spline.first!r}",
            f"step = {found.spline.step!r}",
            *_table("coefficients", found.spline.coefficients / _units(), 12),
        ]
        if sigma is not None and np.isfinite(sigma).all():
            lines += _table("sigma", sigma / _units(), 4)
    if errors is not None and np.isfinite(errors.covariance).all():
        row, column = np.tril_indices(6)
        lines += [
            "",
            "# How exactly the corrected trajectory is known: at times (seconds from the image's own zero), the",
            "# covariance of east, north, up (metres) and small rotations about x, y, z (degrees); lower triangles.",
            "[accuracy]",
            f"times = {_list(errors.times)}",
            *_table("covariance", (errors.covariance / (_units()[:, None] * _units()))[:, row, column], 6),
        ]
    return "\n".join(lines) + "\n"


def _units() -> _Floats:
    return np.repeat([1.0, np.pi / 180.0], 3)


def _table(name: str, rows: _Floats, digits: int) -> list[str]:
    return [f"{name} = [", *(f"    {_list(row, digits)}," for row in rows), "]"]


def _list(values: _Floats, digits: int = 15) -> str:
    return "[" + ", ".join(repr(float(f"{v:.{digits}g}")) for v in values) + "]"
