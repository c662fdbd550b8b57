"""Weights along seams: smooth, one in sum, and nothing where an image does not see."""

from __future__ import annotations

import numpy as np
import pytest

from photoplan.errors import UsageError
from photoplan.geometry.grid import MapGrid, Window
from photoplan.plan.footprint import Tiles
from photoplan.plan.sources import Feather, Share, feather_of

SIDE = 120
GRID = MapGrid.covering((0, 0, SIDE, SIDE), 1.0, "EPSG:32632")
WIDE = Window(-40, -40, SIDE + 80, SIDE + 80)


def padded(values: np.ndarray) -> np.ndarray:
    return np.pad(values, 40, mode="edge")


def weights(owner: np.ndarray, width: int, seen: list[np.ndarray], window: Window = GRID.window) -> np.ndarray:
    feather = Feather(width)
    wide = feather.around(window)
    at = wide.slices(WIDE)
    share = Share(padded(owner)[at], clear={k: padded(each)[at] for k, each in enumerate(seen)})
    found = feather.weights(share, wide, window)
    none = np.zeros((1, window.height, window.width), np.float32)
    return np.stack([found[k][0] if k in found else none for k in range(len(seen))])[:, 0]


def everything() -> np.ndarray:
    return np.ones((SIDE, SIDE), bool)


def halves() -> np.ndarray:
    owner = np.ones((SIDE, SIDE), np.uint16)
    owner[:, 60:] = 2
    return owner


def test_images_pass_into_each_other_over_the_width() -> None:
    first, second = weights(halves(), 20, [everything()] * 2)
    line, other = first[60], second[60]
    some = line + other > 0
    np.testing.assert_allclose((line + other)[some], 1, atol=1e-6)
    assert some.sum() == 20 and some[50:70].all()
    assert (np.diff(line[some]) < 0).all() and line[59] == pytest.approx(other[60]) and line[59] > 0.5
    # It bends nowhere by more than the square of a slope of 2 / width would.
    assert np.abs(np.diff(line[some], 2)).max() < 2 / 10**2


def test_an_image_has_no_weight_where_it_does_not_see_and_little_beside() -> None:
    blocked = everything()
    blocked[40:80, 50:58] = False
    first, second = weights(halves(), 20, [everything(), blocked])
    assert not second[~blocked].any() and (first[40:80, 50:58].sum(), second[60, 58]) > (0, 0)
    share = second / np.maximum(first + second, 1e-9)
    # From the edge of what hides it the share grows step by step, as far as it would have without.
    assert share[60, 58] < 0.1 and share[60, 62] > share[60, 58]
    np.testing.assert_array_equal(share[10], (lambda a, b: b / np.maximum(a + b, 1e-9))(*weights(
        halves(), 20, [everything()] * 2))[10])  # fmt: skip


def test_an_owner_keeps_what_nobody_else_sees() -> None:
    alone = everything()
    alone[:, :59] = False
    rim = everything()
    rim[:, 57:] = False
    found = weights(halves(), 20, [rim, alone])
    # The first paints columns 57 to 59 in its rim: where the second sees, that takes over; where not, all stays.
    assert found[1, 60, 59] > 0.01 > found[0, 60, 59] > 0 and not found[:, 60, 57].any()


def test_weights_do_not_depend_on_the_window_and_three_add_up() -> None:
    random = np.random.default_rng(4)
    owner = random.integers(1, 4, (6, 6)).repeat(20, axis=0).repeat(20, axis=1).astype(np.uint16)
    owner[:7, :9] = 0
    seen = [random.random((SIDE, SIDE)) < 0.995 for _ in range(3)]
    whole = weights(owner, 24, seen)
    for window in (Window(0, 0, 64, 64), Window(64, 32, 56, 40), Window(33, 70, 5, 50)):
        at = window.slices(GRID.window)
        np.testing.assert_array_equal(weights(owner, 24, seen, window), whole[(slice(None), *at)])
    plain = weights(owner, 24, [everything()] * 3)
    inner = plain.sum(axis=0)[30:-30, 30:-30]
    np.testing.assert_allclose(inner[inner > 0], 1, atol=1e-6)
    assert not plain[:, owner == 0].any()


def test_bands_pass_in_strips_of_their_own() -> None:
    feather = Feather(32, bands=True)
    assert feather.reaches == (2, 4, 8, 16) and Feather(32).reaches == (16,)
    wide = feather.around(GRID.window)
    clear = {k: np.ones((wide.height, wide.width), bool) for k in range(2)}
    found = feather.weights(Share(padded(halves())[wide.slices(WIDE)], clear=clear), wide, GRID.window)
    (first, _), (second, seen) = found[0], found[1]
    both = (first[:, 60] > 0) & (second[:, 60] > 0)
    assert both.sum(axis=1).tolist() == [4, 8, 16, 32] and seen.shape == (wide.height, wide.width)
    np.testing.assert_allclose((first + second)[:, 60, 44:76], 1, atol=1e-6)


def test_widths_that_cannot_be() -> None:
    assert feather_of(0.0, 0.1, 512) is None and feather_of(0.1, 0.1, 512) is None
    made = feather_of(2.0, 0.1, 512)
    assert made is not None and made.width == 20 and made.reach == 10
    for metres in (-1.0, np.nan, np.inf, 1e9):
        with pytest.raises(UsageError, match="`feather`"):
            feather_of(metres, 0.1, 512)


def test_tiles_know_the_sources_around_them() -> None:
    every = Tiles.every(Window(0, 0, 500, 100), 100)
    shared = Tiles.shared([every.only([0]), every.only([0, 1, 2]), every.only([4])])
    assert [tile.sources for tile in shared.with_neighbours()] == [(0, 1), (0, 1), (1,), (2,)]
