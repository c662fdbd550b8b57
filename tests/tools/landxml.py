"""Small LandXML surfaces: points and breaklines, coordinates in the order N, E, Z."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["write_landxml"]


def write_landxml(
    path: Path, points: ArrayLike, lines: Mapping[str, ArrayLike] | None = None, crs: str | None = "32633"
) -> Path:
    """A surface of points X, Y, Z and named breaklines; `crs` is an EPSG number, None: not stated."""

    def triples(xyz: ArrayLike) -> str:
        return " ".join(f"{y:.6f} {x:.6f} {z:.6f}" for x, y, z in np.asarray(xyz, float))

    system = f'<CoordinateSystem epsgCode="{crs}"/>' if crs else ""
    breaks = "".join(
        f'<Breakline brkType="standard" name="{name}"><PntList3D>{triples(xyz)}</PntList3D></Breakline>'
        for name, xyz in (lines or {}).items()
    )
    path.write_text(
        '<?xml version="1.0"?><LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2" version="1.2">'
        f'<Units><Metric linearUnit="meter"/></Units>{system}<Surfaces><Surface name="ground"><SourceData>'
        f'<DataPoints name="mass"><PntList3D>{triples(points)}</PntList3D></DataPoints>'
        f"<Breaklines>{breaks}</Breaklines></SourceData></Surface></Surfaces></LandXML>"
    )
    return path
