"""Calibration reports of the U.S. Geological Survey: the distances that a report prints, against its coordinates.

A camera from such a report is a camera in photoplan's TOML (``docs/templates/usgs-camera.toml`` is a template); beside
its ``[cameras.NAME]`` the file may have a table ``[report]`` with ``distances_mm``, the printed distances between
fiducial marks. Coordinates are typed from paper, and a wrong digit would bend every photograph of the camera unseen.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from photoplan.errors import InputError
from photoplan.io.camera.model import CameraEntry
from photoplan.io.files import finite

#: Coordinates and distances are printed to a micrometre each; rounding makes 2 µm, and the least-squares solution that
#: the coordinates come from one more.
TOLERANCE_UM = 3.0


def distance_differences(
    fiducials_mm: Mapping[str, tuple[float, float]], distances_mm: Mapping[str, float], where: str
) -> dict[str, float]:
    """Distance from the coordinates minus the printed one, micrometres, by pair."""
    found = {}
    for pair, printed in distances_mm.items():
        distance = finite(printed, f"{where}: distance {pair}")
        first, _, second = pair.partition("-")
        if first not in fiducials_mm or second not in fiducials_mm or first == second or distance <= 0:
            raise InputError(
                f"{where}: distance {pair!r} = {distance} mm; a key names two of the marks "
                f"({', '.join(fiducials_mm)}) with a hyphen between, and the distance is positive"
            )
        computed = math.dist(fiducials_mm[first], fiducials_mm[second])
        found[pair] = (computed - distance) * 1000.0
    return found


def check_report(contents: Mapping[str, Any], cameras: Mapping[str, CameraEntry], where: str) -> None:
    """Compare the ``[report]`` of a TOML file, if it has one, with the camera that it is about."""
    report = contents.get("report")
    if report is None:
        return
    where = f"{where}: report"
    if not isinstance(report, dict) or not isinstance(report.get("distances_mm"), dict):
        raise InputError(f"{where}: needed is distances_mm = {{ 1-2 = 311.128, … }} and, of several cameras, camera")
    name = report.get("camera", next(iter(cameras)) if len(cameras) == 1 else None)
    camera = cameras.get(name) if isinstance(name, str) else None
    system = camera.fiducial_system if camera is not None else None
    if system is None:
        raise InputError(f"{where}: camera = {name!r}; name one of the film cameras: {', '.join(map(repr, cameras))}")
    differences = distance_differences(system.places_mm, report["distances_mm"], where)
    wrong = {pair: d for pair, d in differences.items() if abs(d) > TOLERANCE_UM}
    if wrong:
        told = ", ".join(f"{pair} by {d:+.0f} µm" for pair, d in wrong.items())
        raise InputError(
            f"{where}: the fiducial marks of camera {name!r} do not have the printed distances: {told} (allowed are "
            f"±{TOLERANCE_UM:.0f}); compare coordinates and distances with the paper"
        )
