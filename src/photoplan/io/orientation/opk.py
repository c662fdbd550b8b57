"""Agisoft Metashape's "Omega Phi Kappa" text: positions, angles and their matrix.

One line per image, ``# PhotoID, X, Y, Z, Omega, Phi, Kappa, r11, …, r33``, separated by tabs or commas; a line
``# CoordinateSystem: WKT`` above states the CRS (Metashape User Manual, Professional Edition, "Exporting results",
camera orientation). Angles are degrees, ω the primary rotation. Which way the matrix turns has changed between
versions, so the angles are read, and the matrix must be theirs: as it is, transposed, or with axes y down and z
forwards.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.crs import parse_crs, split_compound
from photoplan.geometry.local import enu_poses, is_local_crs, is_wgs84_geographic, legacy_wkt
from photoplan.geometry.pose import rotation_opk
from photoplan.geometry.units import metric_system
from photoplan.io.files import read_text
from photoplan.io.orientation.block import Loss, OrientationBlock, OrientationFormat, common_losses
from photoplan.io.orientation.form import TableFormat
from photoplan.io.orientation.table import FLIP, OrientationTable, OrientedImage, posed
from photoplan.io.orientation.text import numbers

MAX_BYTES = 256 << 20
_HEADER = re.compile(r"#\s*PhotoID\W+X\W+Y\W+Z\W+Omega\W+Phi\W+Kappa", re.I)
_SYSTEM = re.compile(r"#\s*CoordinateSystem\s*:?\s*(\S.*)", re.I)
#: Largest difference of an angle's matrix and the printed one: angles are printed with six digits and more.
_TOLERANCE = 1e-5


def read(path: Path, form: TableFormat) -> OrientationBlock:
    """Oriented images of an OPK text; `form` is not used: the format states angle unit and order."""
    images: list[OrientedImage] = []
    crs: str | None = None
    notes: list[str] = []
    for number, line in enumerate(read_text(path, MAX_BYTES).split("\n"), 1):
        system = _SYSTEM.match(line)
        if system:
            crs, local = _system(system[1], f"{path}:{number}")
            notes += [f"{path.name}: coordinates are in a local system"] if local else []
        if line.strip() and not line.lstrip().startswith("#"):
            images.append(_image(line, number, path))
    height_system = None
    if crs is not None:
        metric = metric_system(crs, f"{path}: CoordinateSystem")
        crs, height_system = split_compound(crs)
        if crs is not None and is_wgs84_geographic(crs, f"{path}: CoordinateSystem"):
            rise = metric.height_scale or 1.0
            images = [replace(i, center=(*i.center[:2], i.center[2] * rise)) for i in images]
            return OrientationBlock(_in_tangential_system(OrientationTable(path, tuple(images), notes=tuple(notes))))
    return OrientationBlock(
        OrientationTable(
            path,
            tuple(images),
            crs=crs,
            height_system=height_system,
            true_metres=crs is not None,
            notes=tuple(notes),
        )
    )


def _in_tangential_system(table: OrientationTable) -> OrientationTable:
    """Positions in longitude, latitude and height, angles to east, north and up at each of them, in one system."""
    lon, lat, height = table.centers.T
    if (np.abs(lat) > 90).any():
        raise InputError(f"{table.file}: latitude {lat[np.abs(lat) > 90][0]}; X is longitude and Y latitude, degrees")
    origin, enu, axes = enu_poses(np.column_stack([lat, lon, height]))
    images = tuple(
        posed(image.name, at, R, line=image.line) for image, at, R in zip(table.images, enu, axes @ table.rotations)
    )
    return replace(table, images=images, origin=origin)


def _system(text: str, where: str) -> tuple[str | None, bool]:
    """CRS of a header line, and whether it is a local one."""
    if is_local_crs(text, where):
        return None, True
    parse_crs(text, where)
    return text, False


def _image(line: str, number: int, path: Path) -> OrientedImage:
    where = f"{path}:{number}"
    if "\t" in line:
        fields = line.split("\t")
    else:
        fields = line.split(",") if "," in line else line.split()
    fields = [f.strip() for f in fields if f.strip()]
    if len(fields) not in (7, 16):
        raise InputError(f"{where}: {len(fields)} columns; 7 (PhotoID, X, Y, Z, Omega, Phi, Kappa) or 16 are needed")
    X, Y, Z, omega, phi, kappa, *matrix = numbers(fields[1:], where, f"image {fields[0]!r}: column", len(fields) - 1)
    if matrix:
        _check_matrix(np.array(matrix).reshape(3, 3), rotation_opk(*np.radians([omega, phi, kappa])), fields[0], where)
    return OrientedImage(name=fields[0], center=(X, Y, Z), angles=(omega, phi, kappa), camera=None, line=number)


def _check_matrix(given: NDArray[np.float64], R: NDArray[np.float64], name: str, where: str) -> None:
    readings = (R, R.T, R @ FLIP, (R @ FLIP).T)
    worst = min(float(np.abs(given - candidate).max()) for candidate in readings)
    if worst > _TOLERANCE:
        raise InputError(
            f"{where}: image {name!r}: the matrix r11 … r33 is not that of ω, φ, κ in degrees (nearest reading "
            f"differs by {worst:.2g}); the file states other angles (yaw, pitch, roll?): export Omega Phi Kappa"
        )


def _render(block: OrientationBlock, path: Path) -> dict[Path, str]:
    table = block.table
    lines = []
    if table.crs is not None:
        lines.append(f"# CoordinateSystem: {legacy_wkt(table.crs)}")
    lines.append(f"# Cameras ({len(table.images)})")
    lines.append("# PhotoID, X, Y, Z, Omega, Phi, Kappa, r11, r12, r13, r21, r22, r23, r31, r32, r33")
    for image, angles, R in zip(table.images, block.angles("opk", "deg").tolist(), table.rotations):
        if "\t" in image.name or "\n" in image.name:
            raise InputError(f"{path}: image {image.name!r} holds a tab or a line end; rename it")
        lines.append("\t".join([image.name, *(repr(v) for v in (*image.center, *angles, *R.ravel().tolist()))]))
    return {path: "\n".join([*lines, ""])}


def _losses(block: OrientationBlock) -> Iterable[Loss]:
    yield from common_losses(block, cameras=False, crs=True)


def _sniff(path: Path, head: str) -> bool:
    return any(_HEADER.match(line.strip()) for line in head.split("\n")[:10])


FORMAT = OrientationFormat(
    name="opk", title="Metashape Omega Phi Kappa text", sniff=_sniff, read=read, render=_render, losses=_losses
)
