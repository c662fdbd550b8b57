"""Scenes for the image formation model: test patterns integrated exactly over small cells."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import Window
from photoplan.quality.formation.shapes import bar_share, disc_share, edge_share, sector_share, step_mean

_Array = NDArray[np.float64]
#: Patterns by name: what their numbers mean, how many there may be, and those that are taken if none is given.
PATTERNS: dict[str, tuple[str, tuple[float, ...]]] = {
    "flat": ("the bright level everywhere", ()),
    "edge": ("ANGLE in degrees of the edge against the columns", (5.0,)),
    "bars": ("PERIOD in pixels, ANGLE in degrees of the bars against the columns", (8.0, 0.0)),
    "star": ("number of bright SECTORS", (36.0,)),
    "wedge": ("number of STEPS from dark to bright", (11.0,)),
    "discs": ("PITCH and DIAMETER in pixels, half the pitch if not given", (24.0, 0.0)),
}


class LightScene(Protocol):
    """What is imaged: mean values of cells, `oversampling` of them along each side of a pixel."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image, pixels."""
        ...

    @property
    def bands(self) -> int:
        """Number of bands."""
        ...

    @property
    def oversampling(self) -> int:
        """Cells along a side of a pixel."""
        ...

    @property
    def continuous(self) -> bool:
        """Whether the cells are means of a continuous scene; else the scene consists of even squares."""
        ...

    def cells(self, window: Window) -> _Array:
        """Cells of a window of pixels, shape (bands, height · k, width · k); it may reach beyond the image."""
        ...


@dataclass(frozen=True)
class PatternScene:
    """A test pattern of any extent, whose cells hold exact means; it goes on beyond the image.

    `edge`: bright to the right of a straight line. `bars`: half of each period bright, a bright bar begins at the
    middle. `star`: as many bright as dark sectors around the middle. `wedge`: steps from left to right. `discs`: dark
    discs on bright ground, one at the middle.
    """

    kind: str
    """A name of `PATTERNS`."""
    size: tuple[int, int]
    """Width and height, pixels."""
    numbers: tuple[float, ...] = ()
    """What `PATTERNS` says of the kind; missing ones are taken from there."""
    oversampling: int = 8
    """Cells along a side of a pixel."""
    levels: tuple[float, float] = (0.0, 1.0)
    """Values of dark and bright."""
    phase: tuple[float, float] = (0.0, 0.0)
    """By which the pattern's middle is moved from the image's middle, pixels along x and y."""
    bands: int = 1
    """Number of equal bands."""

    def __post_init__(self) -> None:
        if self.kind not in PATTERNS:
            raise InputError(f"pattern {self.kind!r}; allowed are {', '.join(PATTERNS)}")
        if min(self.size) < 1 or max(self.size) > 100_000 or not 1 <= self.oversampling <= 64 or self.bands < 1:
            raise InputError(
                f"pattern of {self.size[0]} × {self.size[1]} pixels, {self.bands} bands, oversampling "
                f"{self.oversampling}; allowed are sides up to 100000, one band or more and oversampling 1 to 64"
            )
        meaning, defaults = PATTERNS[self.kind]
        if len(self.numbers) > len(defaults) or not np.isfinite([*self.numbers, *self.levels, *self.phase]).all():
            raise InputError(f"pattern {self.kind}: numbers {self.numbers}; allowed are finite ones: {meaning}")
        object.__setattr__(self, "numbers", self.numbers + defaults[len(self.numbers) :])
        self._check()

    def _check(self) -> None:
        first = self.numbers[0] if self.numbers else 1.0
        least, most = {"edge": (-360.0, 360.0), "star": (1, 360), "wedge": (2, 10_000)}.get(self.kind, (1.0, 1e6))
        whole = self.kind in ("star", "wedge")
        if not least <= first <= most or (whole and first != int(first)):
            raise InputError(
                f"pattern {self.kind}:{first:g}; allowed is {'a whole number' if whole else 'a number'} from {least:g} "
                f"to {most:g} ({PATTERNS[self.kind][0]})"
            )
        if self.kind == "discs" and not 0.0 < self.diameter < self.numbers[0]:
            raise InputError(f"pattern discs: diameter {self.diameter:g} at pitch {first:g}; it must be smaller")

    @property
    def continuous(self) -> bool:
        """The cells are means of a continuous scene."""
        return True

    @property
    def diameter(self) -> float:
        """Of the discs, pixels."""
        return self.numbers[1] or self.numbers[0] / 2.0

    @property
    def middle(self) -> tuple[float, float]:
        """Column and row of the pattern's middle."""
        return (self.size[0] - 1) / 2.0 + self.phase[0], (self.size[1] - 1) / 2.0 + self.phase[1]

    def centres(self) -> _Array:
        """Column and row of the discs whose centres lie in the image, shape (n, 2), row by row."""
        pitch = self.numbers[0]
        axes = []
        for middle, side in zip(self.middle, self.size):
            first, last = np.ceil((-0.5 - middle) / pitch), np.floor((side - 0.5 - middle) / pitch)
            axes.append(middle + np.arange(first, last + 1) * pitch)
        y, x = np.meshgrid(axes[1], axes[0], indexing="ij")
        return np.stack([x.ravel(), y.ravel()], 1)

    def cells(self, window: Window) -> _Array:
        """Cells of a window of pixels, shape (bands, height · k, width · k)."""
        k = self.oversampling
        x = (np.arange(window.col * k, window.stop[0] * k) + 0.5) / k - 0.5 - self.middle[0]
        y = (np.arange(window.row * k, window.stop[1] * k) + 0.5) / k - 0.5 - self.middle[1]
        share = np.clip(_SHARES[self.kind](self, x[None, :], y[:, None], 1.0 / k), 0.0, 1.0)
        dark, bright = self.levels
        values = np.broadcast_to(dark + (bright - dark) * share, (y.size, x.size))
        return np.repeat(values[None], self.bands, 0)


def _discs(scene: PatternScene, x: _Array, y: _Array, side: float) -> _Array:
    pitch = scene.numbers[0]
    near = [v - np.round(v / pitch) * pitch for v in (x, y)]
    return 1.0 - disc_share(near[0], near[1], side, scene.diameter / 2.0)


#: Share of a pattern's bright part in cells of a side at x and y from its middle.
_SHARES: dict[str, Callable[[PatternScene, _Array, _Array, float], _Array]] = {
    "flat": lambda scene, x, y, side: np.ones((1, 1)),
    "edge": lambda scene, x, y, side: edge_share(x, y, side, scene.numbers[0]),
    "bars": lambda scene, x, y, side: bar_share(x, y, side, scene.numbers[0], scene.numbers[1]),
    "star": lambda scene, x, y, side: sector_share(x, y, side, int(scene.numbers[0])),
    "wedge": lambda scene, x, y, side: step_mean(x, side, int(scene.numbers[0]), scene.size[0]) + 0.0 * y,
    "discs": _discs,
}


def parse_pattern(text: str) -> tuple[str, tuple[float, ...]] | None:
    """Kind and numbers of a pattern such as ``edge:5`` or ``bars:6,45``; None: the text does not begin with
    a pattern.
    """
    kind, colon, rest = text.partition(":")
    if kind not in PATTERNS:
        return None
    try:
        numbers = tuple(float(part) for part in rest.split(",")) if colon else ()
    except ValueError:
        raise UsageError(f"scene {text!r}; after the colon stand numbers: {PATTERNS[kind][0]}") from None
    return kind, numbers
