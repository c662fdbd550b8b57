"""Result sheet of EMVA 1288 release 4 linear: quantum efficiency, gain, noise, saturation, dynamic range, threshold.

Unlike `photon_transfer`, which weighs, the sheet takes unweighted lines between 0 and 70 %
of saturation, saturation at the largest variance. With y for grey values and p for photons: R = slope of
μ_y − μ_y.dark over μ_p (eq. 49), K = slope of σ²_y − σ²_y.dark over μ_y − μ_y.dark (eq. 50), η = R / K (eq. 52),
σ_d = √(σ²_y.dark − 1/12) / K (eq. 53; below 0.24 DN² only σ_d < 0.40 / K is known, eq. 54),
μ_p.min = (√(σ²_y.dark / K² + 1/4) + 1/2) / η (eq. 26, 27), DR = μ_p.sat / μ_p.min (eq. 28), SNR_max = √μ_e.sat
(eq. 55).

Both lines go through the origin, as those of the package `emva1288` do. Eq. 50 is also read with an offset; a curved
photon transfer then gives another gain, 1.1 % less in that package's own example.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite, log10, nan, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import InputError
from photoplan.quality.camera.linearity import Linearity, linearity
from photoplan.quality.camera.photon_transfer import LEAST_VARIANCE, QUANTISATION

#: Part of the signal at saturation up to which levels count, by the standard.
_RANGE = 0.7


@dataclass(frozen=True, eq=False)
class EmvaPoints:
    """Levels of one measurement: bright and dark at the same exposure; arrays of shape (n,)."""

    photons: NDArray[np.float64]
    """Mean photons per pixel; NaN: unknown (then neither efficiency nor threshold)."""
    mean: NDArray[np.float64]
    variance: NDArray[np.float64]
    dark_mean: NDArray[np.float64]
    dark_variance: NDArray[np.float64]
    samples: NDArray[np.float64]
    """Degrees of freedom of each variance."""
    mean_sigma: NDArray[np.float64]
    """Standard deviation of the signal (mean less dark mean), the flicker of the lamp included."""

    def __post_init__(self) -> None:
        shapes = set()
        for name in ("photons", "mean", "variance", "dark_mean", "dark_variance", "samples", "mean_sigma"):
            array = np.array(getattr(self, name), np.float64)
            array.setflags(write=False)
            shapes.add(array.shape)
            object.__setattr__(self, name, array)
        if len(shapes) != 1 or self.mean.ndim != 1 or self.mean.size < 5:
            raise InputError(f"{self.mean.size} levels; the EMVA 1288 sheet needs five, each with all of its figures")

    def sorted(self) -> EmvaPoints:
        """By growing signal."""
        order = np.argsort(self.photons if np.isfinite(self.photons).all() else self.mean, kind="stable")
        return EmvaPoints(*(getattr(self, name)[order] for name in self.__dataclass_fields__))


@dataclass(frozen=True, eq=False)
class EmvaSheet:
    """The figures; NaN where `refused` says why."""

    gain: float
    """K, DN per electron."""
    gain_sigma: float
    responsivity: float
    """R, DN per photon."""
    responsivity_sigma: float
    quantum_efficiency_percent: float
    quantum_efficiency_percent_sigma: float
    temporal_dark_noise_dn: float
    temporal_dark_noise_e: float
    temporal_dark_noise_e_sigma: float
    saturation_photons: float
    saturation_e: float
    saturation_e_sigma: float
    threshold_photons: float
    """Absolute sensitivity threshold: photons at which signal and noise are equal."""
    threshold_e: float
    dynamic_range: float
    dynamic_range_db: float
    snr_max: float
    snr_max_db: float
    linearity: Linearity | None
    saturation_index: int
    """Level of the largest variance."""
    used: NDArray[np.bool_]
    """Levels between 0 and 70 % of saturation."""
    refused: Mapping[str, str]


def emva_sheet(points: EmvaPoints, step: float = 1.0) -> EmvaSheet:
    """The sheet of a measurement, whose grey values have a distance of `step`."""
    p = points.sorted()
    refused: dict[str, str] = {}
    signal, variance = p.mean - p.dark_mean, p.variance - p.dark_variance
    top = int(np.argmax(p.variance))
    reached = top + 1 < p.mean.size and p.variance[-1] < 0.5 * p.variance[top]
    if not reached:
        refused["saturation"] = (
            "the variance does not fall at the brightest levels: saturation was not reached; take longer exposures"
        )
    used = (signal <= _RANGE * signal[top]) & (np.arange(signal.size) <= top)
    if np.count_nonzero(used & (signal > 0)) < 3:
        raise InputError("fewer than three levels lie between dark and 70 % of saturation")
    weights = np.sqrt(2.0 / p.samples[used]) * np.hypot(p.variance[used], p.dark_variance[used])
    gain, gain_sigma = _through_origin(signal[used], variance[used], weights)
    if not gain > 3 * gain_sigma:
        raise InputError("the variance does not grow with the signal; these are not raw frames of a linear sensor")
    light = _responsivity(p, signal, used, refused)
    efficiency = 100 * light[0] / gain
    efficiency_sigma = efficiency * sqrt((light[1] / light[0]) ** 2 + (gain_sigma / gain) ** 2) if light[0] > 0 else nan
    dark_dn, dark_e, dark_sigma = _dark_noise(p, (gain, gain_sigma), step, refused)
    well = _saturation(p, signal, top if reached else None, gain, gain_sigma, light[0])
    threshold_e = sqrt(p.dark_variance[0] / gain**2 + 0.25) + 0.5 if isfinite(dark_e) else nan
    threshold = threshold_e / (light[0] / gain) if light[0] > 0 else nan
    rng = well[0] / threshold if isfinite(well[0]) and isfinite(threshold) else _ratio(well[1], threshold_e)
    snr = sqrt(well[1]) if isfinite(well[1]) else nan
    return EmvaSheet(
        gain=gain,
        gain_sigma=gain_sigma,
        responsivity=light[0],
        responsivity_sigma=light[1],
        quantum_efficiency_percent=efficiency,
        quantum_efficiency_percent_sigma=efficiency_sigma,
        temporal_dark_noise_dn=dark_dn,
        temporal_dark_noise_e=dark_e,
        temporal_dark_noise_e_sigma=dark_sigma,
        saturation_photons=well[0],
        saturation_e=well[1],
        saturation_e_sigma=well[2],
        threshold_photons=threshold,
        threshold_e=threshold_e,
        dynamic_range=rng,
        dynamic_range_db=_db(rng),
        snr_max=snr,
        snr_max_db=_db(snr),
        linearity=_linearity(p, signal, top if reached else None, refused),
        saturation_index=top,
        used=used,
        refused=refused,
    )


def _ratio(a: float, b: float) -> float:
    return a / b if isfinite(a) and b > 0 else nan


def _db(ratio: float) -> float:
    return 20 * log10(ratio) if isfinite(ratio) and ratio > 0 else nan


def _through_origin(x: NDArray[np.float64], y: NDArray[np.float64], sigma: ArrayLike) -> tuple[float, float]:
    """Slope of an unweighted line through the origin, and its sigma by propagation, or by the scatter where larger."""
    slope = float(x @ y / (x @ x))
    stated = float(np.sqrt(np.sum((x * np.asarray(sigma)) ** 2)) / (x @ x))
    # Each residual by itself, since the noise may grow with x; enlarged by what the line took of it.
    residual = (y - slope * x) / np.sqrt(np.maximum(1 - x**2 / (x @ x), 0.1))
    scatter = float(np.sqrt(np.sum((x * residual) ** 2)) / (x @ x))
    return slope, max(stated, scatter)


def _responsivity(
    p: EmvaPoints, signal: NDArray[np.float64], used: NDArray[np.bool_], refused: dict[str, str]
) -> tuple[float, float]:
    if not np.isfinite(p.photons).all() or not (p.photons > 0).all():
        refused["quantum efficiency"] = (
            "photons per pixel are not stated; give photons_per_pixel, or irradiance_uw_cm2 with wavelength_nm, "
            "exposure_ms and camera.pixel_size_um"
        )
        return nan, nan
    return _through_origin(p.photons[used], signal[used], p.mean_sigma[used])


def _dark_noise(
    p: EmvaPoints, gain_of: tuple[float, float], step: float, refused: dict[str, str]
) -> tuple[float, float, float]:
    """Of the shortest exposure: grey values, electrons, sigma."""
    gain, gain_sigma = gain_of
    least, rounding = LEAST_VARIANCE * step**2, QUANTISATION * step**2
    variance = float(p.dark_variance[0])
    if not isfinite(variance):
        refused["dark noise"] = "there are no dark frames, two or more at an exposure"
        return nan, nan, nan
    if variance < least:
        refused["dark noise"] = (
            f"the dark variance is {variance:.3g} DN²; below {least:.3g} DN² rounding hides the noise, the "
            f"standard states it as below {0.4 * step / gain:.3g} electrons"
        )
        return sqrt(variance), nan, nan
    noise = sqrt(variance - rounding) / gain
    relative = variance * sqrt(2.0 / p.samples[0]) / (2 * (variance - rounding))
    return sqrt(variance), noise, noise * sqrt(relative**2 + (gain_sigma / gain) ** 2)


def _saturation(
    p: EmvaPoints, signal: NDArray[np.float64], top: int | None, gain: float, gain_sigma: float, responsivity: float
) -> tuple[float, float, float]:
    """Saturation capacity in photons and electrons, and the sigma of the latter by the spacing of the levels."""
    if top is None:
        return nan, nan, nan
    gap = float(signal[min(top + 1, signal.size - 1)] - signal[max(top - 1, 0)]) / 2 / sqrt(3.0)
    relative = sqrt((gap / signal[top]) ** 2 + (gain_sigma / gain) ** 2)
    if isfinite(responsivity):
        photons = float(p.photons[top])
        electrons = photons * responsivity / gain
        return photons, electrons, electrons * relative
    electrons = float(signal[top]) / gain
    return nan, electrons, electrons * relative


def _linearity(
    p: EmvaPoints, signal: NDArray[np.float64], top: int | None, refused: dict[str, str]
) -> Linearity | None:
    if not np.isfinite(p.photons).all():
        refused["linearity error"] = "photons per pixel are not stated"
        return None
    limit = float(signal[top]) if top is not None else float(signal.max()) / 0.95
    end = signal.size if top is None else top + 1
    try:
        return linearity(p.photons[:end], signal[:end], p.mean_sigma[:end], limit)
    except InputError as error:
        refused["linearity error"] = str(error)
        return None
