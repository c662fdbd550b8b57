"""OpenDroneMap's ``shots.geojson`` (in its folder ``odm_report``): one feature per image.

The geometry is the projection centre in longitude, latitude and height. ``translation`` is the projection centre in
the project's UTM zone, and ``rotation``, as in OpenSfM, a rotation vector that takes the axes of the map to those of
the camera (x right, y down, z forwards). ``focal`` is divided by the larger side of the image; the lens is not in this
file but in ``cameras.json`` of the project, which is read if it lies beside the file or in the folder above.

The file does not name the UTM zone. It is the one in which the two positions that it states of every image agree.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from photoplan.errors import InputError
from photoplan.geometry.crs import canonical_crs, crs_label, crs_step, utm_codes
from photoplan.io.camera import opensfm as camera_opensfm
from photoplan.io.camera.model import CameraEntry
from photoplan.io.files import finite, read_json
from photoplan.io.lens_forms import opencv_form
from photoplan.io.orientation.block import Loss, OrientationBlock, OrientationFormat, common_losses
from photoplan.io.orientation.form import TableFormat
from photoplan.io.orientation.table import FLIP, OrientationTable, OrientedImage, posed

#: Longest distance of the two positions of an image, metres; the same numbers differ by rounding only.
_AGREE = 0.05


def read(path: Path, form: TableFormat) -> OrientationBlock:
    """Oriented images of a ``shots.geojson``, with the cameras of ``cameras.json``; `form` is not used."""
    contents = read_json(path)
    features = contents.get("features") if isinstance(contents, dict) else None
    if not isinstance(features, list) or not features:
        raise InputError(f"{path}: not a shots.geojson of OpenDroneMap (a FeatureCollection with features)")
    shots = [_shot(feature, k, path) for k, feature in enumerate(features)]
    crs, notes = _utm_zone(np.array([s[2] for s in shots]), np.array([s[1].center for s in shots]), path)
    cameras, file = _cameras_beside(path, [s[1] for s in shots])
    if cameras:
        notes.append(f"{path.name}: cameras from {file}")
    else:
        notes.append(f"{path.name}: states focal lengths but no lens; the project's cameras.json describes the cameras")
    table = OrientationTable(path, tuple(s[1] for s in shots), crs=crs, true_metres=True, notes=tuple(notes))
    return OrientationBlock(table, cameras, sizes={s[1].name: s[0] for s in shots} if not cameras else {})


def _shot(feature: Any, k: int, path: Path) -> tuple[tuple[int, int], OrientedImage, tuple[float, float, float]]:
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


def _utm_zone(lonlat: NDArray[np.float64], XYZ: NDArray[np.float64], path: Path) -> tuple[str | None, list[str]]:
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
            cameras = camera_opensfm.read(file)
            named = {i.camera for i in images}
            known = named <= set(cameras) or (named == {None} and len(cameras) == 1)
            return (cameras, file) if known else ({}, None)
    return {}, None


def _render(block: OrientationBlock, path: Path) -> dict[Path, str]:
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


def _losses(block: OrientationBlock) -> Iterable[Loss]:
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


def _sniff(path: Path, head: str) -> bool:
    return '"FeatureCollection"' in head and '"translation"' in head and '"rotation"' in head


FORMAT = OrientationFormat(
    name="odm",
    title="OpenDroneMap shots.geojson",
    sniff=_sniff,
    read=read,
    render=_render,
    losses=_losses,
    suffix=".geojson",
)
