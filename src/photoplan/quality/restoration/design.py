"""Design of restoration filters: apertures, noise, compression, inverse and regularised filters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import pi, sqrt
from typing import Any, Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from photoplan.arrays import Floats, Mask
from photoplan.errors import InputError
from photoplan.quality.curves import GAUSSIAN_WIDTH, MtfCurve, SpreadFunction, disc_transfer
from photoplan.quality.restoration.restorer import (
    FOLDS,
    FilterKernel,
    SceneStatistics,
    Transfer,
    block_spectra,
    frequency_grid,
)

#: Frequencies per axis over which the series of the inverse is summed.
_GRID = 256
#: Where less than this of a frequency is left, the aperture cannot be undone.
LEAST_TRANSFER = 0.05


def aperture_transfer(shape: Literal["square", "round"], ratio: float, u: Floats, v: Floats) -> Floats:
    """Transfer function of an aperture."""
    if shape == "square":
        return np.asarray(np.sinc(ratio * u) * np.sinc(ratio * v))
    return disc_transfer(ratio / 2.0, np.hypot(u, v))


def aperture_filter(shape: Literal["square", "round"], ratio: float = 1.0, half: int = 4) -> Floats:
    """Filter that undoes an aperture: the Fourier series of the inverse transfer function up to 0.5 cycles per step.

    With ratio 1 and nine values a side these are He's matrices; the square one is printed divided by its sum, the
    round one before that.
    """
    if not 0.0 < ratio <= 10.0:
        raise InputError(f"aperture by step {ratio:g}; allowed are numbers above 0 up to 10")
    if not 1 <= half <= 50:
        raise InputError(f"a filter of {half} pixels to each side; allowed are 1 to 50")
    frequency = (np.arange(_GRID) + 0.5) / _GRID - 0.5
    transfer = aperture_transfer(shape, ratio, frequency[None, :], frequency[:, None])
    least = float(transfer.min())
    if least < LEAST_TRANSFER:
        raise InputError(
            f"a {shape} aperture of {ratio:g} steps leaves {max(least, 0.0):.3f} of a frequency that the scan shows; "
            "undoing it would amplify noise without bound. Use a regularised filter, or ratios up to "
            f"{_largest_ratio(shape):.2f}"
        )
    waves = np.cos(2.0 * pi * np.outer(np.arange(-half, half + 1), frequency))
    series = waves @ (1.0 / transfer) @ waves.T / _GRID**2
    return np.asarray(series / series.sum())


def _largest_ratio(shape: Literal["square", "round"]) -> float:
    """The largest ratio, in hundredths, at which everything up to the corner of the frequency square is left."""
    corner = np.array(0.5)
    ratios = np.arange(1.0, 3.0, 0.01)
    left = [float(aperture_transfer(shape, float(r), corner, corner)) for r in ratios]
    return float(ratios[int(np.argmax(np.array(left) < LEAST_TRANSFER)) - 1])


#: Side of the blocks that are compressed, pixels.
BLOCK = 8
#: Steps that are tried, grey values.
_STEPS = range(2, 121)
#: Mean cosine of a coefficient's place between multiples of a step from which on the step is found; 1: on them all.
_ON_STEPS = 0.5
#: Share of the coefficients that are not rounded to zero, and number of them, that a step needs.
_SEEN, _COUNT = 0.002, 8
#: Share of the frequencies that must show steps, for the image to count as compressed.
_COMPRESSED = 0.2
#: Part of an image's power that coefficients must hold for it to be the scene's and not that of borders of blocks.
_HELD = 0.3


def kept_by_compression(pixels: Floats) -> Floats:
    """Share of what an image shows at each frequency that is the scene, as compression by blocks has left it.

    It is the slope of the scene on the rounded coefficients, for a Laplacian distribution of the coefficients (Lam and
    Goodman 2000) by the share of them that are zero.
    """
    parts = pixels.reshape(pixels.shape[0], pixels.shape[1] // BLOCK, BLOCK, -1, BLOCK).swapaxes(2, 3)
    coefficients = scipy.fft.dctn(parts.reshape(-1, BLOCK, BLOCK), axes=(1, 2), norm="ortho").reshape(-1, BLOCK * BLOCK)
    steps = np.array([0.0, *(_step(row) for row in coefficients.T[1:])])
    if (steps > 0.0).mean() < _COMPRESSED:
        return np.ones((BLOCK, BLOCK))
    kept = np.array([_slope(row, step) for row, step in zip(coefficients.T, steps, strict=True)])
    spectrum = np.mean([block_spectra(window).mean(axis=0) for window in pixels], axis=0)
    at = np.arange(BLOCK) * spectrum.shape[0] // (2 * BLOCK)
    seen = (spectrum[np.ix_(at, at)] + spectrum[np.ix_(-at, at)]) / 2.0
    held = (coefficients**2).mean(axis=0).reshape(BLOCK, BLOCK) > _HELD * seen
    # The window of the spectra spreads the mean over the lowest frequencies.
    held[:2, :2] = True
    return np.asarray(kept.reshape(BLOCK, BLOCK) * held)


def at_frequencies(kept: Floats, u: Floats, v: Floats) -> Floats:
    """Return what `kept_by_compression` found at frequencies up to 0.5 cycles per pixel; arrays that broadcast."""
    at = np.arange(BLOCK) / (2.0 * BLOCK)
    along, down = (np.stack([np.interp(np.abs(f), at, unit) for unit in np.eye(BLOCK)]) for f in (u, v))
    return np.asarray(np.einsum("ij,i...,j...->...", kept, down, along))


def _step(values: Floats) -> float:
    """Step of which coefficients are multiples; 0 if there is none."""
    best, found = _ON_STEPS, 0.0
    size = np.sort(np.abs(values))
    for step in _STEPS:
        beyond = size[np.searchsorted(size, step / 2.0) :]
        if beyond.size < max(_COUNT, _SEEN * size.size):
            break
        on = float(np.cos(2.0 * np.pi * beyond / step).mean())
        if on >= best:
            best, found = on, float(step)
    return found


def _slope(values: Floats, step: float) -> float:
    """Slope of true on rounded coefficients; 1 where no step is known."""
    size = np.abs(np.rint(values / step)) if step > 0.0 else np.zeros(1)
    if not size.any():
        return 1.0
    rate = -2.0 * np.log(max(1.0 - float((size == 0.0).mean()), 1e-6))
    if rate <= 0.0:
        return 1.0
    # The mean of a Laplacian distribution within a step lies so much nearer to 0 than its middle.
    nearer = 0.5 / np.tanh(rate / 2.0) - 1.0 / rate
    return float(1.0 - nearer * size.mean() / (size**2).mean())


#: Side of the blocks, pixels.
BLOCK_IMAGE_NOISE = 24
#: Share of the blocks, the most even ones, that are taken to show noise alone.
_EVEN = 0.1
#: What the most even tenth of blocks of pure noise shows less than its standard deviation, found by simulation.
_TOO_SMALL = 0.894


def block_noise(grey: Floats, valid: Mask | None = None) -> Floats:
    """Standard deviation of the noise in each whole block of an image, if the scene is even there.

    Differences of differences in both directions, [1 -2 1] times [1 -2 1], leave nothing of planes and of edges along
    rows or columns; their root mean square, divided by 6, is the noise of a pixel.
    """
    rows, columns = (side // BLOCK_IMAGE_NOISE * BLOCK_IMAGE_NOISE for side in grey.shape)
    if rows == 0 or columns == 0:
        return np.empty(0)
    blocks = _blocks(np.asarray(grey, np.float64)[:rows, :columns])
    mixed = np.diff(np.diff(blocks, n=2, axis=1), n=2, axis=2)
    noise = np.sqrt((mixed**2).mean(axis=(1, 2))) / 6.0
    whole = np.isfinite(blocks).all(axis=(1, 2))
    if valid is not None:
        whole &= _blocks(valid[:rows, :columns]).all(axis=(1, 2))
    return np.asarray(noise[whole])


def image_noise(blocks: Floats) -> float:
    """Noise of an image from that of its blocks: what the most even ones show; NaN if there is none."""
    seen = np.sort(blocks[blocks > 0.0])
    if seen.size == 0:
        return float("nan")
    count = max(1, round(_EVEN * seen.size))
    return float(seen[:count].mean() / _TOO_SMALL)


def _blocks(pixels: NDArray[Any]) -> NDArray[Any]:
    """Shape (blocks, BLOCK, BLOCK)."""
    rows, columns = pixels.shape
    parts = pixels.reshape(
        rows // BLOCK_IMAGE_NOISE, BLOCK_IMAGE_NOISE, columns // BLOCK_IMAGE_NOISE, BLOCK_IMAGE_NOISE
    )
    return parts.swapaxes(1, 2).reshape(-1, BLOCK_IMAGE_NOISE, BLOCK_IMAGE_NOISE)


#: Rows of the band matrix: its borders do not reach the middle any more (Kölbl 2006, §3, takes 20).
BAND_ROWS = 61
#: Frequencies at which transfer functions are examined.
_FREQUENCIES = np.linspace(0.0, 0.5, 1001)


@dataclass(frozen=True)
class Condition:
    """Conditions on which a spread function can be inverted exactly."""

    neighbour_ratio: float
    """A / Z; exact restoration needs less than 1/2: two objects one pixel apart do not fuse (Kölbl 2006, §2)."""
    least_transfer: float
    """Smallest modulus of the transfer function up to 0.5 cycles/pixel; 0: a frequency is lost."""
    at_frequency: float
    """Frequency of that, cycles per pixel."""
    smallest_singular: float
    """Smallest singular value of the band matrix."""
    largest_singular: float
    """Largest singular value of the band matrix."""

    @property
    def number(self) -> float:
        """Condition number of the band matrix: largest by smallest singular value."""
        return self.largest_singular / self.smallest_singular if self.smallest_singular > 0.0 else float("inf")

    @property
    def holds(self) -> bool:
        """Return whether the exact inverse exists and means something."""
        return self.neighbour_ratio < 0.5 and self.least_transfer > 1e-6 and self.number < 1e6

    def __str__(self) -> str:
        verdict = "holds" if self.holds else "does not hold"
        return (
            f"A/Z = {self.neighbour_ratio:.3f} (limit 0.5), singular values {self.smallest_singular:.3f} to "
            f"{self.largest_singular:.3f}, least transfer {self.least_transfer:.3f} at {self.at_frequency:.2f} "
            f"cycles/px: the condition {verdict}"
        )


def band_matrix(spread: SpreadFunction, rows: int = BAND_ROWS) -> Floats:
    """Band matrix that makes image values of object values, shape (rows, rows) (Kölbl 2006, eq. 2)."""
    half = spread.half
    down, right = np.zeros(rows), np.zeros(rows)
    count = min(half + 1, rows)
    # Image i = sum over objects j of values[half + i - j]: below the diagonal the light that moved onwards.
    down[:count] = spread.values[half : half + count]
    right[:count] = spread.values[half::-1][:count]
    return np.asarray(scipy.linalg.toeplitz(down, right))


def condition_of(spread: SpreadFunction) -> Condition:
    """Condition of the exact inverse."""
    side = spread.side()
    transfer = np.abs(spread.transfer(_FREQUENCIES))
    least = int(np.argmin(transfer))
    singular = scipy.linalg.svdvals(band_matrix(spread))
    return Condition(
        neighbour_ratio=float(side[1] / side[0])
        if side.size > 1 and side[0] > 0.0
        else float("inf" if side[0] <= 0.0 else 0.0),
        least_transfer=float(transfer[least]),
        at_frequency=float(_FREQUENCIES[least]),
        smallest_singular=float(singular[-1]),
        largest_singular=float(singular[0]),
    )


def exact_inverse(spread: SpreadFunction, half: int = 5, rows: int = BAND_ROWS) -> Floats:
    """The one-dimensional filter that undoes a spread function: the middle row of the inverse band matrix (eq. 3).

    Parameters
    ----------
    half : int
        How many values of the row are kept to each side.
    rows : int
        Size of the band matrix, odd.

    Returns
    -------
    ndarray, shape (2 half + 1,)
        Not divided by its sum: what is cut off on both sides is missing in it.

    Raises
    ------
    InputError
        The band matrix has no inverse.
    """
    if rows % 2 == 0 or rows < 2 * half + 1:
        raise InputError(f"the band matrix has an odd number of rows, at least {2 * half + 1}; given: {rows}")
    try:
        inverse = np.linalg.inv(band_matrix(spread, rows))
    except np.linalg.LinAlgError:
        raise InputError("the band matrix of the spread function has no inverse: a frequency is lost") from None
    middle = rows // 2
    # A row of the inverse is read along the objects that give to it; as a filter it is turned round.
    return np.asarray(inverse[middle, middle - half : middle + half + 1][::-1].copy())


def curve_transfer(x: MtfCurve, y: MtfCurve) -> Transfer:
    """Transfer function of two MTF curves; between the axes it goes over with the squared cosine of the direction.

    Beyond the last frequency of a curve it is 0. Curves without standard deviations count as known.
    """

    def transfer(u: Floats, v: Floats) -> tuple[Floats, Floats]:
        square = u**2 + v**2
        frequency = np.sqrt(square)
        share = np.where(square > 0.0, u**2 / np.where(square > 0.0, square, 1.0), 0.5)
        along = [
            [
                np.zeros_like(frequency) if values is None else np.interp(frequency, curve.frequency, values, right=0.0)
                for values in (curve.modulation, curve.sigma)
            ]
            for curve in (x, y)
        ]
        modulation, sigma = (share * one + (1.0 - share) * other for one, other in zip(*along, strict=True))
        return modulation, sigma

    return transfer


def sharpest(transfer: Transfer, sigmas: float = 1.96) -> Transfer:
    """The sharpest that a transfer function may be, by so many standard deviations; it counts as known."""

    def known(u: Floats, v: Floats) -> tuple[Floats, Floats]:
        modulation, sigma = transfer(u, v)
        # A sharpened image has modulations above 1.
        return np.maximum(modulation, np.minimum(modulation + sigmas * sigma, 1.0)), np.zeros_like(sigma)

    return known


@dataclass(frozen=True, eq=False)
class Expectation:
    """Expected square errors of the filters of an image; all over one frequency square, what folds back included."""

    seen: Floats
    """Power of the image, noise included."""
    cross: Floats
    """Cross power of the image with the ideal one."""
    ideal: Floats
    """Power of the ideal image."""

    @classmethod
    def of(
        cls, transfer: Transfer, scene: SceneStatistics, aperture: float = 1.0, kept: Floats | None = None
    ) -> Expectation:
        """Return what is expected of an image."""
        u, v = frequency_grid()
        power, (modulation, sigma) = scene.power(u, v), transfer(u, v)
        ideal = np.sinc(aperture * u) * np.sinc(aperture * v)
        seen = ((modulation**2 + sigma**2) * power).sum(axis=0)
        seen += scene.noise_power(u[0] + FOLDS, v[0] + FOLDS)
        cross = (modulation * ideal * power).sum(axis=0)
        if kept is not None:
            cross = cross * at_frequencies(kept, u[0] + FOLDS, v[0] + FOLDS)
        return cls(seen, cross, (ideal**2 * power).sum(axis=0))

    @classmethod
    def mean(cls, each: Sequence[Expectation]) -> Expectation:
        """Mean of expectations, each of them in units of the error that the image has as it is."""
        shares = [1.0 / (len(each) * max(one.error(np.ones((1, 1))), 1e-300) ** 2) for one in each]
        names = ("seen", "cross", "ideal")
        return cls(*(sum(s * getattr(one, name) for s, one in zip(shares, each, strict=True)) for name in names))

    def gain(self, kernel: Floats) -> float:
        """Expected error after a filter by that of the image as it is."""
        return self.error(kernel) / max(self.error(np.ones((1, 1))), 1e-300)

    def error(self, kernel: Floats) -> float:
        """Expected root mean square difference to the ideal image after a filter, in the light of the scene."""
        base = frequency_grid()[0][0, 0]
        left, right = (
            np.exp(-2j * pi * np.outer(base, np.arange(side) - side // 2)) for side in np.asarray(kernel).shape
        )
        response = left @ kernel @ right.T
        square = (np.abs(response) ** 2 * self.seen - 2.0 * response.real * self.cross + self.ideal).mean()
        return sqrt(max(float(square), 0.0))

    def best(self, half: tuple[int, int]) -> Floats:
        """Kernel of least expected error, symmetric in x and in y, sum 1."""
        # A quadrant of the kernel is unknown; its waves are products of one per axis.
        down, right = (_waves(frequency_grid()[0][0, 0], reach) for reach in half)
        count = self.seen.size
        basis = (down[:, None, :, None] * right[None, :, None, :]).reshape(count, -1)
        normal = basis.T @ (basis * self.seen.reshape(-1, 1)) / count
        at_zero = np.multiply.outer(*(np.where(np.arange(reach + 1) > 0, 2.0, 1.0) for reach in half)).ravel()
        quadrant = _with_sum_one(normal, basis.T @ self.cross.ravel() / count, at_zero)
        quadrant = quadrant.reshape(half[0] + 1, half[1] + 1)
        rows = np.concatenate([quadrant[:0:-1], quadrant])
        return np.concatenate([rows[:, :0:-1], rows], axis=1)


def _waves(frequency: Floats, half: int) -> Floats:
    """Real waves of the values 0 to half to both sides of a symmetric kernel, shape (frequencies, half + 1)."""
    waves = np.cos(2.0 * pi * np.outer(frequency, np.arange(half + 1)))
    waves[:, 1:] *= 2.0
    return np.asarray(waves)


def _with_sum_one(normal: Floats, right: Floats, at_zero: Floats) -> Floats:
    """Least squares under the condition that the kernel's sum is 1, so that brightness stays."""
    count = right.size
    # Without noise some kernels cost nothing; a trace of noise keeps the equations solvable and changes no figure.
    bordered = np.zeros((count + 1, count + 1))
    bordered[:count, :count] = normal + np.eye(count) * 1e-9 * np.trace(normal) / count
    bordered[:count, count] = bordered[count, :count] = at_zero
    return np.asarray(np.linalg.solve(bordered, np.append(right, 1.0))[:count])


def radial_filter(inverse_x: Floats, inverse_y: Floats | None = None, distance_digits: int | None = None) -> Floats:
    """Two-dimensional filter whose row and column sums are given one-dimensional inverses, turned about its centre.

    The rotation assumption: the weight depends on the distance r from the centre, linearly between the whole distances
    0, 1, 2 … of the main axes, and is 0 beyond the last but one; where the axes differ, it goes over from one to the
    other with the squared cosine of the direction. The weights on the axes follow from the row and column sums, as
    many linear equations as unknowns. Kölbl states this principle (2006, §3); with distances rounded to two digits it
    gives the printed filters of figures 4 and 6 to the last digit.
    """
    across = np.asarray(inverse_x, float)
    along = across if inverse_y is None else np.asarray(inverse_y, float)
    _check(across, along)
    half = across.size // 2
    weights = _axis_weights(half, distance_digits)
    # Column sums are the inverse along a row, row sums the one along a column; both sides are equal by symmetry.
    equations = np.concatenate([weights.sum(axis=0)[half:], weights.sum(axis=1)[half:]])
    right = np.concatenate([across[half:], along[half:]])
    axes = np.linalg.lstsq(equations, right, rcond=None)[0]
    return np.asarray(weights @ axes)


def point_spread(x: SpreadFunction, y: SpreadFunction) -> Floats:
    """Point spread function whose sums are the spread functions along a row and along a column.

    Between the axes by the rotation assumption of `radial_filter`; both spread functions are made symmetric, and the
    shorter one is continued with 0. Shape (2 n + 1, 2 n + 1), sum 1.
    """
    half = max(x.half, y.half)
    across, along = (np.pad(one.side(), (0, half - one.half)) for one in (x, y))
    return radial_filter(np.concatenate([across[:0:-1], across]), np.concatenate([along[:0:-1], along]))


def separable_filter(inverse_x: Floats, inverse_y: Floats | None = None) -> Floats:
    """Two-dimensional filter as the product of the inverses: exact if the spread function itself is such a product.

    Shape (2 n + 1, 2 n + 1). Its noise gain is the product of both, much larger than that of `radial_filter`.
    """
    across = np.asarray(inverse_x, float)
    along = across if inverse_y is None else np.asarray(inverse_y, float)
    return np.outer(along, across)


def _check(across: Floats, along: Floats) -> None:
    if across.shape != along.shape or across.ndim != 1 or across.size % 2 == 0 or across.size < 3:
        raise InputError(
            f"both inverses have the same odd number of values, at least 3; given: {across.shape} and {along.shape}"
        )
    for name, values in (("along rows", across), ("along columns", along)):
        if np.abs(values - values[::-1]).max() > 1e-9 * np.abs(values).max():
            raise InputError(f"the inverse {name} is not symmetric; a filter turned about its centre cannot hold it")
    if abs(across.sum() - along.sum()) > 1e-9 * max(1.0, abs(along.sum())):
        raise InputError(
            f"the inverses add up to {across.sum():.6g} along rows and {along.sum():.6g} along columns; divide each by "
            "its sum"
        )


def _axis_weights(half: int, digits: int | None) -> Floats:
    """Return how each weight follows from those on the axes, shape (2 n + 1, 2 n + 1, 1 + 2 n): centre, x axis, y
    axis."""
    offset = np.arange(-half, half + 1.0)
    x, y = np.meshgrid(offset, offset)
    distance = np.hypot(x, y)
    if digits is not None:
        distance = np.round(distance, digits)
    with np.errstate(invalid="ignore", divide="ignore"):
        share_x = np.where(distance > 0.0, x**2 / (x**2 + y**2), 0.5)
    below = np.floor(distance + 1e-12).astype(int)
    weights = np.zeros((*distance.shape, 1 + 2 * half))
    for whole, part in ((below, 1.0 - (distance - below)), (below + 1, distance - below)):
        for ring in range(half + 1):
            here = np.where(whole == ring, part, 0.0)
            if ring == 0:
                weights[..., 0] += here
            else:
                weights[..., ring] += here * share_x
                weights[..., half + ring] += here * (1.0 - share_x)
    return weights


#: Sizes that are tried until nothing that matters is cut off an exact inverse, pixels to each side.
_HALVES = (5, 7, 10, 14, 20, 28)
#: Share of an inverse that may be cut off.
_CUT_OFF = 0.002
#: Width of the 95 % interval of MTF50, by its value, beyond which a spread function is practically unknown.
_UNKNOWN = 0.5
#: What a filter may leave of the error at most where the scenes that an image may show speak for different ones.
_CLEAR = 0.98
#: Smoothing of noise that is worth a word, pixels.
_SMOOTHED = 0.1
Method = Literal["none", "exact", "regularised"]
_AS_IT_IS = np.ones((1, 1))
#: How messages call the methods.
_NAMES = {"none": "as it is", "regularised": "regularised", "exact": "exact"}


@dataclass(frozen=True, eq=False)
class Sharpness:
    """Sharpness of an image in one direction, as far as it is known."""

    spread: SpreadFunction
    curve: MtfCurve | None = None
    """MTF, also beyond 0.5 cycles/pixel; None: that of the Gaussian of one pixel's aperture with the same spread."""

    def modulation(self) -> MtfCurve:
        """The curve, or its Gaussian stand-in."""
        if self.curve is not None:
            return self.curve
        # The discrete spread function holds the aperture twice: that of the sensor and that of the object pixel.
        variance = (self.spread.gaussian_fwhm() / GAUSSIAN_WIDTH) ** 2 - 2.0 / 12.0
        frequency = np.linspace(0.0, 2.0, 201)
        optics = np.exp(-2.0 * (pi * frequency) ** 2 * max(variance, 0.0))
        return MtfCurve(frequency, optics * np.abs(np.sinc(frequency)))

    @property
    def doubt(self) -> str:
        """Return why the spread function is practically unknown, with figures; empty if it is known."""
        curve = self.modulation()
        low, high = curve.mtf50_interval()
        value = float(np.nan_to_num(curve.mtf50, nan=curve.frequency[-1]))
        return f"MTF50 {value:.2f}, interval {low:.2f} to {high:.2f}" if high - low > _UNKNOWN * value else ""


@dataclass(frozen=True)
class DesignOptions:
    """Choices of the user."""

    method: Literal["auto", "exact", "regularised"] = "auto"
    rotation: Literal["radial", "separable"] = "radial"
    """Way in which an exact inverse becomes two-dimensional."""
    half: int | None = None
    """Pixels to each side; None: 5, or as many as an exact inverse needs."""
    aperture: float = 1.0
    """Side of the ideal aperture that 'regularised' aims at, pixels."""


@dataclass(frozen=True, eq=False)
class Design:
    """A designed kernel and why it is as it is."""

    kernel: Floats
    """Shape (2 m + 1, 2 n + 1), sum 1; one row or one column where the other direction stays as it is."""
    method: Method
    reason: str
    """The rule that chose the method, with its figures."""
    condition_x: Condition
    condition_y: Condition
    expected: Mapping[str, float] = field(default_factory=dict)
    """Expected root mean square error in light by method, ``none`` for the image as it is; empty if unknown."""
    scene: SceneStatistics | None = None
    """Scene that the errors are expected for: the first one, or if nothing is done that in which a filter would gain
    least."""

    @property
    def noise_gain(self) -> float:
        """By what factor noise grows."""
        return FilterKernel(self.kernel).noise_gain

    @property
    def expectation(self) -> str:
        """The expected errors, for people; empty if they are unknown."""
        return ", ".join(f"{error:.3g} {_NAMES[method]}" for method, error in self.expected.items())


def design_filter(
    x: Sharpness,
    y: Sharpness,
    scenes: Sequence[SceneStatistics] = (),
    options: DesignOptions | None = None,
    kept: Floats | None = None,
) -> Design:
    """Restoration filter of an image whose sharpness is known along rows and along columns.

    Along a direction whose MTF50 has an interval wider than half its value the image stays as it is. Of filters that
    are expected to gain in one scene and lose in another the one counts that gains most in its worst scene; `auto`
    takes none that does not gain in all.

    Parameters
    ----------
    x, y : Sharpness
        Along a row (across columns) and along a column.
    scenes : sequence of SceneStatistics
        Noise and spectrum that the image may have, the likeliest first; only an exact inverse that is asked for can do
        without.
    kept : ndarray, shape (8, 8), optional
        What compression has left of the scene (`kept_by_compression`); None: all.

    Raises
    ------
    InputError
        The exact inverse is asked for and its condition does not hold or the spread function is practically unknown,
        the latter in both directions whatever is asked for, or the scene is needed and missing.
    """
    asked = options or DesignOptions()
    both = dict(zip(("along rows", "along columns"), (x, y), strict=True))
    conditions = (condition_of(x.spread), condition_of(y.spread))
    doubts = [f"{name}: {one.doubt}" for name, one in both.items() if one.doubt]
    broken = [f"{name}: {c}" for name, c in zip(both, conditions, strict=True) if not c.holds]
    _refuse(asked, doubts, broken, scenes)
    exact: dict[Method, Floats] = {}
    if asked.method != "regularised" and not broken and not doubts:
        exact["exact"] = _exact(x.spread, y.spread, asked)
    notes = [f"not inverted, practically unknown {doubt}" for doubt in doubts]
    if asked.method == "auto" and broken:
        notes.append("no exact inverse " + "; ".join(broken))
    if not scenes:
        return Design(exact["exact"], "exact", "; ".join(["exact: as asked for", *notes]), *conditions)
    curves = [one.modulation() if not one.doubt else _ideal_curve(asked.aperture) for one in (x, y)]
    choice = _Choice.of(curve_transfer(*curves), scenes, asked.aperture, kept)
    half = asked.half or _HALVES[0]
    regularised = choice.regularised((0 if y.doubt else half, 0 if x.doubt else half))
    kernels: dict[Method, Floats] = {"regularised": regularised, **exact}
    method, why = (asked.method, "as asked for") if asked.method != "auto" else choice.method(kernels)
    index = choice.worst(regularised) if method == "none" else 0
    every: dict[str, Floats] = {"none": _AS_IT_IS, **{str(name): each for name, each in kernels.items()}}
    expected = {name: choice.models[index].error(each) for name, each in every.items()}
    if kept is not None and kept.min() < 1.0:
        notes.append(f"compression has left {100 * kept.mean():.0f} % of the fine detail")
    notes.append(f"{_told(scenes[index])}, ideal aperture {asked.aperture:g} px")
    if expected[method] > expected["none"]:
        notes.append("more error is expected than the image has as it is")
    kernel = kernels.get(method, _AS_IT_IS)
    return Design(kernel, method, f"{method}: " + "; ".join([why, *notes]), *conditions, expected, scenes[index])


def _refuse(asked: DesignOptions, doubts: list[str], broken: list[str], scenes: Sequence[SceneStatistics]) -> None:
    if len(doubts) == 2 or (doubts and asked.method == "exact"):
        raise InputError(
            "the spread function is practically unknown "
            + "; ".join(doubts)
            + ". It is not inverted; give images with "
            "more or clearer edges, or a filter"
        )
    if asked.method == "exact" and broken:
        raise InputError(
            "the image cannot be restored exactly: " + "; ".join(broken) + ". Objects that have fused cannot be told "
            "apart; use `method` regularised"
        )
    if not scenes and asked.method != "exact":
        raise InputError("a filter of least error needs the noise and the contrast of the scene; state both")


def _told(scene: SceneStatistics) -> str:
    """Noise and spectrum of a scene, for people."""
    smoothed = f", smoothed by {scene.smoothed:.2f} px" if scene.smoothed > _SMOOTHED else ""
    white = f" and a white part of {scene.texture:.3g}" if scene.texture > 0.1 * scene.contrast else ""
    return (
        f"noise {scene.noise:.3g}{smoothed}, neighbouring pixels of an ideal image differ by {scene.contrast:.3g} "
        f"(rms), spectrum of the scene ν^-{scene.exponent:.2f}{white}"
    )


@dataclass(frozen=True, eq=False)
class _Choice:
    """Expectations of all that an image may show, and the filter that they speak for."""

    scenes: Sequence[SceneStatistics]
    plain: Sequence[Expectation]
    """One for each scene, as if nothing were lost by compression: what filters are designed by."""
    models: Sequence[Expectation]
    """The same with what is lost: what filters are judged by."""
    sharp: Sequence[Expectation]
    """The judges, were the image as sharp as it may be."""

    @classmethod
    def of(cls, transfer: Transfer, scenes: Sequence[SceneStatistics], aperture: float, kept: Floats | None) -> _Choice:
        """Return the choice for an image of a modulation transfer."""
        cases = ((transfer, None), (transfer, kept), (sharpest(transfer), kept))
        return cls(scenes, *([Expectation.of(h, s, aperture, lost) for s in scenes] for h, lost in cases))

    def worst(self, kernel: Floats) -> int:
        """The scene in which a filter gains least."""
        return int(np.argmax([model.gain(kernel) for model in self.models]))

    def gain(self, kernel: Floats) -> float:
        """Return what a filter leaves of the error in its worst scene."""
        return self.models[self.worst(kernel)].gain(kernel)

    def regularised(self, half: tuple[int, int]) -> Floats:
        """Return the filter that gains most in its worst scene, of the best filters of each scene and of their mean."""
        means = [Expectation.mean(self.plain)] if len(self.plain) > 1 else []
        return min((model.best(half) for model in [*self.plain, *means]), key=self.gain)

    def method(self, kernels: Mapping[Method, Floats]) -> tuple[Method, str]:
        """Method of least expected error in the worst scene, and why."""
        method = min(kernels, key=lambda each: self.gain(kernels[each]))
        kernel = kernels[method]
        gains = [model.gain(kernel) for model in self.models]
        if max(gains) > 1.0 > min(gains):
            told = "; ".join(f"{100 * g:.0f} % ({_told(s)})" for s, g in zip(self.scenes, gains, strict=True))
            return "none", (
                f"fine texture and noise cannot be told apart here, and {method} might do harm: of the error it would "
                f"leave {told}. State the noise if you know it"
            )
        if max(gains) > (_CLEAR if max(gains) - min(gains) > 1.0 - _CLEAR else 1.0):
            return "none", f"{method} is expected to leave {100 * max(gains):.0f} % of the error"
        # The error that is expected is a mean over what the MTF may be; an image that is sharp already must not suffer.
        left = max(self.sharp, key=lambda model: model.gain(kernel))
        if left.gain(kernel) > 1.0:
            before, after = left.error(_AS_IT_IS), left.error(kernel)
            return "none", (
                f"were the MTF at the upper end of its interval, {method} would leave {after:.3g} and not {before:.3g}"
            )
        return method, "least expected error"


def _ideal_curve(aperture: float) -> MtfCurve:
    """MTF of an ideal aperture: nothing is left to be restored."""
    frequency = np.linspace(0.0, 4.0, 401)
    return MtfCurve(frequency, np.abs(np.sinc(aperture * frequency)))


def _exact(x: SpreadFunction, y: SpreadFunction, asked: DesignOptions) -> Floats:
    """Two-dimensional filter of the exact inverses, large enough, sum 1."""
    for half in _HALVES if asked.half is None else (asked.half,):
        # Both sides averaged: a filter turned about its centre has no other.
        inverses = [exact_inverse(SpreadFunction.symmetric(s.side()), half, 8 * half + 41) for s in (x, y)]
        cut = max(float(abs(i.sum() - 1.0)) + abs(float(i[0])) for i in inverses)
        if cut < _CUT_OFF * sqrt(2.0 * half + 1.0):
            break
    ones = [inverse / inverse.sum() for inverse in inverses]
    return radial_filter(*ones) if asked.rotation == "radial" else separable_filter(*ones)
