"""Settings of building a terrain model: grid, covariance function, filter values, gross errors."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from photoplan.errors import UsageError
from photoplan.surfaces.units import LINE_KINDS, POINT_KINDS

Family = Literal["gaussian", "matern", "exponential"]
FAMILIES: tuple[Family, ...] = get_args(Family)
"""Families of covariance functions; the place of each is its number in the kernels."""

#: Filter values of classes that are not given, as parts of that of mass points: lines and spots are measured with care.
SHARE = {"mass": 1.0, "spot": 0.25, "breakline": 0.25, "formline": 0.25, "border": 0.25, "hole": 0.25}


@dataclass(frozen=True)
class BuildSettings:
    """All that decides a model beside its data."""

    grid_width: float | None = None
    """Finest side of a mesh, metres; None: from the density of the points, and half of that beside breaklines."""
    unit_meshes: int = 64
    """Meshes of the finest width along the side of a computing unit; a power of two."""
    adapt: float | None = None
    """A unit's grid is widened while its surface stays within this, metres; 0: all units have the finest width;
    None: a quarter of the unit's mean standard deviation."""
    family: Family | Literal["auto"] = "auto"
    """Family of the covariance function; auto: the one that predicts the points best from each other."""
    filters: dict[str, float] = field(default_factory=dict)
    """Filter value (standard deviation of measurement, metres) by class of points or lines. Mass points that have none
    are estimated from the data, other classes take their share (`SHARE`) of it. Where all mass points have one, what
    the ground adds to it is estimated; zero stays zero."""
    gross: float = 5.0
    """Normalised residual beyond which a point is a gross error and left out; 0: none is sought."""
    reach: float | None = None
    """Gaps wider than twice this are not bridged, metres; None: ten times the spacing of the points."""

    def __post_init__(self) -> None:
        for name in ("grid_width", "reach"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise UsageError(f"{name.replace('_', ' ')} {value}; a positive number of metres is needed")
        if self.adapt is not None and not (np.isfinite(self.adapt) and self.adapt >= 0):
            raise UsageError(f"adapt {self.adapt}; a tolerance in metres, zero or more, is needed")
        if not 4 <= self.unit_meshes <= 1024 or self.unit_meshes & (self.unit_meshes - 1):
            raise UsageError(f"units of {self.unit_meshes} meshes; a power of two from 4 to 1024 is needed")
        if self.family != "auto" and self.family not in FAMILIES:
            raise UsageError(f"covariance family {self.family!r}; families are auto, {', '.join(FAMILIES)}")
        for kind, sigma in self.filters.items():
            if kind not in (*POINT_KINDS, *LINE_KINDS):
                raise UsageError(f"filter value for {kind!r}; classes are {', '.join((*POINT_KINDS, *LINE_KINDS))}")
            if not (np.isfinite(sigma) and sigma >= 0):
                raise UsageError(f"filter value {sigma} for {kind}; metres, zero or more, are needed")
        if not (np.isfinite(self.gross) and self.gross >= 0):
            raise UsageError(f"limit of gross errors {self.gross}; zero or more is needed")
