"""What the vectors of a registration say as a whole."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.matching.register import FOUND, STATES, PatchDisplacements
from photoplan.plain import pick

_Floats = NDArray[np.float64]

PERCENTILES = (50.0, 90.0, 95.0, 99.0, 99.7)


@dataclass(frozen=True)
class RegisterFigures:
    """Figures of a field of vectors, pixels of the first image."""

    patches: int
    counts: dict[str, int]
    """Patches by what became of them, see `photoplan.matching.register.STATES`."""
    median: tuple[float, float]
    rms: tuple[float, float]
    """Of dx and of dy."""
    spread: tuple[float, float]
    """Standard deviation of dx and of dy about their means."""
    percentiles: dict[str, float]
    """Of the vectors' lengths."""
    largest: float
    """Longest vector."""
    quarter: float
    """Share of the vectors not longer than a quarter of a pixel, 0 to 1."""
    half: float
    """Share not longer than half a pixel."""
    sigma: tuple[float, float]
    """Median standard deviation of dx and of dy."""
    factor: float
    """Median of the factors by which standard deviations of the fits were multiplied: noise of pixels is alike."""
    correlation: float
    """Median."""

    def json_fields(self) -> dict[str, Any]:
        """All of it, with its unit."""
        own = ("patches", "counts", "factor", "correlation")
        pixels = ("median", "rms", "spread", "percentiles", "largest", "sigma")
        shares = {"share_within_quarter_px": self.quarter, "share_within_half_px": self.half}
        return {**pick(self, *own), **{f"{name}_px": getattr(self, name) for name in pixels}, **shares}


def figures_of(found: PatchDisplacements) -> RegisterFigures:
    """Figures of the vectors that were found; there is one at least."""
    good = found.state == FOUND
    d, length = found.moved[good], np.linalg.norm(found.moved[good], axis=1)
    values = np.percentile(length, PERCENTILES).tolist()
    return RegisterFigures(
        patches=len(good),
        counts=dict(zip(STATES, np.bincount(found.state, minlength=len(STATES)).tolist())),
        median=_two(np.median(d, axis=0)),
        rms=_two(np.sqrt((d**2).mean(axis=0))),
        spread=_two(d.std(axis=0)),
        percentiles={f"{p:g}": v for p, v in zip(PERCENTILES, values)},
        largest=float(length.max()),
        quarter=float((length <= 0.25).mean()),
        half=float((length <= 0.5).mean()),
        sigma=_two(np.median(found.sigma[good], axis=0)),
        factor=float(np.median(found.factor[good])),
        correlation=float(np.median(found.correlation[good])),
    )


def _two(values: _Floats) -> tuple[float, float]:
    a, b = values.tolist()
    return a, b
