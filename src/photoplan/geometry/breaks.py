"""Where a mapping is bent."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from photoplan.errors import UsageError


@dataclass(frozen=True)
class Breaks:
    """Where a mapping is continuous but bent: no interpolation may cross these places unnoticed.

    Positions are those of the image for a projection, those of the product for a target; pixels.
    """

    columns: tuple[float, ...] = ()
    """x (or u), increasing."""
    rows: tuple[float, ...] = ()
    """y (or v), increasing."""

    def __post_init__(self) -> None:
        for name, places in (("columns", self.columns), ("rows", self.rows)):
            if not all(a < b for a, b in pairwise(places)):
                raise UsageError(f"breaks: {name} {places[:5]} …; they must be finite and increase")
