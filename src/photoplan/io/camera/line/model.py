"""A line camera as files state it: trajectory, clock and directions of the detectors, in the axes of a body."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from photoplan.cameras.line import LineCamera
from photoplan.cameras.line_look import LineLook
from photoplan.cameras.line_track import LineTrack
from photoplan.geometry.body import BodyGround

#: Nothing that holds a trajectory and what belongs to an image is larger.
MAX_BYTES = 200_000_000


@dataclass(frozen=True, eq=False)
class StatedLine:
    """A line camera of a file."""

    file: Path
    form: str
    """The file's format, in words."""
    track: LineTrack
    look: LineLook
    radii: tuple[float, float]
    """Equatorial and polar radius of the body, metres."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        return self.look.columns, self.track.lines

    def camera(self, crs: str, heights: str) -> LineCamera:
        """The camera over a ground; a CRS of another body is an InputError."""
        return LineCamera(self.track, self.look, BodyGround(crs, heights, self.radii))

    def describe(self) -> dict[str, str]:
        """In words, by name."""
        first, last = math.ceil(self.track.oriented[0]), math.floor(self.track.oriented[1])
        rate = float(self.track.rates[0])
        oriented = f"{first} to {last}"
        whole = self.track.oriented == (-0.5, self.size[1] - 0.5)
        return {
            "line camera": self.form,
            "image": f"{self.size[0]} columns, {self.size[1]} lines of {1000 * rate:.6g} ms",
            "oriented lines": "all" if whole else f"{oriented} only; the others have no position or attitude",
            "directions": f"{1e6 * self.look.pitch:.4g} µrad from column to column in the middle",
            "body": f"radii {self.radii[0] / 1000:.3f} and {self.radii[1] / 1000:.3f} km",
        }
