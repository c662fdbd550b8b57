"""Tiles of a product, kept as numbers."""

from __future__ import annotations

import numpy as np
import pytest

from photoplan.geometry.grid import MapGrid, Window
from photoplan.plan.footprint import Tile, Tiles

GRID = MapGrid(400_000.3, 5_400_000.1, 0.07, 1000, 730, "EPSG:32633")


@pytest.mark.parametrize("window", [GRID.window, Window(5, 7, 256, 129), Window(0, 0, 1, 1)])
def test_they_are_those_of_the_window(window: Window) -> None:
    every = Tiles.every(window, 128, 3)
    assert list(every) == [Tile(i, w, (0, 1, 2)) for i, w in enumerate(window.tiles(128))]
    assert len(every) == every.total
    np.testing.assert_array_equal(every.windows, [(w.col, w.row, w.width, w.height) for w in window.tiles(128)])


def test_some_are_a_part_of_all() -> None:
    every = Tiles.every(GRID.window, 128)
    some = every.only([2, 3, 47])
    assert list(some) == [every[2], every[3], every[47]] == [*some[:2], some[-1]]
    assert (some.total, len(some), len(every.only(()))) == (48, 3, 0)
    with pytest.raises(IndexError):
        some[3]
    np.testing.assert_array_equal(some.bounds(GRID), [GRID.bounds_of(tile.window) for tile in some])


def test_a_large_product_takes_a_few_bytes_for_each() -> None:
    """500 images have a million tiles; as objects they took 230 bytes each."""
    assert Tiles.every(Window(0, 0, 1_000_000, 1_000_000), 1000).indices.nbytes <= 8 * 1_000_000


def test_tiles_know_which_sources_can_paint_them() -> None:
    every = Tiles.every(Window(0, 0, 300, 200), 100)
    shared = Tiles.shared([every.only([0, 1, 4]), every.only([]), every.only([1, 5])])
    assert [(tile.index, tile.sources) for tile in shared] == [(0, (0,)), (1, (0, 2)), (4, (0,)), (5, (2,))]
    assert [(tile.index, tile.sources) for tile in shared[1:3]] == [(1, (0, 2)), (4, (0,))]
    assert [tile.sources for tile in shared.only([5, 1, 3])] == [(0, 2), (2,)]
    assert shared[-1].sources == (2,) and list(shared.only(())) == []
    assert list(Tiles.shared([every.only([])])) == []


def test_tiles_that_touch_a_window() -> None:
    every = Tiles.every(Window(0, 0, 350, 250), 100)
    for window in (Window(99, 100, 2, 1), Window(-50, -50, 60, 60), Window(340, 240, 900, 900), Window(400, 0, 5, 5)):
        want = [tile.index for tile in every if (tile.window & window).size]
        assert [tile.index for tile in every.touching(window)] == want
