"""Figures of a sensor: resolution, sizes, Nyquist frequency, charge transfer, quantisation, jitter, transfer functions.

Beside them its noise budget in electrons (Behr 1989, §3.6.4, table 3.3, after Beynon), and figures of a video norm.

Lengths are in millimetres or micrometres as named; spatial frequencies are line pairs per millimetre (LP/mm), which are
cycles per millimetre.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log2, log10, pi, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import InputError
from photoplan.quality.mtf_curve import pupil_transfer

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
    """Modulation that is left after shifting charges (Behr 1989, eq. 3.15)."""
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
    """
    return jitter_s * grey_step / rise_s


def aperture_mtf(frequency: ArrayLike, width_um: float) -> Array:
    """MTF of the sensitive width of an element: \\|sin(π f w) / (π f w)\\|; frequency in LP/mm."""
    return np.asarray(np.abs(np.sinc(np.asarray(frequency, float) * width_um / 1000.0)))


def diffraction_cutoff(f_number: float, wavelength_nm: float) -> float:
    """Frequency beyond which a lens with a circular stop transfers nothing in incoherent light: 1/(λ N), LP/mm."""
    return 1e6 / (wavelength_nm * f_number)


def diffraction_mtf(frequency: ArrayLike, cutoff: float) -> Array:
    """MTF of a perfect lens with a circular stop in incoherent light, see `pupil_transfer`."""
    if not cutoff > 0.0:
        raise InputError(f"a diffraction limit of {cutoff:g} LP/mm; it is positive")
    return pupil_transfer(np.abs(np.asarray(frequency, float)) / cutoff)


#: By how many kelvin the dark current doubles (Behr 1989, §3.6.4).
DOUBLING_C = 10.0


def transfer_noise(signal_e: float, inefficiency: float, transfers: float) -> float:
    """Noise of shifting charges, electrons: √(2 ε n N) (Behr 1989, §3.6.4)."""
    return sqrt(2.0 * inefficiency * transfers * signal_e)


def amplifier_noise(capacitance_pf: float) -> float:
    """Noise of resetting the output capacitance, electrons: 400 √C (Behr 1989, table 3.3)."""
    return 400.0 * sqrt(capacitance_pf)


def dark_at(current: float, temperature_c: float, reference_c: float, doubling_c: float = DOUBLING_C) -> float:
    """Dark current at a temperature from that at another one; it doubles every `doubling_c` (Behr 1989, §3.6.4)."""
    return float(current * 2.0 ** ((temperature_c - reference_c) / doubling_c))


@dataclass(frozen=True)
class NoiseBudget:
    """Sources of noise of one reading, electrons; None where a source is not described."""

    signal_e: float
    """Electrons of the signal."""
    dark_e: float | None = None
    """Electrons of the dark current."""
    transfer: float | None = None
    """Noise of shifting charges."""
    amplifier: float | None = None
    """Noise of the amplifier, or all noise of reading."""
    quantisation: float | None = None
    """Noise of rounding to grey values."""

    def __post_init__(self) -> None:
        if not self.signal_e > 0.0:
            raise InputError(f"a signal of {self.signal_e:g} electrons; it is positive")

    @property
    def shot(self) -> float:
        """Noise of the light: √N."""
        return sqrt(self.signal_e)

    @property
    def dark(self) -> float | None:
        """Noise of the dark current: √N."""
        return None if self.dark_e is None else sqrt(self.dark_e)

    def sources(self) -> dict[str, float]:
        """Noise of each described source, electrons."""
        every = {
            "shot": self.shot,
            "dark": self.dark,
            "transfer": self.transfer,
            "amplifier": self.amplifier,
            "quantisation": self.quantisation,
        }
        return {name: value for name, value in every.items() if value is not None}

    @property
    def total(self) -> float:
        """Root of the sum of squares: the sources are independent."""
        return sqrt(sum(value**2 for value in self.sources().values()))

    @property
    def plain_sum(self) -> float:
        """Sum of the sources, an upper bound; the total that Behr 1989, table 3.3 prints."""
        return sum(self.sources().values())

    @property
    def without_signal(self) -> float:
        """Noise that stays without light: the root of the sum of squares of dark, amplifier and quantisation."""
        left = {name: v for name, v in self.sources().items() if name in ("dark", "amplifier", "quantisation")}
        return sqrt(sum(value**2 for value in left.values()))

    @property
    def signal_to_noise(self) -> float:
        """Signal through total noise."""
        return self.signal_e / self.total

    @property
    def signal_to_noise_db(self) -> float:
        """The same in decibels: 20 log10."""
        return 20.0 * log10(self.signal_to_noise)

    @property
    def signal_to_noise_bits(self) -> float:
        """The same in bits: log2."""
        return log2(self.signal_to_noise)


def viewed_length(distance: float, angle_rad: float) -> float:
    """Length that is seen under a small angle from a distance, in its unit (Behr 1989, eq. 3.1 and 3.2)."""
    return distance * angle_rad


def lines_from_viewing(viewing_angle_rad: float, eye_resolution_rad: float) -> float:
    """Lines that the eye tells apart within the viewing angle (Behr 1989, eq. 3.3)."""
    return viewing_angle_rad / eye_resolution_rad


def columns_of(lines: float, aspect: float) -> float:
    """Square picture points in a line of a picture with an aspect ratio width/height (Behr 1989, eq. 3.4)."""
    return lines * aspect


def points_of(lines: float, aspect: float) -> float:
    """Square picture points of the whole picture (Behr 1989, eq. 3.5)."""
    return lines * columns_of(lines, aspect)


def bandwidth_hz(points: float, frame_hz: float) -> float:
    """Half a period for each picture point (Behr 1989, eq. 3.6; with eq. 3.5 it is eq. 3.7)."""
    return 0.5 * points * frame_hz


def lengthened(length: float, blanking: float, period: float) -> float:
    """A line or picture lengthened by the part of its time that is blanked (Behr 1989, eq. 3.8 to 3.10)."""
    if not 0.0 <= blanking < period:
        raise InputError(f"a blanking of {blanking:g} in a period of {period:g}; it is shorter than the period")
    return length / (1.0 - blanking / period)


def sampling_hz(highest_hz: float) -> float:
    """The lowest frequency of sampling that keeps a signal (Behr 1989, eq. 3.13)."""
    return 2.0 * highest_hz


@dataclass(frozen=True)
class VideoNorm:
    """A video norm such as CCIR (Behr 1989, table 3.1)."""

    lines: int
    """Of a frame, blanked ones included."""
    line_s: float
    """Time of a line."""
    line_blanking_s: float
    """Part of it that is blanked."""
    frame_blanking_s: float
    """Part of a frame's time that is blanked."""
    aspect: float
    """Width through height of the picture."""
    kell_factor: float = 1.0
    """Share of the lines that the discrete lines resolve."""
    fields: int = 2
    """Of a frame: 2 with interlace."""

    def __post_init__(self) -> None:
        lengthened(1.0, self.line_blanking_s, self.line_s)
        lengthened(1.0, self.frame_blanking_s, self.frame_s)
        if not 0.0 < self.kell_factor <= 1.0:
            raise InputError(f"a Kell factor of {self.kell_factor:g}; it lies between 0 and 1")

    @property
    def frame_s(self) -> float:
        """Time of a frame."""
        return self.lines * self.line_s

    @property
    def line_hz(self) -> float:
        """Lines a second."""
        return 1.0 / self.line_s

    @property
    def frame_hz(self) -> float:
        """Frames a second."""
        return 1.0 / self.frame_s

    @property
    def field_hz(self) -> float:
        """Fields a second."""
        return self.fields * self.frame_hz

    @property
    def columns_factor(self) -> float:
        """By which blanking lengthens a line (Behr 1989, eq. 3.9)."""
        return lengthened(1.0, self.line_blanking_s, self.line_s)

    @property
    def lines_factor(self) -> float:
        """By which blanking adds to the lines (Behr 1989, eq. 3.10)."""
        return lengthened(1.0, self.frame_blanking_s, self.frame_s)

    @property
    def plain_hz(self) -> float:
        """Bandwidth without blanking (Behr 1989, eq. 3.7)."""
        return bandwidth_hz(points_of(self.lines, self.aspect), self.frame_hz)

    @property
    def blanking_factor(self) -> float:
        """By which blanking widens the band (Behr 1989, eq. 3.11)."""
        return self.columns_factor / self.lines_factor

    @property
    def blanked_hz(self) -> float:
        """Bandwidth with blanking (Behr 1989, eq. 3.11)."""
        return self.plain_hz * self.blanking_factor

    @property
    def kell_hz(self) -> float:
        """Bandwidth with blanking and Kell factor (Behr 1989, eq. 3.12)."""
        return self.kell_factor * self.blanked_hz

    @property
    def resolved_lines(self) -> float:
        """Lines that are resolved with the Kell factor (Behr 1989, §3.1)."""
        return self.kell_factor * self.lines
