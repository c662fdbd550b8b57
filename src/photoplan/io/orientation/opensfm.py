"""Orientations and cameras of OpenSfM (``reconstruction.json``) and OpenDroneMap (``shots.geojson``, ``cameras.json``).

The models of cameras are those of OpenSfM's documentation (opensfm.org/docs/geometry.html): image coordinates are
divided by the larger side of the image, origin in its middle, x right and y down; the middle is ((w − 1)/2, (h − 1)/2)
with the centre of the upper-left pixel at (0, 0). Camera axes are x right, y down, z forwards, so distortion has
OpenCV's meaning: ``perspective`` has one focal length and k1, k2; ``simple_radial``, ``radial`` and ``brown`` add
focal_x, focal_y, c_x, c_y, (k3, p1, p2); ``fisheye`` is OpenCV's with k1, k2, ``fisheye_opencv`` with k1–k4.

Poses, as its documentation defines them (opensfm.org/docs: geometry, dataset): ``rotation`` is an angle-axis vector
that, with ``translation``, takes world coordinates to camera coordinates, x_camera = R x_world + t, the camera's axes
being x right, y down, z forwards. World coordinates are a local tangential system (east, north, up) whose origin is
``reference_lla``, or with OpenDroneMap of today a UTM zone. So the projection centre is −Rᵀ t, and with our axes (y up,
z backwards) R_ground_camera = Rᵀ diag(1, −1, −1).

Which world the numbers are in is told by the data, never assumed. OpenSfM, and OpenDroneMap up to 2020, write east,
north, up about ``reference_lla``. OpenDroneMap of today replaces that file by one in the axes of its UTM zone, minus an
offset in whole metres, and keeps the former as ``reconstruction.topocentric.json`` (its stage ``run_opensfm``:
OpenSfM's ``export_geocoords``). It puts the reference at the offset itself, with height 0 (``opendm/osfm.py``,
write_reference_lla), so that both files state the same reference, and their origins coincide; they differ by the
convergence of meridians and the map's scale. ``gps_position`` of the shots stays east, north, up in both.

OpenDroneMap's ``shots.geojson`` (in its folder ``odm_report``): one feature per image. The geometry is the projection
centre in longitude, latitude and height. ``translation`` is the projection centre in the project's UTM zone, and
``rotation``, as in OpenSfM, a rotation vector that takes the axes of the map to those of the camera (x right, y down, z
forwards). ``focal`` is divided by the larger side of the image; the lens is not in this file but in ``cameras.json`` of
the project, which is read if it lies beside the file or in the folder above. The file does not name the UTM zone. It is
the one in which the two positions that it states of every image agree.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from photoplan.arrays import Floats
from photoplan.errors import InputError
from photoplan.geometry.bounds import is_no_fix
from photoplan.geometry.crs import agreement, canonical_crs, crs_label, crs_step, misfit, topocentric_poses, utm_codes
from photoplan.geometry.local import enu_of_geodetic, geodetic_of_enu, topocentric_of_map
from photoplan.geometry.pose import FLIP
from photoplan.io.camera.model import CameraEntry, InPixels, UnusableCamera, frame_in_pixels
from photoplan.io.camera.opencv import opencv_form, opencv_losses
from photoplan.io.files import elements, finite, format_hint, members, read_json
from photoplan.io.orientation.block import (
    Loss,
    OrientationBlock,
    OrientationFormat,
    OrientationTable,
    OrientedImage,
    TableFormat,
    common_losses,
    height_losses,
    posed,
    require_cameras,
    without_unusable,
)

_COEFFICIENTS = {
    "perspective": ("k1", "k2"),
    "simple_radial": ("k1",),
    "radial": ("k1", "k2"),
    "brown": ("k1", "k2", "p1", "p2", "k3"),
    "fisheye": ("k1", "k2"),
    "fisheye_opencv": ("k1", "k2", "k3", "k4"),
}


def read_cameras(path: Path) -> dict[str, CameraEntry]:
    """Cameras of a JSON file by name; sizes are those that the file states."""
    contents = read_json(path)
    if isinstance(contents, dict) and contents and all(_is_camera(c) for c in contents.values()):
        return cameras_of([{"cameras": contents}], path)
    return cameras_of(contents, path)


def cameras_of(
    reconstructions: Any, path: Path, faults: dict[str, UnusableCamera] | None = None
) -> dict[str, CameraEntry]:
    """Cameras of the parsed contents of a ``reconstruction.json``.

    Those of a projection that has no form here are entered into `faults`; None: they are errors.
    """
    if not isinstance(reconstructions, list) or not all(
        isinstance(r, dict) and isinstance(r.get("cameras"), dict) for r in reconstructions
    ):
        raise InputError(
            f"{path}: neither a reconstruction.json of OpenSfM nor a cameras.json of OpenDroneMap{format_hint(path)}"
        )
    cameras: dict[str, CameraEntry] = {}
    for reconstruction in reconstructions:
        for name, values in reconstruction["cameras"].items():
            try:
                camera = _camera(values, f"{path}: camera {name!r}")
            except UnusableCamera as error:
                if faults is None:
                    raise
                faults[name] = error
                continue
            if cameras.setdefault(name, camera) != camera:
                raise InputError(f"{path}: camera {name!r} differs between the reconstructions; keep one of them")
    return cameras


def _is_camera(values: Any) -> bool:
    return isinstance(values, dict) and "projection_type" in values


def _camera(values: Any, where: str) -> CameraEntry:
    if not _is_camera(values):
        raise InputError(f"{where}: projection_type is missing")
    kind = values["projection_type"]
    if not isinstance(kind, str) or kind not in _COEFFICIENTS:
        raise UnusableCamera(
            f"{where}: projection_type {kind!r} is not supported; must be one of {', '.join(_COEFFICIENTS)}"
        )
    size = finite([values.get("width"), values.get("height")], f"{where}: width and height", 2)
    w, h = int(size[0]), int(size[1])
    side = max(w, h)
    focal_x = finite(values.get("focal_x", values.get("focal")), f"{where}: focal")
    focal_y = finite(values.get("focal_y", focal_x * _value(values, "aspect_ratio", where, 1.0)), f"{where}: focal_y")
    for key in ("p1", "p2", "k3", "k4", "k5", "k6", "s0", "s1", "s2", "s3"):
        if key not in _COEFFICIENTS[kind] and _value(values, key, where) != 0:
            raise InputError(f"{where}: {key} = {values[key]} is not supported for projection_type {kind!r}")
    lens: dict[str, Any] = {k: _value(values, k, where) for k in _COEFFICIENTS[kind]}
    point = ((w - 1) / 2 + _value(values, "c_x", where) * side, (h - 1) / 2 + _value(values, "c_y", where) * side)
    lens = {"type": "opencv_fisheye" if kind.startswith("fisheye") else "opencv", **lens}
    return frame_in_pixels(InPixels((w, h), (focal_x * side, focal_y * side), point), lens, where)


def _value(values: dict[str, Any], key: str, where: str, default: float = 0.0) -> float:
    number: float = finite(values.get(key, default), f"{where}: {key}")
    return number


def resized(camera: CameraEntry, size: tuple[int, int], where: str) -> CameraEntry:
    """The camera for images of another resolution, as normalised coordinates define it."""
    if size == camera.size or camera.pixels is None:
        return camera
    given = camera.pixels
    factor = max(size) / max(given.size)
    expected = tuple(s * factor for s in given.size)
    if max(abs(a - b) for a, b in zip(expected, size)) > max(1.0, factor):
        raise InputError(
            f"{where}: image of {size[0]} × {size[1]} px, camera of {given.size[0]} × {given.size[1]} px; "
            "another aspect ratio means another camera or crop"
        )
    (fx, fy), middle = given.focal, [(s - 1) / 2 for s in given.size]
    point = tuple((s - 1) / 2 + (p - m) * factor for s, p, m in zip(size, given.point, middle))
    focal = fx * factor if fx == fy else (fx * factor, fy * factor)
    return camera.model_copy(update={"size": size, "focal_px": focal, "principal_point_px": point})


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
    """System that positions and rotations refer to."""

    crs: str | None
    """UTM zone; None: east, north, up about the reference."""
    offset: Floats
    """To be added to positions (3,), metres."""
    note: str


@dataclass(frozen=True, eq=False)
class Shots:
    """Poses as the file states them, n images."""

    names: tuple[str, ...]
    centers: Floats
    """Shape (n, 3)."""
    vectors: Floats
    """Rotation vectors, shape (n, 3)."""
    gps: Floats
    """Positions of a receiver, shape (n, 3): east, north, up; NaN: not stated."""
    dop: float
    """Their usual error as the shots state it, metres."""


def world_of(path: Path, origin: tuple[float, float, float], shots: Shots) -> World:
    """The world of the poses, as positions of receivers, files beside it and the reference tell."""
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


def _utm_offset(origin: tuple[float, float, float]) -> tuple[str, Floats] | None:
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
    """Return whether the poses are UTM (True), by the name of the file and by what lies beside it."""
    votes = {}
    topocentric = path.name.endswith(".topocentric.json")
    beside = path.with_name(f"{path.stem}.topocentric.json")
    if topocentric:
        votes["its name says topocentric"] = False
    elif beside.is_file():
        own = {name: members(shot, f"{beside}: {name!r}") for name, shot in _stated(_reconstructions(beside))}
        same = _equal(shots, {name: shot.get("rotation") for name, shot in own.items()}, beside)
        if same is not None:
            votes[f"{beside.name} has {'the same' if same else 'other'} rotations"] = not same
    for folder in (path.parent, path.parent / "odm_report", path.parent.parent / "odm_report"):
        report = folder / "shots.geojson"
        if report.is_file():
            features = elements(members(read_json(report), str(report)).get("features"), f"{report}: features")
            stated = [members(members(f, str(report)).get("properties"), f"{report}: properties") for f in features]
            same = _equal(shots, {str(p.get("filename")): p.get("rotation") for p in stated}, report)
            if same is not None:
                votes[f"shots.geojson has {'the same' if same else 'other'} rotations"] = same
            break
    return votes


def _equal(shots: Shots, rotations: dict[str, object], file: Path) -> bool | None:
    """Return whether shots have the rotation vectors of another file, digit for digit; None if no image is in both."""
    apart = [
        float(np.abs(np.subtract(vector, finite(rotations[name], f"{file}: rotation of {name!r}", 3))).max())
        for name, vector in zip(shots.names, shots.vectors)
        if isinstance(rotations.get(name), list)
    ]
    return max(apart) < _SAME if apart else None


def _vote_of_gps(shots: Shots, map_gps: Floats) -> dict[str, bool]:
    """Return whether positions of the receiver fit the poses better in UTM (True), if they decide."""
    fit = agreement(map_gps, shots.centers)
    if fit.count < 4:
        return {}
    # A receiver is not better than some centimetres, however well few points agree.
    variance = max(fit.scatter, 0.02) ** 2
    local, utm = (misfit(p, shots.centers) / variance for p in (shots.gps, map_gps))
    if abs(local - utm) < _CLEAR:
        return {}
    return {f"gps_position of {fit.count} shots": bool(utm < local)}


def _refuse_far(path: Path, worlds: dict[str, Floats], shots: Shots) -> None:
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


def _losses(block: OrientationBlock) -> Iterable[Loss]:
    """Return the properties of a block that the format cannot hold."""
    yield from opencv_losses(block, rational=False)
    yield from height_losses(block.table)


def _render(block: OrientationBlock, path: Path) -> dict[Path, str]:
    """Text of a ``reconstruction.json``.

    Raises
    ------
    InputError
        The block has no cameras or no place on the earth, or a camera has no form there.
    """
    require_cameras(block, path, "reconstruction.json")
    origin, centers, rotations = _tangential(block.table, path)
    shots: dict[str, dict[str, Any]] = {}
    for image, center, R in zip(block.table.images, centers, rotations):
        R_camera_world = FLIP @ R.T
        shots[image.name] = {
            "rotation": Rotation.from_matrix(R_camera_world).as_rotvec().tolist(),
            "translation": (-R_camera_world @ center).tolist(),
            "camera": block.camera_name(image),
            "orientation": 1,
        }
    if block.table.positions is not None:
        gps = enu_of_geodetic(origin, block.table.positions)
        for shot, position in zip(shots.values(), gps):
            if np.isfinite(position).all():
                shot["gps_position"] = position.tolist()
    contents = {
        "cameras": {name: normalised_camera(name, camera, path) for name, camera in block.cameras.items()},
        "shots": shots,
        "points": {},
        "reference_lla": dict(zip(("latitude", "longitude", "altitude"), origin)),
    }
    return {path: json.dumps([contents], indent=1) + "\n"}


def _tangential(table: OrientationTable, path: Path) -> tuple[tuple[float, float, float], Floats, Floats]:
    """Origin of a tangential system, and poses in it."""
    if table.origin is not None:
        return table.origin, table.centers, table.rotations
    if table.crs is None:
        raise InputError(f"{path}: reconstruction.json needs the place on the earth; state the CRS of the orientation")
    middle = table.centers.mean(axis=0)
    lon, lat = crs_step(table.crs, "EPSG:4326")(middle[:2]).tolist()
    origin = (lat, lon, float(table.centers[:, 2].min()))
    enu, R_map_enu = topocentric_of_map(origin, table.crs, table.centers)
    return origin, enu, np.swapaxes(R_map_enu, 1, 2) @ table.rotations


def normalised_camera(name: str, camera: CameraEntry, path: Path) -> dict[str, Any]:
    """Entry of a camera in ``cameras``."""
    form = opencv_form(camera)
    if form is None or form.rational:
        raise InputError(f"{path}: camera {name!r} has no form in OpenSfM; write without its lens, or another format")
    side = max(form.size)
    c_x, c_y = ((point - (s - 1) / 2) / side for point, s in zip(form.point, form.size))
    common: dict[str, Any] = {"width": form.size[0], "height": form.size[1]}
    common |= {"focal_x": form.focal[0] / side, "focal_y": form.focal[1] / side, "c_x": c_x, "c_y": c_y}
    k = {f"k{i + 1}": v for i, v in enumerate(form.k)}
    if form.fisheye:
        return {"projection_type": "fisheye_opencv", **common, **k}
    radial = {n: k[n] for n in ("k1", "k2", "k3")}
    return {"projection_type": "brown", **common, **radial, "p1": form.p[0], "p2": form.p[1]}


def _read(path: Path, form: TableFormat) -> OrientationBlock:
    """Oriented images of a ``reconstruction.json``, in its local system or UTM zone; `form` is not used.

    With the cameras of the file, where it describes them.
    """
    contents = _reconstructions(path)
    origins = {_origin(r, path) for r in contents}
    if len(origins) != 1:
        raise InputError(f"{path}: the reconstructions have {len(origins)} different origins; keep one reconstruction")
    origin = origins.pop()
    stated = _stated(contents)
    if not stated:
        raise InputError(f"{path}: a reconstruction.json without shots; reconstruct again")
    shots = _shots(stated, path)
    world = world_of(path, origin, shots)
    rotations = np.swapaxes(Rotation.from_rotvec(shots.vectors).as_matrix(), 1, 2) @ FLIP
    images = tuple(
        posed(name, center, R, str(shot["camera"]) if shot.get("camera") else None)
        for (name, shot), center, R in zip(stated, shots.centers + world.offset, rotations)
    )
    notes = [world.note]
    if len(contents) > 1:
        sizes = ", ".join(str(len(r["shots"])) for r in contents)
        notes.insert(0, f"{path.name}: {len(contents)} separate reconstructions ({sizes} images), tied by GPS only")
    known = np.isfinite(shots.gps).any()
    table = OrientationTable(
        path,
        images,
        crs=world.crs,
        true_metres=world.crs is not None,
        origin=origin if world.crs is None else None,
        positions=geodetic_of_enu(origin, shots.gps) if known else None,
        notes=tuple(notes),
    )
    faults: dict[str, UnusableCamera] = {}
    described = all(isinstance(r.get("cameras"), dict) for r in contents)
    cameras = cameras_of(contents, path, faults) if described else {}
    return OrientationBlock(without_unusable(table, faults), cameras)


def _reconstructions(path: Path) -> list[dict[str, Any]]:
    """Reconstructions of a file, with their shots."""
    contents = read_json(path)
    if not isinstance(contents, list) or not all(
        isinstance(each, dict) and isinstance(each.get("shots"), dict) for each in contents
    ):
        raise InputError(
            f"{path}: not a reconstruction.json of OpenSfM (a list of reconstructions with `shots`){format_hint(path)}"
        )
    return contents


def _stated(reconstructions: list[dict[str, Any]]) -> list[tuple[str, Any]]:
    return [(name, shot) for each in reconstructions for name, shot in each["shots"].items()]


def _origin(reconstruction: dict[str, Any], path: Path) -> tuple[float, float, float]:
    lla = reconstruction.get("reference_lla")
    beside = path.with_name("reference_lla.json")
    if lla is None and beside.is_file():
        lla, path = read_json(beside, 100_000), beside
    if not isinstance(lla, dict):
        raise InputError(f"{path}: states no reference_lla; the reconstruction is not georeferenced")
    lat, lon, alt = (finite(lla.get(k), f"{path}: reference_lla.{k}") for k in ("latitude", "longitude", "altitude"))
    if abs(lat) > 90 or abs(lon) > 360:
        raise InputError(f"{path}: reference_lla latitude {lat}, longitude {lon} are not on the earth")
    if is_no_fix(lat, lon):
        raise InputError(
            f"{path}: reference_lla is latitude 0, longitude 0: OpenSfM writes so if no image states a position; the "
            "reconstruction is not georeferenced"
        )
    return lat, lon, alt


def _shots(stated: list[tuple[str, Any]], path: Path) -> Shots:
    """Poses and positions of receivers, as stated."""
    centers, vectors, gps, dops = [], [], [], []
    for name, shot in stated:
        where = f"{path}: shot {name!r}"
        if not isinstance(shot, dict) or "rotation" not in shot or "translation" not in shot:
            raise InputError(f"{where}: rotation or translation is missing")
        vectors.append(finite(shot["rotation"], f"{where}: rotation", 3))
        t = np.array(finite(shot["translation"], f"{where}: translation", 3))
        centers.append(-Rotation.from_rotvec(vectors[-1]).inv().apply(t))
        position = shot.get("gps_position")
        gps.append([np.nan] * 3 if position is None else finite(position, f"{where}: gps_position", 3))
        dops.append(shot["gps_dop"] if isinstance(shot.get("gps_dop"), int | float) else np.nan)
    known = [d for d in dops if np.isfinite(d)]
    return Shots(
        names=tuple(name for name, _ in stated),
        centers=np.array(centers),
        vectors=np.array(vectors),
        gps=np.array(gps, float),
        dop=float(np.median(known)) if known else np.nan,
    )


FORMAT = OrientationFormat(
    name="opensfm",
    title="reconstruction.json of OpenSfM",
    sniff=lambda path, head: path.suffix.lower() == ".json" and '"shots"' in head,
    read=_read,
    render=_render,
    losses=_losses,
    suffix=".json",
)


#: Longest distance of the two positions of an image, metres; the same numbers differ by rounding only.
_AGREE = 0.05


def _read_odm(path: Path, form: TableFormat) -> OrientationBlock:
    """Oriented images of a ``shots.geojson``, with the cameras of ``cameras.json``; `form` is not used."""
    contents = read_json(path)
    features = contents.get("features") if isinstance(contents, dict) else None
    if not isinstance(features, list) or not features:
        raise InputError(f"{path}: not a shots.geojson of OpenDroneMap (a FeatureCollection with features)")
    shots = [_odm_shot(feature, k, path) for k, feature in enumerate(features)]
    crs, notes = _utm_zone(np.array([s[2] for s in shots]), np.array([s[1].center for s in shots]), path)
    cameras, file = _cameras_beside(path, [s[1] for s in shots])
    if cameras:
        notes.append(f"{path.name}: cameras from {file}")
    else:
        notes.append(f"{path.name}: states focal lengths but no lens; the project's cameras.json describes the cameras")
    table = OrientationTable(path, tuple(s[1] for s in shots), crs=crs, true_metres=True, notes=tuple(notes))
    return OrientationBlock(table, cameras, sizes={s[1].name: s[0] for s in shots} if not cameras else {})


def _odm_shot(feature: Any, k: int, path: Path) -> tuple[tuple[int, int], OrientedImage, tuple[float, float, float]]:
    """Image size, pose, and longitude, latitude, height of a feature."""
    properties = feature.get("properties") if isinstance(feature, dict) else None
    if not isinstance(properties, dict) or not isinstance(properties.get("filename"), str):
        raise InputError(f"{path}: feature {k + 1} states no filename")
    name = properties["filename"]
    where = f"{path}: shot {name!r}"
    center = finite(properties.get("translation"), f"{where}: translation", 3)
    R_camera_ground = Rotation.from_rotvec(finite(properties.get("rotation"), f"{where}: rotation", 3)).as_matrix()
    width, height = finite([properties.get("width"), properties.get("height")], f"{where}: width and height", 2)
    geometry = feature.get("geometry")
    place = geometry.get("coordinates") if isinstance(geometry, dict) else None
    camera = properties.get("camera")
    image = posed(name, center, R_camera_ground.T @ FLIP, camera if isinstance(camera, str) else None)
    return (int(width), int(height)), image, finite(place, f"{where}: coordinates", 3)


def _utm_zone(lonlat: Floats, XYZ: Floats, path: Path) -> tuple[str | None, list[str]]:
    """The UTM zone in which longitude, latitude and the map coordinates agree, with a note."""
    for code in utm_codes(float(np.median(lonlat[:, 1])), float(np.median(lonlat[:, 0]))):
        try:
            there = crs_step("EPSG:4326", code)(lonlat[:, :2])
        except InputError:
            continue
        if np.abs(there - XYZ[:, :2]).max() < _AGREE:
            return code, [f"{path.name}: positions agree with longitude and latitude in {crs_label(code)}"]
    return None, [f"{path.name}: no UTM zone makes positions agree with longitude and latitude; declare the CRS"]


def _cameras_beside(path: Path, images: list[OrientedImage]) -> tuple[dict[str, CameraEntry], Path | None]:
    """Cameras of the project's ``cameras.json``, if it describes those of all images."""
    for folder in (path.parent, path.parent.parent):
        file = folder / "cameras.json"
        if file.is_file():
            cameras = read_cameras(file)
            named = {i.camera for i in images}
            known = named <= set(cameras) or (named == {None} and len(cameras) == 1)
            return (cameras, file) if known else ({}, None)
    return {}, None


def _render_odm(block: OrientationBlock, path: Path) -> dict[Path, str]:
    table = block.table
    if table.crs is None:
        raise InputError(f"{path}: shots.geojson needs longitude and latitude; state the CRS of the orientation")
    lonlat = crs_step(table.crs, "EPSG:4326")(table.centers[:, :2]).tolist()
    features = []
    for image, (lon, lat), R in zip(table.images, lonlat, table.rotations):
        size = block.size(image)
        form = opencv_form(block.camera(image)) if block.cameras else None
        properties: dict[str, Any] = {"filename": image.name}
        if block.cameras:
            properties["camera"] = block.camera_name(image)
        if form is not None:
            properties["focal"] = form.focal[0] / max(form.size)
        if size is None:
            raise InputError(f"{path}: the size of image {image.name!r} is not known; name the file with the cameras")
        properties |= {"width": size[0], "height": size[1], "translation": list(image.center)}
        properties["rotation"] = Rotation.from_matrix(FLIP @ R.T).as_rotvec().tolist()
        point = {"type": "Point", "coordinates": [lon, lat, image.center[2]]}
        features.append({"type": "Feature", "properties": properties, "geometry": point})
    return {path: json.dumps({"type": "FeatureCollection", "features": features}, indent=1) + "\n"}


def _losses_odm(block: OrientationBlock) -> Iterable[Loss]:
    lost = common_losses(block, cameras=False, crs=True)
    for loss in lost:
        if loss.kind == "camera":
            yield Loss(
                "camera", "only the focal length of the cameras, no principal point and no lens: keep their file"
            )
        else:
            yield loss
    crs = block.table.crs
    if crs is not None and not re.fullmatch(r"EPSG:32[67]\d\d", canonical_crs(crs)):
        yield Loss("crs", "no CRS but UTM zones of WGS 84; readers will take these positions for others")


def _sniff_odm(path: Path, head: str) -> bool:
    return '"FeatureCollection"' in head and '"translation"' in head and '"rotation"' in head


ODM = OrientationFormat(
    name="odm",
    title="OpenDroneMap shots.geojson",
    sniff=_sniff_odm,
    read=_read_odm,
    render=_render_odm,
    losses=_losses_odm,
    suffix=".geojson",
)
