"""Files of objects become faces on a project's terrain: in its CRS, its heights, and above its ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import HeightSystemError, InputError
from photoplan.geometry.crs import CrsStep, crs_label, crs_step, require_projected_metres, same_crs
from photoplan.geometry.heights import OPTIONS, HeightStep, check_height_system, height_step
from photoplan.io.objects.file import read_objects
from photoplan.io.objects.model import ObjectFile
from photoplan.io.project.model import Objects
from photoplan.surfaces.base import Terrain
from photoplan.surfaces.faces import Faces
from photoplan.surfaces.objects import ObjectSurface

#: Objects whose highest point is deeper than this below the ground, metres, are refused.
DEEP = 0.5
#: Objects that are named in a message.
_NAMED = 5

Steps = tuple[CrsStep | HeightStep, ...]


@dataclass(frozen=True)
class Place:
    """What objects are brought to."""

    crs: str
    height_system: str
    """The one that surface and cameras are in."""
    terrain_system: str
    """Height system of the terrain file: what "same" means for objects."""
    bounds: tuple[float, float, float, float] | None
    """Outer edges of the terrain; None: everywhere."""


def with_objects(ground: Terrain, files: Sequence[tuple[Path, Objects]], place: Place) -> tuple[ObjectSurface, Steps]:
    """Terrain with the objects of some files.

    Parameters
    ----------
    ground : Terrain
    files : sequence of (path, entry)
    place : Place

    Returns
    -------
    surface : ObjectSurface
    steps : tuple
        Coordinate operations on the way, for the run record.

    Raises
    ------
    InputError
        A file cannot be used, its CRS is not known or none of its objects is near the terrain, or objects lie below the
        ground; they are named.
    HeightSystemError
        Their heights are not declared, or cannot be joined.
    """
    corners, paints, owners = [], [], []
    names: list[str] = []
    steps: list[CrsStep | HeightStep] = []
    for path, stated in files:
        own = read_objects(path, stated.layer)
        placed, taken = _placed(path, own, stated, place)
        steps += taken
        roles = [stated.role or role or ("occluder" if own.mesh else "paint") for role in own.roles]
        _refuse_buried(path, own, placed, ground, place)
        corners.append(placed)
        paints.append(np.array([role == "paint" for role in roles])[own.owner])
        owners.append(own.owner + len(names))
        names += own.names
    faces = Faces(np.concatenate(corners), np.concatenate(paints), np.concatenate(owners), tuple(names))
    return ObjectSurface(ground, faces), tuple(steps)


def _placed(path: Path, own: ObjectFile, stated: Objects, place: Place) -> tuple[NDArray[np.float64], Steps]:
    """Corners in the project's CRS and heights."""
    corners = own.corners + (stated.offset or (0.0, 0.0, 0.0))
    crs = own.crs or stated.crs
    if crs is None:
        raise InputError(f'{path}: no CRS; state it as crs = "EPSG:nnnn" in [[objects]], it is not guessed')
    if own.crs is not None and stated.crs is not None and not same_crs(own.crs, stated.crs):
        raise InputError(f"{path}: is in {crs_label(own.crs)}; [[objects]] states {crs_label(stated.crs)}: remove that")
    system = own.height_system or stated.height_system
    if system is None:
        raise HeightSystemError(
            f"{path}: no height system stated → height_system = … in [[objects]]; allowed are {OPTIONS}"
        )
    system = check_height_system(system, str(path))
    steps: list[CrsStep | HeightStep] = []
    if not same_crs(crs, place.crs):
        require_projected_metres(crs, f"{path}: CRS")
        low, high = corners[..., :2].min(axis=(0, 1)), corners[..., :2].max(axis=(0, 1))
        step = crs_step(crs, place.crs, (*low.tolist(), *high.tolist()))
        corners = np.concatenate([step(corners[..., :2]), corners[..., 2:]], axis=-1)
        steps.append(step)
    if not np.isfinite(corners).all():
        raise InputError(f"{path}: coordinates that {crs_label(crs)} does not reach; is the CRS right?")
    _refuse_apart(path, corners, place)
    rise = height_step(
        place.terrain_system if system == "same" else system, place.height_system, place.crs, place.bounds
    )
    if rise.definition is not None:
        corners = np.concatenate([corners[..., :2], rise(corners)[..., None]], axis=-1)
        steps.append(rise)
    return corners, tuple(steps)


def _refuse_apart(path: Path, corners: NDArray[np.float64], place: Place) -> None:
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    b = place.bounds
    if b is not None and not (low[0] < b[2] and b[0] < high[0] and low[1] < b[3] and b[1] < high[1]):
        told = " ".join(f"{v:.10g}" for v in (low[0], low[1], high[0], high[1]))
        raise InputError(
            f"{path}: objects in {told} do not meet the terrain in {' '.join(f'{v:.10g}' for v in b)}; check CRS and "
            "offset"
        )


def _refuse_buried(path: Path, own: ObjectFile, corners: NDArray[np.float64], ground: Terrain, place: Place) -> None:
    """Refuse objects that lie below the ground as a whole; beyond the terrain nothing is known."""
    over = np.full(len(own.names), -np.inf)
    above = corners[..., 2] - ground.heights(corners[..., :2])
    np.maximum.at(over, np.repeat(own.owner, 3), np.where(np.isfinite(above), above, np.inf).ravel())
    buried = np.flatnonzero(over < -DEEP)
    if len(buried):
        told = ", ".join(f"{own.names[k]!r} by {-over[k]:.1f} m" for k in buried[:_NAMED])
        more = f" and {len(buried) - _NAMED} more" if len(buried) > _NAMED else ""
        raise InputError(
            f"{path}: {len(buried)} of {len(own.names)} objects lie below the ground: {told}{more}; check height "
            "system and offset, or remove them"
        )
