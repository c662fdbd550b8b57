"""Registration of two images: patches, their noise, and smooth displacements."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.adjustment.least_squares import huber, solve, spread
from photoplan.codec import storable
from photoplan.geometry.grid import Placement, Window
from photoplan.kernels.matching import correlate, sample_spline, spline_coefficients
from photoplan.matching.features import Grey, patches_at
from photoplan.matching.refine import RefineSettings, disc, match_between
from photoplan.plain import pick

_Floats = NDArray[np.float64]

#: Distances at which noise may be alike, pixels.
REACH = 4
#: The noise that is expected counts as so many patches.
_EXPECTED = 10.0


def noise_factors(columns: _Floats, observed: _Floats, mask: NDArray[np.bool_], expected: _Floats) -> _Floats:
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


def _products(values: _Floats) -> _Floats:
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
    def L(self) -> _Floats:
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

    def __call__(self, xy: ArrayLike) -> _Floats:
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

    at: NDArray[np.int64]
    """Middle in the first image, column and row, (n, 2)."""
    moved: _Floats
    """Found minus expected place, pixels of the first image, (n, 2); NaN where it was not found."""
    covariance: _Floats
    """Of it, (n, 2, 2)."""
    correlation: _Floats
    state: NDArray[np.uint8]
    """See `STATES`."""
    factor: _Floats
    """By which the fit's standard deviations were multiplied, (n, 2)."""

    @property
    def sigma(self) -> _Floats:
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

    def read(self, window: Window) -> NDArray[np.float32]:
        """Grey values of any window, shape (height, width); NaN where a pixel or a neighbour has none."""
        v = self.image.read(Window(window.col - 1, window.row - 1, window.width + 2, window.height + 2))
        a, b, c = _SMOOTHING.astype(np.float32)
        v = a * v[:-2] + b * v[1:-1] + c * v[2:]
        return np.asarray(a * v[:, :-2] + b * v[:, 1:-1] + c * v[:, 2:], np.float32)


def match_grid(
    pair: tuple[Grey, Grey], transfer: PixelTransfer, at: NDArray[np.int64], settings: PatchSettings
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
    off: _Floats = np.asarray((found.xy - transfer(at[some])) @ inverse.T)
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


def _promised(templates: _Floats, round_patch: NDArray[np.bool_]) -> _Floats:
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

    low: NDArray[np.int64]
    """First pixel of the first image."""
    values: _Floats
    """At its pixels; NaN where there are none."""
    coefficients: _Floats
    corner: NDArray[np.int64]
    """First pixel of the spline in the second image."""

    @classmethod
    def of(cls, other: Grey, transfer: PixelTransfer, at: NDArray[np.int64], around: int) -> _Tile:
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

    def sample(self, xy: _Floats) -> _Floats:
        """Grey values at points (..., 2) of the second image; NaN outside."""
        local = np.ascontiguousarray((xy - self.corner).reshape(-1, 2))
        out = np.empty(len(local))
        sample_spline(self.coefficients, local, out)
        return out.reshape(xy.shape[:-1])


def _whole_pixels(
    picture: _Tile, at: NDArray[np.int64], templates: _Floats, settings: PatchSettings
) -> tuple[_Floats, NDArray[np.bool_]]:
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


def _factors(
    picture: _Tile, templates: _Floats, found: tuple[_Floats, _Floats], round_patch: NDArray[np.bool_]
) -> _Floats:
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


def _apart(found: PatchDisplacements, shape: tuple[int, int]) -> NDArray[np.bool_]:
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
    unknowns: _Floats
    """d0 and, of an affine mapping, the derivatives along columns and rows; a row for dx, one for dy, (2, u)."""
    covariances: _Floats
    """Of each row, (2, u, u)."""
    rms: tuple[float, float]
    """Residuals of dx and of dy, pixels."""

    def __call__(self, at: _Floats) -> _Floats:
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


def _columns(at: _Floats, middle: tuple[float, float], unknowns: int) -> _Floats:
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
