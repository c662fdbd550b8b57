"""A lens and a film that is not quite affine, as a field in the image."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.interior import Interior
from photoplan.cameras.lenses.base import Lens
from photoplan.cameras.plane import Affine2D


@dataclass(frozen=True)
class LensField:
    """From where an image point would lie without distortion, on an affine image plane, to where it lies.

    Equal for all images of one lens and one interior orientation.
    """

    interior: Interior
    lens: Lens
    breaks: None = field(default=None, init=False)
    """Lenses are smooth."""
    _to_tangent: Affine2D = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_to_tangent", ~ideal_plane(self.interior))

    def __call__(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Ideal to real positions, shapes (..., 2), pixels."""
        with np.errstate(invalid="ignore", over="ignore"):
            return self.interior.tangent_to_pixel(self.lens.distort(self._to_tangent(xy)))

    def inverse(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Real to ideal positions, shapes (..., 2), pixels; NaN where there are none."""
        return ideal_plane(self.interior)(self.lens.undistort(self.interior.tangent_to_pixel.inverse(xy)))


def ideal_plane(interior: Interior) -> Affine2D:
    """From tangents to pixels without what is bilinear: its tangent at the principal point."""
    T = interior.tangent_to_pixel
    return T if isinstance(T, Affine2D) else Affine2D(T.b1, T.b2, T.b4, T.b5, T.b6, T.b8)
