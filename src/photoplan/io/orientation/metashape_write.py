"""Agisoft Metashape's ``cameras.xml`` written (version 2.0.0); see `photoplan.io.orientation.metashape`.

Camera transforms are written in a local system (east, north, up about the middle of the block), which the component's
transform places on the earth; a block without CRS is written in its own coordinates, as a local system.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import InputError
from photoplan.geometry.earth_poses import (
    enu_axes,
    geocentric_of_geodetic,
    geocentric_poses,
    geodetic_of_geocentric,
    legacy_wkt,
)
from photoplan.io.camera.model import CameraEntry
from photoplan.io.lens_forms import agisoft_form
from photoplan.io.orientation.block import Loss, OrientationBlock, height_losses, require_cameras
from photoplan.io.orientation.table import FLIP

_LOCAL = 'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1,AUTHORITY["EPSG","9001"]]]'

_Floats = NDArray[np.float64]


def losses(block: OrientationBlock) -> Iterable[Loss]:
    """What of a block the format cannot hold."""
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
        lines += _sensor(name, sensors[name], camera, path)
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
            f'      <camera id="{k}" sensor_id="{sensor}" component_id="0" label={quoteattr(image.name)}>',
            f"        <transform>{_text(M)}</transform>",
            "      </camera>",
        ]
    lines += ["    </cameras>", f"    <reference>{escape(wkt)}</reference>", "  </chunk>", "</document>", ""]
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


def _sensor(name: str, key: str, camera: CameraEntry, path: Path) -> list[str]:
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
        f'      <sensor id="{key}" label={quoteattr(name)} type="{kind}">',
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
