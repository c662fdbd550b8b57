"""Files of objects turned into faces on a project's terrain: in its CRS, its heights, and above its ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import HeightSystemError, InputError, named_by
from photoplan.geometry.bounds import MOST_HEIGHT
from photoplan.geometry.crs import CrsStep, crs_label, crs_step, require_projected_metres, same_crs
from photoplan.geometry.heights import OPTIONS, HeightStep, check_height_system, height_label, height_step
from photoplan.geometry.units import agreed_metres, metric_heights, metric_system
from photoplan.io.objects import ObjectFile, read_objects
from photoplan.io.project.model import Objects
from photoplan.surfaces.base import Terrain
from photoplan.surfaces.objects import Faces, ObjectSurface
from photoplan.surfaces.polygon_faces import cannot_be_used

#: Objects whose highest point is deeper than this below the ground, metres, are refused.
DEEP = 0.5
#: Objects that rise higher than this above the ground, metres, are refused: nothing that stands does.
TALL = 2000.0

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
    """Terrain with the objects of some files."""
    corners, paints, owners = [], [], []
    names: list[str] = []
    entries: list[int] = []
    steps: list[CrsStep | HeightStep] = []
    for entry, (path, stated) in enumerate(files):
        own = read_objects(path, stated.layer)
        if not len(own.corners):
            raise cannot_be_used(str(path), own.faults)
        placed, taken = _placed(path, own, stated, place)
        steps += taken
        roles = [stated.role or role or ("occluder" if own.mesh else "paint") for role in own.roles]
        faults = {**own.faults, **_misplaced(own, placed, ground)}
        if faults:
            raise cannot_be_used(str(path), faults)
        corners.append(placed)
        paints.append(np.array([role == "paint" for role in roles])[own.owner])
        owners.append(own.owner + len(names))
        names += own.names
        entries += [entry] * len(own.names)
    faces = Faces(np.concatenate(corners), np.concatenate(paints), np.concatenate(owners), tuple(names))
    return ObjectSurface(ground, faces, entries=tuple(entries)), tuple(steps)


def _placed(path: Path, own: ObjectFile, stated: Objects, place: Place) -> tuple[NDArray[np.float64], Steps]:
    """Corners in the project's CRS and heights."""
    crs = own.crs or stated.crs
    if crs is None:
        raise InputError(
            f'{path}: no CRS (`crs` states it); state it as crs = "EPSG:nnnn" in [[objects]], it is not guessed'
        )
    if own.crs is not None and stated.crs is not None and not same_crs(own.crs, stated.crs):
        raise InputError(f"{path}: is in {crs_label(own.crs)}; [[objects]] states {crs_label(stated.crs)}: remove that")
    pair = own.height_system, stated.height_system
    if None not in pair and "same" not in pair:
        metric_pair = [metric_heights(check_height_system(name or "", str(path)))[0] for name in pair]
        if metric_pair[0] != metric_pair[1]:
            given = [height_label(name) for name in pair]
            raise HeightSystemError(f"{path}: states heights {given[0]}; [[objects]] states {given[1]}: remove that")
    system = own.height_system or stated.height_system
    if system is None:
        raise HeightSystemError(
            f"{path}: no height system stated (`height_system` states it) → height_system = … in [[objects]]; "
            f"allowed are {OPTIONS}"
        )
    system = check_height_system(system, str(path))
    # The height system of the file and its CRS decide the unit, a declared system where the file states none.
    metric = metric_system(crs, f"{path}: CRS").declaring(system, str(path))
    if own.unit is not None:
        metric = replace(
            metric,
            scale=agreed_metres(own.unit, metric.scale, f"{path}: X and Y", in_one_file=False),
            height_scale=agreed_metres(own.unit, metric.height_scale, f"{path}: heights", in_one_file=False),
        )
    corners = metric.to_metres(own.corners, f"{path}: heights")
    corners = corners + (stated.offset or (0.0, 0.0, 0.0))
    crs, system = metric.crs, metric.heights or system
    steps: list[CrsStep | HeightStep] = []
    if not same_crs(crs, place.crs):
        require_projected_metres(crs, f"{path}: CRS")
        low, high = corners[..., :2].min(axis=(0, 1)), corners[..., :2].max(axis=(0, 1))
        with named_by(path):
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


def _misplaced(own: ObjectFile, corners: NDArray[np.float64], ground: Terrain) -> dict[str, str]:
    """Objects below the ground as a whole or far above it, by name; beyond the terrain only their own heights tell."""
    over = np.full(len(own.names), -np.inf)
    below = ground.heights(corners[..., :2])
    owner, above = np.repeat(own.owner, 3), (corners[..., 2] - np.nan_to_num(below)).ravel()
    np.maximum.at(over, owner, above)
    known = np.bincount(owner, np.isnan(below).ravel(), len(over)) == 0
    there = np.bincount(own.owner, minlength=len(over)) > 0
    faults = {
        own.names[k]: f"lies below the ground, by {-over[k]:.1f} m; are height system and offset right?"
        for k in np.flatnonzero(there & known & (over < -DEEP))
    }
    for k in np.flatnonzero(there & (over > np.where(known, TALL, MOST_HEIGHT))):
        above_what = "the ground" if known[k] else "zero"
        faults[own.names[k]] = f"rises to {over[k]:.6g} m above {above_what}; are its heights in metres?"
    return faults
