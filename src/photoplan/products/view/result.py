"""What came out of a view."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from photoplan.plain import pick
from photoplan.products.view.overlay import OverlayFacts


@dataclass(frozen=True)
class ViewResult:
    """What came out."""

    path: Path
    size: tuple[int, int]
    tiles: int
    sky: int
    """Pixels that show no ground (of a picture with several rays to a pixel: rays)."""
    rays: int
    lost: int
    """Those of them that point downwards: they pass the border of the terrain, or a hole of it."""
    nearest: float | None
    farthest: float | None
    """Distances of ground, metres."""
    resumed: int
    """Tiles of an earlier run."""
    seconds: float
    svg: Path | None = None
    drawn: OverlayFacts | None = None
    """What became of lines and labels."""

    def json_fields(self) -> dict[str, Any]:
        """Counts of rays."""
        counts = pick(self, "rays", sky_rays="sky", downward_sky_rays="lost")
        return {**pick(self, "path", "size", "tiles", nearest_m="nearest", farthest_m="farthest"), **counts,
                **pick(self, "seconds", resumed_tiles="resumed"),
                **({} if self.drawn is None else pick(self, "svg", "drawn"))}  # fmt: skip
