"""Standpoints along a path: stations of a table or of points, or a line at equal steps."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError
from photoplan.io.drawn_features import read_drawn_features
from photoplan.io.tables import Columns, read_table
from photoplan.products.view.camera import CameraRequest
from photoplan.products.view.ground import ViewGround
from photoplan.products.view.lines import in_crs_of_ground

_Floats = NDArray[np.float64]
#: Pictures of a sequence at most.
MOST_FRAMES = 100_000


def stations(path: Path, layer: str | None, step: float | None, ground: ViewGround) -> _Floats:
    """Places (n, 3) along a path; NaN height: none is stated."""
    if path.suffix.lower() in (".csv", ".txt"):
        roles = {"x": ("x", "e", "east", "easting"), "y": ("y", "n", "north", "northing"), "z": ("z", "h", "height")}
        table = read_table(path, Columns(roles=roles, needed=("x", "y"), row="station"))
        places, line = np.column_stack([table.numbers("x", "y"), table.numbers("z", empty=True).ravel()]), False
    else:
        drawn = read_drawn_features(path, layer)
        line = not bool(drawn.is_point.all())
        if line and len(drawn.is_point) != 1:
            raise InputError(f"{path}: {len(drawn.is_point)} points and lines; a path is one line, or points alone")
        places = in_crs_of_ground(drawn, {}, ground)
    if line != (step is not None):
        raise UsageError(f"{path}: " + ("a line needs a `step`, metres" if line else "stations have no `step`"))
    if step is not None:
        places = at_equal_steps(places, step)
    if not 2 <= len(places) <= MOST_FRAMES:
        raise UsageError(f"{path}: {len(places)} stations; 2 to {MOST_FRAMES} are allowed")
    return places


def at_equal_steps(line: _Floats, step: float) -> _Floats:
    """Places (m, 3) on a line (n, 3) at equal steps on the map, from its first vertex on."""
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T)))
    if not (math.isfinite(step) and step > 0) or along[-1] / step > MOST_FRAMES:
        raise UsageError(f"`step` {step} m along {along[-1]:.6g} m; at most {MOST_FRAMES} stations are allowed")
    at = np.arange(0.0, along[-1] * (1 + 1e-12), step)
    return np.column_stack([np.interp(at, along, line[:, k]) for k in range(3)])


def cameras(template: CameraRequest, places: _Floats, along: bool) -> list[CameraRequest]:
    """A camera at each of the places (n, 3); `along`: its azimuth is that from the station before to the one behind."""
    ahead = np.vstack([places[1:2] - places[:1], places[2:] - places[:-2], places[-1:] - places[-2:-1]])
    azimuth = np.degrees(np.arctan2(ahead[:, 0], ahead[:, 1]))
    for k in np.flatnonzero(np.hypot(ahead[:, 0], ahead[:, 1]) == 0).tolist():
        azimuth[k] = azimuth[k - 1] if k else 0.0
    out = []
    for (x, y, z), way in zip(places.tolist(), azimuth.tolist()):
        altitude = template.altitude if math.isnan(z) else z + template.height
        out.append(replace(template, position=(x, y), altitude=altitude, azimuth=way if along else template.azimuth))
    return out
