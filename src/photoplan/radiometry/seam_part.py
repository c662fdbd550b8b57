"""A part of a map between whose images seams are found: labels of the whole map go in and out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.max_flow import SINK, least_cut
from photoplan.kernels.seams import differences, expansion, sum_of

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
    """What some images show of a part."""

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
        if not expansion(labels, free, self._weight, image, *shown, self._costs, self._step, room, ends):
            return None
        tree = np.zeros(len(ends), np.int8)
        least_cut(room, ends, width + 2, tree)
        at = np.s_[top : top + height, left : left + width]
        taken = tree.reshape(height + 2, width + 2)[1:-1, 1:-1] == SINK
        if not taken.any():
            return None
        kept = labels[at].copy()
        before = sum_of(labels, self._weight, box, *shown, self._costs)
        labels[at][taken] = image + 1
        if sum_of(labels, self._weight, box, *shown, self._costs) >= before - self._step:
            labels[at] = kept
            return None
        rows, cols = (np.flatnonzero(taken.any(axis=axis)) for axis in (1, 0))
        return top + int(rows[0]), left + int(cols[0]), int(np.ptp(rows)) + 1, int(np.ptp(cols)) + 1

    def total(self, labels: _Labels) -> float:
        """The sum that is made least."""
        whole = 0, 0, *self._weight.shape
        shown = self._boxes, self._first, self._layers
        return float(sum_of(self._own(labels), self._weight, whole, *shown, self._costs))

    def difference(self, labels: _Labels, box: _Box) -> tuple[float, int]:
        """Sum and number of differences at seams from pixels of a box of the map."""
        (row, col), (height, width) = self._corner, self._weight.shape
        mine = self._own(labels[row : row + height, col : col + width])
        at = box[0] - row, box[1] - col, box[2], box[3]
        total, count = differences(mine, at, self._boxes, self._first, self._layers)
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
        """Where an image lies in the part, and what of that it sees."""
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
