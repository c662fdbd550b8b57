"""Seams between overlapping images, by minimum cuts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photoplan.kernels.graph_cut import SINK, expansion_graph, minimum_cut, seam_differences, seam_energy
from photoplan.radiometry.shown import ArrayStore, SeamLayer, quads

_Floats = NDArray[np.float32]
_Mask = NDArray[np.bool_]
_Labels = NDArray[np.uint16]
_Box = tuple[int, int, int, int]
#: What a pixel of seam costs anyway, and a pixel at the border of its image, in parts of the usual difference.
_LENGTH, _MIDDLE = 0.3, 0.15
#: No more rounds than this; steps of the usual difference in which costs are counted.
_ROUNDS, _STEPS = 12, 64
#: Cost of a seam where one of its images shows nothing, in parts of the usual difference: no image should go on there.
_BLIND = 50.0


class SeamPart:
    """Grey values that some images show in a part."""

    def __init__(
        self,
        corner: tuple[int, int],
        images: NDArray[np.int64],
        shown: Sequence[tuple[_Box, _Floats]],
        weight: _Floats,
        fixed: _Labels,
        usual: float,
    ) -> None:
        self._corner, self._images, self._weight = corner, images, np.ascontiguousarray(weight)
        self._boxes = np.array([each for each, _ in shown], np.int64).reshape(-1, 4) - [*corner, 0, 0]
        self._first = np.concatenate([[0], np.cumsum(self._boxes[:, 2] * self._boxes[:, 3])])
        depth = shown[0][1].shape[2] if shown else 1
        self._layers = np.empty((int(self._first[-1]), depth), np.float32)
        for k, (_, values) in enumerate(shown):
            self._layers[self._first[k] : self._first[k + 1]] = values.reshape(-1, depth)
        self._layers[:, -1] *= _MIDDLE * usual
        self._step, self._costs = usual / _STEPS, (_BLIND * usual, _LENGTH * usual)
        own = self._own(fixed)
        for k in range(len(images)):
            at, seen = self._of(k)
            own[at][(own[at] == k + 1) & ~seen] = 0
            outside = own == k + 1
            outside[at] = False
            own[outside] = 0
        self._fixed = own

    def start(self) -> _Labels:
        """Each pixel has the image whose border is furthest."""
        best, cost = np.zeros(self._weight.shape, np.int32), np.full(self._weight.shape, np.inf, np.float32)
        for k in range(len(self._images)):
            at, seen = self._of(k)
            place = self._values(k)[..., -1]
            better = seen & (place < cost[at])
            cost[at][better], best[at][better] = place[better], k + 1
        return self._whole(np.where(self._fixed > 0, self._fixed, best))

    def allowed(self, labels: _Labels) -> _Labels:
        """The same with images that see their pixels."""
        wanted = np.where(self._fixed > 0, self._fixed, self._own(labels))
        found = np.zeros_like(wanted)
        for k in reversed(range(len(self._images))):
            at, seen = self._of(k)
            found[at][seen] = k + 1
        for k in range(len(self._images)):
            at, seen = self._of(k)
            mine = seen & (wanted[at] == k + 1)
            found[at][mine] = k + 1
        return self._whole(found)

    def settled(self, labels: _Labels, free: _Mask, waiting: Sequence[_Box]) -> _Labels:
        """Labels after one image after the other has taken what it gains, until a whole round has changed nothing."""
        mine = self._own(labels)
        free = free & (self._fixed == 0) & (mine > 0)
        asked = np.ones(len(self._images), np.bool_)
        for box in waiting:
            asked &= ~self._near(box)
        for turn in range(_ROUNDS * len(self._images)):
            if asked.all():
                break
            image = turn % len(self._images)
            if asked[image]:
                continue
            asked[image] = True
            changed = self.expand(mine, image, free)
            if changed is not None:
                # The best of one expansion is its own answer: only others have something new to say.
                others = self._near(changed)
                others[image] = False
                asked &= ~others
        return self._whole(mine)

    def expand(self, labels: NDArray[np.int32], image: int, free: _Mask) -> _Box | None:
        """The best of all ways in which an image takes pixels from others; the box in which labels have changed."""
        top, left, height, width = box = self._box(image)
        room, ends = np.zeros((4, (height + 2) * (width + 2)), np.int32), np.zeros((height + 2) * (width + 2), np.int32)
        shown = self._boxes, self._first, self._layers
        if not expansion_graph(labels, free, self._weight, image, *shown, self._costs, self._step, room, ends):
            return None
        tree = np.zeros(len(ends), np.int8)
        minimum_cut(room, ends, width + 2, tree)
        at = np.s_[top : top + height, left : left + width]
        taken = tree.reshape(height + 2, width + 2)[1:-1, 1:-1] == SINK
        if not taken.any():
            return None
        kept = labels[at].copy()
        before = seam_energy(labels, self._weight, box, *shown, self._costs)
        labels[at][taken] = image + 1
        if seam_energy(labels, self._weight, box, *shown, self._costs) >= before - self._step:
            labels[at] = kept
            return None
        rows, cols = (np.flatnonzero(taken.any(axis=axis)) for axis in (1, 0))
        return top + int(rows[0]), left + int(cols[0]), int(np.ptp(rows)) + 1, int(np.ptp(cols)) + 1

    def total(self, labels: _Labels) -> float:
        """The sum that is made least."""
        whole = 0, 0, *self._weight.shape
        shown = self._boxes, self._first, self._layers
        return float(seam_energy(self._own(labels), self._weight, whole, *shown, self._costs))

    def difference(self, labels: _Labels, box: _Box) -> tuple[float, int]:
        """Sum and number of differences at seams from pixels of a box of the map."""
        (row, col), (height, width) = self._corner, self._weight.shape
        mine = self._own(labels[row : row + height, col : col + width])
        at = box[0] - row, box[1] - col, box[2], box[3]
        total, count = seam_differences(mine, at, self._boxes, self._first, self._layers)
        return float(total), int(count)

    def _near(self, box: _Box) -> _Mask:
        """Images that show something of a box or beside it."""
        row, col, height, width = self._boxes.T
        down = (row <= box[0] + box[2]) & (row + height >= box[0])
        return np.asarray(down & (col <= box[1] + box[3]) & (col + width >= box[1]))

    def _box(self, image: int) -> _Box:
        row, col, height, width = self._boxes[image].tolist()
        return row, col, height, width

    def _values(self, image: int) -> _Floats:
        height, width = self._boxes[image, 2:]
        return self._layers[self._first[image] : self._first[image + 1]].reshape(height, width, -1)

    def _of(self, image: int) -> tuple[tuple[slice, slice], _Mask]:
        """Return where an image lies in the part, and what of that it sees."""
        row, col, height, width = self._box(image)
        return np.s_[row : row + height, col : col + width], ~np.isnan(self._values(image)[..., -1])

    def _own(self, labels: _Labels) -> NDArray[np.int32]:
        """Labels by this part's own numbers; 0 for images that do not touch it."""
        number = np.zeros(max(int(labels.max(initial=0)), int(self._images.max(initial=-1)) + 1) + 1, np.int32)
        number[self._images + 1] = np.arange(1, len(self._images) + 1)
        return np.asarray(number[labels])

    def _whole(self, labels: NDArray[np.int32]) -> _Labels:
        """Labels by the map's numbers."""
        return np.concatenate([[0], self._images + 1]).astype(np.uint16)[labels]


Run = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]
"""Results of a function of all items in their order, as `map` or `photoplan.engine.run.Steps` give them."""
#: Shorter side of images and of the map on the coarsest pixels; and pixels to either side of a coarser seam that are
#: asked again.
_COARSEST, _BAND = 48, 5
#: How often a part is solved at most.
_SWEEPS = 4
#: Ground stands out by this from what is around it, metres and pixels; height where none is known.
_RAISED, AROUND, _ABYSS = 1.0, 25, -1e5
#: Pairs of images and rows in each by which the usual difference is known.
_PAIRS, _ROWS = 64, 8


@dataclass(frozen=True)
class SeamParts:
    """Division of a map into parts: their sides, and their overlap, pixels."""

    side: int = 320
    reach: int = 48

    def of(self, shape: tuple[int, int]) -> list[tuple[_Box, _Box]]:
        """Boxes (row, column, height, width) that together are a map, and each with what it reaches into."""
        found = []
        for row in range(0, shape[0], self.side):
            for col in range(0, shape[1], self.side):
                bottom, right = min(row + self.side, shape[0]), min(col + self.side, shape[1])
                inner = row, col, bottom - row, right - col
                found.append((inner, grown(inner, self.reach, shape)))
        return found

    def apart(self, shape: tuple[int, int]) -> list[list[int]]:
        """Numbers of the parts in groups; within one even what parts reach into does not touch."""
        rows, cols = (-(-n // self.side) for n in shape)
        step = 1 + -(-2 * (self.reach + 1) // self.side)
        starts = product(range(min(step, rows)), range(min(step, cols)))
        return [[i * cols + j for i in range(row, rows, step) for j in range(col, cols, step)] for row, col in starts]


PARTS = SeamParts()


def find_seams(
    images: Sequence[Sequence[SeamLayer]],
    store: ArrayStore,
    weight: _Floats,
    fixed: _Labels | None = None,
    parts: SeamParts = PARTS,
    run: Run = map,
) -> tuple[_Labels, float, float]:
    """The image of each pixel.

    Parameters
    ----------
    images : sequence
        For each its layers, see `features_of`, none if it shows nothing; `store` holds them.
    weight : ndarray of float32, shape (height, width)
        What a seam costs at a place beside others; 1 usually, more where none should run.
    fixed : ndarray of uint16, shape (height, width), optional
        Number of an image plus one where somebody has decided, and the image sees the pixel; 0 elsewhere.
    parts : Parts
        How the map is cut.
    run : callable
        Solves parts, several at once.

    Returns
    -------
    labels : ndarray of uint16, shape (height, width)
        Number of the image plus one; 0 where no image sees anything.
    start, found : float
        Mean difference of the images on both sides of a pixel of seam, if each pixel had the image in whose middle it
        lies most, and as it is; grey values of detail.
    """
    pyramid = [(weight, np.zeros(weight.shape, np.uint16) if fixed is None else fixed)]
    across = float(np.median([min(layers[0].box[2:]) for layers in images if layers]))
    while min(*pyramid[-1][0].shape, across) > 2 * _COARSEST:
        across /= 2
        w, kept = pyramid[-1]
        even = np.pad(w, [(0, n % 2) for n in w.shape], mode="edge")
        pyramid.append((quads(even[None])[0] / 4, _coarser(kept)))
    labels: _Labels | None = None
    for depth in reversed(range(len(pyramid))):
        level = _Level([_layer(each, depth) for each in images], store, *pyramid[depth], parts)
        near = None
        if labels is not None:
            shape = level.shape
            labels = level.allowed(np.repeat(np.repeat(labels, 2, axis=0), 2, axis=1)[: shape[0], : shape[1]])
            near = ndimage.binary_dilation(_borders(labels), iterations=_BAND)
        labels = level.start() if labels is None else labels
        level.settle(labels, near, run)
    assert labels is not None
    return labels, level.difference(level.start()), level.difference(labels)


def without_overlap(images: Sequence[Sequence[SeamLayer]], store: ArrayStore, shape: tuple[int, int]) -> list[bool]:
    """For each image with layers on a map whether no other shows what it shows, on pixels four times as large."""
    counts = np.zeros([-(-n // 4) + 1 for n in shape], np.uint16)
    whole = 0, 0, *counts.shape

    def seen(layer: SeamLayer) -> tuple[tuple[slice, slice], _Mask]:
        box, values = layer.window(store, whole)
        return _slices(box), ~np.isnan(values[..., -1])

    coarse = [_layer(layers, 2) for layers in images]
    for layer in coarse:
        if layer is not None:
            at, mask = seen(layer)
            counts[at] += mask
    found = []
    for layers, layer in zip(images, coarse):
        at, mask = (np.s_[:0, :0], np.zeros((0, 0), np.bool_)) if layer is None else seen(layer)
        found.append(bool(layers) and not (counts[at][mask] > 1).any())
    return found


def standing_out(relief: _Floats) -> _Mask:
    """Return where heights (h, w) stand out from those around, such as houses and trees; NaN is unknown.

    Pixels nearer to the border than `AROUND` lack some of what is around them.
    """
    known = np.where(np.isnan(relief), np.float32(_ABYSS), relief)
    ground = ndimage.grey_opening(known, size=(AROUND, AROUND))
    return np.asarray(ndimage.binary_dilation((known - ground > _RAISED) & ~np.isnan(relief)))


class _Level:
    """Images on pixels of one size, part by part."""

    def __init__(
        self, layers: Sequence[SeamLayer | None], store: ArrayStore, weight: _Floats, fixed: _Labels, parts: SeamParts
    ) -> None:
        self.shape, self._weight, self._fixed, self._store = weight.shape, weight, fixed, store
        self._layers, self._parts, self._apart = layers, parts.of(weight.shape), parts.apart(weight.shape)
        self._boxes = np.array([(0, 0, 0, 0) if each is None else each.box for each in layers], np.int64)
        self.usual = self._usual()

    def part(self, box: _Box, rim: int) -> SeamPart:
        """Return what images show of a box with a rim."""
        row, col, height, width = wide = grown(box, rim, self.shape)
        r, c, h, w = self._boxes.T
        touching = (r < row + height) & (r + h > row) & (c < col + width) & (c + w > col)
        images, found = np.flatnonzero(touching), []
        for k in images.tolist():
            layer = self._layers[k]
            assert layer is not None
            found.append(layer.window(self._store, wide))
        at = np.s_[row : row + height, col : col + width]
        return SeamPart((row, col), images, found, self._weight[at], self._fixed[at], self.usual)

    def start(self) -> _Labels:
        """Each pixel has the image whose border is furthest."""
        labels = np.zeros(self.shape, np.uint16)
        for inner, _ in self._parts:
            labels[_slices(inner)] = self.part(inner, 0).start()
        return labels

    def allowed(self, labels: _Labels) -> _Labels:
        """The same, with what is fixed, and with images that see their pixels: elsewhere another that does, or none."""
        out = np.zeros(self.shape, np.uint16)
        for inner, _ in self._parts:
            out[_slices(inner)] = self.part(inner, 0).allowed(labels[_slices(inner)])
        return out

    def settle(self, labels: _Labels, near: _Mask | None, run: Run) -> None:
        """Expand images part by part till none gains, and parts again that a neighbour has changed; labels change."""
        changed: list[list[_Box]] = [[outer] for _, outer in self._parts]

        asked: dict[int, list[_Box]] = {}

        def solve(k: int) -> tuple[_Box, _Labels] | None:
            """Solve a part in which boxes have changed; return where labels are new, and which, or None if none are."""
            outer = self._parts[k][1]
            part, wide = self.part(outer, 1), grown(outer, 1, self.shape)
            free = np.zeros(wide[2:], np.bool_)
            free[_slices(outer, wide)] = True if near is None else near[_slices(outer)]
            before = labels[_slices(wide)]
            after = part.settled(before, free, [(b[0] - wide[0], b[1] - wide[1], *b[2:]) for b in asked[k]])
            at = np.argwhere(after != before)
            if not len(at):
                return None
            (top, left), (bottom, right) = at.min(axis=0).tolist(), (at.max(axis=0) + 1).tolist()
            box = wide[0] + top, wide[1] + left, bottom - top, right - left
            return box, after[top:bottom, left:right].copy()

        for _ in range(_SWEEPS):
            for group in self._apart:
                asked = {k: changed[k] for k in group if changed[k] and self._asked(k, near)}
                for k in group:
                    changed[k] = []
                for k, found in zip(asked, list(run(solve, asked)), strict=True):
                    if found is None:
                        continue
                    box, labels[_slices(found[0])] = found
                    for other, (_, theirs) in enumerate(self._parts):
                        if other != k and (common := _common(grown(box, 1, self.shape), theirs)) is not None:
                            changed[other].append(common)
            if not any(changed):
                break

    def _asked(self, part: int, near: _Mask | None) -> bool:
        """Return whether a part has pixels that may change."""
        return near is None or bool(near[_slices(self._parts[part][1])].any())

    def total(self, labels: _Labels) -> float:
        """The sum that is made least."""
        whole = 0, 0, *self.shape
        return self.part(whole, 0).total(labels)

    def difference(self, labels: _Labels) -> float:
        """Mean difference of the two images at a pixel of seam; NaN without seams."""
        total, count = 0.0, 0
        for inner, _ in self._parts:
            found = self.part(inner, 1).difference(labels, inner)
            total, count = total + found[0], count + found[1]
        return total / count if count else float("nan")

    def _usual(self) -> float:
        """Median difference of two images that see the same place, in rows drawn by lot, the same every time."""
        random, found = np.random.default_rng(0), [np.zeros(0, np.float32)]
        r, c, h, w = self._boxes.T
        for _ in range(_PAIRS):
            one = int(random.integers(len(self._boxes)))
            row, col, height, width = self._boxes[one].tolist()
            meet = (r < row + height) & (r + h > row) & (c < col + width) & (c + w > col)
            meet[one] = False
            if not meet.any():
                continue
            other = int(random.choice(np.flatnonzero(meet)))
            both = _common(self._boxes[one].tolist(), self._boxes[other].tolist())
            assert both is not None
            for line in random.integers(both[0], both[0] + both[2], _ROWS).tolist():
                at = line, both[1], 1, both[3]
                a, b = (self._row(k, at) for k in (one, other))
                good = ~np.isnan(a[:, -1] + b[:, -1])
                found.append(np.abs(a - b)[good, :-1].sum(axis=1))
        apart = np.concatenate(found)
        return max(float(np.median(apart)), 1e-3) if len(apart) else 1.0

    def _row(self, image: int, box: _Box) -> _Floats:
        layer = self._layers[image]
        assert layer is not None
        return layer.window(self._store, box)[1][0]


def _layer(layers: Sequence[SeamLayer], depth: int) -> SeamLayer | None:
    """Return the layer of an image on pixels of a size; None if it is too small for them."""
    return layers[depth] if depth < len(layers) else None


def grown(box: _Box, by: int, shape: tuple[int, ...]) -> _Box:
    """A box with what lies around it on a map."""
    row, col = max(box[0] - by, 0), max(box[1] - by, 0)
    bottom, right = min(box[0] + box[2] + by, shape[0]), min(box[1] + box[3] + by, shape[1])
    return row, col, bottom - row, right - col


def _common(a: Sequence[int], b: Sequence[int]) -> _Box | None:
    row, col = max(a[0], b[0]), max(a[1], b[1])
    height, width = min(a[0] + a[2], b[0] + b[2]) - row, min(a[1] + a[3], b[1] + b[3]) - col
    return (row, col, height, width) if height > 0 and width > 0 else None


def _slices(box: _Box, inside: Sequence[int] = (0, 0)) -> tuple[slice, slice]:
    """Return the slices of a box in a map, or in another box."""
    row, col = box[0] - inside[0], box[1] - inside[1]
    return slice(row, row + box[2]), slice(col, col + box[3])


def _borders(labels: _Labels) -> _Mask:
    out = np.zeros(labels.shape, np.bool_)
    out[:, 1:] |= labels[:, 1:] != labels[:, :-1]
    out[1:] |= labels[1:] != labels[:-1]
    return out


def _coarser(labels: _Labels) -> _Labels:
    """Labels on pixels twice as large, 0 where four of them are not alike."""
    even = np.pad(labels, [(0, n % 2) for n in labels.shape])
    a, b, c, d = even[::2, ::2], even[1::2, ::2], even[::2, 1::2], even[1::2, 1::2]
    return np.where((a == b) & (a == c) & (a == d), a, 0).astype(np.uint16)
