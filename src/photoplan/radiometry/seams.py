"""Where one image of a mosaic takes over from the next: seams that are least seen, over all images at once.

Every pixel of the map gets one of the images that see it. What is made least is a sum over pixels (how far the place
lies from the middle of its image) and over neighbours with different images: how much these images differ at both
places (Kwatra et al. 2003, eq. 1), in their fine detail, its strength and, less, their colours. The sum of differences
is a metric between images, so that each expansion of an image into all others is a cut of least cost in a graph
(Boykov, Veksler & Zabih 2001, section 5). Expansions are repeated, image by image, until none lowers the sum: where
three or more meet, all are asked. From coarse to fine pixels only what lies near a seam is asked again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photoplan.kernels.max_flow import SINK, least_cut

_Floats = NDArray[np.float32]
_Mask = NDArray[np.bool_]
_Labels = NDArray[np.uint16]
#: Pixels over which brightness is what images differ in, and not detail.
_SMOOTH = 6.0
#: What colours and the strength of detail count beside detail itself.
_COLOUR, _STRENGTH = 0.15, 0.5
#: What a pixel of seam costs anyway, and a pixel at the border of its image, in parts of the usual difference.
_LENGTH, _MIDDLE = 0.3, 0.15
#: Shorter side of the coarsest maps, pixels; and pixels to either side of a coarser seam that are asked again.
_COARSEST, _BAND = 48, 5
#: No more rounds than this; steps of the usual difference in which costs are counted.
_ROUNDS, _STEPS = 12, 64
#: Cost of a seam where one of its images shows nothing, in parts of the usual difference: no image should go on there.
_BLIND = 50.0


@dataclass(frozen=True, eq=False)
class Shown:
    """What an image shows of a map."""

    row: int
    col: int
    """Of its upper-left pixel in the map."""
    values: _Floats
    """Shape (bands, height, width)."""
    valid: _Mask
    """Pixels that the image sees, shape (height, width)."""

    def halved(self) -> Shown:
        """The same on pixels twice as large; a pixel is valid if at least half of it was."""
        top, left = self.row % 2, self.col % 2
        height, width = (-(-(n + odd) // 2) * 2 for n, odd in zip(self.valid.shape, (top, left)))
        values = np.zeros((len(self.values), height, width), np.float32)
        weight = np.zeros((height, width), np.float32)
        here = slice(top, top + self.valid.shape[0]), slice(left, left + self.valid.shape[1])
        values[(slice(None), *here)], weight[here] = self.values * self.valid, self.valid
        sums, count = _quads(values), _quads(weight[None])[0]
        return Shown(self.row // 2, self.col // 2, sums / np.maximum(count, 1.0), count >= 2.0)


def find_seams(
    images: Sequence[Shown],
    weight: _Floats,
    fixed: _Labels | None = None,
    told: Callable[[], None] = lambda: None,
) -> tuple[_Labels, float, float]:
    """The image of each pixel.

    Parameters
    ----------
    images : sequence of Shown
    weight : ndarray of float32, shape (height, width)
        What a seam costs at a place beside others; 1 usually, more where none should run.
    fixed : ndarray of uint16, shape (height, width), optional
        Number of an image plus one where somebody has decided, and the image sees the pixel; 0 elsewhere.
    told : callable
        Called after each level.

    Returns
    -------
    labels : ndarray of uint16, shape (height, width)
        Number of the image plus one; 0 where no image sees anything.
    start, found : float
        Mean difference of the images on both sides of a pixel of seam, if each pixel had the image in whose middle it
        lies most, and as it is; grey values of detail.
    """
    fixed = np.zeros(weight.shape, np.uint16) if fixed is None else fixed
    pyramid = [(list(images), weight, fixed)]
    while min(pyramid[-1][1].shape) > 2 * _COARSEST:
        finer, w, kept = pyramid[-1]
        even = np.pad(w, [(0, n % 2) for n in w.shape], mode="edge")
        pyramid.append(([each.halved() for each in finer], _quads(even[None])[0] / 4, _coarser(kept)))
    labels: _Labels | None = None
    for each, w, kept in reversed(pyramid):
        level = _Level(each, w, kept)
        near = np.ones(w.shape, np.bool_)
        if labels is not None:
            labels = np.repeat(np.repeat(labels, 2, axis=0), 2, axis=1)[: w.shape[0], : w.shape[1]]
            labels = level.allowed(labels)
            near = ndimage.binary_dilation(_borders(labels), iterations=_BAND)
        labels = level.settled(level.start() if labels is None else labels, near)
        told()
    assert labels is not None
    return labels, level.difference(level.start()), level.difference(labels)


class _Level:
    """Images on pixels of one size, and what seams between them cost."""

    def __init__(self, images: Sequence[Shown], weight: _Floats, fixed: _Labels) -> None:
        self.shape, self._weight = weight.shape, weight
        self._box = np.array([(i.row, i.col, *i.valid.shape) for i in images], np.int64).reshape(-1, 4)
        self._first = np.concatenate([[0], np.cumsum(self._box[:, 2] * self._box[:, 3])])
        self._seen = np.concatenate([i.valid.ravel() for i in images])
        self._detail = np.concatenate([_detail(i) for i in images])
        self._edge = np.concatenate([_from_middle(i.valid).ravel() for i in images])
        self.usual = self._usual()
        own = fixed.astype(np.int64) - 1
        kept = np.flatnonzero(fixed.ravel())
        self._fixed = np.zeros(weight.size, np.uint16)
        self._fixed[kept] = np.where(self._valid(own.ravel()[kept], kept), fixed.ravel()[kept], 0)

    def start(self) -> _Labels:
        """Each pixel has the image whose border is furthest."""
        cost, best = np.full(self.shape, np.inf, np.float32), np.zeros(self.shape, np.uint16)
        for k, (row, col, height, width) in enumerate(self._box.tolist()):
            at = np.s_[row : row + height, col : col + width]
            mine = slice(self._first[k], self._first[k + 1])
            own = np.where(self._seen[mine], self._edge[mine], np.inf).reshape(height, width)
            better = own < cost[at]
            cost[at][better], best[at][better] = own[better], k + 1
        return self.allowed(best)

    def allowed(self, labels: _Labels) -> _Labels:
        """The same, with what is fixed, and with images that see their pixels: elsewhere another that does, or none."""
        flat = np.where(self._fixed > 0, self._fixed, labels.ravel())
        places = np.arange(flat.size)
        wrong = np.flatnonzero(~self._valid(flat.astype(np.int64) - 1, places))
        flat[wrong] = 0
        for k in range(len(self._box)):
            some = wrong[(flat[wrong] == 0) & self._valid(np.full(len(wrong), k), wrong)]
            flat[some] = k + 1
        return flat.reshape(self.shape)

    def settled(self, labels: _Labels, near: _Mask) -> _Labels:
        """Expand one image after the other, until a whole round has changed nothing."""
        flat, free = labels.ravel().copy(), (near.ravel() & (self._fixed == 0) & (labels.ravel() > 0))
        quiet = 0
        for turn in range(_ROUNDS * len(self._box)):
            quiet = 0 if self.expand(flat, turn % len(self._box), free) else quiet + 1
            if quiet >= len(self._box):
                break
        return flat.reshape(self.shape)

    def expand(self, flat: _Labels, image: int, free: _Mask) -> bool:
        """The best of all ways in which an image takes pixels from others; whether the sum has become less."""
        row, col, height, width = self._box[image].tolist()
        inside = (np.arange(row, row + height)[:, None] * self.shape[1] + np.arange(col, col + width)).ravel()
        mine = self._seen[self._first[image] : self._first[image + 1]]
        nodes = inside[mine & free[inside] & (flat[inside] != image + 1)]
        if not len(nodes):
            return False
        number = np.full(flat.size, -1, np.int64)
        number[nodes] = np.arange(len(nodes))
        take = self._own(np.full(len(nodes), image), nodes) - self._own(flat[nodes].astype(np.int64) - 1, nodes)
        pairs, both = [], []
        for p, q in self._neighbours():
            some = (number[p] >= 0) | (number[q] >= 0)
            some &= (flat[p] > 0) & (flat[q] > 0)
            p, q = p[some], q[some]
            a, b, new = flat[p].astype(np.int64) - 1, flat[q].astype(np.int64) - 1, np.full(len(p), image)
            keep, one, other = (self._seam(x, y, p, q) for x, y in ((a, b), (a, new), (new, b)))
            at_p, at_q = number[p] >= 0, number[q] >= 0
            # Neighbours that stay count for the one that may change.
            np.add.at(take, number[p[at_p & ~at_q]], (other - keep)[at_p & ~at_q])
            np.add.at(take, number[q[at_q & ~at_p]], (one - keep)[at_q & ~at_p])
            two = at_p & at_q
            np.add.at(take, number[p[two]], (other - keep)[two])
            np.add.at(take, number[q[two]], -other[two])
            pairs.append(np.stack([number[p[two]], number[q[two]]]))
            both.append(np.maximum((one + other - keep)[two], 0.0))
        y, x = np.divmod(nodes, self.shape[1])
        places = (y - row + 1) * (width + 2) + x - col + 1
        edges = np.concatenate(pairs, axis=1), np.concatenate(both)
        taken = _least(take, edges, self.usual / _STEPS, places, (height + 2, width + 2))
        if not taken.any():
            return False
        before = self.total(flat)
        trial = flat.copy()
        trial[nodes[taken]] = image + 1
        if self.total(trial) >= before - 1e-6 * abs(before):
            return False
        flat[:] = trial
        return True

    def total(self, flat: _Labels) -> float:
        """The sum that is made least."""
        some = np.flatnonzero(flat)
        cost = float(self._own(flat[some].astype(np.int64) - 1, some).sum())
        return cost + sum(float(costs.sum()) for costs in self._seams(flat))

    def difference(self, labels: _Labels) -> float:
        """Mean difference of the two images at a pixel of seam; NaN without seams."""
        flat = labels.ravel()
        found = []
        for p, q in self._neighbours():
            p, q = (each[(flat[p] != flat[q]) & (flat[p] > 0) & (flat[q] > 0)] for each in (p, q))
            a, b = (flat[each].astype(np.int64) - 1 for each in (p, q))
            for at in (p, q):
                good = self._valid(a, at) & self._valid(b, at)
                found.append(self._apart(a[good], b[good], at[good]))
        return float(np.concatenate(found).mean()) if sum(map(len, found)) else float("nan")

    def _seams(self, flat: _Labels) -> list[_Floats]:
        out = []
        for p, q in self._neighbours():
            some = (flat[p] != flat[q]) & (flat[p] > 0) & (flat[q] > 0)
            p, q = p[some], q[some]
            out.append(self._seam(flat[p].astype(np.int64) - 1, flat[q].astype(np.int64) - 1, p, q))
        return out

    def _neighbours(self) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        at = np.arange(self.shape[0] * self.shape[1]).reshape(self.shape)
        return [(at[:, :-1].ravel(), at[:, 1:].ravel()), (at[:-1].ravel(), at[1:].ravel())]

    def _seam(self, a: NDArray[np.int64], b: NDArray[np.int64], p: NDArray[np.int64], q: NDArray[np.int64]) -> _Floats:
        """Cost of neighbours p and q with the images a and b; a metric between images."""
        cost = np.zeros(len(a), np.float32)
        for at in (p, q):
            good = self._valid(a, at) & self._valid(b, at)
            each = np.full(len(a), _BLIND * self.usual, np.float32)
            each[good] = self._apart(a[good], b[good], at[good])
            cost += (np.minimum(each, _BLIND * self.usual) + _LENGTH * self.usual) * self._weight.ravel()[at]
        return np.where(a == b, 0.0, cost).astype(np.float32)

    def _own(self, image: NDArray[np.int64], at: NDArray[np.int64]) -> _Floats:
        """Cost of pixels of images by their place in them."""
        return (_MIDDLE * self.usual * self._edge[self._index(image, at)]).astype(np.float32)

    def _apart(self, a: NDArray[np.int64], b: NDArray[np.int64], at: NDArray[np.int64]) -> _Floats:
        return np.abs(self._detail[self._index(a, at)] - self._detail[self._index(b, at)]).sum(axis=1)

    def _index(self, image: NDArray[np.int64], at: NDArray[np.int64]) -> NDArray[np.int64]:
        row, col, _, width = self._box[image].T
        y, x = np.divmod(at, self.shape[1])
        return np.asarray(self._first[image] + (y - row) * width + (x - col))

    def _valid(self, image: NDArray[np.int64], at: NDArray[np.int64]) -> _Mask:
        """Whether images (none: −1) see pixels."""
        known = np.maximum(image, 0)
        row, col, height, width = self._box[known].T
        y, x = np.divmod(at, self.shape[1])
        inside = (image >= 0) & (y >= row) & (y < row + height) & (x >= col) & (x < col + width)
        out = np.zeros(len(at), np.bool_)
        out[inside] = self._seen[self._index(known[inside], at[inside])]
        return out

    def _usual(self) -> float:
        """Median difference of two images that see the same place; at places drawn by chance, the same every time."""
        random = np.random.default_rng(0)
        at = random.integers(0, self.shape[0] * self.shape[1], 40_000)
        a, b = random.integers(0, len(self._box), (2, len(at)))
        good = (a != b) & self._valid(a, at) & self._valid(b, at)
        apart = self._apart(a[good], b[good], at[good])
        return max(float(np.median(apart)), 1e-3) if len(apart) else 1.0


def _least(
    take: _Floats,
    edges: tuple[NDArray[np.int64], _Floats],
    step: float,
    places: NDArray[np.int64],
    shape: tuple[int, int],
) -> _Mask:
    """The nodes (n,) that change in the cheapest way.

    Parameters
    ----------
    take : ndarray, shape (n,)
        What a node costs more if it changes.
    edges : ndarrays, shapes (2, m) and (m,)
        Pairs of nodes, and their cost if the second changes and the first does not; not negative.
    step : float
        Costs are counted in whole steps of it.
    places : ndarray of int, shape (n,)
        Of the nodes in a grid of a shape with a rim of one pixel, counted row by row.
    """
    own = np.clip(np.rint(take / step), -(10**8), 10**8).astype(np.int32)
    pairs, both = edges
    cost = np.clip(np.rint(both / step), 0, 10**8).astype(np.int32)
    first, second = places[pairs]
    room, ends = np.zeros((4, shape[0] * shape[1]), np.int32), np.zeros(shape[0] * shape[1], np.int32)
    room[np.where(second == first + 1, 0, 2), first] = cost
    ends[places] = own
    tree = np.zeros(len(ends), np.int8)
    least_cut(room, ends, shape[1], tree)
    return np.asarray(tree[places] == SINK)


def _detail(image: Shown) -> _Floats:
    """By what images are compared, shape (pixels, features): detail of each band, its strength, colour."""
    weight = image.valid.astype(np.float32)
    known = np.maximum(ndimage.gaussian_filter(weight, _SMOOTH), 1e-3)
    smooth = np.stack([ndimage.gaussian_filter(band * weight, _SMOOTH) / known for band in image.values])
    fine = (image.values - smooth) * weight
    grey = fine.mean(axis=0)
    strength = np.hypot(*np.gradient(grey)) if min(grey.shape) > 1 else np.zeros_like(grey)
    bands = len(fine)
    features = [*(fine / bands), _STRENGTH * strength, _COLOUR * image.values.mean(axis=0) * weight]
    return np.stack([each.ravel() for each in features], axis=1).astype(np.float32)


def _from_middle(valid: _Mask) -> _Floats:
    """0 in the middle of what an image shows, growing with the square to 1 at its border."""
    inside = ndimage.distance_transform_edt(np.pad(valid, 1))[1:-1, 1:-1]
    return np.asarray((1.0 - inside / max(float(inside.max()), 1.0)) ** 2, np.float32)


def _borders(labels: _Labels) -> _Mask:
    out = np.zeros(labels.shape, np.bool_)
    out[:, 1:] |= labels[:, 1:] != labels[:, :-1]
    out[1:] |= labels[1:] != labels[:-1]
    return out


def _quads(values: _Floats) -> _Floats:
    """Sums of 2 × 2 pixels of (bands, height, width), both even."""
    return values[:, ::2, ::2] + values[:, 1::2, ::2] + values[:, ::2, 1::2] + values[:, 1::2, 1::2]


def _coarser(labels: _Labels) -> _Labels:
    """Labels on pixels twice as large, 0 where four of them are not alike."""
    even = np.pad(labels, [(0, n % 2) for n in labels.shape])
    a, b, c, d = even[::2, ::2], even[1::2, ::2], even[::2, 1::2], even[1::2, 1::2]
    return np.where((a == b) & (a == c) & (a == d), a, 0).astype(np.uint16)
