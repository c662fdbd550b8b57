"""Objects as files have them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.crs import split_compound
from photoplan.surfaces.polygon_faces import Rings, filled


@dataclass(frozen=True, eq=False)
class ObjectFile:
    """Triangles of a file's objects, in its own coordinates."""

    corners: NDArray[np.float64]
    """X, Y, Z, shape (n, 3, 3), finite."""
    owner: NDArray[np.int32]
    """Object of each triangle, its place in `names`, shape (n,)."""
    names: tuple[str, ...]
    roles: tuple[str | None, ...]
    """``paint``, ``occluder``, or None where the file does not say, of each object."""
    crs: str | None
    """Horizontal CRS as stated; None: it is not."""
    height_system: str | None
    unit: float | None = None
    """Metres in the unit that a drawing states for all its coordinates; None: none is stated."""
    mesh: bool = False
    """Whether it is a mesh, which by itself only hides."""
    faults: Mapping[str, str] = field(default_factory=dict)
    """What is wrong with polygons that have no triangles for it, by name of the object."""


def from_polygons(
    where: str,
    polygons: list[Rings],
    objects: list[int],
    names: list[str],
    crs: str | None = None,
    roles: list[str | None] | None = None,
    unit: float | None = None,
) -> ObjectFile:
    """Objects of polygons."""
    corners, polygon, faults = filled(polygons, [names[k] for k in objects])
    if not len(corners) and not faults:
        raise InputError(f"{where}: holds no face of an object; give a file or a layer that does")
    horizontal, heights = (None, None) if crs is None else split_compound(crs, f"{where}: CRS")
    owner = np.array(objects, np.int32)[polygon]
    said = tuple(roles or [None] * len(names))
    return ObjectFile(
        corners=corners,
        owner=owner,
        names=tuple(names),
        roles=said,
        crs=horizontal,
        height_system=heights,
        unit=unit,
        faults=faults,
    )
