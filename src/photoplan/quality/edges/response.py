"""Responses of edges: spread function, MTF, confidence."""

from __future__ import annotations

from dataclasses import dataclass
from math import log, nan, pi, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from photoplan.adjustment.least_squares import solve
from photoplan.arrays import Floats, Mask
from photoplan.errors import InputError
from photoplan.quality.curves import GAUSSIAN_WIDTH, MtfCurve, SpreadFunction
from photoplan.quality.edges.find import (
    EdgeResiduals,
    EdgeSettings,
    check_certainty,
    check_clipping,
    check_line,
    check_one_peak,
    check_overshoot,
    check_region,
    check_sides,
    check_step,
    grain,
)
from photoplan.quality.edges.line import (
    EdgeFit,
    EdgeLine,
    EdgePixels,
    PixelEdge,
    ProfileBasis,
    determines,
    find_line,
    fit_line,
    fit_profile,
)

#: Line spread function and edge profile are looked at this densely: lines for each standard deviation.
DENSITY = 25
#: Reach, in standard deviations of the trend, within which width, over- and undershoot are looked for.
REACH = 8.0
#: Standard deviation of the light beyond the window, relative to what is estimated by the square of the distance: 95 %
#: reach from none of it, as where a bell ends, to twice as much.
BEYOND = 0.5
#: Frequencies for each cycle per pixel at which the transfer function is computed.
FREQUENCIES = 128


@dataclass(frozen=True, eq=False)
class EdgeShape:
    """Linear maps from the coefficients of a profile, and from light beyond the window, to what is read from it.

    That light is half of it on each side, so far away that only the levels and the modulation at frequency 0 have it;
    it is never less than none.
    """

    at: Floats
    edge: Floats
    ends: Floats
    line: Floats
    frequency: Floats
    transfer: NDArray[np.complex128]
    steps: Floats
    tails: Floats

    @classmethod
    def of(cls, fit: EdgeFit, highest: float) -> EdgeShape:
        """Maps for a fit, with frequencies up to the highest one that its pixels determine."""
        basis = fit.basis
        spacing = basis.model.total / DENSITY
        low = max(basis.low, -REACH * basis.model.total)
        high = min(basis.high, REACH * basis.model.total)
        at = np.linspace(low, high, int((high - low) / spacing) + 2)
        frequency = np.linspace(0.0, highest, max(2, round(highest * FREQUENCIES) + 1))
        far = (np.full(at.size, 0.5), np.zeros(at.size), (frequency == 0.0) + 0.0j, 1.0)
        near = (basis.edge(at), basis.line(at), basis.transfer(frequency), basis.steps)
        edge, line, transfer, steps = (np.append(a, np.expand_dims(b, -1), axis=-1) for a, b in zip(near, far))
        ends = np.append(basis.edge(np.array([basis.low, basis.high])), [[0.5], [0.5]], axis=-1)
        return cls(
            at=at,
            edge=edge,
            ends=ends,
            line=line,
            frequency=frequency,
            transfer=transfer,
            steps=steps,
            tails=np.append(basis.tails, 1.0),
        )

    def allowed(self, shapes: Floats) -> Floats:
        """Coefficients (k, size + 1) with what makes negative tails none."""
        filled = shapes.copy()
        filled[:, -1] += np.maximum(0.0, -(shapes @ self.tails))
        return filled

    def modulation(self, shapes: Floats) -> Floats:
        """Modulation (k, frequencies) of coefficients (k, size + 1): 1 at frequency 0."""
        return np.asarray(np.abs(shapes @ self.transfer.T) / (shapes @ self.steps)[:, None])

    def figures(self, shapes: Floats) -> Floats:
        """MTF50, MTF10, FWHM, overshoot, undershoot, modulation at 0.5: shape (k, 6) for coefficients (k, size + 1)."""
        step = (shapes @ self.steps)[:, None]
        edges, ends, lines = (shapes @ each.T / step for each in (self.edge, self.ends, self.line))
        rows = []
        for edge, end, line, curve in zip(edges, ends, lines, self.modulation(shapes)):
            mtf = MtfCurve(self.frequency, curve)
            over, under = _beyond(self.at, edge, end)
            rows.append([mtf.mtf50, mtf.mtf10, _width(self.at, line), over, under, mtf.at(0.5)])
        return np.array(rows)


@dataclass(frozen=True, eq=False)
class EdgeFigures:
    """What `edge_figures` returns; standard deviations and intervals as in `EdgeMeasurement`."""

    values: Floats
    sigma: Floats
    modulation: Floats
    modulation_sigma: Floats
    factor: float
    """How many standard deviations the interval reaches to each side."""
    freedom: int
    """Degrees of freedom of the intervals."""

    def interval(self, which: int) -> tuple[float, float]:
        """Interval of a figure; NaN where it would reach 0 or below, so that the pixels do not determine the figure."""
        value, reach = float(self.values[which]), self.factor * float(self.sigma[which])
        return (value - reach, value + reach) if reach < value else (np.nan, np.nan)


def edge_figures(fit: EdgeFit, shape: EdgeShape, confidence: float) -> EdgeFigures:
    """Figures of a profile and their standard deviations.

    The edge is split along its length into blocks, each of which is a profile of its own. The spread between the
    figures with one block left out (jackknife; Efron and Tibshirani 1993, eq. 11.5) holds noise of any distribution
    and correlation within a block. It cannot hold what the prior hides in all blocks alike, which is added: the change
    of a figure in each direction in which the shape may differ unseen, and by the light beyond the window (`BEYOND`).
    Intervals use Student's distribution with one degree of freedom less than blocks.
    """
    blocks = fit.left_out.shape[0]
    unseen = np.zeros((fit.hidden.shape[0] + 1, fit.shape.size + 1))
    unseen[:-1, :-1] = fit.hidden
    unseen[-1, -1] = BEYOND * fit.beyond[0] * fit.step
    known = np.pad(np.vstack([fit.shape, fit.left_out]), ((0, 0), (0, 1)))
    all_shapes = shape.allowed(np.concatenate([known, known[:1] + unseen, known[:1] - unseen]))
    figures, curves = shape.figures(all_shapes), shape.modulation(all_shapes)
    sigma = _spread(figures, blocks)
    factor = float(stdtrit(blocks - 1, 0.5 + confidence / 2))
    return EdgeFigures(
        values=figures[0],
        sigma=sigma,
        modulation=curves[0],
        modulation_sigma=_spread(curves, blocks),
        factor=factor,
        freedom=blocks - 1,
    )


def gaussian_width(mtf50: float) -> float:
    """FWHM of the Gaussian with the same frequency at half modulation, pixels."""
    return GAUSSIAN_WIDTH * sqrt(log(2.0) / 2.0) / (pi * mtf50) if mtf50 > 0.0 else nan


def _spread(values: Floats, blocks: int) -> Floats:
    left_out = values[1 : blocks + 1]
    hidden = (values.shape[0] - blocks - 1) // 2
    plus, minus = values[blocks + 1 : blocks + 1 + hidden], values[blocks + 1 + hidden :]
    jackknife = (blocks - 1) / blocks * ((left_out - left_out.mean(axis=0)) ** 2).sum(axis=0)
    return np.asarray(np.sqrt(jackknife + (((plus - minus) / 2.0) ** 2).sum(axis=0)))


def _width(at: Floats, line: Floats) -> float:
    """Distance between the outermost crossings of half the maximum; NaN if a side does not fall so low."""
    top = int(np.argmax(line))
    half = _peak(line, top) / 2.0
    above = np.flatnonzero(line >= half)
    if half <= 0.0 or above.size == 0 or above[0] == 0 or above[-1] == line.size - 1:
        return nan
    a, b = int(above[0]) - 1, int(above[-1]) + 1
    start = at[a] + (half - line[a]) / (line[a + 1] - line[a]) * (at[a + 1] - at[a])
    end = at[b] - (half - line[b]) / (line[b - 1] - line[b]) * (at[b] - at[b - 1])
    return float(end - start)


def _peak(line: Floats, top: int) -> float:
    """Height of the parabola through the largest value and its neighbours."""
    if top in (0, line.size - 1):
        return float(line[top])
    left, middle, right = line[top - 1 : top + 2]
    curvature = 2.0 * middle - left - right
    return float(middle + (right - left) ** 2 / (8.0 * curvature)) if curvature > 0.0 else float(middle)


def _beyond(at: Floats, edge: Floats, ends: Floats) -> tuple[float, float]:
    """How far the profile rises above what it is at the bright end, and falls below the dark one; not below 0."""
    bright, dark = edge[at > 0.0], edge[at < 0.0]
    over = float(bright.max() - ends[1]) if bright.size else 0.0
    under = float(ends[0] - dark.min()) if dark.size else 0.0
    return max(over, 0.0), max(under, 0.0)


#: Distance between the lines of the profile that is handed out, pixels.
SPACING = 0.125
#: Steps of the first fit, to all pixels, which only tells those that are near.
_FIRST_STEPS = 8
#: Pixels beyond which those far from the edge are left out at once.
MANY = 50_000
#: Largest distance between neighbouring samples in the edge, pixels, at which it counts as super-sampled.
DENSE = 0.25
#: Distance of samples from which on an edge counts as aligned with the pixels.
_ONE_PHASE = 0.9
#: How much a modulation may rise with frequency by noise.
_RISES = 0.02
#: What a mixture must leave of a modulation so that it tells whether that rises.
_TOLD = 0.3
#: How far modulations are off by what the levels beside the edge are off.
_LEVELS = 0.02


@dataclass(frozen=True, eq=False)
class EdgeProfile:
    """A function of the distance from the edge."""

    positions: Floats
    """Distances from the line in pixels, positive on the bright side, shape (n,)."""
    values: Floats
    """Shape (n,)."""
    sigma: Floats
    """Standard deviations, shape (n,)."""


@dataclass(frozen=True, eq=False)
class EdgeMeasurement:
    """One edge of an image; lengths in pixels, frequencies in cycles per pixel, both along the normal of the edge.

    Edge and line spread functions hold all that lies between object and grey value: optics, movement, and the pixel
    itself. Figures that the edge does not determine are NaN.
    """

    col: float
    """Column of the middle of the edge in the image."""
    row: float
    """Row of the middle of the edge in the image."""
    angle_deg: float
    """Direction in which brightness rises across the edge: 0 along a row to the right (a vertical edge), 90 down a
    column, in −180 < angle ≤ 180."""
    direction: str
    """``x``: the transition is closer to the rows, so it shows the quality across columns; ``y``: across rows."""
    length: float
    """Length of the edge in the region."""
    dark: float
    """Light on the dark side, far from the edge, at its middle."""
    bright: float
    """Light on the bright side, far from the edge, at its middle."""
    noise: float
    """Standard deviation of a pixel."""
    esf: EdgeProfile
    """Edge spread function from 0 to 1 (as fitted to all pixels)."""
    lsf: EdgeProfile
    """Line spread function, per pixel; area 1."""
    samples: EdgeProfile
    """Means of the pixels themselves from 0 to 1: of one pixel width each where the edge is aligned with the pixels,
    else of a quarter pixel."""
    mtf: MtfCurve
    """Modulation transfer function with standard deviations, up to 1 cycle per pixel or, where the samples are farther
    apart than half a pixel, to the highest frequency that they determine."""
    mtf50: float
    mtf50_interval: tuple[float, float]
    mtf10: float
    mtf10_interval: tuple[float, float]
    fwhm: float
    """Full width at half maximum of the line spread function."""
    fwhm_interval: tuple[float, float]
    gaussian_fwhm: float
    """FWHM of the Gaussian with the same MTF50; it differs from `fwhm` as the form differs from a Gaussian."""
    overshoot: float
    """How far the profile rises above the bright level beside the edge, relative to the step; 0 if it does not."""
    overshoot_sigma: float
    undershoot: float
    """How far the profile falls below the dark level beside the edge, relative to the step; 0 if it does not."""
    undershoot_sigma: float
    nyquist: float
    """Modulation at 0.5 cycles per pixel."""
    straightness: float
    """Root mean square deviation from the line beyond what noise explains."""
    structure: float
    """Root mean square structure beside the edge beyond what noise explains, relative to the step."""
    phase_gap: float
    """Largest distance between neighbouring samples of the profile in the edge: 1 if it is aligned with the pixels."""
    window: tuple[float, float]
    """Distances between which the profile is determined."""
    beyond: float
    """Share of the light that is spread farther than that, estimated from what the line spread function is at the ends;
    it is in levels, profiles and modulation. Not below 0."""
    beyond_sigma: float
    """It holds the noise, and half of the estimate for the form of the tails."""
    confidence: float
    """Probability of the intervals."""
    freedom: int
    """Degrees of freedom of their standard deviations."""

    @property
    def sampling(self) -> str:
        """``super-sampled`` if all phases of the pixel occur, else ``few phases``.

        With few phases the form between the samples is that of the model (Gaussian and pixel, with smooth deviations),
        which the pixels cannot test.
        """
        return "super-sampled" if self.phase_gap <= DENSE else "few phases"

    @property
    def snr(self) -> float:
        """Step from dark to bright relative to the noise of a pixel."""
        return (self.bright - self.dark) / self.noise if self.noise > 0.0 else float("inf")


def measure_edge(
    pixels: Floats,
    valid: Mask | None = None,
    *,
    limits: tuple[float, float] | None = None,
    origin: tuple[float, float] = (0.0, 0.0),
    settings: EdgeSettings | None = None,
) -> EdgeMeasurement:
    """Measure the one edge that a region holds.

    Parameters
    ----------
    pixels
        Linear light, shape (rows, columns); NaN is not valid.
    valid
        Mask of the same shape; None: all finite pixels.
    limits
        Light at which pixels are clipped, low and high (`Linearisation.limits`); None: not checked.
    origin
        Column and row of the region's first pixel in the image.
    settings
        What the edge must be like.

    Raises
    ------
    InputError
        For no edge, a saturated, too noisy, too short or bent one, a second edge, a corner, or textured sides.
    """
    chosen = settings or EdgeSettings()
    image = np.asarray(pixels, np.float64)
    mask = np.ones(image.shape, bool) if valid is None else np.asarray(valid, bool)
    mask = check_region(image, mask)
    line = find_line(image, mask)
    every = EdgePixels.of(image, mask, line.direction)
    if every.light.size > MANY:
        every = every.where(np.abs(line.distance(every.across, every.along)) <= max(4.0 * chosen.reach, 64.0))
    line, model, levels = fit_line(every, line, chosen.curve, True, _FIRST_STEPS)
    near = np.abs(line.distance(every.across, every.along)) < 2.5 * model.total
    if np.count_nonzero(near) > 40 and determines(every.where(near), line, model, chosen.curve):
        line, model, levels = fit_line(every.where(near), line, chosen.curve, False)
    distance = line.distance(every.across, every.along)
    check_clipping(every.light, distance, limits, chosen.most_clipped)
    low, high = _window(distance, model, max(chosen.reach, 8.0 * model.total))
    inside = (distance >= low) & (distance <= high)
    seen, distance = every.where(inside), distance[inside]
    span = _span(seen, distance, model, line, chosen)
    weight, first_noise = _weights(seen, distance, line, model)
    own = grain(seen.light, seen.along, seen.across)
    check_step(float(levels[1]), first_noise, own, chosen)
    try:
        fit = _fit(seen, distance, weight, line, ProfileBasis.between(model, low, high), chosen)
    except np.linalg.LinAlgError as error:
        raise InputError("the region's pixels do not determine a profile; choose a larger region") from error
    return _measured(
        _Context(pixels=seen, distance=distance, line=line, fit=fit, span=span, origin=origin, settings=chosen)
    )


@dataclass(frozen=True, eq=False)
class _Context:
    pixels: EdgePixels
    distance: Floats
    line: EdgeLine
    fit: EdgeFit
    span: tuple[float, float]
    origin: tuple[float, float]
    settings: EdgeSettings


def _window(distance: Floats, model: PixelEdge, reach: float) -> tuple[float, float]:
    """Distances within a reach up to which every step of a pixel holds a third as many pixels as the edge itself."""
    if not distance.min() < 0.0 < distance.max():
        raise InputError("no edge: the line that suits the brightness best lies outside the region")
    count = np.bincount((np.floor(distance) - np.floor(distance.min())).astype(np.intp))
    zero = int(-np.floor(distance.min()))
    core = max(1, round(2.0 * model.total))
    usual = float(np.median(count[max(zero - core, 0) : zero + core]))
    poor = count < usual / 3.0
    before, after = np.flatnonzero(poor[:zero]), np.flatnonzero(poor[zero:])
    low = float(before[-1] + 1 - zero) if before.size else float(distance.min())
    high = float(after[0]) if after.size else float(distance.max())
    low, high = max(low, -reach), min(high, reach)
    if min(-low, high) < 3.0 * model.total:
        raise InputError(
            f"the region is too narrow for the edge, or holds none: it reaches {min(-low, high):.1f} pixels beside a "
            f"transition {2.35 * model.total:.1f} pixels wide; {3.0 * model.total:.1f} are needed on both sides"
        )
    return low, high


def _span(
    pixels: EdgePixels, distance: Floats, model: PixelEdge, line: EdgeLine, settings: EdgeSettings
) -> tuple[float, float]:
    """First and last row (or column) in which the edge lies in the region."""
    rows = pixels.along[np.abs(distance) <= max(model.total, 0.5)]
    length = (np.ptp(rows) + 1.0) * line.length_of_normal if rows.size else 0.0
    if length < settings.least_length:
        raise InputError(f"edge too short: {length:.1f} pixels, at least {settings.least_length:g} are needed")
    return float(rows.min()), float(rows.max())


def _weights(pixels: EdgePixels, distance: Floats, line: EdgeLine, model: PixelEdge) -> tuple[Floats, float]:
    """Weights of pixels whose noise differs between dark and bright side, and their mean noise.

    The variance of photon noise grows in proportion to the light, so it is interpolated between both sides.
    """
    rise = model.profile(distance)[0]
    design = np.concatenate([rise[:, None], _levels(pixels, distance, line, rise)], axis=1)
    residual = -solve(design, pixels.light).residuals
    dark, bright = residual[distance < -2.0 * model.total], residual[distance > 2.0 * model.total]
    if min(dark.size, bright.size) < 30:
        return np.ones_like(distance), float(residual.std())
    low, high = float(dark.var()), float(bright.var())
    usual = 0.5 * (low + high)
    if not usual > 0.0:
        return np.ones_like(distance), 0.0
    low, high = max(low, 0.01 * usual), max(high, 0.01 * usual)
    return usual / (low + (high - low) * np.clip(rise, 0.0, 1.0)), float(np.sqrt(usual))


def _levels(pixels: EdgePixels, distance: Floats, line: EdgeLine, rise: Floats) -> Floats:
    """Columns of the dark level and of the changes of both levels along the edge: across it, a slope can hardly be told
    from stray light."""
    t = (pixels.along - line.middle) / max(float(np.ptp(pixels.along)), 1.0)
    return np.stack([np.ones_like(distance), t * (1.0 - rise), t * rise], axis=1)


def _fit(
    pixels: EdgePixels, distance: Floats, weight: Floats, line: EdgeLine, basis: ProfileBasis, settings: EdgeSettings
) -> EdgeFit:
    model = basis.model
    extra = _levels(pixels, distance, line, model.profile(distance)[0])
    near = pixels.along[np.abs(distance) <= max(model.total, 0.5)]
    blocks = int(min(settings.blocks, max(5, np.ptp(near) // 2)))
    borders = np.linspace(near.min(), near.max() + 1.0, blocks + 1)[1:-1]
    starts = np.concatenate([[0], np.searchsorted(pixels.along, borders)])
    return fit_profile(basis, (distance, pixels.light, weight), extra, starts)


def _measured(found: _Context) -> EdgeMeasurement:
    fit, line, settings = found.fit, found.line, found.settings
    step, noise = fit.step, fit.noise
    beyond, spoilt = fit.beyond
    check_step(step, noise, grain(found.pixels.light, found.pixels.along, found.pixels.across), settings)
    straightness, structure = _residual_checks(found, step)
    gap = _phase_gap(found.distance, fit.basis.model)
    profiles = _profiles(found, step, gap)
    lsf = profiles["lsf"]
    # How much lies beyond the window makes both peaks of two edges higher or lower, but not one of them.
    own = np.sqrt(np.maximum(lsf.sigma**2 - (BEYOND * beyond * lsf.values) ** 2, 0.0))
    check_one_peak(lsf.positions, lsf.values, own)
    shape = EdgeShape.of(fit, min(1.0, 0.5 / gap))
    figures = edge_figures(fit, shape, settings.confidence)
    mtf50, mtf10, fwhm, over, under, nyquist = (float(v) for v in figures.values)
    check_overshoot(over, under)
    check_certainty(mtf50, figures.factor * float(figures.sigma[0]), settings.most_uncertain)
    middle = line.place(0.5 * (found.span[0] + found.span[1]))
    dark = float(fit.levels[0]) - fit.missing / 2.0
    return EdgeMeasurement(
        col=found.origin[0] + middle[0],
        row=found.origin[1] + middle[1],
        angle_deg=line.angle_deg,
        direction=line.direction,
        length=(found.span[1] - found.span[0] + 1.0) * line.length_of_normal,
        dark=dark,
        bright=dark + step,
        noise=noise,
        **profiles,
        mtf=MtfCurve(shape.frequency, figures.modulation, figures.modulation_sigma),
        mtf50=mtf50,
        mtf50_interval=_with_phase(figures.interval(0), gap, profiles["samples"]),
        mtf10=mtf10 if np.isfinite(figures.interval(1)).all() else nan,
        mtf10_interval=figures.interval(1),
        fwhm=fwhm if np.isfinite(figures.interval(2)).all() else nan,
        fwhm_interval=figures.interval(2),
        gaussian_fwhm=gaussian_width(mtf50),
        overshoot=over,
        overshoot_sigma=float(figures.sigma[3]),
        undershoot=under,
        undershoot_sigma=float(figures.sigma[4]),
        nyquist=nyquist,
        straightness=straightness,
        structure=structure,
        phase_gap=gap,
        window=(fit.basis.low, fit.basis.high),
        beyond=beyond,
        beyond_sigma=float(np.hypot(BEYOND * beyond, spoilt)),
        confidence=settings.confidence,
        freedom=figures.freedom,
    )


def _with_phase(interval: tuple[float, float], gap: float, samples: EdgeProfile) -> tuple[float, float]:
    """The interval of MTF50 of an edge along the pixels, of which one phase is sampled.

    Its samples tell a spread of whole pixels not from an edge that lies inside a pixel: there the object's edge mixes
    the grey values of one pixel before they are spread (Kölbl 2006). Their differences then are the spread function
    times (1 − a, a) for a mixture a that no sample shows. The interval holds the MTF50 of every a from 0 to ½ with
    which the modulation falls from frequency to frequency.
    """
    if gap < _ONE_PHASE or not np.isfinite(interval).all():
        return interval
    rise = np.diff(samples.values)
    rise = rise / rise.sum()
    frequency = np.linspace(0.001, 0.499, 499)
    turn = 2.0 * np.pi * frequency
    curve = np.abs(np.exp(1j * np.multiply.outer(turn, samples.positions[:-1])) @ rise)
    half = 0.5 * (interval[1] - interval[0])
    for a in np.linspace(0.0, 0.5, 26):
        mixed = np.abs(1.0 - a + a * np.exp(-1j * turn))
        spread = curve / np.maximum(mixed, 0.02)
        # At the highest frequencies a mixture of halves leaves nothing but noise.
        rises = (spread - np.minimum.accumulate(spread))[mixed > _TOLD]
        if a > 0.0 and rises.max() > _RISES:
            continue
        # The differences are as uncertain as the levels of the edge.
        low, high = (np.flatnonzero(spread < 0.5 + sign * _LEVELS) for sign in (1.0, -1.0))
        first, last = (float(frequency[k[0]]) if k.size else float(frequency[-1]) for k in (low, high))
        interval = min(interval[0], first - half), max(interval[1], last + half)
    return interval


def _phase_gap(distance: Floats, model: PixelEdge) -> float:
    """Largest distance between neighbouring samples within 1.5 standard deviations of the edge."""
    reach = max(1.5 * model.total, 1.0)
    core = np.sort(distance[np.abs(distance) <= reach])
    return float(np.diff(core).max()) if core.size > 1 else 2.0 * reach


def _residual_checks(found: _Context, step: float) -> tuple[float, float]:
    fit, pixels, settings = found.fit, found.pixels, found.settings
    rise, spread, _ = fit.basis.model.profile(found.distance)
    table = np.linspace(fit.basis.low, fit.basis.high, 4 * int(fit.basis.high - fit.basis.low) * 8)
    fitted = np.interp(found.distance, table, fit.basis.edge(table) @ fit.shape)
    fitted += _levels(pixels, found.distance, found.line, rise) @ fit.levels
    value = (pixels.light - fitted) / step
    residuals = EdgeResiduals(
        across=pixels.across,
        along=pixels.along,
        distance=found.distance,
        value=value,
        spread=spread,
        width=fit.basis.model.total,
    )
    structure = check_sides(residuals, settings.most_structure)
    return check_line(residuals, settings.most_bend, settings.curve), structure


def _profiles(found: _Context, step: float, gap: float) -> dict[str, EdgeProfile]:
    """Edge and line spread functions as lines, and the pixels' own means."""
    fit = found.fit
    first, last = np.ceil(fit.basis.low / SPACING), np.floor(fit.basis.high / SPACING)
    at = np.arange(first, last + 1.0) * SPACING
    edge, line = fit.basis.edge(at) / step, fit.basis.line(at) / step
    area = fit.basis.steps / step
    profiles = {}
    far = BEYOND * fit.beyond[0]
    for name, rows, base in (("esf", edge, 0.5), ("lsf", line, 0.0)):
        share = rows @ fit.shape + base * fit.missing / step
        relative = rows - np.multiply.outer(share, area)
        variance = np.maximum(np.einsum("ij,jk,ik->i", relative, fit.covariance, relative), 0.0)
        profiles[name] = EdgeProfile(at, share, np.sqrt(variance + (far * (share - base)) ** 2))
    aligned = 1.0 / found.line.length_of_normal if abs(found.line.slope) < 0.05 else min(gap, 1.0)
    width = 0.25 if gap <= DENSE else aligned
    # Bins are centred on the phase that occurs most, so that no column of an aligned edge is split.
    phase = float(np.angle(np.exp(2j * np.pi * found.distance / width).mean())) / (2.0 * np.pi)
    place = np.floor(found.distance / width - phase + 0.5).astype(np.intp)
    place -= place.min()
    count = np.bincount(place)
    mean = np.bincount(place, found.distance)[count > 0] / count[count > 0]
    value = (
        np.bincount(place, (found.pixels.light - fit.levels[0] + fit.missing / 2.0) / step)[count > 0]
        / count[count > 0]
    )
    sigma = fit.noise / step / np.sqrt(count[count > 0])
    return profiles | {"samples": EdgeProfile(mean, value, sigma)}


#: Pixels to each side that a spread function is asked for.
_HALF = 5


@dataclass(frozen=True, eq=False)
class EdgeSpread:
    """Spread function that an edge shows."""

    spread: SpreadFunction
    beyond: float
    """Share of the light that falls outside of the spread function's reach (stray light)."""


def spread_from_response(
    position: Floats, response: Floats, half: int, sigma: Floats | None = None
) -> tuple[SpreadFunction, float]:
    """Discrete spread function from a finely sampled edge spread function.

    The share at k pixels is the rise of the response from k - 1/2 to k + 1/2: what a profile across an edge on the
    border of two pixels shows.
    """
    reach = half + 0.5
    if position[0] > -reach or position[-1] < reach:
        raise InputError(
            f"the edge is known from {position[0]:.1f} to {position[-1]:.1f} pixels; a spread function of {half} "
            f"pixels to each side needs {reach} on both"
        )
    borders = np.arange(-half, half + 2) - 0.5
    at = np.interp(borders, position, response)
    values = np.diff(at)
    total = float(values.sum())
    if not total > 0.0:
        raise InputError("the edge response does not rise")
    errors = None
    if sigma is not None:
        each = np.interp(borders, position, sigma)
        errors = np.hypot(each[1:], each[:-1]) / total
    return SpreadFunction(values / total, errors), 1.0 - total


def spread_of_edge(edge: EdgeMeasurement) -> EdgeSpread | None:
    """Discrete spread function of a measured edge, five pixels to each side or as far as it is seen.

    It follows from the edge spread function as measured. An edge that runs along the pixels shows that at one phase
    only, and what lies between its samples is a model (`EdgeMeasurement.sampling`). The solution by a mixed object
    pixel (design/009) is no help there: half a pixel from the border it gives Z = 0.83 where it is 0.61.
    """
    positions = edge.esf.positions
    half = min(_HALF, int(min(-positions[0], positions[-1]) - 0.5))
    if half < 1:
        return None
    try:
        spread, beyond = spread_from_response(positions, edge.esf.values, half, edge.esf.sigma)
    except InputError:
        return None
    return EdgeSpread(spread, beyond)
