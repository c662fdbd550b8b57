"""What was found of a scan's fiducial marks, and what was not."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.fiducials_fit import FiducialFit
from photoplan.errors import InputError
from photoplan.orientation.marks.layout import MarkPlacement, ScanTurn


@dataclass(frozen=True, eq=False)
class LocatedMark:
    """A mark where it was found."""

    name: str
    x: float
    y: float
    """Column and row of its reference point, (0, 0) the centre of the upper-left pixel."""
    sigma_x: float
    sigma_y: float
    """Standard deviations, pixels."""
    correlation: float
    """With the template, at the nearest whole pixel."""
    method: str
    """`matching` (least squares), `paraboloid`, or `edges` where image content lies beside the mark."""
    paraboloid: tuple[float, float] | None
    """Column and row by the paraboloid (Behr 1989, eq. 4.4)."""
    matching: tuple[float, float] | None
    """Column and row by least-squares matching; None: it did not converge."""


@dataclass(frozen=True)
class MissingMark:
    """A mark that was not found."""

    name: str
    correlation: float
    """The best near where the other marks say; NaN: that lies outside the scan."""
    x: float
    y: float
    """Where the other marks say, column and row."""
    reason: str


@dataclass(frozen=True, eq=False)
class FiducialResult:
    """Marks of a scan and its interior orientation."""

    marks: tuple[LocatedMark, ...]
    missing: tuple[MissingMark, ...]
    fit: FiducialFit
    """Affine transformation from millimetres to pixels."""
    residuals_um: NDArray[np.float64]
    """Transformed minus measured position of each mark in `fit`, in the image plane (x right, y up), micrometres."""
    turn: ScanTurn
    """How the upright picture was turned before it was scanned."""
    negative: bool
    blur_px: float
    """Standard deviation of the scan's blur that fits best, pixels."""
    placement: MarkPlacement
    """The similarity that led to the marks."""
    notes: tuple[str, ...]
    """What a user should know, one sentence each."""

    @property
    def pixel_mm(self) -> float:
        """Side of a pixel on the film, millimetres."""
        t = self.fit.transformation.derivative(np.zeros(2))
        return 1.0 / math.sqrt(abs(float(np.linalg.det(t))))

    @property
    def sigma0_um(self) -> float:
        """Standard deviation of a coordinate from the residuals, micrometres; NaN with three marks."""
        return self.fit.sigma0 * self.pixel_mm * 1000.0


@dataclass(frozen=True)
class SoughtMark:
    """Where a mark of a scan was sought that cannot be oriented."""

    name: str
    x: float
    y: float
    """Column and row: where it was found, or where it is expected."""
    found: bool
    correlation: float
    """The best there; NaN: none."""


class MarksNotFound(InputError):
    """Fewer than three marks of a scan were found."""

    def __init__(self, message: str, sought: tuple[SoughtMark, ...]) -> None:
        super().__init__(message)
        self.sought = sought
