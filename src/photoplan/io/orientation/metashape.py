"""Agisoft Metashape's ``cameras.xml``: cameras and poses (File, Export, Export Cameras), read and written.

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
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element, tostring

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
from photoplan.io.camera.opencv import AgisoftForm, agisoft_form, frame_camera
from photoplan.io.files import finite, numbers, read_xml
from photoplan.io.orientation.block import (
    Loss,
    OrientationBlock,
    OrientationFormat,
    OrientationTable,
    height_losses,
    posed,
    require_cameras,
)
from photoplan.io.orientation.form import TableFormat
from photoplan.io.orientation.text import checked_rotation
from photoplan.plain import xml_quoted, xml_text

MAX_BYTES = 256 << 20
_COEFFICIENTS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")

_Floats = NDArray[np.float64]
#: How far a printed matrix times itself may be from the unit matrix.
_ROUNDED = 2e-5


@dataclass(frozen=True, eq=False)
class _Similarity:
    """From the chunk's own system to the world: X = scale · R x + t."""

    R: _Floats = field(default_factory=lambda: np.eye(3))
    t: _Floats = field(default_factory=lambda: np.zeros(3))
    scale: float = 1.0


def read(path: Path, form: TableFormat) -> OrientationBlock:
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


def read_cameras(path: Path) -> dict[str, CameraEntry]:
    """The cameras alone: sensors with a calibration, by label."""
    chunk = _chunk(path)
    found = {s.get("id", ""): s for s in chunk.findall("./sensors/sensor") if s.find("calibration") is not None}
    return dict(_named(chunk, {key: _sensor(s, key, path) for key, s in found.items()}).values())


def _chunk(path: Path) -> Element:
    root = read_xml(path, MAX_BYTES)
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
    R = np.array(numbers(element.find("rotation"), f"{where}: rotation", 9)).reshape(3, 3)
    t = np.array(numbers(element.find("translation"), f"{where}: translation", 3))
    scale = numbers(element.find("scale"), f"{where}: scale", 1)[0] if element.find("scale") is not None else 1.0
    if scale <= 0:
        raise InputError(f"{where}: scale {scale}; a positive number is needed")
    return _Similarity(checked_rotation(R, where, _ROUNDED), t, scale)


def _pose_of(
    camera: Element, every: Mapping[str, Element], sensors: Mapping[str, Element], path: Path
) -> tuple[_Floats, _Floats] | None:
    """Rotation and centre in the chunk; None if neither the camera nor the master of its rig is aligned."""
    where = f"{path}: camera {camera.get('label')!r}"
    master = every.get(camera.get("master_id", ""))
    if camera.find("transform") is None and master is not None and master is not camera:
        sensor = sensors.get(camera.get("sensor_id", ""))
        if master.find("transform") is None or sensor is None or sensor.find("rotation") is None:
            return None
        R_master, t_master = _camera_pose(master, f"{path}: camera {master.get('label')!r}")
        where = f"{path}: sensor {sensor.get('label')!r}"
        R = np.array(numbers(sensor.find("rotation"), f"{where}: rotation", 9)).reshape(3, 3)
        stated = sensor.find("location")
        t = np.zeros(3) if stated is None else np.array(numbers(stated, f"{where}: location", 3))
        return R_master @ checked_rotation(R, where, _ROUNDED), R_master @ t + t_master
    return None if camera.find("transform") is None else _camera_pose(camera, where)


def _camera_pose(camera: Element, where: str) -> tuple[_Floats, _Floats]:
    M = np.array(numbers(camera.find("transform"), f"{where}: transform", 16)).reshape(4, 4)
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


def _geodetic(references: _Floats, chunk: Element, path: Path) -> _Floats | None:
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
    v = {c: numbers(calibration.find(c), f"{where}: {c}", 1)[0] for c in _COEFFICIENTS if _has(calibration, c)}
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

    centers: _Floats
    rotations: _Floats
    crs: str | None = None
    origin: tuple[float, float, float] | None = None
    notes: tuple[str, ...] = ()


def _place(chunk: Element, centers: _Floats, rotations: _Floats, georeferenced: bool, path: Path) -> _Placed:
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


def _sniff(path: Path, head: str) -> bool:
    return "<document" in head and "<chunk" in head and path.suffix.lower() == ".xml"


_LOCAL = 'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1,AUTHORITY["EPSG","9001"]]]'


def losses(block: OrientationBlock) -> Iterable[Loss]:
    """Return the properties of a block that the format cannot hold."""
    for name, camera in block.cameras.items():
        if camera.pixels is None:
            yield Loss("camera", f"no camera {name!r}: film has no pixels of its own")
        elif agisoft_form(camera) is None:
            yield Loss("lens", f"no lens of type {camera.lens.type} as camera {name!r} has it")
    yield from height_losses(block.table)


def render(block: OrientationBlock, path: Path) -> dict[Path, str]:
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


def _placed(block: OrientationBlock) -> tuple[_Floats, _Floats, str, _Floats, _Floats]:
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


FORMAT = OrientationFormat(
    name="metashape",
    title="Metashape cameras.xml",
    sniff=_sniff,
    read=read,
    render=render,
    losses=losses,
    suffix=".xml",
)
