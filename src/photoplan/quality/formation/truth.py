"""What a model puts into its images, as estimators should find it: transfer function, MTF50, line spread width."""

from __future__ import annotations

from math import cos, radians, sin

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.quality.formation.kernels import aperture_transfer, spread_transfer
from photoplan.quality.formation.model import ImageModel
from photoplan.quality.mtf_curve import MtfCurve

_Array = NDArray[np.float64]
#: Cycles per pixel up to which a transfer function is summed; what is left there is refused.
_MOST_FREQUENCY = 40.0


def model_transfer(
    model: ImageModel, frequency: _Array, angle_deg: float = 0.0, radius: float = 0.0
) -> NDArray[np.complex128]:
    """Optical transfer function of spread and aperture together, of a continuous scene.

    Parameters
    ----------
    model : ImageModel
    frequency : array
        Cycles per pixel along the direction.
    angle_deg : float
        Direction: 0 along x, 90 along y. An edge of `PatternScene` at an angle shows it across itself.
    radius : float
        Place in the field: 0 in the middle, 1 in the corners.
    """
    f = np.asarray(frequency, float)
    fx, fy = f * cos(radians(angle_deg)), f * sin(radians(angle_deg))
    scale = model.spread.scale_at(radius)
    return np.asarray(spread_transfer(model.spread, fx, fy, scale) * aperture_transfer(model.aperture, fx, fy))


def model_modulation(model: ImageModel, frequency: _Array, angle_deg: float = 0.0, radius: float = 0.0) -> _Array:
    """Modulus of `model_transfer`, which says what the arguments are: the MTF."""
    return np.abs(model_transfer(model, frequency, angle_deg, radius))


def model_mtf50(model: ImageModel, angle_deg: float = 0.0, radius: float = 0.0) -> float:
    """First frequency at which the MTF falls to one half, cycles per pixel; NaN if it does not below 20.

    Direction and place are those of `model_transfer`.
    """
    f = np.linspace(0.0, 20.0, 40001)
    return MtfCurve(f, model_modulation(model, f, angle_deg, radius)).falls_to(0.5)


def line_spread(model: ImageModel, offsets: _Array, angle_deg: float = 0.0, radius: float = 0.0) -> _Array:
    """Line spread function at offsets in pixels, its integral 1, by Fourier's integral.

    Direction and place are those of `model_transfer`.

    Raises
    ------
    InputError
        The line spread function has steps (an aperture or a motion without other spread): the integral does not
        converge.
    """
    f = np.linspace(0.0, _MOST_FREQUENCY, 16001)
    transfer = model_transfer(model, f, angle_deg, radius)
    if np.abs(transfer[-2000:]).max() > 2e-3:
        raise InputError(
            "the line spread function of this model has steps; give it some Gaussian spread, or ask for its MTF"
        )
    waves = np.exp(2j * np.pi * np.multiply.outer(np.asarray(offsets, float), f))
    weights = np.full(f.size, f[1])
    weights[[0, -1]] /= 2.0
    return np.asarray(2.0 * (waves * transfer).real @ weights)
