"""Edge enhancement: bright and dark seams beside edges that no optics makes, found from several edges.

A spread function that is a distribution of light gives an edge profile that only rises. Cameras and programs that
sharpen images leave an overshoot on the bright and an undershoot on the dark side (Kölbl 2006, §4.2–4.3, fig. 11). What
is then measured is optics and sharpening together: the sharpness says little of the lens, and restoration has less to
gain, since part of it has been done already, by a filter that does not fit the spread function.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite, nan
from typing import Any, Protocol

import numpy as np

from photoplan.errors import InputError
from photoplan.plain import pick
from photoplan.quality.edges.groups import CombinedValue, combine

#: Mean of over- and undershoot from which an image counts as enhanced, parts of the contrast. Diffraction and ideal
#: optics leave none; noise and the interpolation of colours leave one or two hundredths.
LEAST = 0.02
#: How many standard deviations it must be above that.
_CLEAR = 2.0
#: With fewer edges a warning says so.
_FEW = 3


class EnhancedEdge(Protocol):
    """What is needed of the measurement of an edge."""

    @property
    def overshoot(self) -> float:
        """How far the profile rises above the bright level, parts of the contrast."""
        ...

    @property
    def undershoot(self) -> float:
        """How far it falls below the dark level, parts of the contrast."""
        ...


@dataclass(frozen=True)
class Enhancement:
    """Whether an image was sharpened, by its edges."""

    enhanced: bool
    """The mean of over- and undershoot is above 2 % by two standard deviations."""
    size: float
    """Mean of over- and undershoot over the edges, parts of the contrast."""
    sigma: float
    """Its standard deviation; NaN for a single edge without errors."""
    overshoot: CombinedValue
    undershoot: CombinedValue
    edges: int
    """Edges that were used."""
    share: float
    """Part of the edges of which both over- and undershoot are above 2 %."""

    @property
    def warning(self) -> str:
        """What a user must know; empty if nothing was found."""
        if not self.enhanced:
            return ""
        few = f" (by {self.edges} edge{'s' if self.edges > 1 else ''} only)" if self.edges < _FEW else ""
        return (
            f"edges are enhanced{few}: overshoot {100 * self.overshoot.value:.1f} %, undershoot "
            f"{100 * self.undershoot.value:.1f} % of the contrast. The image was sharpened; its MTF is that of lens "
            "and sharpening together, and restoration is limited: noise grew already. Use the unsharpened image "
            "if there is one"
        )

    def json_fields(self) -> dict[str, Any]:
        """Means flat, with the warning."""
        return {
            **pick(self, "enhanced", "size", "sigma", "edges", "share"),
            "overshoot": self.overshoot.value,
            "overshoot_sigma": self.overshoot.sigma,
            "undershoot": self.undershoot.value,
            "undershoot_sigma": self.undershoot.sigma,
            "warning": self.warning or None,
        }


def enhancement_of(edges: Sequence[EnhancedEdge]) -> Enhancement:
    """Judge edge enhancement by the over- and undershoot of all measured edges."""
    known = [e for e in edges if isfinite(e.overshoot) and isfinite(e.undershoot)]
    if not known:
        raise InputError("edge enhancement cannot be judged without a measured edge")
    over = combine([e.overshoot for e in known], [_sigma(e, "overshoot_sigma") for e in known])
    under = combine([e.undershoot for e in known], [_sigma(e, "undershoot_sigma") for e in known])
    both = combine(
        [(e.overshoot + e.undershoot) / 2 for e in known],
        [float(np.hypot(_sigma(e, "overshoot_sigma"), _sigma(e, "undershoot_sigma"))) / 2 for e in known],
    )
    share = float(np.mean([min(e.overshoot, e.undershoot) > LEAST for e in known]))
    sigma = both.sigma if isfinite(both.sigma) else 0.0
    enhanced = both.value - _CLEAR * sigma > LEAST
    return Enhancement(
        enhanced=enhanced,
        size=both.value,
        sigma=both.sigma,
        overshoot=over,
        undershoot=under,
        edges=len(known),
        share=share,
    )


def _sigma(edge: EnhancedEdge, name: str) -> float:
    """Standard deviation of a figure; NaN where the measurement states none."""
    value = getattr(edge, name, nan)
    return float(value) if value is not None else nan
