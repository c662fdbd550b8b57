"""Light on slopes and haze: their effect on grey values, and its correction.

Radiometric rectification for which the terrain matters (Ecker 1991, section 4.6.4) is made on the map. The models are
the usual ones: with i the angle between sun and the normal of the slope, z the sun's zenith angle and V the part of
the sky that a slope sees,

- c: grey = a + m cos i, corrected by (cos z + c) / (cos i + c), c = a / m (Teillet, Guindon and Goodenough 1982);
- cosine: grey = m cos i + d V, sun and diffuse light of the sky, corrected by (m cos z + d) / (m cos i + d V);
- haze: grey of the darkest places is path radiance, and is taken off; by height it falls with the height of the ground.
  The darkest places are lit by the sky, so this is too much rather than too little. What it is at the mean height is
  therefore taken off after slopes are corrected: before, dark slopes would come out too bright or too dark.

Parameters are estimated from lit pixels, band by band, with standard deviations from parts of the map left out in turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.least_squares import huber, solve, spread
from photoplan.errors import GeometryError, UsageError

_Floats = NDArray[np.float64]
_Reals = NDArray[np.floating]

#: What may be corrected, by name.
CORRECTIONS = ("cosine", "c", "haze", "haze-by-height")
#: No pixel is brightened or darkened by more than this.
MOST = 4.0
#: Slopes are estimated from that are lit so much at least.
_LIT = 0.05
#: Part of the pixels that is dark, classes of height, parts of the map that are left out in turn.
_DARK, _CLASSES, _PARTS = 0.002, 8, 16
_ROUNDS, _HUBER = 6, 2.0
#: Pixels that an estimate needs.
_LEAST = 500


@dataclass(frozen=True, eq=False)
class LitGround:
    """Illumination of places: cos i, height and shadow, as arrays of one shape."""

    cos_i: NDArray[np.floating]
    """Cosine of the angle between sun and normal; NaN: no terrain."""
    sky: NDArray[np.floating]
    """Part of the sky that the slope sees, (1 + cos slope) / 2."""
    height: NDArray[np.floating]
    """Metres."""
    shadow: NDArray[np.bool_]
    """Whether other terrain keeps the sun off."""

    @classmethod
    def on(cls, gradient: _Reals, height: _Reals, sun: _Floats, shadow: NDArray[np.bool_]) -> LitGround:
        """Slopes to the east and to the north, shape (2, h, w), under a sun in the direction (east, north, up)."""
        (gx, gy), (east, north, up) = gradient, sun
        flat = 1 / np.sqrt(1 + gx.astype(float) ** 2 + gy.astype(float) ** 2)
        return cls((up - east * gx - north * gy) * flat, (1 + flat) / 2, height, shadow)

    @property
    def lit(self) -> NDArray[np.bool_]:
        """Return where the sun shines."""
        with np.errstate(invalid="ignore"):
            return np.asarray((self.cos_i > 0) & ~self.shadow)


@dataclass(frozen=True)
class BandLight:
    """Parameters of one band, with standard deviations; 0 where nothing was asked."""

    slope: float = 0.0
    """m: grey values per cos i."""
    sky: float = 0.0
    """Cosine: d, grey values of the diffuse light; c: a."""
    haze: float = 0.0
    """Path radiance at the mean height, grey values."""
    haze_by_height: float = 0.0
    """Its change with height, grey values per 100 m."""
    sigmas: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Covariance of these four."""


@dataclass(frozen=True)
class LightModel:
    """Corrections of illumination, with their parameters."""

    corrections: tuple[str, ...]
    cos_z: float
    """Cosine of the sun's zenith angle: light on level ground."""
    height: float
    """Mean height, metres."""
    bands: tuple[BandLight, ...]

    def __post_init__(self) -> None:
        odd = [name for name in self.corrections if name not in CORRECTIONS]
        if odd or not self.corrections:
            raise UsageError(f"corrections {', '.join(odd) or 'none'}; name some of {', '.join(CORRECTIONS)}")
        for pair in (("cosine", "c"), ("haze", "haze-by-height")):
            if set(pair) <= set(self.corrections):
                raise UsageError(f"{pair[0]} and {pair[1]} are two models of one thing; name one of them")

    def factor(self, ground: LitGround, band: BandLight) -> _Floats:
        """By what a grey value without haze is multiplied; 1 in shadow, and where the sun does not shine."""
        if not {"cosine", "c"} & set(self.corrections):
            return np.ones(ground.cos_i.shape)
        sky = ground.sky if "cosine" in self.corrections else 1.0
        lit = band.slope * ground.cos_i + band.sky * sky
        level = band.slope * self.cos_z + band.sky
        with np.errstate(invalid="ignore", divide="ignore"):
            factor = np.clip(level / lit, 1 / MOST, MOST)
        return np.where(ground.lit & (lit > 0), factor, 1.0)

    def haze(self, ground: LitGround, band: BandLight) -> _Floats:
        """By how much path radiance is more than at the mean height, grey values."""
        return np.asarray(band.haze_by_height * np.nan_to_num(ground.height - self.height) / 100.0)

    def corrected(self, values: NDArray[np.floating], ground: LitGround) -> _Floats:
        """Grey values (bands, ...) after correction; where there is no terrain they stay."""
        known = np.isfinite(ground.cos_i)
        out = [
            np.where(known, (grey - self.haze(ground, band)) * self.factor(ground, band) - band.haze, grey)
            for grey, band in zip(values.astype(float), self.bands)
        ]
        return np.stack(out)


def estimate_light(
    values: _Floats, ground: LitGround, part: NDArray[np.int64], corrections: Sequence[str], cos_z: float
) -> LightModel:
    """Parameters of the corrections that are named.

    Parameters
    ----------
    values : ndarray, shape (bands, n)
        Grey values of pixels all over the map.
    ground : Ground
        Of the same pixels, (n,).
    part : ndarray, shape (n,)
        Pixels of one number lie near each other and err together.
    corrections : sequence of str
    cos_z : float
        Light on level ground.

    Raises
    ------
    UsageError
        An unknown correction.
    GeometryError
        There are too few lit pixels, or the light does not depend on the slopes as it must.
    """
    empty = LightModel(tuple(corrections), cos_z, float(np.nanmean(ground.height)), ())
    known = np.isfinite(ground.cos_i)
    if (known & ground.lit).sum() < _LEAST:
        raise GeometryError(
            f"{int((known & ground.lit).sum())} pixels with terrain on which the sun shines; {_LEAST} are needed: do "
            "terrain and picture overlap, and is the sun right?"
        )
    groups = np.unique(part, return_inverse=True)[1] % _PARTS
    left = min(int((known & ground.lit & (groups != k)).sum()) for k in np.unique(groups))
    if left < _LEAST // 2:
        raise GeometryError(
            f"without one part of the picture {left} pixels are left on which the sun shines; {_LEAST // 2} are needed"
            ": does the terrain cover the picture?"
        )
    bands = []
    for number, grey in enumerate(values, 1):
        whole = _estimate(empty, grey, ground, known)
        some = [_estimate(empty, grey, ground, known & (groups != k)) for k in np.unique(groups)]
        if {"cosine", "c"} & set(corrections) and whole[0] <= 0:
            raise GeometryError(
                f"band {number} is not brighter on slopes towards the sun ({whole[0]:.3g} grey values per cos i): is "
                "the sun's direction right, and does the terrain lie where the picture is?"
            )
        count = len(some)
        sigma = np.sqrt((count - 1) / count * ((np.array(some) - np.mean(some, axis=0)) ** 2).sum(axis=0))
        slope, sky, haze, by_height = whole.tolist()
        bands.append(BandLight(slope=slope, sky=sky, haze=haze, haze_by_height=by_height, sigmas=tuple(sigma.tolist())))
    return LightModel(empty.corrections, cos_z, empty.height, tuple(bands))


def _estimate(model: LightModel, grey: _Floats, ground: LitGround, use: NDArray[np.bool_]) -> _Floats:
    """m, d or a, haze, haze by height of one band from some pixels."""
    haze = np.zeros(2)
    if "haze" in model.corrections:
        haze[0] = float(np.quantile(grey[use], _DARK))
    elif "haze-by-height" in model.corrections:
        haze = _dark_by_height(model, grey[use], ground.height[use])
    light = np.zeros(2)
    if {"cosine", "c"} & set(model.corrections):
        lit = use & ground.lit & (ground.cos_i > _LIT)
        clear = grey[lit] - haze[1] * (ground.height[lit] - model.height) / 100.0
        sky = ground.sky[lit] if "cosine" in model.corrections else np.ones(int(lit.sum()))
        A = np.column_stack([ground.cos_i[lit], sky]).astype(float)
        weight = np.ones(len(clear))
        for _ in range(_ROUNDS):
            fit = solve(A, clear, weight)
            # Ground of other colours errs in parts of its light, and so it is judged after the correction.
            level = np.maximum(A @ fit.unknowns, 1e-3 * np.abs(clear).mean() + 1e-9)
            relative = fit.residuals / level
            weight = huber(relative / max(spread(relative), 1e-9), _HUBER) / level**2
        light = fit.unknowns
        if light[1] < 0 and "cosine" in model.corrections:
            # No sky is darker than none: all light is the sun's.
            light = np.array([float((A[:, 0] @ (weight * clear)) / (A[:, 0] @ (weight * A[:, 0]))), 0.0])
    return np.concatenate([light, haze])


def _dark_by_height(model: LightModel, grey: _Floats, height: NDArray[np.floating]) -> _Floats:
    """A line through the darkest grey values of classes of height: at the mean height, and per 100 m."""
    edges = np.quantile(height, np.linspace(0, 1, _CLASSES + 1))
    of = np.clip(np.searchsorted(edges, height, side="right") - 1, 0, _CLASSES - 1)
    classes = [of == k for k in range(_CLASSES) if (of == k).sum() > _CLASSES]
    heights, dark = np.array([(height[mine].mean(), np.quantile(grey[mine], _DARK)) for mine in classes]).T
    if np.ptp(heights) < 1.0:
        return np.array([float(dark.mean()), 0.0])
    return solve(np.column_stack([np.ones(len(dark)), (heights - model.height) / 100.0]), dark).unknowns
