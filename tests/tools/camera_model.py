"""Frames of a camera whose figures are known: a small model of a sensor.

Kept apart from `photoplan.quality.formation` on purpose, so that the estimators are tested against a second model.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rasterio

from photoplan.quality.camera.sensor import FrameStack, StackSums

__all__ = ["Sensor", "gathered", "write_frame"]


def gathered(frames: Iterable[np.ndarray], saturation: float, counted: np.ndarray | None = None) -> FrameStack:
    """Frames gathered one after the other."""
    sums = StackSums(saturation, counted)
    for frame in frames:
        sums.add(frame)
    return sums.stack()


@dataclass(frozen=True)
class Sensor:
    """Electrons, then grey values; everything that stays from frame to frame comes from `seed`."""

    shape: tuple[int, int] = (120, 160)
    gain: float = 0.4
    """Grey values per electron."""
    read_noise: float = 8.0
    """Electrons."""
    bias: float = 64.0
    """Grey values."""
    dark_current: float = 20.0
    """Electrons per second at 20 °C."""
    doubling: float = 7.0
    """Degrees in which it doubles."""
    dsnu: float = 0.0
    """Electrons, standard deviation of offsets of pixels."""
    dsnu_rows: float = 0.0
    dsnu_columns: float = 0.0
    prnu: float = 0.0
    """Part of the signal."""
    full_well: float = 9000.0
    """Electrons."""
    compression: float = 0.0
    """Part of the grey value that a response which bends has lost at the full well."""
    bits: int = 12
    efficiency: float = 0.5
    flicker: float = 0.0
    """Of whole frames, part of the light."""
    seed: int = 1
    hot: dict[tuple[int, int], float] = field(default_factory=dict)
    """(row, column): electrons per second more."""
    dead: tuple[tuple[int, int], ...] = ()
    blinking: tuple[tuple[int, int], ...] = ()

    def frame(self, photons: float | np.ndarray, exposure_ms: float, noise: np.random.Generator, celsius: float = 20.0):
        """One frame, uint16."""
        fixed = np.random.default_rng(self.seed)
        rows, cols = self.shape
        offsets = self.dsnu * fixed.standard_normal(self.shape)
        offsets = offsets + self.dsnu_rows * fixed.standard_normal((rows, 1))
        offsets = offsets + self.dsnu_columns * fixed.standard_normal((1, cols))
        response = 1 + self.prnu * fixed.standard_normal(self.shape)
        for place in self.dead:
            response[place] = 0.05
        light = self.efficiency * np.broadcast_to(photons, self.shape) * response
        light = light * (1 + self.flicker * noise.standard_normal())
        dark = np.full(self.shape, self.dark_current)
        for place, more in self.hot.items():
            dark[place] += more
        dark = dark * 2 ** ((celsius - 20) / self.doubling) * exposure_ms / 1000
        electrons = noise.poisson(np.maximum(light, 0) + dark).astype(float)
        for place in self.blinking:
            electrons[place] += 600.0 * noise.integers(0, 2)
        electrons = np.minimum(electrons, self.full_well)
        electrons = electrons * (1 - self.compression * electrons / self.full_well)
        electrons = electrons + offsets + self.read_noise * noise.standard_normal(self.shape)
        return np.clip(np.rint(self.bias + self.gain * electrons), 0, 2**self.bits - 1).astype(np.uint16)


def write_frame(path: Path, pixels: np.ndarray) -> Path:
    """A TIFF of one band, or of several (bands first)."""
    bands = pixels[None] if pixels.ndim == 2 else pixels
    path.parent.mkdir(parents=True, exist_ok=True)
    profile = {"driver": "GTiff", "count": len(bands), "height": bands.shape[1], "width": bands.shape[2]}
    with rasterio.open(path, "w", dtype=bands.dtype.name, **profile) as file:
        file.write(bands)
    return path
