"""Seams: expansions are the best there are, things that moved are not cut, what is drawn stays."""

from __future__ import annotations

from itertools import count, product
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from photoplan.errors import PhotoplanError
from photoplan.io.store import ResultLog
from photoplan.radiometry import seams
from photoplan.radiometry.seams import SeamParts, _Level, standing_out
from photoplan.radiometry.shown import SeamLayer, Shown, features_of


class ArrayMemory:
    """A store that ends with the process."""

    def __init__(self) -> None:
        self._kept: dict[int, NDArray[np.float32]] = {}
        self._numbers = count()

    def keep(self, values: NDArray[np.float32], /) -> int:
        """Keep an array; its number."""
        number = next(self._numbers)
        self._kept[number] = values
        return number

    def rows(self, at: int, shape: tuple[int, int, int], first: int, last: int, /) -> NDArray[np.float32]:
        """Some of its rows."""
        return self._kept[at][first:last]


def layers_of(image: Shown, store: ArrayMemory) -> tuple[SeamLayer, ...]:
    return tuple(each.kept(store) for each in features_of(image))


def find_seams(
    images: list[Shown], weight: NDArray[np.float32], fixed: NDArray[np.uint16] | None = None, **options: SeamParts
) -> tuple[NDArray[np.uint16], float, float]:
    store = ArrayMemory()
    return seams.find_seams([layers_of(each, store) for each in images], store, weight, fixed, **options)


@pytest.mark.parametrize("seed", range(12))
def test_an_expansion_is_the_best_of_all_subsets(seed: int) -> None:
    """Three images of nine pixels with holes: against all 2⁹ ways in which one of them can take pixels."""
    random = np.random.default_rng(seed)
    images = [
        Shown(0, 0, random.uniform(0, 100, (1, 3, 3)).astype(np.float32), random.random((3, 3)) < 0.9) for _ in range(3)
    ]
    store, weight = ArrayMemory(), random.uniform(1, 3, (3, 3)).astype(np.float32)
    layers = [layers_of(each, store)[0] for each in images]
    level = _Level(layers, store, weight, np.zeros((3, 3), np.uint16), SeamParts())
    labels, part = level.start().astype(np.int32), level.part((0, 0, 3, 3), 0)
    for image in range(3):
        free = labels > 0
        nodes = np.argwhere(free & images[image].valid & (labels != image + 1))
        best = part.total(labels)
        for chosen in product([False, True], repeat=len(nodes)):
            trial = labels.copy()
            trial[tuple(nodes[np.array(chosen, bool)].T)] = image + 1
            best = min(best, part.total(trial))
        part.expand(labels, image, free)
        # Costs are counted in steps of a 64th of the usual difference.
        assert part.total(labels) <= best + level.usual * len(nodes) / 16


def ground(height: int = 120, width: int = 200) -> NDArray[np.float32]:
    noise = gaussian_filter(np.random.default_rng(3).normal(size=(1, height, width)), (0, 1.5, 1.5))
    return (100 + 30 * noise / noise.std()).astype(np.float32)


def two(moved: NDArray[np.float32]) -> list[Shown]:
    """Left and right halves of a ground, with 80 columns in common; the second brighter, and with something moved."""
    whole = ground()
    left, right = whole[:, :, :140], 1.3 * (whole + moved)[:, :, 60:] + 12
    return [
        Shown(0, 0, left, np.ones(left.shape[1:], bool)),
        Shown(0, 60, right.astype(np.float32), np.ones(right.shape[1:], bool)),
    ]


def test_a_seam_goes_around_what_differs() -> None:
    """A thing that stands in one image alone is whole in the product, or not there: no seam crosses it."""
    moved = np.zeros((1, 120, 200), np.float32)
    moved[:, 30:90, 85:112] = np.random.default_rng(1).normal(0, 60, (1, 60, 27))
    labels, halfway, found = find_seams(two(moved), np.ones((120, 200), np.float32))
    assert np.unique(labels).tolist() == [1, 2]
    assert len(np.unique(labels[31:89, 87:110])) == 1
    assert found < 0.75 * halfway
    assert (labels[:, :60] == 1).all() and (labels[:, 140:] == 2).all()
    again = find_seams(two(moved), np.ones((120, 200), np.float32))[0]
    np.testing.assert_array_equal(labels, again)


def test_without_differences_it_is_short_and_in_the_middle() -> None:
    labels, _, _ = find_seams(two(np.zeros((1, 120, 200), np.float32)), np.ones((120, 200), np.float32))
    at = (labels == 1).sum(axis=1)
    assert np.abs(at - 100).max() < 25 and np.abs(np.diff(at)).sum() < 60


def test_what_stands_out_is_avoided() -> None:
    weight = np.ones((120, 200), np.float32)
    weight[:, 90:125] = 5.0
    labels, _, _ = find_seams(two(np.zeros((1, 120, 200), np.float32)), weight)
    at = (labels == 1).sum(axis=1)
    assert ((at < 92) | (at > 123)).mean() > 0.95


def test_drawn_regions_stay_where_their_image_sees_them() -> None:
    fixed = np.zeros((120, 200), np.uint16)
    fixed[20:40, 50:180] = 1  # the first image ends at column 140
    labels, _, _ = find_seams(two(np.zeros((1, 120, 200), np.float32)), np.ones((120, 200), np.float32), fixed)
    assert (labels[20:40, 50:140] == 1).all() and (labels[20:40, 140:180] == 2).all()


def test_three_images_meet_and_holes_stay_empty() -> None:
    whole = ground(140, 140)
    boxes = [(0, 0, 90, 90), (0, 50, 90, 90), (50, 20, 90, 100)]
    images = []
    for row, col, height, width in boxes:
        values = whole[:, row : row + height, col : col + width]
        valid = np.ones(values.shape[1:], bool)
        valid[:5] = False
        images.append(Shown(row, col, values, valid))
    labels, _, _ = find_seams(images, np.ones((140, 140), np.float32))
    seen = np.zeros((140, 140), int)
    for number, image in enumerate(images, 1):
        at = np.s_[image.row : image.row + image.valid.shape[0], image.col : image.col + image.valid.shape[1]]
        seen[at] += image.valid
        outside = np.ones((140, 140), bool)
        outside[at] = ~image.valid
        assert not (outside & (labels == number)).any()
    np.testing.assert_array_equal(labels > 0, seen > 0)
    assert np.unique(labels[labels > 0]).tolist() == [1, 2, 3]


def test_images_apart_and_black_ones() -> None:
    """Nothing to compare: each keeps its own; a black image differs from all, and says so by its figure."""
    black = np.zeros((1, 60, 60), np.float32)
    apart = [Shown(0, 0, black, np.ones((60, 60), bool)), Shown(0, 80, black, np.ones((60, 60), bool))]
    labels, halfway, found = find_seams(apart, np.ones((60, 140), np.float32))
    assert (labels[:, :60] == 1).all() and (labels[:, 80:] == 2).all() and not labels[:, 60:80].any()
    assert np.isnan(halfway) and np.isnan(found)


@pytest.mark.parametrize("shift", [(0, 0), (1, 0), (3, 5)])
def test_halved_images_keep_their_place(shift: tuple[int, int]) -> None:
    row, col = shift
    y, x = np.mgrid[:21, :33]
    values = (x + col + 100.0 * (y + row))[None].astype(np.float32)
    half = Shown(row, col, values, np.ones((21, 33), bool)).halved()
    r, c = np.mgrid[: half.valid.shape[0], : half.valid.shape[1]]
    inner = half.valid[1:-1, 1:-1]
    centre = 2 * (c + half.col) + 0.5 + 100.0 * (2 * (r + half.row) + 0.5)
    np.testing.assert_allclose(half.values[0, 1:-1, 1:-1][inner], centre[1:-1, 1:-1][inner], rtol=1e-5)


def test_parts_of_a_map_cost_no_more_than_the_whole() -> None:
    """Six images with things that moved: cut into 30 parts the sum is within 1 % of that of one part, and less than at
    the start."""
    random, size, step = np.random.default_rng(2), (110, 140), (60, 50)
    whole = ground(step[0] + size[0], 2 * step[1] + size[1])
    images = []
    for row, col in product((0, step[0]), (0, step[1], 2 * step[1])):
        values = whole[:, row : row + size[0], col : col + size[1]] * random.uniform(0.8, 1.2)
        values = values + random.normal(0, 6, values.shape)
        for y, x in random.integers(0, 90, (5, 2)):
            values[:, y : y + 15, x : x + 15] += random.normal(0, 50)
        images.append(Shown(row, col, values.astype(np.float32), np.ones(size, bool)))
    weight = np.ones(whole.shape[1:], np.float32)
    store = ArrayMemory()
    level = _Level([layers_of(each, store)[0] for each in images], store, weight, np.zeros(weight.shape, np.uint16),
                   SeamParts())  # fmt: skip
    one, many = (find_seams(images, weight, parts=each)[0] for each in (SeamParts(1000), SeamParts(40, 12)))
    assert level.total(many) < 1.01 * level.total(one) < 0.9 * level.total(level.start())
    assert len(SeamParts(40, 12).of(weight.shape)) == 30 and len(np.unique(many)) > 4


def test_arrays_wait_on_the_disk(tmp_path: Path) -> None:
    """Seams from a file are those from memory, also when the file is opened again; a file that was cut is told."""
    images, weight = two(np.zeros((1, 120, 200), np.float32)), np.ones((120, 200), np.float32)
    with ResultLog(tmp_path / "log", "key", None) as store:
        layers = [layers_of(each, store) for each in images[:1]]
        assert not store.finished
    with ResultLog(tmp_path / "log", "key", None) as store:
        layers.append(layers_of(images[1], store))
        assert len({layer.at for each in layers for layer in each}) == sum(map(len, layers))
        found = seams.find_seams(layers, store, weight)[0]
        np.testing.assert_array_equal(found, find_seams(images, weight)[0])
        with (tmp_path / "log").open("r+b") as file:
            file.truncate(10_000)
        with pytest.raises(PhotoplanError, match="has become shorter"):
            layers[1][0].window(store, (0, 60, 120, 140))


@pytest.mark.parametrize("shape", [(1, 1), (320, 320), (321, 1000), (2000, 1500)])
@pytest.mark.parametrize("parts", [SeamParts(), SeamParts(40, 12), SeamParts(30, 45)])
def test_parts_that_are_solved_at_once_do_not_touch(shape: tuple[int, int], parts: SeamParts) -> None:
    boxes, groups = parts.of(shape), parts.apart(shape)
    assert sorted(k for group in groups for k in group) == list(range(len(boxes)))
    for group in groups[:4]:
        asked = np.zeros(shape, np.uint8)
        for k in group:
            row, col, height, width = seams.grown(boxes[k][1], 1, shape)
            asked[row : row + height, col : col + width] += 1
        assert asked.max() == 1


def test_houses_stand_out_of_slopes_and_unknown_ground_does_not() -> None:
    row, col = np.mgrid[:90, :90]
    relief = (0.03 * row + 0.02 * col).astype(np.float32)
    relief[40:50, 30:45] += 5
    relief[70:, 70:] = np.nan
    found = standing_out(relief)
    assert found[40:50, 30:45].all() and found[39, 35] and found.sum() == 10 * 15 + 2 * (10 + 15)
