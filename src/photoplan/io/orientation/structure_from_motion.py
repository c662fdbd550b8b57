"""Orientations and cameras of Agisoft Metashape (``cameras.xml``) and of COLMAP, read and written.

Agisoft Metashape's ``cameras.xml``: cameras and poses (File, Export, Export Cameras), read and written.

As its manual (Metashape User Manual, Professional Edition 2.1, appendix "Camera models") and the API reference define
it: a camera's ``transform`` is a row-major 4 × 4 matrix from the camera's axes (x right, y down, z forwards) to the
chunk's own system; the ``transform`` of a component (of the chunk, in files before version 1.5) takes these by scale,
rotation and translation to the world: geocentric coordinates of the datum of the ``reference`` CRS if that is
geographic or projected, else the local system. A camera of a multi-camera rig without a transform of its own has
that of its master (``master_id``), followed by ``location`` and ``rotation`` of its sensor in the master's axes, in the
units of the chunk. Pixels: u = w/2 + cx + x′ f + x′ B1 + y′ B2, v = h/2 + cy + y′ f with
(0.5, 0.5) as the centre of the upper-left pixel; x′, y′ from Brown's polynomial with k1–k4, p1, p2, y down.

Written (version 2.0.0) are transforms in a local system (east, north, up about the middle of the block), which the
component's transform places on the earth; a block without CRS is written in its own coordinates, as a local system.

COLMAP models, text and binary: cameras, images, rigs and frames of one folder.

As COLMAP's documentation and `reconstruction_io_binary.cc` define it (colmap.github.io: Output Format, Camera Models):
an image's pose is a unit quaternion (w, x, y, z; Hamilton) and a translation that take world coordinates to camera
coordinates, the axes being x right, y down, z forwards, so the projection centre is −Rᵀ t. Lenses are OpenCV's. The
corner of the upper-left pixel is (0, 0), its centre (0.5, 0.5). The world has no CRS.

Since version 3.12, ``rigs`` and ``frames`` state the same poses once more: camera-from-world is sensor-from-rig times
rig-from-world. COLMAP itself uses these and ignores the poses of ``images``; here both must agree.
"""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, tostring

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from photoplan.arrays import Floats
from photoplan.errors import InputError, named_by
from photoplan.geometry.crs import crs_step, parse_crs
from photoplan.geometry.local import (
    enu_axes,
    geocentric_of_geodetic,
    geocentric_poses,
    geodetic_of_geocentric,
    is_local_crs,
    is_wgs84_geographic,
    legacy_wkt,
    map_poses,
)
from photoplan.geometry.pose import FLIP
from photoplan.geometry.units import metric_system
from photoplan.io.camera.model import CameraEntry, UnusableCamera
from photoplan.io.camera.opencv import AgisoftForm, OpenCVForm, agisoft_form, frame_camera, opencv_form, opencv_losses
from photoplan.io.files import element_numbers, finite, read_text, read_xml, whole_number
from photoplan.io.orientation.block import (
    Loss,
    OrientationBlock,
    OrientationFormat,
    OrientationTable,
    TableFormat,
    height_losses,
    posed,
    require_cameras,
    without_unusable,
)
from photoplan.io.orientation.text import checked_rotation, numbers
from photoplan.plain import xml_quoted, xml_text

_METASHAPE_BYTES = 256 << 20
_COEFFICIENTS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")

#: How far a printed matrix times itself may be from the unit matrix.
_ROUNDED = 2e-5


@dataclass(frozen=True, eq=False)
class _Similarity:
    """From the chunk's own system to the world: X = scale · R x + t."""

    R: Floats = field(default_factory=lambda: np.eye(3))
    t: Floats = field(default_factory=lambda: np.zeros(3))
    scale: float = 1.0


def read_metashape(path: Path, form: TableFormat) -> OrientationBlock:
    """Oriented images and cameras of a ``cameras.xml``; `form` is not used."""
    chunk = _chunk(path)
    sensors = {s.get("id", ""): s for s in chunk.findall("./sensors/sensor")}
    shared, by_component = _component_transforms(chunk, path)
    notes: list[str] = []
    every = list(chunk.iterfind("./cameras//camera"))
    by_id = {c.get("id", ""): c for c in every}
    poses = {c: pose for c in every if (pose := _pose_of(c, by_id, sensors, path)) is not None}
    oriented = list(poses)
    unaligned = len(every) - len(oriented)
    if not oriented:
        raise InputError(f"{path}: no camera has a transform; align the photos and export again")
    if unaligned > 0:
        notes.append(f"{path.name}: {unaligned} cameras are not aligned; left out")
    rolling = sum(c.find("rolling_shutter") is not None for c in oriented)
    if rolling:
        notes.append(f"{path.name}: {rolling} cameras state a rolling shutter; its motion is not applied")
    slaves = [c for c in oriented if c.find("transform") is None]
    if slaves:
        notes.append(
            f"{path.name}: {len(slaves)} cameras of rigs are placed by their master and the offset of the sensor"
        )
    named = _image_names(chunk, oriented)
    names, centers, rotations, references = [], [], [], []
    scaled: set[str] = set()
    placed = [by_component.get(c.get("component_id", ""), shared) for c in oriented]
    georeferenced = any(p is not None for p in placed)
    kept = [c for c, p in zip(oriented, placed) if p is not None or not georeferenced]
    if len(kept) < len(oriented):
        notes.append(f"{path.name}: {len(oriented) - len(kept)} cameras of a component without position; left out")
    described: dict[str, tuple[str, CameraEntry]] = {}
    faults: dict[str, UnusableCamera] = {}
    for s in dict.fromkeys(c.get("sensor_id", "") for c in kept):
        try:
            described[s] = _sensor(sensors.get(s), s, path)
        except UnusableCamera as error:
            faults[s] = error
    if faults:
        if not described:
            raise next(iter(faults.values()))
        usable = [c for c in kept if c.get("sensor_id", "") in described]
        lost, first = len(kept) - len(usable), next(iter(faults.values()))
        notes.append(f"warning: {lost} of {len(kept)} images are left out, whose camera cannot be used: {first}")
        kept = usable
    for camera in kept:
        world = by_component.get(camera.get("component_id", ""), shared) or _Similarity()
        R, t = poses[camera]
        if camera in slaves and abs(world.scale - 1.0) > 1e-3 and (c := camera.get("sensor_id", "")) not in scaled:
            scaled.add(c)
            notes.append(f"sensor {c}: its offset in the rig is taken in units of the chunk, {world.scale:.4g} m each")
        names.append((named[camera], camera.get("sensor_id", "")))
        centers.append(world.scale * world.R @ t + world.t)
        rotations.append(world.R @ R @ FLIP)
        references.append(_reference(camera))
    cameras = _named(chunk, described)
    placing = _place(chunk, np.array(centers), np.array(rotations), georeferenced, path)
    images = tuple(
        posed(name, at, R, cameras[s][0]) for (name, s), at, R in zip(names, placing.centers, placing.rotations)
    )
    heights = "ellipsoidal" if placing.crs is not None else None
    table = OrientationTable(
        path,
        images,
        crs=placing.crs,
        true_metres=placing.crs is not None,
        height_system=heights,
        origin=placing.origin,
        positions=_geodetic(np.array(references), chunk, path),
        notes=(*notes, *placing.notes),
    )
    return OrientationBlock(table, dict(cameras.values()))


def read_metashape_cameras(path: Path) -> dict[str, CameraEntry]:
    """The cameras alone: sensors with a calibration, by label."""
    chunk = _chunk(path)
    found = {s.get("id", ""): s for s in chunk.findall("./sensors/sensor") if s.find("calibration") is not None}
    return dict(_named(chunk, {key: _sensor(s, key, path) for key, s in found.items()}).values())


def _chunk(path: Path) -> Element:
    root = read_xml(path, _METASHAPE_BYTES)
    chunks = [root] if root.tag == "chunk" else root.findall("./chunk")
    if root.tag not in ("document", "chunk") or not chunks:
        raise InputError(f"{path}: an XML document of <{root.tag[:50]}>; Metashape's <document> with a <chunk> is read")
    if len(chunks) > 1:
        raise InputError(f"{path}: holds {len(chunks)} chunks; export the cameras of one chunk")
    return chunks[0]


def _component_transforms(chunk: Element, path: Path) -> tuple[_Similarity | None, dict[str, _Similarity | None]]:
    """Return the transforms of the chunk, and of its components by their id; None without a position."""
    shared = _similarity(chunk.find("./transform"), f"{path}: chunk")
    found: dict[str, _Similarity | None] = {}
    for component in chunk.findall("./components/component"):
        own = component.find("./transform")
        where = f"{path}: component {component.get('label')!r}"
        found[component.get("id", "")] = shared if own is None else _similarity(own, where)
    # Cameras of files with one component need not name it.
    if len(found) == 1 and shared is None:
        shared = next(iter(found.values()))
    return shared, found


def _similarity(element: Element | None, where: str) -> _Similarity | None:
    if element is None or element.find("rotation") is None:
        return None
    R = np.array(element_numbers(element.find("rotation"), f"{where}: rotation", 9)).reshape(3, 3)
    t = np.array(element_numbers(element.find("translation"), f"{where}: translation", 3))
    scale = (
        element_numbers(element.find("scale"), f"{where}: scale", 1)[0] if element.find("scale") is not None else 1.0
    )
    if scale <= 0:
        raise InputError(f"{where}: scale {scale}; a positive number is needed")
    return _Similarity(checked_rotation(R, where, _ROUNDED), t, scale)


def _pose_of(
    camera: Element, every: Mapping[str, Element], sensors: Mapping[str, Element], path: Path
) -> tuple[Floats, Floats] | None:
    """Rotation and centre in the chunk; None if neither the camera nor the master of its rig is aligned."""
    where = f"{path}: camera {camera.get('label')!r}"
    master = every.get(camera.get("master_id", ""))
    if camera.find("transform") is None and master is not None and master is not camera:
        sensor = sensors.get(camera.get("sensor_id", ""))
        if master.find("transform") is None or sensor is None or sensor.find("rotation") is None:
            return None
        R_master, t_master = _camera_pose(master, f"{path}: camera {master.get('label')!r}")
        where = f"{path}: sensor {sensor.get('label')!r}"
        R = np.array(element_numbers(sensor.find("rotation"), f"{where}: rotation", 9)).reshape(3, 3)
        stated = sensor.find("location")
        t = np.zeros(3) if stated is None else np.array(element_numbers(stated, f"{where}: location", 3))
        return R_master @ checked_rotation(R, where, _ROUNDED), R_master @ t + t_master
    return None if camera.find("transform") is None else _camera_pose(camera, where)


def _camera_pose(camera: Element, where: str) -> tuple[Floats, Floats]:
    M = np.array(element_numbers(camera.find("transform"), f"{where}: transform", 16)).reshape(4, 4)
    if not np.allclose(M[3], [0.0, 0.0, 0.0, 1.0], rtol=0, atol=1e-9):
        raise InputError(f"{where}: transform: the last row is {M[3].tolist()}; 0 0 0 1 is needed")
    return checked_rotation(M[:3, :3], where, _ROUNDED), M[:3, 3]


def _reference(camera: Element) -> list[float]:
    """Return a receiver's measurement, in the CRS of the chunk; NaN if the camera states none, or does not use it."""
    stated = camera.find("reference")
    if stated is None or stated.get("enabled", "true") in ("0", "false"):
        return [np.nan] * 3
    try:
        return [float(stated.get(axis, "nan")) for axis in "xyz"]
    except ValueError:
        return [np.nan] * 3


def _geodetic(references: Floats, chunk: Element, path: Path) -> Floats | None:
    """Latitude, longitude and height (n, 3) of receivers' positions; None: none, or in no CRS that leads there."""
    crs = (chunk.findtext("./reference") or "").strip()
    there = np.isfinite(references[:, :2]).all(axis=1) & (references[:, :2] != 0).any(axis=1)
    if not there.any() or not crs or is_local_crs(crs, f"{path}: reference"):
        return None
    try:
        system = metric_system(crs, f"{path}: reference")
        if parse_crs(system.crs).is_geocentric:
            return None
        out = np.full(references.shape, np.nan)
        lonlat = crs_step(system.crs, "EPSG:4326")(system.scale * references[there, :2])
        rise = np.nan if system.height_scale is None else system.height_scale
        out[there] = np.column_stack([lonlat, rise * references[there, 2]])
    except InputError:  # they only check the poses
        return None
    return out[:, [1, 0, 2]]


def _sensor(sensor: Element | None, key: str, path: Path) -> tuple[str, CameraEntry]:
    if sensor is None:
        raise InputError(f"{path}: sensor {key!r}, which a camera refers to, is not described")
    label = sensor.get("label") or f"sensor {key}"
    where = f"{path}: sensor {label!r}"
    given = sensor.findall("./calibration")
    if not given:
        raise InputError(f"{where}: has no calibration; export the cameras after the photos were aligned")
    calibration = next((c for c in given if c.get("class") == "adjusted"), given[-1])
    kind = calibration.get("type") or sensor.get("type") or "frame"
    if kind not in ("frame", "fisheye"):
        raise UnusableCamera(f"{where}: type {kind!r} is not supported; allowed are frame and fisheye")
    v = {c: element_numbers(calibration.find(c), f"{where}: {c}", 1)[0] for c in _COEFFICIENTS if _has(calibration, c)}
    if "f" not in v:
        raise InputError(f"{where}: its calibration states no focal length f")
    if v.get("p3") or v.get("p4"):
        raise UnusableCamera(f"{where}: p3 and p4 are not supported; fix them to 0, align and export again")
    resolution = calibration.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    sides = ("width", "height")
    try:
        width, height = (int(resolution.get(s, "")) if resolution is not None else 0 for s in sides)
    except ValueError:
        width = height = 0
    if width <= 0 or height <= 0:
        raise InputError(f"{where}: its resolution (width and height in pixels) is not stated")
    finite([width, height], where, 2)
    c = {name: v.get(name, 0.0) for name in _COEFFICIENTS}
    k, p, b = (c["k1"], c["k2"], c["k3"], c["k4"]), (c["p1"], c["p2"]), (c["b1"], c["b2"])
    form = AgisoftForm(
        size=(width, height), f=c["f"], offset=(c["cx"], c["cy"]), k=k, p=p, b=b, fisheye=kind == "fisheye"
    )
    return label, frame_camera(form, where)


def _has(element: Element, name: str) -> bool:
    return element.find(name) is not None


def _named(chunk: Element, cameras: Mapping[str, tuple[str, CameraEntry]]) -> dict[str, tuple[str, CameraEntry]]:
    """Name and description by the sensor's id: its label, with the id if another calibration has the label."""
    calibrations: dict[str, set[bytes]] = {}
    for sensor in chunk.findall("./sensors/sensor"):
        stated = b"".join(tostring(c) for c in sensor.findall("./calibration"))
        if stated:
            calibrations.setdefault(sensor.get("label") or f"sensor {sensor.get('id')}", set()).add(stated)
    return {
        key: (f"{label} (sensor {key})" if len(calibrations.get(label, ())) > 1 else label, camera)
        for key, (label, camera) in cameras.items()
    }


def _image_names(chunk: Element, cameras: Sequence[Element]) -> dict[Element, str]:
    """Name of every camera's image: its label, with the group, then the id, where labels are equal."""
    groups = {c: g.get("label") or "" for g in chunk.iterfind("./cameras//group") for c in g.iter("camera")}
    names = {c: c.get("label") or f"camera {c.get('id')}" for c in cameras}
    count = Counter(names.values())
    names = {c: f"{groups[c]}/{name}" if count[name] > 1 and groups.get(c) else name for c, name in names.items()}
    count = Counter(names.values())
    return {c: f"{name} (camera {c.get('id')})" if count[name] > 1 else name for c, name in names.items()}


@dataclass(frozen=True, eq=False)
class _Placed:
    """Poses in a system that photoplan knows."""

    centers: Floats
    rotations: Floats
    crs: str | None = None
    origin: tuple[float, float, float] | None = None
    notes: tuple[str, ...] = ()


def _place(chunk: Element, centers: Floats, rotations: Floats, georeferenced: bool, path: Path) -> _Placed:
    """Poses of the world system, in the CRS that the file states."""
    stated = (chunk.findtext("./reference") or "").strip()
    if not georeferenced:
        note = f"{path.name}: the chunk has no position, scale and rotation; coordinates are the program's own"
        return _Placed(centers, rotations, notes=(note,))
    if not stated or is_local_crs(stated, f"{path}: reference"):
        return _Placed(centers, rotations, notes=(f"{path.name}: coordinates are in a local system",))
    where = f"{path}: reference"
    crs = parse_crs(stated, where)
    if crs.is_geocentric or is_wgs84_geographic(metric_system(stated, where).crs, where):
        lat, lon, h = geodetic_of_geocentric(centers.mean(axis=0))
        axes = enu_axes(lat, lon)
        enu = (centers - geocentric_of_geodetic((lat, lon, h))) @ axes.T
        return _Placed(enu, axes @ rotations, origin=(lat, lon, h))
    # Poses are geocentric, in metres; only the reference may be in feet.
    horizontal = metric_system(stated, where).crs
    if not parse_crs(horizontal, where).is_projected:
        raise InputError(
            f"{where}: {crs.name!r} is geographic on another datum than WGS 84; choose a projected CRS in Metashape "
            "(Reference, Convert) and export again"
        )
    with named_by(path):
        XYZ, axes = map_poses(horizontal, centers)
    return _Placed(XYZ, np.swapaxes(axes, 1, 2) @ rotations, crs=horizontal)


def _sniff_metashape(path: Path, head: str) -> bool:
    return "<document" in head and "<chunk" in head and path.suffix.lower() == ".xml"


_LOCAL = 'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1,AUTHORITY["EPSG","9001"]]]'


def _losses_metashape(block: OrientationBlock) -> Iterable[Loss]:
    """Return the properties of a block that the format cannot hold."""
    for name, camera in block.cameras.items():
        if camera.pixels is None:
            yield Loss("camera", f"no camera {name!r}: film has no pixels of its own")
        elif agisoft_form(camera) is None:
            yield Loss("lens", f"no lens of type {camera.lens.type} as camera {name!r} has it")
    yield from height_losses(block.table)


def _render_metashape(block: OrientationBlock, path: Path) -> dict[Path, str]:
    """Text of a ``cameras.xml``.

    Raises
    ------
    InputError
        The block has no cameras, a lens has no form there, or the CRS cannot be used.
    """
    require_cameras(block, path, "cameras.xml")
    R_world_chunk, t, wkt, centers, rotations = _placed(block)
    sensors = {name: str(k) for k, name in enumerate(block.cameras)}
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', '<document version="2.0.0">']
    lines += ['  <chunk label="Chunk 1" enabled="true">', f'    <sensors next_id="{len(sensors)}">']
    for name, camera in block.cameras.items():
        lines += _sensor_lines(name, sensors[name], camera, path)
    lines += ["    </sensors>", '    <components next_id="1" active_id="0">']
    lines += ['      <component id="0" label="Component 1">', "        <transform>"]
    lines += [
        f"          <rotation>{_text(R_world_chunk)}</rotation>",
        f"          <translation>{_text(t)}</translation>",
        "          <scale>1</scale>",
    ]
    lines += ["        </transform>", "      </component>", "    </components>"]
    lines += [f'    <cameras next_id="{len(block.table.images)}" next_group_id="0">']
    for k, image in enumerate(block.table.images):
        M = np.eye(4)
        M[:3, :3], M[:3, 3] = rotations[k] @ FLIP, centers[k]
        sensor = sensors[block.camera_name(image)]
        lines += [
            f'      <camera id="{k}" sensor_id="{sensor}" component_id="0" label={xml_quoted(image.name)}>',
            f"        <transform>{_text(M)}</transform>",
            "      </camera>",
        ]
    lines += ["    </cameras>", f"    <reference>{xml_text(wkt)}</reference>", "  </chunk>", "</document>", ""]
    return {path: "\n".join(lines)}


def _placed(block: OrientationBlock) -> tuple[Floats, Floats, str, Floats, Floats]:
    """Rotation and translation of the chunk, WKT of the CRS, and poses in the chunk's system."""
    table = block.table
    if table.crs is not None:
        earth, axes = geocentric_poses(table.crs, table.centers)
        t = earth.mean(axis=0)
        lat, lon, _ = geodetic_of_geocentric(t)
        R = enu_axes(lat, lon)
        return R.T, t, legacy_wkt(table.crs), (earth - t) @ R.T, R @ axes @ table.rotations
    if table.origin is not None:
        R, t = enu_axes(*table.origin[:2]), geocentric_of_geodetic(table.origin)
        return R.T, t, legacy_wkt("EPSG:4326"), table.centers, table.rotations
    return np.eye(3), np.zeros(3), _LOCAL, table.centers, table.rotations


def _sensor_lines(name: str, key: str, camera: CameraEntry, path: Path) -> list[str]:
    form = agisoft_form(camera)
    if form is None:
        raise InputError(
            f"{path}: camera {name!r} has no form in cameras.xml; write without its lens, or another format"
        )
    kind = "fisheye" if form.fisheye else "frame"
    size = f'<resolution width="{form.size[0]}" height="{form.size[1]}"/>'
    numbers = {"f": form.f, "cx": form.offset[0], "cy": form.offset[1], "b1": form.b[0], "b2": form.b[1]}
    numbers |= {f"k{i + 1}": v for i, v in enumerate(form.k)} | {"p1": form.p[0], "p2": form.p[1]}
    return [
        f'      <sensor id="{key}" label={xml_quoted(name)} type="{kind}">',
        f"        {size}",
        f'        <calibration type="{kind}" class="adjusted">',
        f"          {size}",
        *(f"          <{n}>{v!r}</{n}>" for n, v in numbers.items() if n == "f" or v != 0),
        "        </calibration>",
        "      </sensor>",
    ]


def _text(values: ArrayLike) -> str:
    # Seventeen digits: numbers come back as they were.
    return " ".join(repr(v) for v in np.asarray(values, float).ravel().tolist())


METASHAPE = OrientationFormat(
    name="metashape",
    title="Metashape cameras.xml",
    sniff=_sniff_metashape,
    read=read_metashape,
    render=_render_metashape,
    losses=_losses_metashape,
    suffix=".xml",
)


_COLMAP_BYTES = 2 << 30
#: Parameters of every camera model, in the order of COLMAP's model numbers (0, 1, 2, …).
_MODELS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "FOV": ("fx", "fy", "cx", "cy", "omega"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "THIN_PRISM_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        *("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s1", "s2", "s3", "s4"),
    ),
    "SIMPLE_DIVISION": ("f", "cx", "cy", "k"),
    "DIVISION": ("fx", "fy", "cx", "cy", "k"),
    "SIMPLE_FISHEYE": ("f", "cx", "cy"),
    "FISHEYE": ("fx", "fy", "cx", "cy"),
    "EUCM": ("fx", "fy", "cx", "cy", "alpha", "beta"),
    "EQUIRECTANGULAR": ("w", "h"),
}
_NUMBERED = tuple(_MODELS)
_BINARY = ("cameras.bin", "images.bin", "rigs.bin", "frames.bin")
_FISHEYES = tuple(name for name in _MODELS if name.endswith("FISHEYE"))
#: Parameters that must be 0, by model: this program has no lens with these terms.
_ZERO = {
    "FOV": ("omega",),
    "THIN_PRISM_FISHEYE": ("p1", "p2", "sx1", "sy1"),
    "RAD_TAN_THIN_PRISM_FISHEYE": ("k5", "k6", "p1", "p2", "s1", "s2", "s3", "s4"),
    "SIMPLE_DIVISION": ("k",),
    "DIVISION": ("k",),
    "EUCM": ("alpha",),
}
#: Poses of rigs and images may differ by rounding only: radians, and parts of the spread of the projection centres.
_TURNED, _APART = 1e-4, 1e-3


@dataclass(frozen=True)
class _Rigid:
    """World coordinates to those of a camera or a rig: x = R X + t."""

    R: Floats
    t: Floats

    def __matmul__(self, other: _Rigid) -> _Rigid:
        return _Rigid(self.R @ other.R, self.R @ other.t + self.t)

    @property
    def center(self) -> Floats:
        """Origin of the camera in world coordinates (3,)."""
        return -self.R.T @ self.t


@dataclass
class _Model:
    """Contents of one folder; keys are COLMAP's numbers."""

    cameras: dict[str, CameraEntry] = field(default_factory=dict)
    images: dict[int, tuple[str, str, _Rigid, int | None]] = field(default_factory=dict)
    """Name, camera, pose and line of the file."""
    faults: dict[str, UnusableCamera] = field(default_factory=dict)
    """Cameras that have no form here."""
    rigs: dict[int, dict[int, _Rigid | None]] = field(default_factory=dict)
    """Sensor-from-rig of every camera; None: not stated."""
    frames: dict[int, tuple[int, _Rigid, list[tuple[int, int]]]] = field(default_factory=dict)
    """Rig, rig-from-world, and the camera and image numbers of the frame."""


def read_colmap(path: Path, form: TableFormat) -> OrientationBlock:
    """Oriented images and cameras of a model; `form` is not used."""
    folder = path if path.is_dir() else path.parent
    forms = [s for s in ("txt", "bin") if all((folder / f"{n}.{s}").is_file() for n in ("cameras", "images"))]
    if not forms:
        missing = [n for n in ("cameras.txt", "images.txt") if not (folder / n).is_file()]
        raise InputError(
            f"{folder}: has no {' and no '.join(missing)}, so it is not a COLMAP model; "
            "give the folder with cameras and images as .txt or .bin"
        )
    if path.suffix[1:].lower() in forms:
        forms = [path.suffix[1:].lower()]
    models = {suffix: _read_model(folder, suffix) for suffix in forms}
    if len(models) == 2:
        poses = [{n: pose for n, _, pose, _ in model.images.values()} for model in models.values()]
        differing = next((n for n in poses[0].keys() ^ poses[1].keys()), None) or _contradiction(*poses)
        if differing is not None:
            raise InputError(
                f"{folder}: images.txt and images.bin disagree (image {differing}); "
                "give the file that is meant, or remove the other one"
            )
    suffix, model = next(iter(models.items()))
    notes = _check_rigs(model, folder, suffix)
    file = folder / f"images.{suffix}"
    images = tuple(
        posed(name, pose.center, pose.R.T @ FLIP, camera, line) for name, camera, pose, line in model.images.values()
    )
    notes.append("a COLMAP model states no CRS; unless it was georeferenced, position, scale and axes are its own")
    table = without_unusable(OrientationTable(file, images, notes=tuple(notes)), model.faults)
    used = {i.camera for i in table.images}
    cameras = {name: c for name, c in model.cameras.items() if name in used}
    return OrientationBlock(table, cameras)


def _contradiction(stated: dict[str, _Rigid], others: dict[str, _Rigid]) -> str | None:
    """The first image whose poses differ by more than rounding, with the difference; None: all agree."""
    centers = np.array([pose.center for pose in stated.values()]).reshape(-1, 3)
    spread = float(np.sqrt(((centers - centers.mean(axis=0)) ** 2).sum(axis=1).mean())) if len(centers) else 0.0
    for name in stated.keys() & others.keys():
        one, other = stated[name], others[name]
        turned = float(np.linalg.norm(Rotation.from_matrix(one.R @ other.R.T).as_rotvec()))
        apart = float(np.linalg.norm(one.center - other.center))
        if turned > _TURNED or apart > max(_APART * spread, 1e-8 * float(np.linalg.norm(one.center))):
            return f"{name!r}: {apart:.3g} units and {np.degrees(turned):.3g}° apart"
    return None


def _check_rigs(model: _Model, folder: Path, suffix: str) -> list[str]:
    """Refuse rigs and frames that contradict the images; return notes on what could not be compared."""
    if not model.frames:
        return []
    where = f"{folder}: rigs.{suffix} and frames.{suffix}"
    expected: dict[str, _Rigid] = {}
    open_ = 0
    for number, (rig, rig_from_world, members) in model.frames.items():
        if rig not in model.rigs:
            raise InputError(f"{where}: frame {number} is of rig {rig}, which is not described")
        for camera, image in members:
            if image not in model.images:
                continue
            name, own, _, _ = model.images[image]
            if str(camera) != own:
                raise InputError(f"{where}: image {name!r} is of camera {camera}, but images.{suffix} states {own}")
            if camera not in model.rigs[rig]:
                raise InputError(f"{where}: frame {number}: camera {camera} is not a sensor of rig {rig}")
            sensor = model.rigs[rig][camera]
            if sensor is None:
                open_ += 1
            else:
                expected[name] = sensor @ rig_from_world
    found = _contradiction({n: pose for n, _, pose, _ in model.images.values()}, expected)
    if found is not None:
        raise InputError(
            f"{where} contradict images.{suffix}: image {found}. Export the model again with COLMAP; if "
            f"images.{suffix} is right, give a folder without rigs and frames"
        )
    notes = [f"poses of {len(expected)} images agree with rigs.{suffix} and frames.{suffix}"] if expected else []
    unknown = len(model.images) - len(expected)
    if unknown:
        notes.append(f"{unknown} images: rigs and frames state no pose; those of images.{suffix} are used")
    return notes


def read_colmap_cameras(path: Path, faults: dict[str, UnusableCamera] | None = None) -> dict[str, CameraEntry]:
    """Cameras of a ``cameras.txt`` or ``cameras.bin`` by their number, as text.

    Those that have no form here are entered into `faults`; None: they are errors.
    """
    if path.suffix.lower() == ".bin":
        return _Binary(path).cameras(faults)
    cameras: dict[str, CameraEntry] = {}
    for number, line in _lines(path):
        words = line.split()
        where = f"{path}:{number}"
        if len(words) < 4:
            raise InputError(f"{where}: {line[:50]!r}; CAMERA_ID, MODEL, WIDTH, HEIGHT and parameters are needed")
        with _unusable(words[0], faults):
            model = _model_name(words[1], where)
            values = numbers(words[2:], where, f"camera model {model}", 2 + len(_MODELS[model]))
            _add_camera(cameras, words[0], model, values, where)
    return cameras


@contextmanager
def _unusable(key: str, faults: dict[str, UnusableCamera] | None) -> Iterator[None]:
    """Enter a camera that has no form here into `faults`."""
    try:
        yield
    except UnusableCamera as error:
        if faults is None:
            raise
        faults[key] = error


def _model_name(given: str, where: str) -> str:
    """Name of a camera model that is given by name or number."""
    number = whole_number(given)
    name = given if number is None or number >= len(_NUMBERED) else _NUMBERED[number]
    if name not in _MODELS:
        accepted = ", ".join(_MODELS)
        raise UnusableCamera(f"{where}: camera model {given[:40]!r} is not supported; accepted are {accepted}")
    return name


def _add_camera(cameras: dict[str, CameraEntry], key: str, model: str, values: Iterable[float], where: str) -> None:
    width, height, *parameters = values
    v = dict(zip(_MODELS[model], parameters))
    odd = [f"{name} = {v[name]:g}" for name in _ZERO.get(model, ()) if v[name] != 0]
    if odd or "cx" not in v:
        terms = f" with {', '.join(odd)}" if odd else ""
        raise UnusableCamera(
            f"{where}: camera model {model}{terms} has no form here; undistort the images with "
            "`colmap image_undistorter`, or calibrate with OPENCV, FULL_OPENCV or OPENCV_FISHEYE"
        )
    if key in cameras:
        raise InputError(f"{where}: camera {key} is given twice")
    focal = (v.get("fx", v.get("f", 0.0)), v.get("fy", v.get("f", 0.0)))
    fisheye = model in _FISHEYES
    k = tuple(v.get(f"k{i + 1}", 0.0) for i in range(4 if fisheye else 6))
    p = (0.0, 0.0) if fisheye else (v.get("p1", 0.0), v.get("p2", 0.0))
    size, point = (int(width), int(height)), (v["cx"] - 0.5, v["cy"] - 0.5)
    cameras[key] = frame_camera(OpenCVForm(size=size, focal=focal, point=point, fisheye=fisheye, k=k, p=p), where)


def _rigid(values: Iterable[float], where: str) -> _Rigid:
    """A pose of QW, QX, QY, QZ, TX, TY, TZ."""
    numbers_ = np.array(list(values), float)
    length = float(np.linalg.norm(numbers_[:4]))
    if not 0.99 < length < 1.01:
        raise InputError(f"{where}: the quaternion has the length {length:.3g}, not 1")
    return _Rigid(Rotation.from_quat(np.roll(numbers_[:4], -1)).as_matrix(), numbers_[4:])


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    for number, line in enumerate(read_text(path, _COLMAP_BYTES).split("\n"), 1):
        if line.strip() and not line.startswith("#"):
            yield number, line


def _read_model(folder: Path, suffix: str) -> _Model:
    """All files of one form; rigs and frames only where both are there."""
    rigged = all((folder / f"{name}.{suffix}").is_file() for name in ("rigs", "frames"))
    faults: dict[str, UnusableCamera] = {}
    model = _Model(read_colmap_cameras(folder / f"cameras.{suffix}", faults), faults=faults)
    if suffix == "bin":
        model.images = _Binary(folder / "images.bin").images()
        if rigged:
            model.rigs = _Binary(folder / "rigs.bin").rigs()
            model.frames = _Binary(folder / "frames.bin").frames()
    else:
        _text_images(folder / "images.txt", model)
        if rigged:
            _text_rigs(folder, model)
    return model


def _text_images(path: Path, model: _Model) -> None:
    """Every image; the line of its points, which may be empty, is passed over."""
    lines = enumerate(read_text(path, _COLMAP_BYTES).split("\n"), 1)
    for number, line in lines:
        if not line.strip() or line.startswith("#"):
            continue
        where = f"{path}:{number}"
        words = line.split(maxsplit=9)
        if len(words) != 10:
            raise InputError(
                f"{where}: {len(words)} columns; IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID and NAME are needed "
                "(a line with points follows every image, even if it is empty)"
            )
        name = words[9].strip()
        pose = _rigid(numbers(words[1:8], where, f"image {name!r}: pose", 7), f"{where}: image {name!r}")
        key = _whole(words[0], where)
        if key in model.images:
            raise InputError(f"{where}: image number {key} is given twice ({model.images[key][0]!r} and {name!r})")
        model.images[key] = (name, words[8], pose, number)
        _, points = next(lines, (0, ""))
        fields = points.split()
        if len(fields) % 3 or (fields and not re.fullmatch(r"-?\d+", fields[-1])):
            raise InputError(
                f"{path}:{number + 1}: {points[:40]!r} after image {name!r}; an empty line, or X, Y, POINT3D_ID of its "
                "points, must follow every image"
            )


def _text_rigs(folder: Path, model: _Model) -> None:
    for number, line in _lines(folder / "rigs.txt"):
        where = f"{folder / 'rigs.txt'}:{number}"
        words = _Words(line, where)
        sensors = model.rigs.setdefault(words.whole(), {})
        for k in range(words.whole()):
            kind, sensor = words.next(), words.whole()
            # The reference sensor is the rig itself and has no pose of its own.
            stated = k > 0 and words.whole() != 0
            pose = words.pose() if stated else None if k else _Rigid(np.eye(3), np.zeros(3))
            if kind == "CAMERA":
                sensors[sensor] = pose
    for number, line in _lines(folder / "frames.txt"):
        words = _Words(line, f"{folder / 'frames.txt'}:{number}")
        frame, rig, pose = words.whole(), words.whole(), words.pose()
        data = [(words.next(), words.whole(), words.whole()) for _ in range(words.whole())]
        model.frames[frame] = rig, pose, [(sensor, image) for kind, sensor, image in data if kind == "CAMERA"]


def _whole(word: str, where: str) -> int:
    number = whole_number(word)
    if number is None:
        raise InputError(f"{where}: {word[:40]!r} is not a whole number")
    return number


class _Words:
    """The words of one line, taken one after the other."""

    def __init__(self, line: str, where: str) -> None:
        self._words, self._where = iter(line.split()), where

    def next(self) -> str:
        """Return the next word."""
        word = next(self._words, None)
        if word is None:
            raise InputError(f"{self._where}: the line ends too early; export the model again")
        return word

    def whole(self) -> int:
        """Return the next word as a whole number."""
        return _whole(self.next(), self._where)

    def pose(self) -> _Rigid:
        """Return the next seven words as a pose."""
        return _rigid(numbers([self.next() for _ in range(7)], self._where, "pose", 7), self._where)


class _Binary:
    """A binary file, read from its beginning; every count is compared with what is left of the file."""

    def __init__(self, path: Path) -> None:
        self._path, self._at = path, 0
        try:
            if path.stat().st_size > _COLMAP_BYTES:
                raise InputError(f"{path}: more than {_COLMAP_BYTES} bytes; at most that many are read")
            self._data = path.read_bytes()
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None

    def _take(self, code: str) -> tuple[Any, ...]:
        end = self._at + struct.calcsize("<" + code)
        if end > len(self._data):
            raise InputError(f"{self._path}: ends after {len(self._data)} bytes, in the middle of an entry")
        values = struct.unpack_from("<" + code, self._data, self._at)
        self._at = end
        return values

    def _pose(self, what: str) -> _Rigid:
        where = f"{self._path}: {what}"
        return _rigid(finite(self._take("7d"), where, 7), where)

    def cameras(self, faults: dict[str, UnusableCamera] | None) -> dict[str, CameraEntry]:
        """Return the cameras of ``cameras.bin``; `faults` is as in `read_colmap_cameras`."""
        cameras: dict[str, CameraEntry] = {}
        for _ in range(self._take("Q")[0]):
            key, number, width, height = self._take("IiQQ")
            where = f"{self._path}: camera {key}"
            model = _model_name(str(number), where)
            if max(width, height) > 1 << 31:
                raise InputError(f"{where}: {width} × {height} pixels; the file is damaged")
            values = finite(self._take(f"{len(_MODELS[model])}d"), where, len(_MODELS[model]))
            with _unusable(str(key), faults):
                _add_camera(cameras, str(key), model, (width, height, *values), where)
        return cameras

    def images(self) -> dict[int, tuple[str, str, _Rigid, int | None]]:
        """Return the images of ``images.bin``; their points are passed over."""
        images: dict[int, tuple[str, str, _Rigid, int | None]] = {}
        for _ in range(self._take("Q")[0]):
            (key,) = self._take("I")
            pose, (camera,) = self._pose(f"image {key}"), self._take("I")
            end = self._data.find(b"\0", self._at)
            name = self._data[self._at : max(end, self._at)].decode("utf-8", "replace")
            self._at = end + 1 if end >= 0 else len(self._data)
            (points,) = self._take("Q")
            if points > (len(self._data) - self._at) // 24:
                raise InputError(f"{self._path}: image {name[:200]!r} has {points} points, more than the file holds")
            self._at += 24 * points
            if key in images:
                raise InputError(f"{self._path}: image number {key} is given twice ({images[key][0]!r} and {name!r})")
            images[key] = (name, str(camera), pose, None)
        return images

    def rigs(self) -> dict[int, dict[int, _Rigid | None]]:
        """Return the rigs of ``rigs.bin``; sensors of type 0 are cameras."""
        rigs: dict[int, dict[int, _Rigid | None]] = {}
        for _ in range(self._take("Q")[0]):
            key, count = self._take("II")
            sensors = rigs.setdefault(key, {})
            for k in range(count):
                kind, sensor = self._take("iI")
                stated = k > 0 and self._take("B")[0] != 0
                pose = self._pose(f"rig {key}") if stated else None if k else _Rigid(np.eye(3), np.zeros(3))
                if kind == 0:
                    sensors[sensor] = pose
        return rigs

    def frames(self) -> dict[int, tuple[int, _Rigid, list[tuple[int, int]]]]:
        """Return the frames of ``frames.bin``."""
        frames = {}
        for _ in range(self._take("Q")[0]):
            key, rig = self._take("II")
            pose, (count,) = self._pose(f"frame {key}"), self._take("I")
            data = [self._take("iIQ") for _ in range(count)]
            frames[key] = rig, pose, [(sensor, image) for kind, sensor, image in data if kind == 0]
        return frames


def _render_colmap(block: OrientationBlock, path: Path) -> dict[Path, str]:
    require_cameras(block, path, "a COLMAP model")
    cameras = ["# Camera list with one line of data per camera:", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    numbers = {name: str(k + 1) for k, name in enumerate(block.cameras)}
    for name, camera in block.cameras.items():
        cameras.append(f"{numbers[name]} {_camera_line(name, camera, path)}")
    images = [
        "# Image list with two lines of data per image:",
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
        "#   POINTS2D[] as (X, Y, POINT3D_ID)",
    ]
    for k, (image, R) in enumerate(zip(block.table.images, block.table.rotations), 1):
        R_camera_world: Floats = FLIP @ R.T
        q = np.roll(Rotation.from_matrix(R_camera_world).as_quat(), 1)
        t = -R_camera_world @ np.array(image.center)
        values = " ".join(repr(v) for v in (*q.tolist(), *t.tolist()))
        images += [f"{k} {values} {numbers[block.camera_name(image)]} {image.name}", ""]
    points = ["# 3D point list with one line of data per point:"]
    points.append("#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)")
    texts = {"cameras.txt": cameras, "images.txt": images, "points3D.txt": points}
    return {path / name: "\n".join([*lines, ""]) for name, lines in texts.items()}


def _camera_line(name: str, camera: CameraEntry, path: Path) -> str:
    form = opencv_form(camera)
    if form is None:
        raise InputError(f"{path}: camera {name!r} has no form in COLMAP; write without its lens, or another format")
    model = "OPENCV_FISHEYE" if form.fisheye else "FULL_OPENCV" if any(form.k[2:]) else "OPENCV"
    if not (form.fisheye or any(form.k) or any(form.p)):
        model = "PINHOLE"
    v = dict(zip(("fx", "fy"), form.focal)) | dict(zip(("cx", "cy"), (c + 0.5 for c in form.point)))
    v |= {f"k{i + 1}": value for i, value in enumerate(form.k)} | {"p1": form.p[0], "p2": form.p[1]}
    values = " ".join(repr(v[n]) for n in _MODELS[model])
    return f"{model} {form.size[0]} {form.size[1]} {values}"


def _losses_colmap(block: OrientationBlock) -> Iterable[Loss]:
    yield from opencv_losses(block)
    if block.table.crs is not None or block.table.origin is not None:
        yield Loss("crs", "no coordinate system: state it to whoever reads the model")
    if block.table.height_system is not None:
        yield Loss("height_system", f"no height system ({block.table.height_system})")
    if block.cameras:
        yield Loss("other", "no names of cameras: they are numbered")


def _sniff_colmap(path: Path, head: str) -> bool:
    if path.is_dir():
        return any(all((path / f"{n}.{s}").is_file() for n in ("images", "cameras")) for s in ("txt", "bin"))
    if path.suffix.lower() == ".bin":
        return path.name in _BINARY
    return "IMAGE_ID, QW, QX, QY, QZ" in head or "CAMERA_ID, MODEL, WIDTH, HEIGHT" in head


COLMAP = OrientationFormat(
    name="colmap",
    title="COLMAP model",
    sniff=_sniff_colmap,
    read=read_colmap,
    render=_render_colmap,
    losses=_losses_colmap,
    suffix="",
)
