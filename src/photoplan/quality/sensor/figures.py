"""Figures of a sensor: resolution, sizes, Nyquist frequency, charge transfer, quantisation, jitter, transfer functions.

Lengths are in millimetres or micrometres as named; spatial frequencies are line pairs per millimetre (LP/mm), which are
cycles per millimetre.
"""

from __future__ import annotations

from math import pi, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import InputError

Array = NDArray[np.float64]


def line_resolution(points: float) -> float:
    """Line pairs that a number of picture points tells apart (Behr 1989, eq. 3.17 and 3.18)."""
    return points / 2.0


def element_um(side_mm: float, elements: int) -> float:
    """Period of the elements along a side of the sensor, gaps included (Behr 1989, eq. 3.19 and 3.20)."""
    return 1000.0 * side_mm / elements


def pixel_um(reference_mm: float, pixels: float) -> float:
    """Size of a pixel of the image from a known length and the pixels that it covers (Behr 1989, eq. 3.21, 3.22)."""
    return 1000.0 * reference_mm / pixels


def nyquist(period_um: ArrayLike) -> Array:
    """Highest frequency that a period of sampling carries, LP/mm (Behr 1989, eq. 3.23)."""
    return np.asarray(1000.0 / (2.0 * np.asarray(period_um, float)))


def transfer_modulation(product: float, signal_to_clock: ArrayLike) -> Array:
    """Modulation that is left after shifting charges (Behr 1989, eq. 3.15).

    Parameters
    ----------
    product : float
        Transfer inefficiency product: inefficiency of one transfer times their number.
    signal_to_clock : array_like
        Signal frequency through clock frequency; 0.5 is the Nyquist frequency.
    """
    turn = 2.0 * pi * np.asarray(signal_to_clock, float)
    return np.asarray(np.exp(-product * (1.0 - np.cos(turn))))


def transfer_phase(product: float, signal_to_clock: ArrayLike) -> Array:
    """Shift of phase by shifting charges, radians (Behr 1989, eq. 3.16); parameters as `transfer_modulation`.

    It is the lag that is left over when the delay that low frequencies have, the product in elements, is taken away;
    the whole lag is ``product * sin(2 π f_s / f_c)``.
    """
    turn = 2.0 * pi * np.asarray(signal_to_clock, float)
    return np.asarray(-product * (turn - np.sin(turn)))


def quantisation_sigma(step: float) -> float:
    """Standard deviation of rounding to steps of a size, in its unit (Behr 1989, eq. 3.14)."""
    return step / sqrt(12.0)


def jitter_pixels(jitter_s: float, sampling_hz: float) -> float:
    """Error of position by an error of the time of sampling, pixels (Behr 1989, eq. 4.5, as a product).

    The source prints the quotient; its figures, 20 ns and 10 MHz, give the printed 0.2 pixel as the product.
    """
    return jitter_s * sampling_hz


def jitter_grey(jitter_s: float, grey_step: float, rise_s: float) -> float:
    """Largest error of grey by an error of the time of sampling, or of the place (Behr 1989, eq. 4.6).

    The source's eq. 4.7, 20 ns · 255 / 100 ns, is 51 grey values; it prints 20, which a step of 100 grey values, named
    in its text, would make.

    Parameters
    ----------
    jitter_s : float
        Error of the time, or in pixels.
    grey_step, rise_s : float
        The steepest change of grey and the time (or pixels) that it takes: one period of sampling in eq. 4.7.
    """
    return jitter_s * grey_step / rise_s


def aperture_mtf(frequency: ArrayLike, width_um: float) -> Array:
    """MTF of the sensitive width of an element: \\|sin(π f w) / (π f w)\\|; frequency in LP/mm."""
    return np.asarray(np.abs(np.sinc(np.asarray(frequency, float) * width_um / 1000.0)))


def diffraction_cutoff(f_number: float, wavelength_nm: float) -> float:
    """Frequency beyond which a lens with a circular stop transfers nothing in incoherent light: 1/(λ N), LP/mm."""
    return 1e6 / (wavelength_nm * f_number)


def diffraction_mtf(frequency: ArrayLike, cutoff: float) -> Array:
    """MTF of a perfect lens with a circular stop in incoherent light: 2/π (arccos v − v √(1 − v²)), v = f / cutoff.

    The autocorrelation of a disc, Goodman, Introduction to Fourier Optics, chapter 6.

    Raises
    ------
    InputError
        The cutoff is not positive.
    """
    if not cutoff > 0.0:
        raise InputError(f"a diffraction limit of {cutoff:g} LP/mm; it is positive")
    v = np.clip(np.abs(np.asarray(frequency, float)) / cutoff, 0.0, 1.0)
    return np.asarray(2.0 / pi * (np.arccos(v) - v * np.sqrt(1.0 - v * v)))
