"""Which world the numbers of a ``reconstruction.json`` are in: told by the data, never assumed.

OpenSfM, and OpenDroneMap up to 2020, write east, north, up about ``reference_lla``. OpenDroneMap of today replaces that
file by one in the axes of its UTM zone, minus an offset in whole metres, and keeps the former as
``reconstruction.topocentric.json`` (its stage ``run_opensfm``: OpenSfM's ``export_geocoords``). It puts the reference
at the offset itself, with height 0 (``opendm/osfm.py``, write_reference_lla), so that both files state the same
reference, and their origins coincide; they differ by the convergence of meridians and the map's scale.
``gps_position`` of the shots stays east, north, up in both.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.agreement import agreement, misfit
from photoplan.geometry.crs import crs_label, crs_step, topocentric_poses, utm_codes
from photoplan.io.plain_files import read_json

_Floats = NDArray[np.float64]

#: How near to whole metres a reference lies that was made from an offset, metres; the numbers differ by rounding.
_WHOLE = 0.005
#: Rotation vectors that are one number written twice; and poses in two worlds that no orthophoto tells apart, metres.
_SAME, _ALIKE = 1e-9, 0.02
#: A sum of squares decides between two worlds if it is smaller by this many variances (400 to 1 in likelihood).
_CLEAR = 12.0
#: Poses farther than this from the positions of a receiver are in no known world, metres; and so many of its errors.
_FAR, _FARTHER = 50.0, 10.0


@dataclass(frozen=True, eq=False)
class World:
    """What positions and rotations refer to."""

    crs: str | None
    """UTM zone; None: east, north, up about the reference."""
    offset: _Floats
    """To be added to positions (3,), metres."""
    note: str


@dataclass(frozen=True, eq=False)
class Shots:
    """Poses as the file states them, n images."""

    names: tuple[str, ...]
    centers: _Floats
    """Shape (n, 3)."""
    vectors: _Floats
    """Rotation vectors, shape (n, 3)."""
    gps: _Floats
    """Positions of a receiver, shape (n, 3): east, north, up; NaN: not stated."""
    dop: float
    """Their usual error as the shots state it, metres."""


def world_of(path: Path, origin: tuple[float, float, float], shots: Shots) -> World:
    """The world of the poses, as positions of receivers, files beside it and the reference tell.

    Raises
    ------
    InputError
        The poses are neither east, north, up nor UTM minus the offset, or nothing tells which of the two.
    """
    local = World(None, np.zeros(3), f"{path.name}: poses are east, north, up about reference_lla")
    utm = _utm_offset(origin)
    if utm is None:
        _refuse_far(path, {"east, north, up about reference_lla": shots.gps}, shots)
        return local
    code, offset = utm
    label = f"{crs_label(code)} minus the offset {offset[0]:.0f}, {offset[1]:.0f}"
    map_gps = topocentric_poses(origin, code, np.nan_to_num(shots.gps))[0] - offset
    map_gps[np.isnan(shots.gps)] = np.nan
    votes = {**_votes_of_files(path, shots), **_vote_of_gps(shots, map_gps)}
    if len(set(votes.values())) > 1:
        told = "; ".join(f"{why}: {'UTM' if v else 'east, north, up'}" for why, v in votes.items())
        raise InputError(f"{path}: what tells the axes of the poses contradicts itself ({told}); {_INSTEAD}")
    _refuse_far(path, {"east, north, up about reference_lla": shots.gps, label: map_gps}, shots)
    if not votes:
        there = topocentric_poses(origin, code, shots.centers)[0] - offset
        apart = float(np.linalg.norm((there - shots.centers)[:, :2], axis=1).max())
        if apart > _ALIKE:
            raise InputError(
                f"{path}: its reference lies on whole metres of {crs_label(code)}, as OpenDroneMap writes it, and "
                "nothing tells whether the poses are east, north, up or in the axes of that zone (up to "
                f"{apart:.2f} m apart); {_INSTEAD}"
            )
        votes["both readings agree"] = False
    why = ", ".join(votes)
    if any(votes.values()):
        return World(code, offset, f"{path.name}: poses are in {label}, as OpenDroneMap writes today ({why})")
    return World(None, np.zeros(3), f"{local.note} ({why})")


_INSTEAD = "give odm_report/shots.geojson of the project, or opensfm/reconstruction.topocentric.json under its own name"


def _utm_offset(origin: tuple[float, float, float]) -> tuple[str, _Floats] | None:
    """UTM zone in which the reference lies on whole metres, and these (3,)."""
    lat, lon, _ = origin
    for code in utm_codes(lat, lon):
        try:
            place = crs_step("EPSG:4326", code)(np.array([lon, lat]))
        except InputError:
            continue
        if np.abs(place - np.round(place)).max() < _WHOLE:
            return code, np.array([*np.round(place), 0.0])
    return None


def _votes_of_files(path: Path, shots: Shots) -> dict[str, bool]:
    """Whether the poses are UTM (True), by the name of the file and by what lies beside it."""
    votes = {}
    topocentric = path.name.endswith(".topocentric.json")
    beside = path.with_name(f"{path.stem}.topocentric.json")
    if topocentric:
        votes["its name says topocentric"] = False
    elif beside.is_file():
        own = {name: shot for r in read_json(beside) for name, shot in r.get("shots", {}).items()}
        same = _equal(shots, {name: shot.get("rotation") for name, shot in own.items()})
        if same is not None:
            votes[f"{beside.name} has {'the same' if same else 'other'} rotations"] = not same
    for folder in (path.parent, path.parent / "odm_report", path.parent.parent / "odm_report"):
        report = folder / "shots.geojson"
        if report.is_file():
            stated = [f.get("properties", {}) for f in read_json(report).get("features", [])]
            same = _equal(shots, {str(p.get("filename")): p.get("rotation") for p in stated})
            if same is not None:
                votes[f"shots.geojson has {'the same' if same else 'other'} rotations"] = same
            break
    return votes


def _equal(shots: Shots, rotations: dict[str, object]) -> bool | None:
    """Whether shots have the rotation vectors of another file, digit for digit; None: no image is in both."""
    apart = [
        float(np.abs(vector - np.asarray(rotations[name], float)).max())
        for name, vector in zip(shots.names, shots.vectors)
        if isinstance(rotations.get(name), list)
    ]
    return max(apart) < _SAME if apart else None


def _vote_of_gps(shots: Shots, map_gps: _Floats) -> dict[str, bool]:
    """Whether positions of the receiver fit the poses better in UTM (True), where they tell."""
    fit = agreement(map_gps, shots.centers)
    if fit.count < 4:
        return {}
    # A receiver is not better than some centimetres, however well few points agree.
    variance = max(fit.scatter, 0.02) ** 2
    local, utm = (misfit(p, shots.centers) / variance for p in (shots.gps, map_gps))
    if abs(local - utm) < _CLEAR:
        return {}
    return {f"gps_position of {fit.count} shots": bool(utm < local)}


def _refuse_far(path: Path, worlds: dict[str, _Floats], shots: Shots) -> None:
    """Refuse poses that are far from the receiver's positions, or turned against them, in every world."""
    faults = []
    for name, gps in worlds.items():
        fit = agreement(gps, shots.centers)
        far = max(_FAR, _FARTHER * (shots.dop if np.isfinite(shots.dop) else 0.0))
        turned = abs(fit.turn) > max(10 * fit.sigma_turn, np.radians(5.0))
        if fit.count and fit.shift > far:
            faults.append(f"as {name} they lie {fit.shift:.0f} m from them")
        elif turned or abs(fit.scale - 1) > max(0.1, 10 * fit.sigma_turn):
            faults.append(
                f"as {name} they are turned by {np.degrees(fit.turn):.1f}° and scaled by {fit.scale:.3f} against them"
            )
        else:
            return
    raise InputError(
        f"{path}: poses do not fit gps_position of the shots: {'; '.join(faults)}. The file is in a world of its own: "
        f"{_INSTEAD}, or orient the images by control points"
    )
