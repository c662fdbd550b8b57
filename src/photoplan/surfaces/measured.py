"""Terrain as it was measured: points and lines with the accuracy of each class, before anything is predicted."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from photoplan.codec import storable
from photoplan.errors import InputError

PointKind = Literal["mass", "spot"]
LineKind = Literal["breakline", "formline", "border", "hole"]
POINT_KINDS: tuple[PointKind, ...] = get_args(PointKind)
LINE_KINDS: tuple[LineKind, ...] = get_args(LineKind)


@storable
@dataclass(frozen=True, eq=False)
class PointGroup:
    """Points of one class that were measured in one way."""

    name: str
    """What users call the group: the file, or file and code."""
    kind: PointKind
    """Mass points describe the surface; spot heights are chosen points (tops, hollows) measured with more care."""
    xyz: NDArray[np.float64]
    """X, Y, Z, shape (n, 3), metres; finite."""
    records: NDArray[np.int64]
    """Number of the record (line of a text file, else feature or point number from 1) of each point, shape (n,)."""
    sigma: float | None = None
    """Standard deviation of the heights, metres (the filter value); None: that of its class."""
    names: NDArray[Any] | None = None
    """Names of the points as the file gives them, shape (n,), strings; None: they have none."""

    def __post_init__(self) -> None:
        _check_points(self.xyz, self.name)
        if self.kind not in POINT_KINDS:
            raise InputError(f"{self.name}: points of kind {self.kind!r}; kinds are {', '.join(POINT_KINDS)}")
        if len(self.records) != len(self.xyz) or (self.names is not None and len(self.names) != len(self.xyz)):
            raise InputError(f"{self.name}: {len(self.xyz)} points, but {len(self.records)} record numbers or names")
        _check_sigma(self.sigma, self.name)

    def label(self, index: int) -> str:
        """How a point is named in messages and lists."""
        own = f" {self.names[index]}" if self.names is not None else ""
        return f"{self.name}{own} (record {self.records[index]})"


@storable
@dataclass(frozen=True, eq=False)
class MeasuredLine:
    """One line: its vertices in order."""

    name: str
    """What users call the line: file and record, and its own name or code."""
    kind: LineKind
    """Breakline (slope jumps, or with `right` the height), form line (bends smoothly), border or hole (closed)."""
    xyz: NDArray[np.float64]
    """X, Y, Z, shape (n, 3), metres; at a two-sided breakline the height left of the line in its direction.
    Z may be NaN in borders and holes, which then only bound the model."""
    right: NDArray[np.float64] | None = None
    """Heights right of the line, shape (n,), metres: a wall. None: both sides share the height."""
    sigma: float | None = None
    """Standard deviation of the heights, metres (the filter value); None: that of its class."""
    code: str = ""
    """Code of the file, such as the survey code of a ditch's edge; empty if there is none."""

    def __post_init__(self) -> None:
        if self.kind not in LINE_KINDS:
            raise InputError(f"{self.name}: line of kind {self.kind!r}; kinds are {', '.join(LINE_KINDS)}")
        _check_points(self.xyz, self.name, heights=self.kind in ("breakline", "formline"))
        if len(self.xyz) < 2:
            raise InputError(f"{self.name}: a line of {len(self.xyz)} points; at least two are needed")
        if self.right is not None and (
            self.kind != "breakline" or self.right.shape != (len(self.xyz),) or not np.isfinite(self.right).all()
        ):
            raise InputError(f"{self.name}: right-hand heights belong to breaklines, one finite height for each vertex")
        _check_sigma(self.sigma, self.name)


@storable
@dataclass(frozen=True, eq=False)
class Tin:
    """Triangles that a file brings along; kept for comparison, never used as measurements."""

    xyz: NDArray[np.float64]
    """Vertices, shape (n, 3), metres."""
    faces: NDArray[np.int64]
    """Vertex numbers of each triangle, shape (m, 3)."""


@storable
@dataclass(frozen=True, eq=False)
class MeasuredTerrain:
    """All that was measured of one terrain, in one projected CRS and one height system."""

    points: tuple[PointGroup, ...] = ()
    lines: tuple[MeasuredLine, ...] = ()
    crs: str | None = None
    """CRS as pyproj reads it; None: the files do not say."""
    height_system: str | None = None
    """Vertical CRS or its name as the file gives it; None: the files do not say."""
    tin: Tin | None = None
    """The file's own triangulation, if it has one."""
    files: tuple[Path, ...] = ()
    notes: tuple[str, ...] = field(default=())
    """What was noticed while reading and repaired or left out, one line each."""
    codes: frozenset[str] = frozenset()
    """All codes and names of layers that the files hold."""
    unit: float | None = None
    """Metres in the unit of X, Y and, without `height_unit`, Z that the file states apart from its CRS; None: none."""
    height_unit: float | None = None
    """Metres in the unit of Z that the file states apart from its height system; None: none."""
    fields: tuple[str, ...] = ()
    """What the columns, attributes or layers of the files are called, file by file, for messages."""

    @property
    def count(self) -> int:
        """Number of points, vertices of lines not included."""
        return sum(len(group.xyz) for group in self.points)


def _check_points(xyz: NDArray[np.float64], name: str, heights: bool = True) -> None:
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise InputError(f"{name}: points of shape {xyz.shape}; X, Y, Z in three columns are needed")
    if not np.isfinite(xyz if heights else xyz[:, :2]).all():
        raise InputError(f"{name}: a coordinate is not finite")


def _check_sigma(sigma: float | None, name: str) -> None:
    if sigma is not None and not (np.isfinite(sigma) and sigma >= 0):
        raise InputError(f"{name}: filter value {sigma}; a standard deviation in metres, zero or more, is needed")
