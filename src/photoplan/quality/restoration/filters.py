"""Restoration filters as values: kernels, where in the field and for which band they hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError

#: Kernels wider than this are refused: they come from damaged files rather than from optics.
MOST_WIDTH = 101


@dataclass(frozen=True, eq=False)
class FilterKernel:
    """A two-dimensional kernel; the restored image is the image convolved with it."""

    values: NDArray[np.float64]
    """Shape (2 m + 1, 2 n + 1): rows, columns; ``values[m + i, n + k]`` is the weight of the pixel i rows above and k
    columns left of the restored one."""
    at: tuple[float, float] | None = None
    """Column and row where in the image it holds, pixels; None: everywhere."""
    band: int | None = None
    """Band that it is for, counted from 1; None: all."""

    def __post_init__(self) -> None:
        values = np.array(self.values, np.float64)
        if values.ndim != 2 or values.shape[0] % 2 == 0 or values.shape[1] % 2 == 0:
            raise InputError(f"a filter has an odd number of rows and columns; given is shape {values.shape}")
        if max(values.shape) > MOST_WIDTH:
            raise InputError(
                f"a filter of {values.shape[1]} × {values.shape[0]} values; at most {MOST_WIDTH} are allowed"
            )
        if not np.isfinite(values).all():
            raise InputError("a filter has finite values only")
        values.setflags(write=False)
        object.__setattr__(self, "values", values)

    @property
    def total(self) -> float:
        """Sum of the values: 1 keeps the mean brightness."""
        return float(self.values.sum())

    @property
    def noise_gain(self) -> float:
        """By what factor uncorrelated noise grows: the root of the sum of squares."""
        return sqrt(float((self.values**2).sum()))


@dataclass(frozen=True, eq=False)
class RestorationFilter:
    """Kernels of one image or camera, for each band and place in the field."""

    kernels: tuple[FilterKernel, ...]
    """At least one. For a band either one without place, or several with places, between which is interpolated."""
    image_size: tuple[int, int] | None = None
    """Width and height of the images that the places refer to; None where no kernel has a place."""
    description: str = ""
    """How it was made, in words."""
    facts: Mapping[str, object] = field(default_factory=dict)
    """Figures of its making, such as spread function, condition, rule and noise gain; plain values."""

    def __post_init__(self) -> None:
        if not self.kernels:
            raise InputError("a restoration filter has at least one kernel")
        for band in {kernel.band for kernel in self.kernels}:
            places = [kernel.at for kernel in self.kernels if kernel.band == band]
            if len(places) > 1 and (None in places or len(set(places)) < len(places)):
                name = "all bands" if band is None else f"band {band}"
                raise InputError(f"a filter with several kernels for {name} needs a different place for each of them")
        if any(kernel.at is not None for kernel in self.kernels) and self.image_size is None:
            raise InputError("a filter whose kernels have places states the size of the image that they refer to")

    @property
    def margin(self) -> tuple[int, int]:
        """Columns and rows that the widest and highest kernel reaches beyond a pixel."""
        return (
            max(kernel.values.shape[1] for kernel in self.kernels) // 2,
            max(kernel.values.shape[0] for kernel in self.kernels) // 2,
        )

    def for_band(self, band: int) -> tuple[FilterKernel, ...]:
        """Kernels of a band, counted from 1: its own, else those of all bands; empty if the band stays as it is."""
        own = tuple(kernel for kernel in self.kernels if kernel.band == band)
        return own or tuple(kernel for kernel in self.kernels if kernel.band is None)

    @property
    def noise_gain(self) -> float:
        """The largest of its kernels' noise gains."""
        return max(kernel.noise_gain for kernel in self.kernels)
