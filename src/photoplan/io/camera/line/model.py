"""A line camera as files state it: trajectory, clock and directions of the detectors, in the axes of a body."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from photoplan.cameras.pushbroom import ChippedLine, LineCamera
from photoplan.cameras.pushbroom_rays import LineLook, LineTrack
from photoplan.geometry.local import BodyGround

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
    beside: float | None = None
    """How far elements of a table of detectors lie beside the curve that stands for them, columns; None: no table."""
    chips: tuple[LineLook, ...] = ()
    """Of a line of several chips, all of them, with `look` the first; empty: it is one."""
    lens: str | None = None
    """Focal length and kind of distortion in words; None: the file states directions alone."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        return self.look.columns, self.track.lines

    def camera(self, crs: str, heights: str) -> LineCamera | ChippedLine:
        """The camera over a ground; a CRS of another body is an InputError."""
        ground = BodyGround(crs, heights, self.radii)
        if self.chips:
            return ChippedLine(tuple(LineCamera(self.track, look, ground) for look in self.chips))
        return LineCamera(self.track, self.look, ground)

    def describe(self) -> dict[str, str]:
        """In words, by name."""
        first, last = math.ceil(self.track.oriented[0] - 1e-3), math.floor(self.track.oriented[1] + 1e-3)
        oriented = f"{first} to {last}"
        t0, rate = float(self.track.time(np.zeros(1))[0]), float(self.track.rates[0])
        ends = [[round((t - t0) / rate, 1) for t in gap] for gap in self.track.gaps]
        gaps = ", ".join(f"{a:g} to {b:g}" for a, b in ends if b > 0 and a < self.size[1])
        table = "" if self.beside is None else f"; elements lie up to {self.beside:.2g} columns beside a smooth curve"
        chips = f"; {len(self.chips)} chips" if self.chips else ""
        whole = self.track.oriented == (-0.5, self.size[1] - 0.5)
        return {
            "line camera": self.form,
            "image": f"{self.size[0]} columns, {self.size[1]} lines of {1000 * rate:.6g} ms",
            "oriented lines": "all" if whole else f"{oriented} only; the others have no position or attitude",
            "directions": f"{1e6 * self.look.pitch:.4g} µrad from column to column in the middle{table}{chips}",
            **({} if self.lens is None else {"focal length": self.lens}),
            **({} if not gaps else {"gaps": f"of the record: lines {gaps} have no orientation"}),
            "body": f"radii {self.radii[0] / 1000:.3f} and {self.radii[1] / 1000:.3f} km",
        }
