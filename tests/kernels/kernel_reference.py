"""The kernels' slow twin: one pixel after the other, double precision, textbook weights. Shares no code with them."""

from __future__ import annotations

import itertools
import math

import numpy as np

SUPPORT = {"bilinear": 1, "bicubic": 2, "bicubic-1": 2, "lanczos3": 3}


def weight(name: str, t: float) -> float:
    """Weight at distance t, not normalised; bicubic-1 is Ecker 1991, eq. 4.15 as printed."""
    t = abs(t)
    if name == "bilinear":
        return max(0.0, 1 - t)
    if name == "bicubic-1":
        return 1 - 2 * t**2 + t**3 if t < 1 else 4 - 8 * t + 5 * t**2 - t**3 if t < 2 else 0.0
    if name == "bicubic":
        return 1 - 2.5 * t**2 + 1.5 * t**3 if t < 1 else 2 - 4 * t + 2.5 * t**2 - 0.5 * t**3 if t < 2 else 0.0
    if t == 0:
        return 1.0
    return 3 * math.sin(math.pi * t) * math.sin(math.pi * t / 3) / (math.pi * t) ** 2 if t < 3 else 0.0


def normalised(name: str, t: float) -> float:
    """Weight at distance t, divided by the sum over the whole lattice that contains t."""
    total = sum(weight(name, t + k) for k in range(-7, 8))
    return weight(name, t) / total


def stretch(s: float) -> float:
    return 1.0 if s <= 1.1 else s if s >= 1.3 else 1.0 + 0.3 * (s - 1.1) / 0.2


def axis_weights(name: str, position: float, widening: float) -> dict[int, float]:
    """Pixels along one axis and their weights, which add up to 1."""
    reach = SUPPORT[name] * widening
    pixels = range(math.ceil(position - reach), math.floor(position + reach) + 1)
    raw = {i: normalised(name, (i - position) / widening) for i in pixels}
    total = sum(raw.values())
    return {i: w / total for i, w in raw.items()}


def sample(source, valid, name, x, y, widening=(1.0, 1.0)):
    """(values per band, weight of the valid taps) at one position."""
    bands, height, width = source.shape
    if name == "nearest":
        col, row = min(math.floor(x + 0.5), width - 1), min(math.floor(y + 0.5), height - 1)
        inside = col >= 0 and row >= 0 and (valid is None or valid[row, col])
        return (source[:, row, col].astype(float), 1.0) if inside else (np.zeros(bands), 0.0)
    total, values = 0.0, np.zeros(bands)
    along_x, along_y = axis_weights(name, x, widening[0]), axis_weights(name, y, widening[1])
    for (j, wy), (i, wx) in itertools.product(along_y.items(), along_x.items()):
        if 0 <= i < width and 0 <= j < height and (valid is None or valid[j, i]):
            total += wx * wy
            values += wx * wy * source[:, j, i].astype(float)
    return (values / total if total > 1e-9 else values), total


def rectify(mapping, relief, source, valid, border, name):
    """Values (bands, rows, cols) before rounding, weight of the valid taps (rows, cols), positions (rows, cols, 2)."""
    rows, cols = relief.shape
    values, totals = np.zeros((source.shape[0], rows, cols)), np.zeros((rows, cols))
    xy = np.full((rows, cols, 2), np.nan)
    for v, u in itertools.product(range(rows), range(cols)):
        h = float(relief[v, u])
        if math.isnan(h):
            continue
        x, y = mapping.xy(u, v, h)
        xy[v, u] = x, y
        if not (border[0] <= x <= border[2] and border[1] <= y <= border[3]):
            continue
        widening = (1.0, 1.0) if name == "nearest" else tuple(stretch(s) for s in mapping.scales(u, v, h))
        values[:, v, u], totals[v, u] = sample(source, valid, name, x, y, widening)
    return values, totals, xy


class Mapping:
    """x·w, y·w, w linear in u, v, h, as for any undistorted frame camera over a plane target."""

    def __init__(self, matrix):
        self.matrix = np.asarray(matrix, float)

    @classmethod
    def similarity(cls, scale=1.0, angle=0.0, shift=(0.0, 0.0), per_metre=(0.0, 0.0)):
        c, s = scale * math.cos(angle), scale * math.sin(angle)
        return cls([[c, -s, per_metre[0], shift[0]], [s, c, per_metre[1], shift[1]], [0, 0, 0, 1]])

    def homogeneous(self, u, v, h):
        u, v, h = np.broadcast_arrays(*(np.asarray(each, float) for each in (u, v, h)))
        return np.stack([u, v, h, np.ones_like(u)], axis=-1) @ self.matrix.T

    def xy(self, u, v, h):
        p = self.homogeneous(u, v, h)
        return p[..., 0] / p[..., 2], p[..., 1] / p[..., 2]

    def scales(self, u, v, h, step=1e-4):
        """By differences: source pixels per target pixel along x and along y."""
        (xa, ya), (xb, yb) = self.xy(u - step, v, h), self.xy(u + step, v, h)
        (xc, yc), (xd, yd) = self.xy(u, v - step, h), self.xy(u, v + step, h)
        return math.hypot(xb - xa, xd - xc) / (2 * step), math.hypot(yb - ya, yd - yc) / (2 * step)

    def anchors(self, rects, levels):
        """Anchor arrays; each rectangle gets the boxes between consecutive `levels`."""
        rects = np.asarray(rects, np.int32).reshape(-1, 4)
        boxes = list(itertools.pairwise(levels))
        corners = [
            [self.homogeneous(u, v, h) for h in box for v in (r[1] - 0.5, r[3] - 0.5) for u in (r[0] - 0.5, r[2] - 0.5)]
            for r in rects
            for box in boxes
        ]
        start = np.arange(len(rects) + 1, dtype=np.int32) * len(boxes)
        heights = np.array(boxes * len(rects), float)
        return rects, start, heights, np.array(corners), np.zeros(5), np.empty((0, 0, 2), np.float32)


def noise(shape, dtype, seed=0):
    """Random pixels over the whole range of an integer type, or 0 … 1000."""
    rng = np.random.default_rng(seed)
    if np.dtype(dtype).kind == "f":
        return (rng.random(shape) * 1000).astype(dtype)
    limits = np.iinfo(dtype)
    return rng.integers(limits.min, limits.max + 1, shape).astype(dtype)


def rounded(values, dtype):
    """Half away from zero, clipped."""
    if np.dtype(dtype).kind == "f":
        return values.astype(dtype)
    limits = np.iinfo(dtype)
    return np.clip(np.trunc(values + np.copysign(0.5, values)), limits.min, limits.max).astype(dtype)
