"""Image features: extraction, matching, tie points, and the edge of the sky.

Sky is even, so that the edge is the first strong change of grey values from above; and the edge of a column lies near
that of the next one. Both together are a cost for each pixel and one for each step between columns, of which the least
sum is found by dynamic programming (Bellman 1957).
"""

from __future__ import annotations

import importlib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from photoplan.adjustment.least_squares import cauchy, solve
from photoplan.arrays import Floats, Floats32, Ints, Mask
from photoplan.cameras.lenses import Interior, Lens
from photoplan.codec import storable
from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.geometry.pose import skew

#: Pixels are read in squares of this side.
TILE = 2048
_LUMINANCE = (0.299, 0.587, 0.114)


class GreyPixels(Protocol):
    """An image that is read by windows; safe to call from several threads."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        ...

    def read(self, window: Window) -> tuple[NDArray[Any], Mask | None]:
        """Pixels of a window inside the image, shape (bands, height, width), and their validity; None: all."""
        ...


class Grey(Protocol):
    """Grey values that are read by windows of any place."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        ...

    def read(self, window: Window) -> Floats32:
        """Grey values, shape (height, width); NaN where there are none."""
        ...


@dataclass(frozen=True, eq=False)
class GreyImage:
    """Grey values of an image and where they count."""

    pixels: GreyPixels
    area: tuple[float, float, float, float] | None = None
    """Columns and rows xmin, ymin, xmax, ymax of the picture on a scan, without its margin; None: everything."""
    bands: tuple[int, ...] = ()
    """Bands whose mean counts, from 1; empty: all, by the rule above."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.pixels.size

    def read(self, window: Window) -> Floats32:
        """Grey values of any window, shape (height, width); NaN outside the image and its area, and where not valid."""
        out = np.full((window.height, window.width), np.nan, np.float32)
        inside = window & Window(0, 0, *self.size)
        if not inside.size:
            return out
        pixels, valid = self.pixels.read(inside)
        grey = _grey(pixels) if not self.bands else pixels[[band - 1 for band in self.bands]].mean(0, np.float32)
        if valid is not None:
            grey[~valid] = np.nan
        if self.area is not None:
            x, y = np.arange(inside.col, inside.stop[0]), np.arange(inside.row, inside.stop[1])
            xmin, ymin, xmax, ymax = self.area
            grey[:, (x < xmin) | (x > xmax)] = np.nan
            grey[(y < ymin) | (y > ymax)] = np.nan
        col, row = inside.col - window.col, inside.row - window.row
        out[row : row + inside.height, col : col + inside.width] = grey
        return out

    def reduced(self, window: Window, factor: int) -> Floats32:
        """Means of `factor` × `factor` pixels; `window` counts in such means. NaN where one of them is."""
        if factor == 1:
            return self.read(window)
        full = self.read(
            Window(window.col * factor, window.row * factor, window.width * factor, window.height * factor)
        )
        return full.reshape(window.height, factor, window.width, factor).mean(axis=(1, 3))

    def stretch(self) -> tuple[float, float]:
        """Grey values at 0.5 and 99.5 percent of nine windows spread over the image."""
        (width, height), side = self.size, 128
        found = [np.zeros(1, np.float32)]
        for k in range(9):
            col = int((k % 3 + 0.5) / 3 * max(0, width - side))
            row = int((k // 3 + 0.5) / 3 * max(0, height - side))
            values = self.read(Window(col, row, min(side, width), min(side, height)))
            found.append(values[np.isfinite(values)])
        values = np.concatenate(found[1:]) if sum(map(len, found[1:])) else found[0]
        low, high = np.percentile(values, (0.5, 99.5))
        return float(low), float(max(high, low + 1e-6))


@dataclass(frozen=True, eq=False)
class ReducedImage:
    """Means of squares of pixels as an image of their own; what does not fill a square at the right and below is lost.

    A point x of the image lies at (x + 0.5) / factor − 0.5.
    """

    image: GreyImage
    factor: int
    """Pixels along each side of a square."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in squares."""
        width, height = self.image.size
        return width // self.factor, height // self.factor

    def read(self, window: Window) -> Floats32:
        """Grey values of any window, shape (height, width); NaN where a pixel has none."""
        return self.image.reduced(window, self.factor)


def _grey(pixels: NDArray[Any]) -> Floats32:
    if len(pixels) == 1:
        return pixels[0].astype(np.float32)
    weights = np.array(_LUMINANCE if len(pixels) == 3 else [1 / len(pixels)] * len(pixels), np.float32)
    return np.einsum("b,bij->ij", weights, pixels, dtype=np.float32, casting="unsafe")


def to_bytes(grey: Floats32, low: float, high: float) -> NDArray[np.uint8]:
    """Grey values from `low` to `high` as 0 to 255; what has none becomes the mean of the rest."""
    scaled = np.clip((grey - low) * (255.0 / (high - low)), 0, 255)
    known = np.isfinite(scaled)
    if not known.all():
        scaled = np.where(known, scaled, scaled[known].mean() if known.any() else 0.0)
    return np.rint(scaled).astype(np.uint8)


def patches_at(image: Grey, corner: Ints, side: int) -> Floats32:
    """Square windows of grey values, shape (n, side, side); NaN where there are none.

    The image is read once, in tiles that hold the windows; what is in memory is a tile and the result.
    """
    out = np.empty((len(corner), side, side), np.float32)
    if not len(corner):
        return out
    cell = corner // TILE
    _, first, which = np.unique(cell, axis=0, return_index=True, return_inverse=True)
    which = which.reshape(-1)
    for t in range(len(first)):
        members = np.flatnonzero(which == t)
        low, high = corner[members].min(axis=0), corner[members].max(axis=0) + side
        part = image.read(Window(int(low[0]), int(low[1]), *(int(v) for v in high - low)))
        for k in members:
            col, row = corner[k] - low
            out[k] = part[row : row + side, col : col + side]
    return out


#: A descriptor's numbers are kept as bytes, this many to one: their squares sum up to its square.
DESCRIPTOR_UNIT = 512.0
#: Parts that are worked on are not smaller than this, reduced pixels.
_LEAST_TILE = 128
#: Pixels (reduced) around a tile that its features may use.
_MARGIN = 96
#: The image is divided into this many cells along each side, which get an equal share of the features.
_CELLS = 12


@dataclass(frozen=True)
class FeatureSettings:
    """How features are looked for; decides whether kept ones can be used again."""

    count: int = 4000
    """Features per image at most."""
    factor: int = 1
    """Grey values are means of this many pixels along each side."""
    contrast: float = 0.015
    """Least contrast of a feature, part of the range of grey values."""
    tile: int = 2048
    """Side of the parts that are worked on at once, pixels of the full image."""


@storable
@dataclass(frozen=True, eq=False)
class Features:
    """Features of one image."""

    xy: Floats
    """Column and row, shape (n, 2), pixels of the full image."""
    scale: Floats
    """Standard deviation of the Gaussian at which the feature was found, (n,), pixels of the full image."""
    angle: Floats
    """Direction of the strongest slope, (n,), radians from the column axis towards the row axis."""
    strength: Floats
    """Contrast, (n,)."""
    descriptors: NDArray[np.uint8]
    """Root-SIFT, shape (n, 128), in `DESCRIPTOR_UNIT`."""

    def __len__(self) -> int:
        return len(self.xy)

    def where(self, keep: NDArray[Any]) -> Features:
        """The features at `keep` (mask or indices)."""
        return Features(
            xy=self.xy[keep],
            scale=self.scale[keep],
            angle=self.angle[keep],
            strength=self.strength[keep],
            descriptors=self.descriptors[keep],
        )


def opencv() -> Any:
    """OpenCV, with one thread: work is divided over images."""
    try:
        cv2 = importlib.import_module("cv2")
    except ImportError:
        raise UsageError("matching needs OpenCV; install it with: pip install 'photoplan[match]'") from None
    cv2.setNumThreads(1)
    return cv2


def extract_features(image: GreyImage, settings: FeatureSettings) -> Features:
    """The strongest features of every part of an image.

    The grey values of a tile are stretched to bytes by the range that the whole image has. A feature counts if its
    neighbourhood of six times its scale lies in the image's area and holds valid pixels only.
    """
    cv2 = opencv()
    limits = image.stretch()
    step = settings.contrast * 3  # OpenCV divides by the number of layers
    sift = cv2.SIFT_create(
        nOctaveLayers=3, contrastThreshold=step, edgeThreshold=10, sigma=1.6, enable_precise_upscale=True
    )
    width, height = (s // settings.factor for s in image.size)
    parts = []
    for core in Window(0, 0, width, height).tiles(max(_LEAST_TILE, settings.tile // settings.factor)):
        part = _tile_features(cv2, sift, image, core, limits, settings)
        parts.append(_spread(part, settings, image.size, share=2.0))
    return _spread(_joined(parts), settings, image.size)


def _tile_features(
    cv2: Any, sift: Any, image: GreyImage, core: Window, limits: tuple[float, float], settings: FeatureSettings
) -> Features:
    """Features whose place lies in the window `core`."""
    whole = Window(0, 0, *(s // settings.factor for s in image.size))
    wide = Window(core.col - _MARGIN, core.row - _MARGIN, core.width + 2 * _MARGIN, core.height + 2 * _MARGIN) & whole
    grey = image.reduced(wide, settings.factor)
    valid = np.isfinite(grey)
    found, descriptors = sift.detectAndCompute(to_bytes(grey, *limits), None)
    if not found:
        return no_features()
    xy = np.array([k.pt for k in found], np.float64)
    scale = np.array([k.size for k in found]) / 2
    at = xy + np.array([wide.col, wide.row])
    own = ((at >= (core.col - 0.5, core.row - 0.5)) & (at < (core.stop[0] - 0.5, core.stop[1] - 0.5))).all(axis=1)
    if not valid.all():
        # Distance to the next pixel without a value.
        room = cv2.distanceTransform(valid.astype(np.uint8), cv2.DIST_L2, 3)
        i, j = np.clip(np.rint(xy).astype(int), 0, (wide.width - 1, wide.height - 1)).T
        own &= room[j, i] > 6 * scale
    keep = np.flatnonzero(own)
    p = descriptors[keep] / np.maximum(descriptors[keep].sum(axis=1, keepdims=True), 1e-9)
    k = settings.factor
    return Features(
        xy=(at[keep] + 0.5) * k - 0.5,
        scale=scale[keep] * k,
        angle=np.radians([found[i].angle for i in keep]),
        strength=np.array([found[i].response for i in keep], float),
        descriptors=np.clip(np.rint(np.sqrt(p) * DESCRIPTOR_UNIT), 0, 255).astype(np.uint8),
    )


def _spread(features: Features, settings: FeatureSettings, size: tuple[int, int], share: float = 1.0) -> Features:
    """At most `count` features: every cell of the image keeps its strongest, as many as all cells can have."""
    if len(features) <= settings.count * share and share == 1.0:
        return features
    cell = np.clip((features.xy / size * _CELLS).astype(int), 0, _CELLS - 1) @ (1, _CELLS)
    order = np.lexsort((-features.strength, cell))
    _, start, count = np.unique(cell[order], return_index=True, return_counts=True)
    rank = np.empty(len(features), int)
    rank[order] = np.arange(len(features)) - np.repeat(start, count)
    if share != 1.0:  # a tile: no cell of the image can need more than a few times its even share
        return features.where(rank < 8 * settings.count / _CELLS**2)
    best = np.lexsort((-features.strength, rank))
    return features.where(np.sort(best[: settings.count]))


def no_features() -> Features:
    """Return no feature at all."""
    empty = np.empty(0)
    return Features(
        xy=np.empty((0, 2)), scale=empty, angle=empty, strength=empty, descriptors=np.empty((0, 128), np.uint8)
    )


def _joined(parts: list[Features]) -> Features:
    parts = [no_features(), *parts]
    return Features(
        *(np.concatenate([getattr(p, n) for p in parts]) for n in ("xy", "scale", "angle", "strength", "descriptors"))
    )


Pair = tuple[int, int]

#: Smaller part of a footprint that a pair shares.
_LEAST_SHARE = 0.05
#: Nearest or most similar images that an image is compared with, at most.
NEIGHBOURS = 20
#: Farthest of the nearest images, in median distances to the nearest one.
_REACH = 6.0
#: Coarse features that a pair shares at least.
_LEAST_SHARED = 6
#: Distance of descriptors as a part of that to the second best, at most (Lowe 2004, section 7.1).
_RATIO = 0.85
#: Rows of the table of similarities that are in memory at once.
_ROWS = 1024


@dataclass(frozen=True, eq=False)
class Guide:
    """Where features of the first image are to be expected in the second one."""

    xy: Floats
    """Column and row, shape (n, 2), pixels; NaN: not to be expected anywhere."""
    radius: float
    """How far from there they may be, pixels."""


def all_pairs(count: int) -> list[Pair]:
    """Every image with every other one."""
    return list(itertools.combinations(range(count), 2))


def pairs_by_footprints(footprints: Sequence[Floats]) -> list[Pair]:
    """Pairs whose footprints share at least 5 % of the smaller one."""
    areas = [shapely.convex_hull(shapely.MultiPoint(f)) for f in footprints]
    tree = shapely.STRtree(areas)
    found = []
    for i, area in enumerate(areas):
        for j in sorted(int(k) for k in tree.query(area) if k > i):
            smaller = min(area.area, areas[j].area)
            if smaller > 0 and area.intersection(areas[j]).area >= _LEAST_SHARE * smaller:
                found.append((i, j))
    return found


def pairs_by_distance(positions: Floats) -> list[Pair]:
    """Each image with its 20 nearest ones, as far as six times the median distance to the nearest one."""
    n = len(positions)
    if n < 2:
        return []
    distance = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    np.fill_diagonal(distance, np.inf)
    limit = _REACH * float(np.median(distance.min(axis=1)))
    near = np.argsort(distance, axis=1, kind="stable")[:, :NEIGHBOURS]
    found = {
        (min(i, int(j)), max(i, int(j))) for i in range(n) for k, j in enumerate(near[i]) if distance[i, j] <= limit
    }
    return sorted(found)


def pairs_by_likeness(coarse: Sequence[Features]) -> list[Pair]:
    """Pairs that share some of their coarsest features: a quick look for images of which nothing is known.

    Each image keeps the 20 images that it shares most with, if they share six features or more.
    """
    shared = np.zeros((len(coarse), len(coarse)), int)
    for i, j in all_pairs(len(coarse)):
        shared[i, j] = shared[j, i] = len(match_features(coarse[i], coarse[j]))
    found: set[Pair] = set()
    for i, row in enumerate(shared):
        best = np.argsort(-row, kind="stable")[:NEIGHBOURS]
        found |= {(min(i, int(j)), max(i, int(j))) for j in best if row[j] >= _LEAST_SHARED}
    return sorted(found)


def match_features(a: Features, b: Features, guide: Guide | None = None) -> Ints:
    """Features that are each other's most similar one, and clearly more similar than the next.

    Second best are features at other places only: one place may have several directions.

    Parameters
    ----------
    guide : Guide, optional
        Features of b are compared only where those of a are expected.

    Returns
    -------
    ndarray, shape (k, 2)
        Indices into a and b.
    """
    none = np.empty((0, 2), np.int64)
    if len(a) < 2 or len(b) < 2:
        return none
    left, right = (f.descriptors.astype(np.float32) / np.float32(DESCRIPTOR_UNIT) for f in (a, b))
    best = np.full(len(a), -1)
    back, back_value = np.full(len(b), -1), np.full(len(b), -np.inf)
    columns = np.arange(len(b))
    for start in range(0, len(a), _ROWS):
        rows = slice(start, min(start + _ROWS, len(a)))
        likeness = left[rows] @ right.T
        if guide is not None:
            likeness[_far(guide, rows, b)] = -1.0
        top = likeness.argmax(axis=0)
        value = likeness[top, columns]
        better = value > back_value
        back[better], back_value[better] = top[better] + start, value[better]
        best[rows] = _clear_best(likeness, b)
    i = np.flatnonzero(best >= 0)
    i = i[back[best[i]] == i]
    return np.stack([i, best[i]], axis=1)


def _far(guide: Guide, rows: slice, b: Features) -> Mask:
    expected, there = guide.xy[rows].astype(np.float32), b.xy.astype(np.float32)
    dx = expected[:, None, 0] - there[None, :, 0]
    dy = expected[:, None, 1] - there[None, :, 1]
    return ~(dx * dx + dy * dy <= np.float32(guide.radius**2))


def _clear_best(likeness: Floats32, b: Features) -> Ints:
    """Column of the best of each row, −1 where the second best is nearly as good or nothing may be compared."""
    rows = np.arange(len(likeness))
    few = min(4, likeness.shape[1])
    top = np.argpartition(-likeness, few - 1, axis=1)[:, :few]
    value = np.take_along_axis(likeness, top, axis=1)
    order = np.argsort(-value, axis=1, kind="stable")
    top, value = np.take_along_axis(top, order, axis=1), np.take_along_axis(value, order, axis=1)
    best = top[:, 0]
    # Unit vectors: squared distance = 2 − 2 · likeness.
    distance = 2.0 - 2.0 * np.minimum(value, 1.0)
    elsewhere = np.linalg.norm(b.xy[top] - b.xy[best][:, None], axis=-1) > 2.0
    next_best = np.where(elsewhere, distance, np.inf).min(axis=1)
    clear = (value[rows, 0] > -0.5) & (distance[:, 0] < _RATIO**2 * next_best)
    return np.where(clear, best, -1)


@dataclass(frozen=True)
class Calibration:
    """What is known of the rays of an image."""

    interior: Interior
    lens: Lens

    def tangents(self, xy: Floats) -> Floats:
        """Image points (n, 2) as ideal tangent coordinates (n, 2); NaN where the lens has none."""
        return self.lens.undistort(self.interior.tangent_to_pixel.inverse(xy))

    @property
    def focal(self) -> float:
        """Pixels per unit of tangent in the middle of the image."""
        return float(np.sqrt(abs(np.linalg.det(self.interior.tangent_to_pixel.derivative(np.zeros(2))))))


@dataclass(frozen=True)
class VerifySettings:
    """When a pair counts as verified."""

    threshold: float = 2.0
    """Distance from the epipolar line up to which a match fits, pixels."""
    least: int = 16
    """Matches that must fit."""
    share: float = 0.25
    """Part of all matches of the pair that must fit."""


@storable
@dataclass(frozen=True, eq=False)
class PairMatches:
    """Verified matches of two images."""

    first: int
    second: int
    """Indices of the images."""
    features: Ints
    """Indices of features in first and second image, shape (n, 2)."""
    tried: int
    """Matches before verification."""

    def __len__(self) -> int:
        return len(self.features)


def verify_pair(
    xy: tuple[Floats, Floats], calibrations: tuple[Calibration | None, Calibration | None], settings: VerifySettings
) -> Mask:
    """Which matches fit one geometry of the pair; none of them if it is not verified.

    With both cameras known the geometry is the essential matrix of the tangents (Nistér 2004), else the fundamental
    matrix. Flat ground is no obstacle: it leaves the essential matrix two solutions which contain the same points, and
    where it leaves the fundamental matrix undetermined, the points of a homography are taken instead.

    Parameters
    ----------
    xy : pair of ndarrays, shape (n, 2)
        Matched image points of the first and the second image, pixels.
    calibrations : pair
        Interior orientation and lens of each, None where they are not known.

    Returns
    -------
    ndarray, shape (n,)
    """
    count = len(xy[0])
    none = np.zeros(count, bool)
    if count < settings.least:
        return none
    a, b = calibrations
    if a is not None and b is not None:
        fits = _essential((a.tangents(xy[0]), b.tangents(xy[1])), settings.threshold / ((a.focal + b.focal) / 2))
    else:
        fits = _fundamental(xy, settings.threshold)
    enough = fits.sum() >= max(settings.least, settings.share * count)
    return fits if enough else none


def _essential(t: tuple[Floats, Floats], threshold: float) -> Mask:
    cv2 = opencv()
    known: Mask = np.asarray(np.isfinite(np.concatenate(t, axis=1)).all(axis=1), np.bool_)
    fits: Mask = np.zeros(len(known), np.bool_)
    p, q = t[0][known], t[1][known]
    if len(p) < 6:
        return fits
    E, inliers = cv2.findEssentialMat(
        p, q, np.eye(3), method=cv2.USAC_MAGSAC, prob=0.9999, threshold=threshold, maxIters=5000
    )
    if E is None or inliers is None or E.shape != (3, 3):
        return fits
    fits[known] = _sampson(_adjusted(cv2, E, p, q, threshold), p, q) <= threshold
    return fits


def _adjusted(cv2: Any, E: Floats, p: Floats, q: Floats, threshold: float) -> Floats:
    """Essential matrix of all matches that fit: five unknowns, weights that fall with the distance (Cauchy).

    A sample of five matches gives a solution through their noise, which loses part of the right ones.
    """
    R, _, base = cv2.decomposeEssentialMat(E)
    base = base.ravel()

    def distances(E: Floats) -> Floats:
        return _signed(E, p, q)

    step = 1e-6
    for _ in range(10):
        across = np.linalg.svd(base[None])[2][1:]
        now = distances(skew(base) @ R)
        turned = [skew(base) @ cv2.Rodrigues(step * axis)[0] @ R for axis in np.eye(3)]
        moved = [skew(base + step * side) @ R for side in across]
        J = np.stack([(distances(m) - now) / step for m in (*turned, *moved)], axis=1)
        change = -solve(J, now, cauchy(now, 0.5 * threshold)).unknowns
        R = cv2.Rodrigues(change[:3])[0] @ R
        base = base + change[3:] @ across
        base /= np.linalg.norm(base)
        if np.abs(change).max() < 1e-7:
            break
    better = skew(base) @ R
    fit = [int((np.abs(distances(m)) <= threshold).sum()) for m in (E, better)]
    return better if fit[1] >= fit[0] else E


def _fundamental(xy: tuple[Floats, Floats], threshold: float) -> Mask:
    cv2 = opencv()
    p, q = (np.ascontiguousarray(v) for v in xy)
    fits: Mask = np.zeros(len(p), np.bool_)
    F, _ = cv2.findFundamentalMat(p, q, cv2.USAC_MAGSAC, threshold, 0.9999, 10000)
    if F is not None and F.shape == (3, 3):
        fits = _sampson(F, p, q) <= threshold
    H, _ = cv2.findHomography(p, q, cv2.USAC_MAGSAC, 2 * threshold, maxIters=5000, confidence=0.9999)
    if H is not None and H.shape == (3, 3):
        moved = np.concatenate([p, np.ones((len(p), 1))], axis=1) @ H.T
        with np.errstate(divide="ignore", invalid="ignore"):
            flat = np.linalg.norm(moved[:, :2] / moved[:, 2:] - q, axis=1) <= 2 * threshold
        if flat.sum() >= 0.8 * fits.sum():
            return flat
    return fits


def _sampson(F: Floats, p: Floats, q: Floats) -> Floats:
    """Distance of matches from their epipolar lines, to first order (Hartley and Zisserman 2004, eq. 11.9)."""
    return np.abs(_signed(F, p, q))


def _signed(F: Floats, p: Floats, q: Floats) -> Floats:
    """The same with a sign."""
    one = np.ones((len(p), 1))
    a, b = np.concatenate([p, one], axis=1), np.concatenate([q, one], axis=1)
    line_b, line_a = a @ F.T, b @ F
    gap = (b * line_b).sum(axis=1)
    scale = np.sqrt((line_a[:, :2] ** 2).sum(axis=1) + (line_b[:, :2] ** 2).sum(axis=1))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(scale > 0, np.sqrt(2) * gap / scale, np.inf)


#: Features of one image closer than this are one point (pixels of the full image, at full scale).
SAME_PLACE = 1.5


@dataclass(frozen=True, eq=False)
class Tracks:
    """Image points and the track that each belongs to; a track has one point in an image."""

    track: Ints
    """Track of each image point, (n,); numbers from 0 without gaps, points of one track side by side."""
    image: Ints
    """Index of its image, (n,)."""
    xy: Floats
    """Column and row, (n, 2), pixels."""
    scale: Floats
    """Scale of the feature, (n,), pixels."""
    angle: Floats
    """Direction of the feature, (n,), radians from column towards row axis."""
    sigma: Floats
    """Standard deviation of column and row, (n, 2), pixels; NaN: not known."""

    def __len__(self) -> int:
        return len(self.track)

    @property
    def count(self) -> int:
        """Number of tracks."""
        return int(self.track[-1]) + 1 if len(self.track) else 0

    @property
    def rays(self) -> Ints:
        """Image points of each track."""
        return np.bincount(self.track, minlength=self.count)

    def where(self, keep: NDArray[Any]) -> Tracks:
        """The points at `keep` (mask); tracks with fewer than two points left are dropped."""
        keep = np.asarray(keep, bool)
        left = np.bincount(self.track[keep], minlength=self.count)
        keep = keep & (left >= 2)[self.track]
        _, track = np.unique(self.track[keep], return_inverse=True)
        rest = (getattr(self, n)[keep] for n in ("image", "xy", "scale", "angle", "sigma"))
        return Tracks(track.reshape(-1).astype(np.int64), *rest)

    def of_tracks(self, keep: Mask) -> Tracks:
        """The tracks where `keep` (one per track) is true."""
        return self.where(keep[self.track])


@dataclass(frozen=True, eq=False)
class TracksFound:
    """Tracks, and how many were not taken."""

    tracks: Tracks
    ambiguous: int
    """Tracks that had points at two places of one image: dropped as a whole."""


def build_tracks(features: Sequence[Features], pairs: Sequence[PairMatches], same: float = SAME_PLACE) -> TracksFound:
    """Join matches that share a feature.

    Parameters
    ----------
    features : sequence of Features
        Of each image.
    pairs : sequence of PairMatches
        Verified matches.
    same : float
        Features of one image that are closer than this are the same point: a place with several directions.
    """
    start = np.concatenate([[0], np.cumsum([len(f) for f in features])]).astype(np.int64)
    total = int(start[-1])
    none = np.empty(0, np.int64)
    a = np.concatenate([none, *(start[p.first] + p.features[:, 0] for p in pairs)])
    b = np.concatenate([none, *(start[p.second] + p.features[:, 1] for p in pairs)])
    graph = coo_matrix((np.ones(len(a), np.int8), (a, b)), shape=(total, total))
    _, label = connected_components(graph, directed=False)
    used = np.zeros(total, bool)
    used[a] = used[b] = True
    index = np.flatnonzero(used)
    image = np.repeat(np.arange(len(features)), np.diff(start))[index]
    xy = np.concatenate([np.empty((0, 2)), *(f.xy for f in features)])[index]
    scale = np.concatenate([np.empty(0), *(f.scale for f in features)])[index]
    angle = np.concatenate([np.empty(0), *(f.angle for f in features)])[index]
    _, track = np.unique(label[index], return_inverse=True)
    order = np.lexsort((scale, image, track))
    track, image, xy, scale, angle = track.reshape(-1)[order], image[order], xy[order], scale[order], angle[order]
    again = np.concatenate([[False], (track[1:] == track[:-1]) & (image[1:] == image[:-1])]) if len(track) else used[:0]
    apart = np.concatenate([[0.0], np.linalg.norm(np.diff(xy, axis=0), axis=1)]) if len(track) else scale
    bad = np.zeros(int(track.max()) + 1 if len(track) else 0, bool)
    bad[track[again & (apart > same)]] = True
    every = Tracks(
        track=track.astype(np.int64),
        image=image,
        xy=xy,
        scale=scale,
        angle=angle,
        sigma=np.full((len(track), 2), np.nan),
    )
    return TracksFound(every.where(~again & ~bad[track]), int(bad.sum()))


def joined_tracks(parts: Sequence[Tracks]) -> Tracks:
    """Tracks of several levels as one, each with numbers of its own."""
    start = np.cumsum([0, *(part.count for part in parts)])
    rest = (np.concatenate([getattr(p, n) for p in parts]) for n in ("image", "xy", "scale", "angle", "sigma"))
    return Tracks(np.concatenate([p.track + k for p, k in zip(parts, start)]), *rest)


#: Points that an image shares with at least two oriented ones, from which a model grows to it.
_GROWS = 20


def weak_images(count: int, tracks: Tracks) -> list[int]:
    """Images to which no model grows that begins with the pair of most common points.

    An image is added when `_GROWS` of its points are seen in two images of the model.
    """
    image, track = tracks.image, tracks.track
    table = coo_matrix((np.ones(len(tracks), np.int32), (image, track)), shape=(count, tracks.count)).tocsr()
    common = (table @ table.T).tocoo()
    apart = common.row < common.col
    if not apart.any():
        return list(range(count))
    best = np.flatnonzero(apart)[np.argmax(common.data[apart])]
    model = np.zeros(count, bool)
    model[[common.row[best], common.col[best]]] = True
    while True:
        known = np.bincount(track[model[image]], minlength=tracks.count) >= 2
        new = ~model & (np.bincount(image[known[track]], minlength=count) >= _GROWS)
        if not new.any():
            return [int(k) for k in np.flatnonzero(~model)]
        model |= new


def connected_parts(count: int, tracks: Tracks) -> list[list[int]]:
    """Images that hang together by tracks, the largest part first; an image without any is a part of its own."""
    total = count + tracks.count
    graph = coo_matrix((np.ones(len(tracks), np.int8), (tracks.image, count + tracks.track)), shape=(total, total))
    _, label = connected_components(graph, directed=False)
    parts: dict[int, list[int]] = {}
    for image in range(count):
        parts.setdefault(int(label[image]), []).append(image)
    return sorted(parts.values(), key=len, reverse=True)


#: Cells along each side of an image.
CELLS = 5
#: Tracks that every sixth of an overlap (its von Gruber positions) keeps, where it has so many.
GRUBER = 3


def thin_tracks(tracks: Tracks, sizes: Sequence[tuple[int, int]], per_image: int) -> Mask:
    """Tracks to keep.

    Long tracks come first, of equally long ones those with the smaller standard deviation (or the finer feature). A
    track is kept if at least half of its images have room for it in the cell where it lies. Then each overlap of two
    images is looked at in two by three parts, and those that hold fewer than `GRUBER` tracks get what they can.

    Parameters
    ----------
    sizes : sequence of (int, int)
        Width and height of each image.
    per_image : int
        Points that an image is to have: an equal share for each of 5 × 5 cells.

    Returns
    -------
    ndarray, shape (tracks.count,)
    """
    room = int(np.ceil(per_image / CELLS**2))
    cell = _cells(tracks, sizes)
    start = np.concatenate([[0], np.cumsum(tracks.rays)])
    filled = np.zeros((len(sizes), CELLS**2), int)
    keep = np.zeros(tracks.count, bool)
    order = _order(tracks)
    for t in order:
        part = slice(start[t], start[t + 1])
        image, where = tracks.image[part], cell[part]
        if 2 * (filled[image, where] < room).sum() >= len(image):
            filled[image, where] += 1
            keep[t] = True
    _fill_overlaps(tracks, start, order, keep)
    return keep


def _cells(tracks: Tracks, sizes: Sequence[tuple[int, int]]) -> Ints:
    part = (tracks.xy + 0.5) / np.array(sizes, float).reshape(-1, 2)[tracks.image] * CELLS
    return np.clip(part.astype(np.int64), 0, CELLS - 1) @ np.array([1, CELLS])


def _order(tracks: Tracks) -> Ints:
    """Tracks from the best to the worst."""
    worst = np.zeros(tracks.count)
    quality = np.where(np.isfinite(tracks.sigma[:, 0]), tracks.sigma.max(axis=1), tracks.scale)
    np.maximum.at(worst, tracks.track, quality)
    return np.lexsort((np.arange(tracks.count), worst, -tracks.rays))


def _fill_overlaps(tracks: Tracks, start: Ints, order: Ints, keep: Mask) -> None:
    """Keep further tracks where a part of an overlap holds too few; `keep` is changed."""
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    members: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for t in range(tracks.count):
        rows = range(start[t], start[t + 1])
        for a in rows:
            for b in rows:
                if tracks.image[a] < tracks.image[b]:
                    members.setdefault((int(tracks.image[a]), int(tracks.image[b])), []).append((t, a))
    for found in members.values():
        t, row = np.array(found).T
        xy = tracks.xy[row]
        low, high = xy.min(axis=0), xy.max(axis=0)
        long = int(np.argmax(high - low))
        counts = np.where(np.arange(2) == long, 3, 2)
        part = np.clip(((xy - low) / np.maximum(high - low, 1.0) * counts).astype(int), 0, counts - 1) @ (1, counts[0])
        for p in range(6):
            here = t[part == p]
            missing = GRUBER - int(keep[here].sum())
            if missing > 0:
                spare = here[~keep[here]]
                keep[spare[np.argsort(rank[spare])[:missing]]] = True


#: Width of the derivative that finds edges, pixels.
SIGMA = 1.5
#: What a change of grey values is full evidence of an edge, in parts of the strong ones (99th percentile).
_FULL = 0.5
#: Least change that is an edge at all, in the same unit: columns without it have none.
_LEAST = 0.15
#: Costs: evidence above the edge against that at the edge; a pixel of a step between columns, and the dearest step.
_ABOVE, _STEP, _DEAREST = 0.15, 0.02, 0.6
_NEVER = 1e6
#: From where a change is evident to its middle, pixels at most.
_SHOULDER = 4


def edge_strength(grey: NDArray[np.floating]) -> Floats:
    """How much grey values (height, width) change downwards in each pixel, same shape; 0 near pixels without value."""
    known = np.isfinite(grey)
    even = np.where(known, grey, 0.0).astype(float)
    change = np.abs(gaussian_filter1d(even, SIGMA, axis=0, order=1, mode="nearest"))
    # Where part of the derivative has met no value.
    hidden = gaussian_filter1d((~known).astype(float), SIGMA, axis=0, mode="nearest") > 1e-6
    change[hidden] = 0.0
    return np.asarray(gaussian_filter1d(change, SIGMA / 2, axis=1, mode="nearest"))


def sky_edge(strength: NDArray[np.floating], low: NDArray[np.integer], high: NDArray[np.integer]) -> Floats:
    """Rows of the edge in every column, to a part of a pixel, shape (width,); NaN: there is none."""
    height, width = strength.shape
    row = np.arange(height)[:, None]
    allowed = (row >= low) & (row <= high)
    out = np.full(width, np.nan)
    columns = np.flatnonzero(allowed.any(axis=0))
    if not len(columns) or not (scale := float(np.percentile(strength[allowed], 99))) > 0:
        return out
    part = np.where(allowed, strength, 0.0) / scale
    evidence = np.minimum(part / _FULL, 1.0)
    above = np.cumsum(evidence, axis=0) - evidence
    cost = np.where(allowed, _ABOVE * above - evidence, _NEVER)
    rows = _cheapest(cost[:, columns])
    # From the shoulder of the change, where it is evident, to its middle.
    around = np.clip(rows[None] + np.arange(-_SHOULDER, _SHOULDER + 1)[:, None], 0, height - 1)
    rows = around[np.argmax(part[around, columns], axis=0), np.arange(len(columns))]
    near = np.clip(rows[None] + np.array([[-1], [0], [1]]), 0, height - 1)
    before, here, after = part[near, columns]
    bent = before - 2 * here + after
    top = (before < here) & (here >= after)
    shift = np.where(top, (before - after) / np.where(top, 2 * bent, 1.0), 0.0)
    out[columns] = np.where(here > _LEAST, rows + np.clip(shift, -0.5, 0.5), np.nan)
    return out


def _cheapest(cost: Floats) -> Ints:
    """The row of each column of (height, width) with the least sum of costs, steps between them included."""
    height, width = cost.shape
    slope = _STEP * np.arange(height)
    sums = np.empty_like(cost)
    sums[:, 0] = cost[:, 0]
    for k in range(1, width):
        last = sums[:, k - 1]
        down = np.minimum.accumulate(last - slope) + slope
        up = (np.minimum.accumulate((last + slope)[::-1]))[::-1] - slope
        sums[:, k] = cost[:, k] + np.minimum(np.minimum(down, up), last.min() + _DEAREST)
    rows = np.empty(width, np.int64)
    rows[-1] = np.argmin(sums[:, -1])
    for k in range(width - 2, -1, -1):
        step = np.minimum(_STEP * np.abs(np.arange(height) - rows[k + 1]), _DEAREST)
        rows[k] = np.argmin(sums[:, k] + step)
    return rows
