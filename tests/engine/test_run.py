"""The one loop: nothing is made twice, figures add up, products are completed while others are computed."""

from __future__ import annotations

import pickle
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError
from typing import Any

import numpy as np
import pytest
from tools.events import Told

from photoplan.engine import executors
from photoplan.engine.executors import Workers, executor_factory
from photoplan.engine.run import Kept, Made, Runner, Shared, Tally, Work, tiles_in_flight
from photoplan.errors import InputError, UsageError
from photoplan.events import stretch, tell
from photoplan.geometry.grid import Window
from photoplan.plan.footprint import Tile

TILES = tuple(Tile(i, Window(i * 4, 0, 4, 4)) for i in range(6))


class Memory:
    """A sink that keeps its tiles in memory, and whether it is open."""

    def __init__(self, tiles: dict[int, tuple[Any, Any]] | None = None) -> None:
        self.tiles = dict(tiles or {})
        self.open = False

    def __enter__(self) -> Memory:
        self.open = True
        return self

    def __exit__(self, *error: object) -> None:
        self.open = False

    @property
    def finished(self) -> frozenset[int]:
        return frozenset(self.tiles)

    def append(self, index: int, pixels: Any, valid: Any, record: Any) -> None:
        assert self.open
        self.tiles[index] = pixels, record

    def append_empty(self, index: int, record: Any = None) -> None:
        assert self.open
        self.tiles[index] = None, record

    def record(self, index: int) -> dict[str, Any]:
        return self.tiles[index][1] or {}


def made(tile: Tile, layers: int = 1) -> Made:
    pixels = np.full((1, 4, 4), tile.index)
    return Made(((pixels, None),) * layers, {"worst_residual": tile.index / 10, "cells": 2, "clipped": [1, tile.index]})


def work(
    name: str,
    sinks: Sequence[Memory],
    job: Callable[[Tile], Made] = made,
    complete: Callable[[Tally], Any] = lambda tally: tally,
) -> Work[Any]:
    return Work(name=name, job=job, tiles=TILES[:5], count=6, sinks=sinks, complete=complete)


def run(*works: Work[Any] | Kept[Any], workers: int = 1, excuse: Any = None) -> tuple[list[Any], Told]:
    told = Told()
    told.begin("tiles")
    with Workers(executor_factory("threads", workers)) as pool:
        return Runner(pool, 4, told, excuse).run(works), told


@pytest.mark.parametrize("workers", [1, 3])
def test_tiles_go_to_every_sink_and_figures_add_up(workers: int) -> None:
    sinks = [Memory(), Memory()]
    (tally,), told = run(work("a", sinks, lambda tile: made(tile, 2)), workers=workers)
    for sink in sinks:
        assert sorted(sink.tiles) == list(range(6))
        assert sink.tiles[5] == (None, None)
        assert [sink.tiles[i][0][0, 0, 0] for i in range(5)] == list(range(5))
        assert not sink.open
    assert tally.totals == {"worst_residual": 0.4, "cells": 10, "clipped": [5, 10]}
    assert (told.units["tiles"], told.pixels, told.results) == (5, 80, [tally])


def test_a_finished_tile_is_not_made_again_and_its_figures_count() -> None:
    """A tile that one of two sinks lacks is made again, for both."""
    half, whole = Memory(), Memory()
    run(work("a", [half, whole], lambda tile: made(tile, 2)))
    before = dict(whole.tiles)
    del half.tiles[3]
    again: list[int] = []

    def job(tile: Tile) -> Made:
        again.append(tile.index)
        return made(tile, 2)

    (tally,), told = run(work("a", [half, whole], job))
    assert again == [3]
    assert tally.resumed == 4
    assert tally.totals == {"worst_residual": 0.4, "cells": 10, "clipped": [5, 10]}
    assert told.talked == ["a: 4 of 5 tiles are finished already"]
    assert whole.tiles.keys() == before.keys()


def test_one_product_is_completed_while_the_next_is_computed() -> None:
    """The first one's end waits for the second one's first tile: one after the other, neither would come."""
    begun = threading.Event()

    def job(tile: Tile) -> Made:
        begun.set()
        return made(tile)

    def complete(tally: Tally) -> str:
        assert begun.wait(60)
        return "first"

    results, told = run(
        work("a", [Memory()], complete=complete), work("b", [Memory()], job, lambda tally: "second"), Kept("third", 7)
    )
    assert results == told.results == ["first", "second", "third"]
    assert told.units["tiles"] == 17


def test_sinks_are_open_while_completed_and_closed_after_an_error() -> None:
    sinks = [Memory(), Memory()]
    results, _ = run(work("a", sinks[:1], complete=lambda tally: sinks[0].open))
    assert results == [True]

    def job(tile: Tile) -> Made:
        raise InputError("damaged")

    with pytest.raises(InputError):
        run(work("a", sinks[1:], job))
    assert not sinks[0].open and not sinks[1].open


@pytest.mark.parametrize("where", ["tile", "end"])
def test_an_excused_error_costs_its_own_product_only(where: str) -> None:
    def fail(*arguments: Any) -> Any:
        raise InputError("damaged")

    bad = work("bad", [Memory()], fail) if where == "tile" else work("bad", [Memory()], complete=fail)
    works = [work("a", [Memory()], complete=lambda t: "a"), bad, work("c", [Memory()], complete=lambda t: "c")]
    results, told = run(*works, excuse=lambda of, error: f"{of.name}: {error}")
    assert results == told.results == ["a", "bad: damaged", "c"]
    assert told.units["tiles"] == 15  # tiles that will not be computed count too: the counter ends at its total


def test_what_was_complete_is_told_before_an_error_ends_the_run() -> None:
    def fail(tile: Tile) -> Made:
        raise InputError("damaged")

    told = Told()
    told.begin("tiles")
    with Workers(executor_factory("threads", 1)) as pool, pytest.raises(InputError):
        Runner(pool, 1, told).run([work("a", [Memory()], complete=lambda t: "a"), work("b", [Memory()], fail)])
    assert told.results == ["a"]


def test_failed_tiles_are_told_to_whoever_completes() -> None:
    def job(tile: Tile) -> Made:
        if tile.index == 2:
            raise RuntimeError("no luck")
        return made(tile)

    sink = Memory()
    (tally,), _ = run(work("a", [sink], job))
    assert (tally.failed, tally.reasons) == ([2], ["tile 2: RuntimeError: no luck"])
    assert 2 not in sink.tiles


def test_memory_bounds_tiles_in_flight() -> None:
    assert tiles_in_flight(8, None, 100, 10) == 8
    assert tiles_in_flight(8, 150, 100, 10) == 5
    assert tiles_in_flight(8, 10**6, 100, 10) == 8
    with pytest.raises(UsageError, match="`memory` 1 MiB; at least 3 MiB"):
        tiles_in_flight(8, 1 << 20, 1 << 20, 2 << 20)


@pytest.mark.parametrize("workers", [1, 2])
def test_a_tile_tells_how_far_it_is_while_others_wait(monkeypatch: pytest.MonkeyPatch, workers: int) -> None:
    """In the thread that began the work, also where there is one worker."""
    monkeypatch.setattr(executors, "PULSE", 0.01)
    heard = threading.Event()

    class Hearing(Told):
        def done(self, units: int = 1, pixels: int = 0, begun: float = 0.0, what: str = "") -> None:
            assert threading.current_thread() is threading.main_thread()
            super().done(units, pixels, begun, what)
            if begun == 0.375:
                heard.set()

    def slow(tile: Tile) -> Made:
        if tile.index == 1:
            with stretch(0.25, 0.5, "level 2 of 3"):
                tell(0.5, "half")
                assert heard.wait(60)
        return made(tile)

    told = Hearing()
    told.begin("tiles")
    with Workers(executor_factory("threads", workers)) as pool:
        Runner(pool, workers, told).run([work("a", [Memory()], slow)])
    assert told.units["tiles"] == 5 and (0.375, "level 2 of 3, half") in told.begun
    # What is done counts as a whole, and no longer as a part.
    assert max(begun for begun, _ in told.begun) <= 0.5


def test_what_nobody_waits_for_ends_where_it_tells_how_far_it_is() -> None:
    ended, told = threading.Event(), threading.Event()

    def long(tile: Tile) -> Made:
        if tile.index == 1:
            assert told.wait(60)
            raise InputError("this ends the run")
        try:
            while True:
                tell(0.5)
                told.set()
        except CancelledError:
            ended.set()
            raise

    with pytest.raises(InputError, match="this ends the run"):
        run(work("a", [Memory()], long), workers=2)
    assert ended.wait(60)


def test_shares_of_a_tile() -> None:
    """Parts of parts; without anybody who listens nothing is told, and another process gets the job itself."""
    found = []

    def job(tile: Tile) -> Made:
        for k in range(2):
            with stretch(k / 2, (k + 1) / 2, f"part {k + 1}"):
                for share in (0.0, 0.5):
                    tell(share, "level")
                    found.append(shared.under_way())
        return made(tile)

    shared = Shared(job)
    assert job(TILES[0]) and found == [(0.0, "")] * 4
    found.clear()
    shared(TILES[0])
    assert found == [(0.0, "part 1, level"), (0.25, "part 1, level"), (0.5, "part 2, level"), (0.75, "part 2, level")]
    shared.ended(TILES[0])
    assert shared.under_way() == (0.0, "")
    assert pickle.loads(pickle.dumps(Shared(made))) is made
