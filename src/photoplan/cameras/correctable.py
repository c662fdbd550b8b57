"""Geometries that an adjustment may correct: what of them is unknown, and how image points follow it.

Satellite images come with polynomials, strips with a record of the flight: neither has a pose to be determined, both
are a little off. What they are off by is a set of parameters that is zero as delivered.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from photoplan.cameras.base import Camera

_Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Corrections:
    """A set of parameters that one image has, or several share."""

    key: str
    """By which images share it; messages call it so."""
    owners: tuple[str, ...]
    """What each row of the parameters belongs to: an image, moments of a flight."""
    parameters: tuple[str, ...]
    """How messages call them; {} stands for the owners: "row shift of {}"."""
    values: _Floats
    """Where an adjustment begins, (owners, parameters); zero is what was delivered."""
    known: sparse.csr_matrix
    """What is known beforehand: rows over the flattened values, each observed as zero with unit weight."""
    owner: str = ""
    """What an owner is: "image"."""


@dataclass(frozen=True, eq=False)
class ByCorrections:
    """Derivatives of image points by one set of parameters."""

    columns: NDArray[np.int64]
    """Which of the flattened values, (n, k)."""
    values: _Floats
    """∂(x, y) / ∂ these, (n, 2, k), pixels."""


class Correctable(Protocol):
    """The geometry of an image with its sets of parameters."""

    @property
    def corrections(self) -> tuple[Corrections, ...]:
        """The sets that it has, with what is known of them."""
        ...

    def camera(self, values: Mapping[str, _Floats]) -> Camera:
        """The camera with values (owners, parameters) of its sets, by their keys."""
        ...

    def seen(self, camera: Camera, XYZ: _Floats, xy: _Floats) -> _Floats:
        """Where `camera` sees ground points (n, 3) that were measured at `xy` (n, 2): (n, 2); NaN where it does not."""
        ...

    def by_ground(self, camera: Camera, XYZ: _Floats, xy: _Floats) -> _Floats:
        """Derivatives of that by the ground points, (n, 2, 3)."""
        ...

    def by_corrections(self, camera: Camera, XYZ: _Floats, xy: _Floats) -> Mapping[str, ByCorrections]:
        """Derivatives of that by each set."""
        ...


def prior_rows(sigma: _Floats) -> sparse.csr_matrix:
    """Rows by which each value is known to be zero with a standard deviation, (n, n); infinite: not known at all."""
    known = np.flatnonzero(np.isfinite(sigma))
    weight = 1.0 / np.asarray(sigma, float)[known]
    return sparse.csr_matrix((weight, (np.arange(len(known)), known)), (len(known), len(sigma)))
