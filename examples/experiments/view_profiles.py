"""Views by profiles, as Herzner (1988) and Ecker (1991) make them: how many profiles and cuts they take.

A vertical plane through the point of view is a line in the picture through the vertical vanishing point. A profile of
the terrain in it gives the ground of all pixels along that line, at its cuts with rows or columns of the picture: each
cut sets the pixel next to it, at most half a pixel beside its ray.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Point = tuple[float, float]


@dataclass(frozen=True)
class Counted:
    """What a method takes for a picture."""

    profiles: int
    cuts: int
    """Cuts of profiles with rows or columns."""
    missing: int
    """Pixels that no cut has set."""
    largest: float
    """Largest distance of a pixel from the best of its cuts, pixels."""


class Picture:
    """Pixels of a picture and the best cut of each."""

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self.off: NDArray[np.float64] = np.full(size[::-1], np.inf)
        self.profiles = self.cuts = 0

    def profile(self, vanishing: Point, through: Point, along_rows: bool, start: float, stop: float) -> None:
        """A profile in the plane of a point of the picture; cut with rows, or columns, from `start` to `stop`."""
        k = 1 if along_rows else 0
        lines = np.arange(np.ceil(min(start, stop) - 1e-9), np.floor(max(start, stop) + 1e-9) + 1)
        other = through[1 - k] + (lines - through[k]) * (through[1 - k] - vanishing[1 - k]) / (
            through[k] - vanishing[k]
        )
        pixel = np.rint(other)
        inside = (pixel >= 0) & (pixel < self.size[1 - k])
        lines, other, pixel = lines[inside].astype(int), other[inside], pixel[inside].astype(int)
        at = (lines, pixel) if along_rows else (pixel, lines)
        np.minimum.at(self.off, at, np.abs(other - pixel))
        self.profiles += 1
        self.cuts += len(lines)

    def counted(self) -> Counted:
        """What it took."""
        known = np.isfinite(self.off)
        return Counted(self.profiles, self.cuts, int((~known).sum()), float(self.off[known].max(initial=0.0)))


def by_border(size: tuple[int, int], vanishing: Point, stages: int = 1) -> Counted:
    """Profiles through the pixels of all sides that lines from the vanishing point leave by (Ecker 1991, §5.4.3).

    With stages (§5.7.2) every `stages`-th profile is whole; of the others the outer 1/2, 2/3, 3/4 … is kept: further
    inside, the lines of those that are longer lie closer than a pixel.
    """
    picture = Picture(size)
    for k, (side, wide) in enumerate([(0, size[0]), (size[1] - 1, size[0]), (0, size[1]), (size[0] - 1, size[1])]):
        rows = k < 2
        depth, near = (vanishing[1], size[1] - 1 - side) if rows else (vanishing[0], size[0] - 1 - side)
        inwards = -1.0 if side else 1.0
        if (depth - side) * inwards <= 0:
            continue
        # As far as the vanishing point, or the opposite side.
        last = min(max(depth, 0.0), float(size[1] - 1 if rows else size[0] - 1)) if side else min(depth, float(near))
        for pixel in range(wide):
            stage = pixel % stages
            part = 1.0 if stage == 0 else stage / (stage + 1)
            stop = side + part * (last - side) if stage == 0 else side + part * (depth - side)
            stop = stop if stage == 0 else stop + 1e-6 * inwards * -1
            picture.profile(vanishing, (pixel, side) if rows else (side, pixel), rows, side, stop)
    return picture.counted()


def by_angle(size: tuple[int, int], vanishing: Point) -> Counted:
    """Profiles that cut rows where they are steeper than 45°, columns elsewhere, no closer than they must (§5.7.1)."""
    picture = Picture(size)
    for rows in (True, False):
        k = 1 if rows else 0
        for way in (-1.0, 1.0):
            reach = (size[k] - 1 - vanishing[k]) if way > 0 else vanishing[k]
            nearest = max(0.0, -vanishing[k] if way > 0 else vanishing[k] - (size[k] - 1))
            if reach <= 0:
                continue
            for slope, far in _slopes(size[1 - k], vanishing[1 - k], max(nearest, 1e-9), reach):
                through = [0.0, 0.0]
                through[k], through[1 - k] = vanishing[k] + way * far, vanishing[1 - k] + slope * far
                start = vanishing[k] + way * nearest
                picture.profile(vanishing, (through[0], through[1]), rows, start, vanishing[k] + way * far)
    return picture.counted()


def _slopes(width: int, centre: float, nearest: float, reach: float) -> Iterator[tuple[float, float]]:
    """Slopes of the profiles of a sector, and how far from the vanishing point the picture goes along each of them.

    Neighbours lie a pixel apart where the picture is still wide enough for both.
    """
    left, right = -0.5 - centre, width - 0.5 - centre

    def far(slope: float) -> float:
        edge = right if slope > 0 else left
        return float(min(reach, edge / slope if slope * edge > 0 else np.inf))

    first = max(-1.0, min(-centre / reach, left / nearest))
    last = min(1.0, max((width - 1 - centre) / reach, right / nearest))
    if first > last:
        return
    ends = {first, last}
    ends |= {float(np.clip(edge / reach, min(ends), max(ends))) for edge in (-centre, width - 1 - centre)}
    cuts = sorted(ends)
    for low, high in itertools.pairwise(cuts):
        slope = low
        while slope < high - 1e-3 / reach:
            yield slope, far(slope)
            slope += 1.0 / max(far(slope), far(min(slope + 1.0 / far(slope), high)), 1.0)
    yield cuts[-1], far(cuts[-1])


def cuts_by_ecker(m: int, stages: int) -> float:
    """Cuts for m × m pixels around the vanishing point, by his eq. 5.5; with one stage eq. 5.4."""
    return 2 * m**2 / stages * (1 + sum((i - 1) / i for i in range(1, stages + 1)))


CASES: dict[str, tuple[tuple[int, int], Point]] = {
    "in the middle": ((120, 120), (59.5, 59.5)),
    "inside, beside the middle": ((120, 80), (30.3, 25.7)),
    "opposite a side": ((120, 80), (59.5, 200.0)),
    "opposite a corner": ((120, 80), (-150.0, 260.0)),
    "at infinity": ((120, 80), (59.5, 1e9)),
}


def main() -> None:
    """Print the tables of the page."""
    for m in (120,):
        for n in range(1, 6):
            print(m, n, by_border((m, m), (59.5, 59.5), n), cuts_by_ecker(m, n))
    for name, (size, vanishing) in CASES.items():
        print(name, by_border(size, vanishing), by_angle(size, vanishing), "rays", size[0] * size[1])


if __name__ == "__main__":
    main()
