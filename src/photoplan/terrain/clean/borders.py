"""Border lines and holes: closed, checked, and turned into the area that the model covers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.errors import GeometryError
from photoplan.surfaces.measured import MeasuredLine, MeasuredTerrain

CHUNK = 1_000_000
"""Points that are compared with the area at once."""


@dataclass(frozen=True)
class Finding:
    """Something that was noticed in measured terrain, and what was done about it."""

    kind: str
    """What it is, in one or two words: the same for findings of one sort."""
    text: str
    """A sentence for people: names, heights, place and remedy."""
    X: float = float("nan")
    """Where it is, metres; NaN where it has no single place."""
    Y: float = float("nan")
    names: tuple[str, ...] = ()
    """Points and lines concerned."""


def closed(lines: Sequence[MeasuredLine]) -> tuple[list[MeasuredLine], list[Finding]]:
    """The lines, with border lines and holes closed: their first vertex is their last.

    A gap is closed if it is not longer than the longest side of the line (the file left the repeated vertex out).
    """
    out, found = [], []
    for line in lines:
        if line.kind not in ("border", "hole"):
            out.append(line)
            continue
        steps = np.hypot(*np.diff(line.xyz[:, :2], axis=0).T)
        gap = float(np.hypot(*(line.xyz[0, :2] - line.xyz[-1, :2])))
        X, Y = line.xyz[-1, :2].tolist()
        if gap > 0 and (len(line.xyz) < 3 or gap > steps.max()):
            raise GeometryError(
                f"{line.name}: the {_word(line)} is not closed: {gap:.3f} m from its last vertex X {X:.3f}, Y {Y:.3f} "
                f"to its first, its longest side has {steps.max():.3f} m; close it, or give it another class"
            )
        if gap > 0:
            found.append(
                Finding(
                    kind="unclosed border",
                    text=f"{line.name}: a gap of {gap:.3f} m closed",
                    X=X,
                    Y=Y,
                    names=(line.name,),
                )
            )
            line = replace(line, xyz=np.concatenate([line.xyz, line.xyz[:1]]))
        out.append(line)
    return out, found


def _word(line: MeasuredLine) -> str:
    return "border line" if line.kind == "border" else "hole"


def unfit_rings(lines: Sequence[MeasuredLine]) -> tuple[list[MeasuredLine], list[Finding]]:
    """The lines without rings that enclose nothing; self-crossing rings are reported, and kept."""
    out, found = [], []
    for line in lines:
        if line.kind in ("border", "hole"):
            X, Y = line.xyz[0, :2].tolist()
            ring = _polygon(line)
            if ring is None or shapely.make_valid(ring).area == 0:
                text = f"{line.name}: the {_word(line)} encloses no area; left out"
                found.append(Finding(kind="empty border", text=text, X=X, Y=Y, names=(line.name,)))
                continue
            if not shapely.is_valid(ring):
                reason = shapely.is_valid_reason(ring)
                place = reason[reason.find("[") + 1 : -1].split() if "[" in reason else []
                X, Y = (float(place[0]), float(place[1])) if len(place) == 2 else (X, Y)
                text = (
                    f"{line.name}: the {_word(line)} crosses or touches itself at X {X:.3f}, Y {Y:.3f}; "
                    "taken is what it encloses an odd number of times"
                )
                found.append(Finding(kind="self-crossing border", text=text, X=X, Y=Y, names=(line.name,)))
        out.append(line)
    return out, found


def domain_of(measured: MeasuredTerrain) -> Any | None:
    """The area that border lines enclose, without holes: a valid shapely polygon or multipolygon.

    Rings are taken from the largest to the smallest, a border line adds its area, a hole takes it away; so a border
    line inside a hole is an island. Self-crossing rings count where they enclose a point an odd number of times.
    With holes alone, everything around the data and outside of the holes is the area.
    """
    rings = [(line.kind, _polygon(line)) for line in measured.lines if line.kind in ("border", "hole")]
    valid = [(kind, _areas(shapely.make_valid(ring))) for kind, ring in rings if ring is not None]
    if not valid:
        return None
    valid.sort(key=lambda item: -item[1].area)
    area = shapely.Polygon()
    if all(kind == "hole" for kind, _ in valid):
        west, south, east, north = _bounds(measured)
        reach = max(east - west, north - south, 1.0)
        area = shapely.box(west - reach, south - reach, east + reach, north + reach)
    for kind, run in groupby(valid, key=lambda item: item[0]):
        together = shapely.union_all([ring for _, ring in run])
        area = shapely.union(area, together) if kind == "border" else shapely.difference(area, together)
    return _areas(shapely.make_valid(area))


def _polygon(line: MeasuredLine) -> Any | None:
    xy = line.xyz[:, :2]
    if len(np.unique(xy, axis=0)) < 3:
        return None
    return shapely.Polygon(xy if (xy[0] == xy[-1]).all() else np.concatenate([xy, xy[:1]]))


def _areas(shape: Any) -> Any:
    """The polygons of a geometry."""
    parts = [p for p in shapely.get_parts(shapely.get_parts(shape)) if shapely.get_type_id(p) == 3 and p.area > 0]
    return parts[0] if len(parts) == 1 else shapely.MultiPolygon(parts)


def _bounds(measured: MeasuredTerrain) -> tuple[float, float, float, float]:
    every = [g.xyz[:, :2] for g in measured.points if len(g.xyz)] + [line.xyz[:, :2] for line in measured.lines]
    low = np.min([xy.min(axis=0) for xy in every], axis=0)
    high = np.max([xy.max(axis=0) for xy in every], axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def outside(measured: MeasuredTerrain, domain: Any, tolerance: float) -> list[Finding]:
    """Points, lines and holes that lie outside of the area; points and lines are counted, holes named."""
    found = []
    borders = replace(measured, lines=tuple(line for line in measured.lines if line.kind == "border"))
    covered = domain_of(borders) if borders.lines else domain
    shapely.prepare(domain)
    for group in measured.points:
        out = _outside(group.xyz[:, :2], domain, tolerance)
        if out.any():
            at = int(np.flatnonzero(out)[0])
            X, Y = group.xyz[at, :2].tolist()
            text = (
                f"{group.name}: {int(out.sum())} of {len(out)} points lie outside the border lines or in holes, the "
                f"first is {group.label(at)} at X {X:.3f}, Y {Y:.3f}; nothing is predicted there"
            )
            found.append(Finding(kind="points outside", text=text, X=X, Y=Y, names=(group.name,)))
    for line in measured.lines:
        if line.kind == "border":
            continue
        if line.kind == "hole":
            ring = _polygon(line)
            if ring is None or shapely.intersection(shapely.make_valid(ring), covered).area > 0:
                continue
            X, Y = line.xyz[0, :2].tolist()
            text = f"{line.name}: the hole at X {X:.3f}, Y {Y:.3f} lies outside the border lines; it has no effect"
            found.append(Finding(kind="hole outside", text=text, X=X, Y=Y, names=(line.name,)))
            continue
        out = _outside(line.xyz[:, :2], domain, tolerance)
        if out.any():
            X, Y = line.xyz[np.flatnonzero(out)[0], :2].tolist()
            text = (
                f"{line.name}: {int(out.sum())} of {len(out)} vertices lie outside the border lines or in holes, the "
                f"first at X {X:.3f}, Y {Y:.3f}; nothing is predicted there"
            )
            found.append(Finding(kind="line outside", text=text, X=X, Y=Y, names=(line.name,)))
    return found


def _outside(xy: NDArray[np.float64], domain: Any, tolerance: float) -> NDArray[np.bool_]:
    """Which points are farther from the area than the tolerance."""
    out = np.zeros(len(xy), bool)
    for at in range(0, len(xy), CHUNK):
        part = slice(at, at + CHUNK)
        out[part] = ~shapely.contains_xy(domain, xy[part, 0], xy[part, 1])
    far = np.flatnonzero(out)
    if len(far):
        near = shapely.dwithin(domain, shapely.points(xy[far]), tolerance)
        out[far[near]] = False
    return out
