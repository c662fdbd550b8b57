"""Where an edge runs: a straight line, or a parabola where lenses bend it, to a hundredth of a pixel."""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, degrees, hypot

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from photoplan.adjustment.iterate import levenberg
from photoplan.adjustment.linear import Decomposed, solve
from photoplan.errors import InputError
from photoplan.quality.edges.model import LEAST_BLUR, PixelEdge

#: Standard deviation in pixels of the smoothing with which an edge is first found.
SMOOTHING = 1.5
#: Steps of the fit; what has not settled by then is not one edge.
MOST_STEPS = 25
#: Part of the best determined direction of the unknowns from which a direction counts as determined. An edge along the
#: pixels shows three columns that are neither dark nor bright, too few for place, blur and both levels (2e-4); slanted
#: by a degree, it has 0.13.
_DETERMINED = 1e-3


@dataclass(frozen=True)
class EdgeLine:
    """The line ``across = offset + slope · along + bend · along²`` of the frame in which it is steep.

    In direction ``x`` *across* is the column and *along* the row, in direction ``y`` the other way round; *along*
    counts from `middle`.
    """

    direction: str
    offset: float
    slope: float
    bend: float
    middle: float
    rising: int
    """1 where brightness rises with *across*, −1 where it falls."""

    def distance(self, across: NDArray[np.float64], along: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance from the line, pixels, positive on the bright side.

        Exact for a straight line; for a parabola to first order in its curvature (the next term is
        bend · slope · distance², below 1e-3 pixel for a sagitta of 1 pixel in 100 and a distance of 10).
        """
        t = along - self.middle
        steep = self.slope + 2.0 * self.bend * t
        return self.rising * (across - self.offset - t * (self.slope + self.bend * t)) / np.sqrt(1.0 + steep**2)

    @property
    def length_of_normal(self) -> float:
        """Ratio of a length along the line to the same length counted in rows (or columns)."""
        return hypot(1.0, self.slope)

    @property
    def angle(self) -> float:
        """Direction in which brightness rises, radians from +x (columns) towards +y (rows), in −π … π."""
        normal = (self.rising * 1.0, -self.rising * self.slope)
        return atan2(normal[1], normal[0]) if self.direction == "x" else atan2(normal[0], normal[1])

    @property
    def angle_deg(self) -> float:
        """The same in degrees, in −180 < angle ≤ 180."""
        angle = degrees(self.angle)
        return angle + 360.0 if angle <= -180.0 else angle

    def place(self, along: float) -> tuple[float, float]:
        """Column and row of the line at *along*."""
        t = along - self.middle
        across = self.offset + t * (self.slope + self.bend * t)
        return (across, along) if self.direction == "x" else (along, across)


@dataclass(frozen=True, eq=False)
class EdgePixels:
    """The pixels of a region in the frame of its edge, as rows: shape (n,) each."""

    across: NDArray[np.float64]
    along: NDArray[np.float64]
    light: NDArray[np.float64]

    @classmethod
    def of(cls, image: NDArray[np.float64], valid: NDArray[np.bool_], direction: str) -> EdgePixels:
        """Valid pixels of a region, ordered along the edge."""
        frame, mask = (image, valid) if direction == "x" else (image.T, valid.T)
        along, across = np.nonzero(mask)
        return cls(across.astype(float), along.astype(float), frame[mask])

    def where(self, chosen: NDArray[np.bool_]) -> EdgePixels:
        """Those that are chosen."""
        return EdgePixels(self.across[chosen], self.along[chosen], self.light[chosen])


def find_line(image: NDArray[np.float64], valid: NDArray[np.bool_]) -> EdgeLine:
    """Line through the strongest brightness steps of a region, to about a pixel.

    A line of least squares through the smoothed gradients, weighted with their squares, of which those that lie far
    from it or point elsewhere are left out step by step.
    """
    filled = np.where(valid, image, np.median(image[valid]))
    if not valid.all():
        weight = gaussian_filter(valid.astype(float), SMOOTHING)
        smooth = gaussian_filter(np.where(valid, image, 0.0), SMOOTHING) / np.maximum(weight, 1e-6)
        filled = np.where(valid, image, smooth)
    columns = gaussian_filter(filled, SMOOTHING, order=(0, 1), mode="nearest")
    rows = gaussian_filter(filled, SMOOTHING, order=(1, 0), mode="nearest")
    direction = "x" if (columns[valid] ** 2).sum() >= (rows[valid] ** 2).sum() else "y"
    main, other, mask = (columns, rows, valid) if direction == "x" else (rows.T, columns.T, valid.T)
    power = np.where(mask, main**2 + other**2, 0.0)
    strong = power > 0.25 * np.quantile(power.max(axis=1), 0.75)
    along, across = np.nonzero(strong)
    if along.size < 6:
        raise InputError("no edge: the region holds no brightness step")
    weight, sign = power[strong], np.sign(main[strong])
    rising = 1 if (weight * sign).sum() >= 0.0 else -1
    middle = (main.shape[0] - 1) / 2.0
    weight = np.where(sign == rising, weight, 0.0)
    offset, slope = 0.0, 0.0
    reach = np.inf
    for _ in range(8):
        keep = np.abs(across - offset - slope * (along - middle)) <= reach
        w = weight * keep
        if np.count_nonzero(w) < 6 or np.ptp(along[w > 0.0]) < 2:
            raise InputError("no edge: the brightness steps of the region do not lie on one line")
        t = along - middle
        design = np.stack([np.ones_like(t), t], axis=1)
        fit = solve(design, across.astype(float), w)
        offset, slope = fit.unknowns
        reach = max(2.5 * float(np.sqrt(fit.square / w.sum())), 2.0)
    return EdgeLine(
        direction=direction, offset=float(offset), slope=float(slope), bend=0.0, middle=middle, rising=rising
    )


def fit_line(
    pixels: EdgePixels, line: EdgeLine, curve: int, shading: bool, most: int = MOST_STEPS
) -> tuple[EdgeLine, PixelEdge, NDArray[np.float64]]:
    """Line and blur of least squares for the pixels of an edge, by the profile of a Gaussian and the pixel.

    Offset, slope (and bend), blur, both levels and, where asked, their slopes are adjusted together (Levenberg and
    Marquardt). Where the true line spread function has another form the line is still right: its slope does not depend
    on the form, and a shift of its offset is taken up by the profile that is measured afterwards.
    """
    start = _LineState(line, _first_blur(pixels, line))
    state = levenberg(
        start,
        lambda state: _linearised(pixels, state, curve, shading)[:2],
        lambda state, step: state.moved(step[: curve + 2], curve),
        most,
    ).state
    return state.line, PixelEdge(state.blur, state.line.angle), _linearised(pixels, state, curve, shading)[2]


def determines(pixels: EdgePixels, line: EdgeLine, model: PixelEdge, curve: int) -> bool:
    """Whether pixels near an edge determine its place and blur beside both levels."""
    design = _linearised(pixels, _LineState(line, model.blur), curve, False)[0]
    return Decomposed.of(design, _DETERMINED).rank == design.shape[1]


@dataclass(frozen=True)
class _LineState:
    line: EdgeLine
    blur: float

    def moved(self, step: NDArray[np.float64], curve: int) -> _LineState:
        old = self.line
        bend = old.bend + (float(step[2]) if curve > 1 else 0.0)
        slope = float(np.clip(old.slope + step[1], -3.0, 3.0))
        line = EdgeLine(
            direction=old.direction,
            offset=old.offset + float(step[0]),
            slope=slope,
            bend=bend,
            middle=old.middle,
            rising=old.rising,
        )
        blur = float(np.clip(self.blur + step[curve + 1], max(LEAST_BLUR, 0.4 * self.blur), 2.5 * self.blur))
        return _LineState(line, blur)


def _linearised(
    pixels: EdgePixels, state: _LineState, curve: int, shading: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Design matrix (n, unknowns) with the levels in it, residuals (n,) computed minus observed, levels of a state."""
    line = state.line
    t = pixels.along - line.middle
    distance = line.distance(pixels.across, pixels.along)
    rise, spread, tilt = PixelEdge(state.blur, line.angle).profile(distance)
    columns = [np.ones_like(rise), rise]
    if shading:
        columns += [t * (1.0 - rise), t * rise]
    linear = np.stack(columns, axis=1)
    fit = solve(linear, pixels.light)
    levels, residual = fit.unknowns, fit.residuals
    shift = -line.rising * spread * levels[1] / line.length_of_normal
    moving = [shift, shift * t] + ([shift * t * t] if curve > 1 else [])
    moving.append(state.blur * tilt * levels[1])
    return np.concatenate([np.stack(moving, axis=1), linear], axis=1), residual, levels


def _first_blur(pixels: EdgePixels, line: EdgeLine) -> float:
    """Rough standard deviation of the line spread function, from means of the profile over one pixel each."""
    distance = np.round(line.distance(pixels.across, pixels.along)).astype(int)
    first = int(distance.min())
    count = np.bincount(distance - first)
    mean = np.bincount(distance - first, pixels.light) / np.maximum(count, 1)
    keep = count > 0
    at, mean = np.flatnonzero(keep) + first, mean[keep]
    if not ((at < 0).any() and (at > 0).any()):
        return 1.0
    dark, bright = np.median(mean[at < 0]), np.median(mean[at > 0])
    if not bright > dark:
        return 1.0
    share = np.clip((mean - dark) / (bright - dark), 0.0, 1.0)
    area = float(np.where(at < 0, share, np.where(at > 0, 1.0 - share, 0.0)).sum())
    return float(np.clip(area * 1.25, 0.3, 30.0))
