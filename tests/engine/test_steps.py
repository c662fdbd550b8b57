"""Steps: a `map` whose results are in order, are kept, and are not computed twice."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from tools.events import Told

from photoplan.engine.run import steps
from photoplan.errors import TilesFailed
from photoplan.io.store import ResultLog


def log(folder: Path) -> ResultLog:
    return ResultLog(folder / "kept", "k", folder / "lock")


def counting(computed: list[int]) -> Callable[[int], int]:
    def square(item: int) -> int:
        computed.append(item)
        return item * item

    return square


@pytest.mark.parametrize("workers", [1, 3])
@pytest.mark.parametrize("kept", [False, True])
def test_results_are_in_order(tmp_path: Path, workers: int, kept: bool) -> None:
    told, computed = Told(), list[int]()
    told.begin("squares", 20)
    with log(tmp_path) as store, steps("a", workers, told, store if kept else None) as run:
        assert list(run(counting(computed), range(20), pixels=lambda item: 2)) == [k * k for k in range(20)]
        assert list(run(str, [1, 2])) == ["1", "2"]
        assert list(run(str, [])) == []
    assert sorted(computed) == list(range(20))
    assert (told.units["squares"], told.pixels) == (22, 40)


def test_a_later_run_computes_what_is_missing(tmp_path: Path) -> None:
    """Calls are told apart by their number, or by what their results depend on."""
    first, again = list[int](), list[int]()

    def fails(item: int) -> int:
        if item == 3:
            raise KeyboardInterrupt
        return counting(first)(item)

    with log(tmp_path) as store, steps("a", 1, store=store) as run:
        list(run(counting(first), [7]))
        with pytest.raises(KeyboardInterrupt):
            run(fails, range(5))
    told = Told()
    told.begin("squares", 6)
    with log(tmp_path) as store, steps("a", 1, told, store) as run:
        assert list(run(counting(again), [7])) == [49]
        assert list(run(counting(again), range(5))) == [0, 1, 4, 9, 16]
    assert (first, again) == ([7, 0, 1, 2], [3, 4])
    assert told.talked == ["a: 4 results of an earlier run are kept"] and told.units["squares"] == 6
    with log(tmp_path) as store, steps("a", 1, store=store) as run:
        assert list(run.under("other tracks")(counting(again), [8])) == [64]
        assert list(run(counting(again), [1, 2], ["one", "two"])) == [1, 4]
        assert list(run(counting(again), [2, 5], ["two", "five"])) == [4, 25]
    assert again == [3, 4, 8, 1, 2, 5]


def test_an_item_that_fails_again_and_again_is_told(tmp_path: Path) -> None:
    computed: list[int] = []

    def fails(item: int) -> int:
        if item == 3:
            raise ValueError("no luck")
        return counting(computed)(item)

    with log(tmp_path) as store, steps("a.gpkg", 2, store=store) as run, pytest.raises(TilesFailed) as error:
        run(fails, range(5))
    assert str(error.value) == "a.gpkg: 1 parts could not be computed (ValueError: no luck); nothing is written"
    assert sorted(computed) == [0, 1, 2, 4]
