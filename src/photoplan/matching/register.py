"""Registration of two images: patches, noise, smooth displacements, and control points from orthophotos."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft, ndimage

from photoplan.adjustment.least_squares import MEDIAN_2D, cauchy, huber, solve, spread
from photoplan.arrays import Floats, Floats32, Ints, Mask
from photoplan.cameras.base import CentralCamera, project
from photoplan.codec import storable
from photoplan.geometry.grid import Placement, Window
from photoplan.geometry.pose import skew, small_rotations
from photoplan.kernels.matching import (
    CONVERGED,
    CORRELATION,
    RESULTS,
    correlate,
    match_patches,
    sample_spline,
    spline_coefficients,
)
from photoplan.matching.features import Grey, GreyImage, patches_at
from photoplan.matching.refine import RefineSettings, disc, match_between
from photoplan.plain import pick

#: Distances at which noise may be alike, pixels.
REACH = 4
#: The noise that is expected counts as so many patches.
_EXPECTED = 10.0


def noise_factors(columns: Floats, observed: Floats, mask: Mask, expected: Floats) -> Floats:
    """Factors f of the standard deviations of the first two unknowns of every patch, (n, 2)."""
    n, side, _, unknowns = columns.shape
    flat = (columns * mask[..., None]).reshape(n, -1, unknowns)
    q = np.linalg.qr(flat)[0]
    e = (observed * mask).reshape(n, -1)
    e = e - np.einsum("npk,nk->np", q, np.einsum("npk,np->nk", q, e))
    free = mask.sum() - unknowns
    e /= np.maximum(np.sqrt((e**2).sum(axis=1, keepdims=True) / free), 1e-12)
    pixels = _products(mask[None].astype(float))[0]
    along = np.correlate(expected, expected, "full") / (expected**2).sum()
    one = np.zeros(2 * REACH + 1)
    half = len(along) // 2
    one[REACH - half : REACH + half + 1] = along
    prior = _EXPECTED * pixels * np.outer(one, one).reshape(-1)
    C = (_products(e.reshape(n, side, side)).sum(axis=0) + prior) / ((n + _EXPECTED) * pixels)
    B = sum(_products(q[..., k].reshape(n, side, side)).sum(axis=0) for k in range(unknowns))
    B = B / ((n + _EXPECTED) * pixels)
    out = np.empty((n, 2))
    for axis in range(2):
        others = np.linalg.qr(np.delete(flat, axis, axis=2))[0]
        g = flat[..., axis] - np.einsum("npk,nk->np", others, np.einsum("npk,np->nk", others, flat[..., axis]))
        R = _products(g.reshape(n, side, side))
        R = R / np.maximum(R[:, [R.shape[1] // 2]], 1e-300)
        out[:, axis] = np.sqrt(np.maximum(R @ C, 0.0) / np.maximum(1.0 - R @ B, 0.2))
    return np.maximum(out, 1.0)


def _products(values: Floats) -> Floats:
    """Sums of products of pixels at distances up to `REACH`, row by row of distances, (n, (2 REACH + 1)²)."""
    size = values.shape[1] + REACH
    power = np.abs(np.fft.rfft2(values, (size, size))) ** 2
    near = np.arange(-REACH, REACH + 1)
    return np.asarray(np.fft.irfft2(power, (size, size))[:, near[:, None], near].reshape(len(values), -1))


#: What became of a patch: found; pixels missing in one of the images; no texture, or along one direction only; not
#: found again, or unlike; found with too large a standard deviation; contradicts its neighbours.
FOUND, MISSING, TEXTURELESS, UNLIKE, UNCERTAIN, APART = range(6)
STATES = ("found", "missing", "textureless", "unlike", "uncertain", "apart")
#: From the whole pixel of the best correlation, matching may go so far, pixels.
_NEAR = 1.5
#: Both images are smoothed by this along rows and columns.
_SMOOTHING = np.array([0.25, 0.5, 0.25])
#: A vector is apart if it differs from the median of its neighbours by so many of their own (Westerweel and Scarano
#: 2005), with an amount that is always allowed, pixels, and by so many of its standard deviations.
_APART, _ALLOWED, _SIGMAS = 4.0, 0.05, 3.0
#: Neighbours that must be there to judge by.
_ENOUGH = 3


@dataclass(frozen=True)
class PixelTransfer:
    """Where a pixel of the first image is expected in the second one: L xy + t."""

    linear: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 1.0)
    """L, row by row."""
    shift: tuple[float, float] = (0.0, 0.0)
    """t, pixels of the second image."""

    @classmethod
    def between(cls, first: Placement, second: Placement) -> PixelTransfer:
        """By where both lie on one map; pixels that are meant to coincide do so to the last digits of a file."""
        (A, at), (B, bt) = ((place.linear, place.to_plane((0.0, 0.0))) for place in (first, second))
        L, t = np.linalg.solve(B, A), np.linalg.solve(B, at - bt)
        L = np.where(np.abs(L - np.rint(L)) < 1e-9, np.rint(L), L)
        t = np.where(np.abs(t - np.rint(t)) < 1e-6, np.rint(t), t)
        a, b, c, d = L.reshape(-1).tolist()
        return cls((a, b, c, d), (float(t[0]), float(t[1])))

    @property
    def L(self) -> Floats:
        """(2, 2)."""
        return np.array(self.linear).reshape(2, 2)

    @property
    def scale(self) -> float:
        """How many times as large as those of the second image pixels of the first one are."""
        return float(np.sqrt(abs(np.linalg.det(self.L))))

    def common(self, first: tuple[int, int], second: tuple[int, int]) -> Window | None:
        """Pixels of the first image that may have a partner, both of known width and height; None: there are none."""
        width, height = second
        corners = np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], float)
        back = (corners - np.array(self.shift)) @ np.linalg.inv(self.L).T
        low = np.maximum(np.floor(np.clip(back.min(axis=0), -1, 1e9)), 0).astype(int)
        high = np.minimum(np.ceil(np.clip(back.max(axis=0), -1, 1e9)) + 1, first).astype(int)
        return None if (high <= low).any() else Window(int(low[0]), int(low[1]), *(high - low).tolist())

    def __call__(self, xy: ArrayLike) -> Floats:
        """Points (..., 2) of the second image."""
        return np.asarray(np.asarray(xy, float) @ self.L.T + np.array(self.shift))


@dataclass(frozen=True)
class PatchSettings:
    """How patches are matched, and which results count."""

    radius: int = 10
    """Of a patch, pixels."""
    search: float = 3.0
    """Largest displacement along each axis, pixels."""
    correlation: float = 0.7
    """Least correlation."""
    sigma: float = 0.2
    """Largest standard deviation of a coordinate, pixels."""

    @property
    def refine(self) -> RefineSettings:
        """The same for least-squares matching."""
        return RefineSettings(self.radius, _NEAR + 0.5, self.correlation, self.sigma)


@storable
@dataclass(frozen=True, eq=False)
class PatchDisplacements:
    """Patches and where they were found."""

    at: Ints
    """Middle in the first image, column and row, (n, 2)."""
    moved: Floats
    """Found minus expected place, pixels of the first image, (n, 2); NaN where it was not found."""
    covariance: Floats
    """Of it, (n, 2, 2)."""
    correlation: Floats
    state: NDArray[np.uint8]
    """See `STATES`."""
    factor: Floats
    """By which the fit's standard deviations were multiplied, (n, 2)."""

    @property
    def sigma(self) -> Floats:
        """Standard deviations, (n, 2)."""
        return np.sqrt(self.covariance[:, [0, 1], [0, 1]])


@dataclass(frozen=True, eq=False)
class SmoothedImage:
    """An image, each pixel with a part of its neighbours."""

    image: Grey

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.image.size

    def read(self, window: Window) -> Floats32:
        """Grey values of any window, shape (height, width); NaN where a pixel or a neighbour has none."""
        v = self.image.read(Window(window.col - 1, window.row - 1, window.width + 2, window.height + 2))
        a, b, c = _SMOOTHING.astype(np.float32)
        v = a * v[:-2] + b * v[1:-1] + c * v[2:]
        return np.asarray(a * v[:, :-2] + b * v[:, 1:-1] + c * v[:, 2:], np.float32)


def match_grid(
    pair: tuple[Grey, Grey], transfer: PixelTransfer, at: Ints, settings: PatchSettings
) -> PatchDisplacements:
    """Find patches of the first image in the second one.

    Parameters
    ----------
    pair : pair of Grey
    transfer : Transfer
        Where they are expected.
    at : ndarray, shape (n, 2)
        Middles of the patches, close to each other: the pixels around all of them are held at once.
    settings : PatchSettings
    """
    images = SmoothedImage(pair[0]), SmoothedImage(pair[1])
    n, r = len(at), settings.radius
    templates = patches_at(images[0], at - r, 2 * r + 1).astype(float)
    round_patch = disc(r) > 0
    state = np.full(n, FOUND, np.uint8)
    picture = _Tile.of(images[1], transfer, at, r + int(np.ceil(settings.search)) + 1)
    offset, seen = _whole_pixels(picture, at, templates, settings)
    state[~np.isfinite(templates[:, round_patch]).all(axis=1) | ~seen] = MISSING
    state[(state == FOUND) & (_promised(templates, round_patch) > settings.sigma)] = TEXTURELESS
    state[(state == FOUND) & ~np.isfinite(offset[:, 0])] = UNLIKE
    moved, covariance = np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan)
    correlation, factor = np.full(n, np.nan), np.full((n, 2), np.nan)
    some = np.flatnonzero(state == FOUND)
    start = transfer(at[some] + offset[some]), np.broadcast_to(transfer.L, (len(some), 2, 2)).copy()
    found = match_between(images, at[some], start, settings.refine)
    inverse = np.linalg.inv(transfer.L)
    off: Floats = np.asarray((found.xy - transfer(at[some])) @ inverse.T)
    correlation[some] = found.correlation
    far = ~(np.abs(off).max(axis=1, initial=0.0) <= settings.search)
    bad = ~(found.correlation >= settings.correlation) | far
    state[some[bad]] = UNLIKE
    good, here = some[~bad], ~bad
    if len(good):
        moved[good] = off[here]
        f = _factors(picture, templates[good], (found.xy[here], found.affine[here]), round_patch)
        factor[good] = f
        C = inverse @ found.covariance[here] @ inverse.T
        covariance[good] = f[:, :, None] * C * f[:, None, :]
    with np.errstate(invalid="ignore"):
        uncertain = np.sqrt(covariance[:, [0, 1], [0, 1]]).max(axis=1, initial=0.0) > settings.sigma
    state[uncertain & (state == FOUND)] = UNCERTAIN
    return PatchDisplacements(
        at=at, moved=moved, covariance=covariance, correlation=correlation, state=state, factor=factor
    )


def _promised(templates: Floats, round_patch: Mask) -> Floats:
    """Standard deviation that matching will have along the worst direction, from slopes and noise of patches, (n,).

    Noise from the second mixed difference (Immerkær 1996), of the quieter patches; its part in the slopes is taken off.
    """
    if not len(templates):
        return np.empty(0)
    mixed = templates[:, :-2] - 2 * templates[:, 1:-1] + templates[:, 2:]
    mixed = mixed[..., :-2] - 2 * mixed[..., 1:-1] + mixed[..., 2:]
    own = np.sqrt(np.nanmean(np.where(np.isfinite(mixed), mixed, 0.0) ** 2, axis=(1, 2))) / 6
    noise = max(float(np.percentile(own, 20)), 1e-6 * float(np.nanmax(np.abs(templates), initial=1.0)), 1e-12)
    gx = (templates[:, 1:-1, 2:] - templates[:, 1:-1, :-2]) / 2
    gy = (templates[:, 2:, 1:-1] - templates[:, :-2, 1:-1]) / 2
    inner = round_patch[1:-1, 1:-1]
    xx, xy, yy = (np.nansum((a * b)[:, inner], axis=1) for a, b in ((gx, gx), (gx, gy), (gy, gy)))
    least = (xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy**2) - inner.sum() * noise**2 / 2
    return np.asarray(noise * np.sqrt(2 / np.maximum(least, 1e-300)))


@dataclass(frozen=True, eq=False)
class _Tile:
    """A part of the second image: as a spline, and at the pixels of the first one."""

    low: Ints
    """First pixel of the first image."""
    values: Floats
    """At its pixels; NaN where there are none."""
    coefficients: Floats
    corner: Ints
    """First pixel of the spline in the second image."""

    @classmethod
    def of(cls, other: Grey, transfer: PixelTransfer, at: Ints, around: int) -> _Tile:
        """The part around patches."""
        low, high = at.min(axis=0) - around, at.max(axis=0) + around + 1
        x, y = np.arange(low[0], high[0], dtype=float), np.arange(low[1], high[1], dtype=float)
        to = transfer(np.stack(np.meshgrid(x, y), axis=-1))
        corner = np.floor(to.min(axis=(0, 1))).astype(np.int64) - 3
        size = np.ceil(to.max(axis=(0, 1))).astype(np.int64) + 4 - corner
        values = other.read(Window(int(corner[0]), int(corner[1]), int(size[0]), int(size[1]))).astype(float)
        known = np.isfinite(values)
        coefficients = np.where(known, values, values[known].mean() if known.any() else 0.0)[None].copy()
        spline_coefficients(coefficients)
        part = cls(low, values, coefficients[0], corner)
        out = part.sample(to)
        near = np.clip(np.rint(to - corner).astype(np.int64), 0, size - 1)
        out[~known[near[..., 1], near[..., 0]]] = np.nan
        return cls(low, out, coefficients[0], corner)

    def sample(self, xy: Floats) -> Floats:
        """Grey values at points (..., 2) of the second image; NaN outside."""
        local = np.ascontiguousarray((xy - self.corner).reshape(-1, 2))
        out = np.empty(len(local))
        sample_spline(self.coefficients, local, out)
        return out.reshape(xy.shape[:-1])


def _whole_pixels(picture: _Tile, at: Ints, templates: Floats, settings: PatchSettings) -> tuple[Floats, Mask]:
    """Displacement of best correlation, whole pixels (n, 2), NaN: none; and whether the expected place has pixels."""
    r, s = settings.radius, int(np.ceil(settings.search))
    offset, seen = np.full((len(at), 2), np.nan), np.zeros(len(at), bool)
    weights, score = disc(r), np.empty((2 * s + 1, 2 * s + 1))
    side = 2 * (r + s) + 1
    for k, (col, row) in enumerate((at - picture.low - r - s).tolist()):
        part = picture.values[row : row + side, col : col + side]
        seen[k] = np.isfinite(part[s : s + 2 * r + 1, s : s + 2 * r + 1][weights > 0]).all()
        if not seen[k] or not np.isfinite(templates[k][weights > 0]).all():
            continue
        correlate(part, np.nan_to_num(templates[k]), weights, 1.0, score)
        if np.isfinite(score).any():
            best = np.unravel_index(int(np.nanargmax(score)), score.shape)
            offset[k] = best[1] - s, best[0] - s
    return offset, seen


def _factors(picture: _Tile, templates: Floats, found: tuple[Floats, Floats], round_patch: Mask) -> Floats:
    """By how much the errors of patches are larger than their fits say, (n, 2)."""
    r = len(round_patch) // 2
    v, u = np.mgrid[-r : r + 1, -r : r + 1].astype(float)
    xy, affine = found
    there = picture.sample(xy[:, None, None] + np.einsum("nij,rcj->nrci", affine, np.stack([u, v], axis=-1)))
    there = np.where(np.isfinite(there), there, np.nanmean(there, axis=(1, 2), keepdims=True))
    gy, gx = np.gradient(there, axis=(1, 2))
    columns = np.stack([gx, gy, gx * u, gx * v, gy * u, gy * v, np.ones_like(gx), there], axis=-1)
    columns[..., 2:6] /= r
    return noise_factors(columns, np.nan_to_num(templates), round_patch, _SMOOTHING)


def contradicting(found: PatchDisplacements, shape: tuple[int, int]) -> PatchDisplacements:
    """A whole grid, (rows, columns) of `shape`, in which vectors that contradict their neighbours are APART."""
    state = found.state.copy()
    state[_apart(found, shape)] = APART
    return replace(found, state=state)


def _apart(found: PatchDisplacements, shape: tuple[int, int]) -> Mask:
    """Which vectors contradict their neighbours, (n,)."""
    rows, columns = shape
    apart = np.zeros((rows, columns), bool)
    good = (found.state == FOUND).reshape(shape)
    for axis in range(2):
        field = np.full((rows + 2, columns + 2), np.nan)
        field[1:-1, 1:-1] = np.where(good, found.moved[:, axis].reshape(shape), np.nan)
        near = np.stack([
            field[i : i + rows, j : j + columns] for i in range(3) for j in range(3) if (i, j) != (1, 1)
        ])  # fmt: skip
        enough = np.isfinite(near).sum(axis=0) >= _ENOUGH
        near[:, ~enough] = 0.0
        middle = np.nanmedian(near, axis=0)
        usual = np.nanmedian(np.abs(near - middle), axis=0)
        sigma = np.nan_to_num(found.sigma[:, axis].reshape(shape), nan=np.inf)
        limit = np.maximum(_APART * (usual + _ALLOWED), _SIGMAS * sigma)
        apart |= enough & good & (np.abs(field[1:-1, 1:-1] - middle) > limit)
    return apart.reshape(-1)


MODELS = ("none", "shift", "affine")
#: Residuals count less beyond so many robust standard deviations.
_LIMIT = 2.0


@dataclass(frozen=True, eq=False)
class SmoothModel:
    """A smooth displacement: d = d0 + A (xy − middle), for dx and dy."""

    kind: str
    middle: tuple[float, float]
    """Pixels of the first image."""
    unknowns: Floats
    """d0 and, of an affine mapping, the derivatives along columns and rows; a row for dx, one for dy, (2, u)."""
    covariances: Floats
    """Of each row, (2, u, u)."""
    rms: tuple[float, float]
    """Residuals of dx and of dy, pixels."""

    def __call__(self, at: Floats) -> Floats:
        """Displacements at pixels (n, 2)."""
        return np.asarray(_columns(at, self.middle, self.unknowns.shape[1]) @ self.unknowns.T)

    def json_fields(self) -> dict[str, Any]:
        """Unknowns with their covariances."""
        names = ("d0", "along_columns", "along_rows")[: self.unknowns.shape[1]]
        sigma = np.sqrt(np.diagonal(self.covariances, axis1=1, axis2=2))
        axes = {
            axis: {
                **dict(zip(names, self.unknowns[k].tolist())),
                "sigma": dict(zip(names, sigma[k].tolist())),
                "covariance": self.covariances[k].tolist(),
            }
            for k, axis in enumerate(("dx", "dy"))
        }
        return {**pick(self, "kind", "middle", rms_px="rms"), **axes}


def _columns(at: Floats, middle: tuple[float, float], unknowns: int) -> Floats:
    off = np.asarray(at, float) - np.array(middle)
    return np.column_stack([np.ones(len(off)), off])[:, :unknowns]


def fit_smooth(found: PatchDisplacements, kind: str, overlap: float) -> SmoothModel | None:
    """A shift or an affine mapping through the vectors by robust least squares; None for the kind `none`.

    Parameters
    ----------
    found : PatchDisplacements
    kind : str
        See `MODELS`.
    overlap : float
        So many patches share a pixel: vectors are no more independent than as many fewer.

    Notes
    -----
    Covariances hold the misfit of the vectors (sigma0): what is not smooth is taken for noise.
    """
    good = found.state == FOUND
    unknowns = {"shift": 1, "affine": 3}.get(kind, 0)
    if not unknowns or good.sum() < 2 * unknowns:
        return None
    at, d, sigma = found.at[good].astype(float), found.moved[good], found.sigma[good]
    column, row = at.mean(axis=0).tolist()
    middle = column, row
    A = _columns(at, middle, unknowns)
    rows, covariances, rms = [], [], []
    for axis in range(2):
        # Vectors are believed by their own accuracy, but none far more than others: the misfit is the field's.
        weight = 1 / np.maximum(sigma[:, axis], np.median(sigma[:, axis])) ** 2
        fit = solve(A, d[:, axis], weight)
        for _ in range(10):
            size = fit.residuals * np.sqrt(weight)
            fit = solve(A, d[:, axis], weight * huber(size / max(spread(size), 1e-9), _LIMIT))
        rows.append(fit.unknowns)
        covariances.append(fit.covariance * max(overlap, 1.0))
        rms.append(float(np.sqrt((fit.residuals**2).mean())))
    return SmoothModel(
        kind=kind, middle=middle, unknowns=np.array(rows), covariances=np.array(covariances), rms=(rms[0], rms[1])
    )


#: Part of a patch that must have values.
FILLED = 0.5
#: A second peak of the correlation must stay below this part of the first one, so many cells away from it.
_SECOND, _EXCLUDED = 0.95, 4
#: Least correlation of a peak before refinement.
_LIKE = 0.4
#: Points that an image's consistency is judged from, at least.
LEAST = 6
#: Prior standard deviation of the rotations of a correction, radians.
_TURN = 0.03
_MEDIAN = MEDIAN_2D**2
#: Fits are at least so much too sure of themselves: what loops of tie points show (see `photoplan.matching.refine`).
_FACTOR = 2.0


@dataclass(frozen=True, eq=False)
class FoundPatch:
    """Where the middle of a patch lies in another picture of its ground."""

    at: tuple[float, float]
    """Column and row."""
    covariance: Floats
    """Of column and row as the fit has it, (2, 2)."""
    correlation: float


@dataclass(frozen=True, eq=False)
class AgreeingPoints:
    """Which points of an image agree with one correction of its orientation."""

    keep: Mask
    """(n,)."""
    residuals: Floats
    """Measured minus computed after the correction, (n, 2), pixels."""
    shift: tuple[float, float]
    """Median of measured minus computed position before, pixels."""
    factor: float
    """By which standard deviations of the fit are to be multiplied, 2 or more."""


def best_place(values: Floats32, radius: int, border: int) -> tuple[int, int] | None:
    """Column and row where a patch has most texture in all directions; None if none has enough values.

    The measure is the smaller eigenvalue of the mean products of slopes over the patch (Förstner and Gülch 1987).
    """
    known = np.isfinite(values)
    if not known.any():
        return None
    filled = np.where(known, values, values[known].mean())
    smooth = ndimage.gaussian_filter(filled, 1.0)
    gx, gy = ndimage.sobel(smooth, 1), ndimage.sobel(smooth, 0)
    inside = ndimage.binary_erosion(known, iterations=2)
    gx, gy = np.where(inside, gx, 0.0), np.where(inside, gy, 0.0)
    side = 2 * radius + 1
    xx, xy, yy = (ndimage.uniform_filter(v, side, mode="constant") for v in (gx * gx, gx * gy, gy * gy))
    least = (xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    share = ndimage.uniform_filter(known.astype(np.float32), side, mode="constant")
    fits = (share >= FILLED) & known
    inner = np.zeros_like(known)
    edge = max(border, 1)
    inner[edge:-edge, edge:-edge] = True
    score = np.where(fits & inner, least, -1.0)
    row, col = np.unravel_index(int(score.argmax()), score.shape)
    return (int(col), int(row)) if score[row, col] > 0 else None


def correlation_scores(patch: Floats, picture: Floats) -> Floats:
    """Correlation coefficient of a patch with every part of a larger picture, over the cells that both have.

    Normalised with means and norms of the common cells (Padfield 2012, eq. 27 and 28).
    """
    mask_t, mask_f = np.isfinite(patch), np.isfinite(picture)
    t = np.where(mask_t, patch - patch[mask_t].mean(), 0.0)
    f = np.where(mask_f, picture - picture[mask_f].mean(), 0.0)
    shape = [fft.next_fast_len(s) for s in picture.shape]

    def forward(a: Floats) -> NDArray[np.complex128]:
        return np.asarray(fft.rfft2(a, shape))

    out = tuple(slice(0, n - m + 1) for n, m in zip(picture.shape, patch.shape))

    def against(a: NDArray[np.complex128], b: NDArray[np.complex128]) -> Floats:
        return np.asarray(fft.irfft2(np.conj(a) * b, shape))[out]

    T, T2, Mt = forward(t), forward(t * t), forward(mask_t.astype(float))
    F, F2, Mf = forward(f), forward(f * f), forward(mask_f.astype(float))
    n = np.maximum(np.rint(against(Mt, Mf)), 1.0)
    sum_t, sum_f = against(T, Mf), against(Mt, F)
    above = against(T, F) - sum_t * sum_f / n
    var_t, var_f = against(T2, Mf) - sum_t**2 / n, against(Mt, F2) - sum_f**2 / n
    floor = 1e-6 * max(float((t * t).sum()), 1e-12)
    enough = (n >= FILLED * mask_t.sum()) & (var_t > floor) & (var_f > 1e-6 * max(float((f * f).sum()), 1e-12))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(enough, np.clip(above / np.sqrt(np.maximum(var_t * var_f, 1e-30)), -1, 1), -1.0)


def find_patch(patch: Floats, picture: Floats, least: float = 0.7) -> FoundPatch | str:
    """Find a patch in a picture of the same scale and direction that is larger on all sides.

    The best whole cell by correlation, then least-squares matching.

    Parameters
    ----------
    patch : ndarray, shape (m, m), m odd
        NaN: no value.
    picture : ndarray, shape (n, n)
    least : float
        Least correlation after refinement.

    Returns
    -------
    FoundPatch or str
        Or why it was not found.
    """
    m, radius = len(patch), len(patch) // 2
    score = correlation_scores(patch, picture)
    row, col = np.unravel_index(int(score.argmax()), score.shape)
    best = float(score[row, col])
    if best < _LIKE:
        return "unlike"
    if min(row, col) == 0 or row == score.shape[0] - 1 or col == score.shape[1] - 1:
        return "at the edge of the search"
    away = score.copy()
    away[max(0, row - _EXCLUDED) : row + _EXCLUDED + 1, max(0, col - _EXCLUDED) : col + _EXCLUDED + 1] = -1
    if away.max() > _SECOND * best:
        return "ambiguous"
    known = np.isfinite(patch)
    there = np.isfinite(picture[row : row + m, col : col + m])
    weights = (known & there).astype(float)
    coefficients = np.where(np.isfinite(picture), picture, np.nanmean(picture))[None].copy()
    spline_coefficients(coefficients)
    result = np.zeros((1, RESULTS))
    result[0, :6] = col + radius, row + radius, 1.0, 0.0, 0.0, 1.0
    limits = np.array([40, 2e-3, 3.0])
    match_patches(np.where(known, patch, 0.0)[None], weights[None], coefficients, limits, result)
    r = result[0]
    if r[-1] != CONVERGED:
        return "not settled"
    if r[CORRELATION] < least:
        return "unlike"
    return FoundPatch((float(r[0]), float(r[1])), r[[9, 10, 10, 11]].reshape(2, 2), float(r[CORRELATION]))


def agree(
    camera: CentralCamera, XYZ: Floats, xy: Floats, covariances: tuple[Floats, Floats], reach: float
) -> AgreeingPoints:
    """Which points obey one small change of the camera's position and direction.

    A change of the orientation moves the points of an image smoothly; what a wrong match does is its own. Six unknowns
    are adjusted with weights that fall with the residuals (Cauchy); points that then lie farther than four robust
    standard deviations, and a pixel at least, do not agree.
    """
    n = len(XYZ)
    gap = xy - project(camera, XYZ)
    if n < LEAST:
        return AgreeingPoints(np.zeros(n, bool), gap, (float("nan"), float("nan")), _FACTOR)
    middle = np.median(gap, axis=0)
    delta = np.zeros(6)
    residual, scale = gap - middle, 0.0
    for step in range(30):
        length = np.linalg.norm(residual, axis=1)
        scale = max(float(np.median(length)) / MEDIAN_2D, 0.05)
        weight = cauchy(length, 2.5 * scale)
        moved, J = _moved(camera, XYZ, delta)
        actual = xy - project(camera, moved)
        W = np.diag(1.0 / np.array([reach, reach, reach, _TURN, _TURN, _TURN]) ** 2) * scale**2
        N = np.einsum("nki,n,nkj->ij", J, weight, J) + W
        b = np.einsum("nki,n,nk->i", J, weight, actual) - W @ delta
        change = np.linalg.solve(N, b)
        delta = delta + change
        residual = xy - project(camera, _moved(camera, XYZ, delta)[0])
        if step > 3 and np.abs(change[:3]).max() < 1e-4 * reach and np.abs(change[3:]).max() < 1e-6:
            break
    keep = np.linalg.norm(residual, axis=1) <= max(4.0 * scale, 1.0)
    factor = _factor(camera, XYZ, residual, covariances, keep) if keep.sum() >= LEAST else _FACTOR
    if keep.sum() < LEAST:
        keep = np.zeros(n, bool)
    return AgreeingPoints(keep, residual, (float(middle[0]), float(middle[1])), factor)


def _moved(camera: CentralCamera, XYZ: Floats, delta: Floats) -> tuple[Floats, Floats]:
    """Points as a camera sees them that is moved by delta[:3] and turned by delta[3:], and ∂(x, y)/∂delta (n, 2, 6)."""
    v = (XYZ - camera.center - delta[:3]) @ small_rotations(delta[3:])
    moved = camera.center + v
    J = camera.derivatives(moved)
    # −ω × v = v × ω.
    return moved, np.concatenate([-J, J @ skew(v)], axis=-1)


def _factor(
    camera: CentralCamera, XYZ: Floats, residual: Floats, covariances: tuple[Floats, Floats], keep: Mask
) -> float:
    """Factor of the fits' standard deviations with which the residuals, as a whole, are as large as expected."""
    J = camera.derivatives(XYZ[keep])
    ground = J @ covariances[1][keep] @ J.transpose(0, 2, 1)
    fit, e = covariances[0][keep], residual[keep]
    # Six unknowns take their part of the residuals.
    expected = _MEDIAN * max(0.2, 1.0 - 3.0 / int(keep.sum()))

    def median(f: float) -> float:
        inverse = np.linalg.inv(f * f * fit + ground)
        return float(np.median(np.einsum("ni,nij,nj->n", e, inverse, e)))

    low, high = _FACTOR, 50.0
    if median(low) <= expected:
        return low
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if median(middle) > expected else (low, middle)
    return high


#: A patch whose ground is rougher than displaces it by this is not used, pixels of the photo (reduced).
_ROUGH = 1.0


#: No position in a photo is believed to be better than this, pixels: two pictures of one place differ.
_SIGMA = 0.1


@dataclass(frozen=True, eq=False)
class Photo:
    """An image whose orientation is known approximately."""

    camera: CentralCamera
    grey: GreyImage


@dataclass(frozen=True, eq=False)
class OrthoPatch:
    """A patch of an orthophoto and its ground."""

    values: Floats
    """(m, m), rows from north to south; NaN: no value."""
    XYZ: tuple[float, float, float]
    """Its middle, on the plane through its ground, metres: what is matched is the patch as a whole."""
    slope: tuple[float, float]
    """Of the plane through its ground, to the east and to the north."""
    rough: float
    """Root mean square of the ground's heights against the plane, metres."""


def patch_on(values: Floats, at: tuple[float, float], Z: Floats, side: float) -> OrthoPatch | None:
    """A patch with the plane through its ground; None where its middle has no height."""
    radius = len(values) // 2
    if not np.isfinite(Z[radius, radius]):
        return None
    v, u = np.mgrid[-radius : radius + 1, -radius : radius + 1] * side
    known = np.isfinite(Z)
    A = np.stack([np.ones(known.sum()), u[known], -v[known]], axis=1)
    off = Z[known] - np.median(Z[known])
    for _ in range(5):
        # Least absolute values: walls and trees tilt no plane.
        fit = solve(A, Z[known], huber(off, 0.05 * side))
        off = fit.residuals
    level, *slope = fit.unknowns.tolist()
    return OrthoPatch(values, (at[0], at[1], level), (slope[0], slope[1]), float(np.sqrt(np.mean(off**2))))


def ground_covariances(patches: Sequence[OrthoPatch], plane: float, height: float) -> Floats:
    """(n, 3, 3): an error of the place changes the height that is read there, by the slope of the ground.

    plane, height: standard deviations of X and Y in the orthophoto, and of the heights; metres.
    """
    A = np.zeros((len(patches), 3, 2))
    A[:, 0, 0] = A[:, 1, 1] = 1.0
    A[:, 2] = [p.slope for p in patches]
    covariance = plane**2 * (A @ A.transpose(0, 2, 1))
    covariance[:, 2, 2] += height**2
    return np.asarray(covariance)


@dataclass(frozen=True)
class Settings:
    """How patches are matched."""

    resolution: float
    """Side of a cell, metres."""
    radius: int
    """Of a patch, cells."""
    cells: int
    """Search, cells."""
    search: float
    """Search, metres."""
    correlation: float
    """Least correlation."""


@dataclass(frozen=True, eq=False)
class ImageControl:
    """What was found in an image."""

    name: str
    tried: int
    """Patches that it may show."""
    matched: int
    points: Ints
    """Numbers of the patches that agree."""
    xy: Floats
    """Where they are, (n, 2), pixels."""
    sigma: Floats
    """(n, 2), pixels."""
    shift: tuple[float, float]
    """Median of measured minus computed position by the approximate orientation, pixels; NaN: too few points."""
    rms: float
    """Of the residuals of a coordinate after the correction of the orientation, pixels."""
    factor: float
    """Of the fit's standard deviations."""
    reasons: dict[str, int]
    """Why patches were not taken."""


def control_of_image(
    name: str, photo: Photo, patches: Sequence[OrthoPatch], covariances: Floats, settings: Settings
) -> ImageControl:
    """Find the patches in a photo and keep those that agree on a correction of its orientation.

    The photo is resampled into the map, on the plane through each patch's ground, by the approximate camera. A place
    found there is carried back into the photo by the same camera and plane: no error of the orientation enters.
    """
    XYZ = np.array([p.XYZ for p in patches])
    expected = project(photo.camera, XYZ)
    size = np.array(photo.camera.size)
    tried = np.flatnonzero(((expected > 0) & (expected < size - 1)).all(axis=1))
    number, xy, fits, reasons = [], [], [], Counter[str]()
    for k in tried.tolist():
        found = _find(photo, patches[k], settings)
        if isinstance(found, str):
            reasons[found] += 1
            continue
        at, covariance = found
        number.append(k)
        xy.append(at)
        fits.append(covariance)
    index = np.array(number, np.int64)
    if not number:
        none = np.empty((0, 2))
        return ImageControl(
            name=name,
            tried=len(tried),
            matched=0,
            points=index,
            xy=none,
            sigma=none,
            shift=(np.nan, np.nan),
            rms=np.nan,
            factor=1.0,
            reasons=dict(reasons),
        )
    places, fit = np.array(xy), np.array(fits)
    fit = fit + 1e-6 * np.eye(2)
    agreed = agree(photo.camera, XYZ[index], places, (fit, covariances[index]), max(settings.search, 1.0))
    keep = agreed.keep
    if (~keep).any():
        reasons["not in agreement"] += int((~keep).sum())
    sigma = np.maximum(agreed.factor * np.sqrt(np.diagonal(fit, axis1=1, axis2=2)), _SIGMA)
    rms = float(np.sqrt((agreed.residuals[keep] ** 2).mean())) if keep.any() else float("nan")
    return ImageControl(
        name=name,
        tried=len(tried),
        matched=len(number),
        points=index[keep],
        xy=places[keep],
        sigma=sigma[keep],
        shift=agreed.shift,
        rms=rms,
        factor=agreed.factor,
        reasons=dict(reasons),
    )


def _find(photo: Photo, patch: OrthoPatch, settings: Settings) -> tuple[Floats, Floats] | str:
    """Position in the photo and its covariance by the fit, or why there is none."""
    J = photo.camera.derivatives(np.array(patch.XYZ))
    gsd = float(1 / np.sqrt(abs(np.linalg.det(J[:, :2]))))
    factor = max(1, round(settings.resolution / gsd))
    if patch.rough * float(np.linalg.norm(J[:, 2])) > _ROUGH * factor:
        return "rough ground"
    half = settings.radius + settings.cells + 2
    row, col = np.mgrid[-half : half + 1, -half : half + 1]
    at = project(photo.camera, _on_plane(patch, col, row, settings.resolution))
    picture = _resampled(photo, at, factor)
    if picture is None:
        return "outside the photo"
    found = find_patch(patch.values, picture, settings.correlation)
    if isinstance(found, str):
        return found
    return _in_photo(photo, patch, found, half, settings)


def _on_plane(patch: OrthoPatch, col: Floats, row: Floats, side: float) -> Floats:
    """Ground points of cells counted from the patch's middle."""
    east, north = np.asarray(col) * side, -np.asarray(row) * side
    X, Y, level = patch.XYZ
    Z = level + patch.slope[0] * east + patch.slope[1] * north
    return np.stack([X + east, Y + north, Z], axis=-1)


def _resampled(photo: Photo, at: Floats, factor: int) -> Floats | None:
    """Grey values of the photo (means of factor × factor pixels) at image points; NaN outside."""
    small = (at + 0.5) / factor - 0.5
    size = np.array(photo.camera.size) // factor
    known: Mask = np.asarray(np.isfinite(small).all(axis=-1), np.bool_)
    if not known.any():
        return None
    low = np.maximum(np.floor(small[known].min(axis=0)).astype(int) - 3, 0)
    high = np.minimum(np.ceil(small[known].max(axis=0)).astype(int) + 4, size)
    if (high - low < 8).any():
        return None
    window = Window(int(low[0]), int(low[1]), *(int(v) for v in high - low))
    pixels = photo.grey.reduced(window, factor).astype(float)
    valid = np.isfinite(pixels)
    if not valid.any():
        return None
    coefficients = np.where(valid, pixels, pixels[valid].mean())[None].copy()
    spline_coefficients(coefficients)
    local = np.where(known[..., None], small - low, -9.0).reshape(-1, 2)
    values = np.empty(len(local))
    sample_spline(coefficients[0], np.ascontiguousarray(local), values)
    if not valid.all():
        nearest = np.clip(np.rint(local).astype(int), 0, high - low - 1)
        values[~valid[nearest[:, 1], nearest[:, 0]]] = np.nan
    return values.reshape(at.shape[:2])


def _in_photo(
    photo: Photo, patch: OrthoPatch, found: FoundPatch, half: int, settings: Settings
) -> tuple[Floats, Floats]:
    col, row = (v - half for v in found.at)
    step = 0.5
    around = np.array([[0.0, 0.0], [step, 0.0], [-step, 0.0], [0.0, step], [0.0, -step]])
    at = project(photo.camera, _on_plane(patch, col + around[:, 0], row + around[:, 1], settings.resolution))
    J = np.stack([at[1] - at[2], at[3] - at[4]], axis=1) / (2 * step)
    return at[0], J @ found.covariance @ J.T
