"""Signs of life: seldom without a terminal, often on one, never in the way of results."""

from __future__ import annotations

import threading

import pytest
from tools.command import counters, unended

from photoplan.cli.telling import OFTEN, SELDOM, Telling
from photoplan.events import Compilations


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_without_a_terminal_a_line_now_and_then(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    with Telling(False, terminal=False, clock=clock) as events:
        events.begin("tiles", 100)
        for _ in range(50):
            clock.now += SELDOM / 20
            events.done(1, 1_000_000)
        events.begin("completing")
        clock.now += 2 * SELDOM
        events.done(0)
    assert capsys.readouterr().err.splitlines() == [
        "tiles: 20/100 tiles 0.667 Mpx/s 0:02:00 left",
        "tiles: 40/100 tiles 0.667 Mpx/s 0:01:30 left",
        "completing: for 0:01:00",
    ]


def test_slow_rates_are_told_in_pixels() -> None:
    """Heights of a surface: 65,536 in a minute."""
    clock = Clock()
    with Telling(False, terminal=False, clock=clock) as events:
        events.begin("tiles", 4)
        clock.now += 0.5 * SELDOM
        events.done(1, 65_536)
        assert events.line(clock.now + 45.0) == "tiles: 1/4 tiles 1092 px/s 0:03:00 left"


def test_parts_of_tiles_under_way_count_and_are_told() -> None:
    clock = Clock()
    with Telling(False, terminal=False, clock=clock) as events:
        events.begin("tiles", 2)
        clock.now += 60
        events.done(0, 0, 0.5, "level 3 of 5")
        assert events.line(clock.now) == "tiles: 0/2 tiles (25%, level 3 of 5) 0:03:00 left"
        events.done(1, 0, 0.2)
        assert events.line(clock.now) == "tiles: 1/2 tiles (60%) 0:00:40 left"
        events.done()
        assert events.line(clock.now) == "tiles: 2/2 tiles for 0:01:00"


def test_a_counter_never_passes_its_total_and_ends_at_it() -> None:
    """Parts that were not known at the beginning add to the total; a total that was too small follows the counter."""
    clock = Clock()
    with Telling(False, terminal=False, clock=clock) as events:
        events.begin("volumes", 0, "windows")
        for known in (4, 16):
            events.more(known)
            events.done(known)
        clock.now += 60
        assert events.line(clock.now) == "volumes: 20/20 windows for 0:01:00"
        events.begin("tiles", 2)
        events.done(3)
        assert events.line(clock.now).startswith("tiles: 3/3 tiles")


def test_what_an_earlier_run_has_done_tells_nothing_of_the_pace() -> None:
    clock = Clock()
    with Telling(False, terminal=False, clock=clock) as events:
        events.begin("tiles", 100)
        events.kept(50)
        clock.now += 30
        assert events.line(clock.now) == "tiles: 50/100 tiles for 0:00:30"
        events.done()
        assert events.line(clock.now) == "tiles: 51/100 tiles 0:24:30 left"


def test_on_a_terminal_a_line_that_moves_and_gives_way(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    with Telling(False, print, terminal=True, clock=clock) as events:
        events.begin("tiles", 4)
        events.done()
        clock.now += 2 * OFTEN
        events.done()
        events.result("product.tif")
        clock.now += 2 * OFTEN
        events.done()
    said = capsys.readouterr()
    assert said.out == "product.tif\n"
    assert said.err.count("\r\x1b[K") == 2 and said.err.endswith("\r\x1b[K")
    assert "▇▇▇▇▇▇▇▇▇▇▇▇············ 2/4 tiles 0:00:00 left" in said.err
    assert "\n" not in said.err
    assert events.results == ["product.tif"]


@pytest.mark.parametrize("terminal", [False, True])
def test_compilation_is_a_phase_of_its_own_and_no_part_of_rates_and_times_left(
    capsys: pytest.CaptureFixture[str], terminal: bool
) -> None:
    """Two kernels for 40 s, the second with a part inside of it, then ten tiles in 10 s of a hundred."""
    clock = Clock()
    compilations = Compilations(clock)
    with Telling(False, terminal=terminal, clock=clock, compilations=compilations) as events:
        events.begin("tiles", 100)
        compilations.change(True)
        clock.now += 10
        assert events.line(clock.now) == "compiling kernels: 1 so far, for 0:00:10"
        compilations.change(False)
        compilations.change(True)
        clock.now += 10
        compilations.change(True)
        clock.now += 20
        assert events.line(clock.now) == "compiling kernels: 2 so far, for 0:00:40"
        compilations.change(False)
        compilations.change(False)
        clock.now += 10
        events.done(10, 10_000_000)
        assert events.line(clock.now).endswith("10/100 tiles 1 Mpx/s 0:01:30 left")
        events.begin("completing")
        clock.now += 5
        assert events.line(clock.now) == "completing: for 0:00:05"
    assert "compiling kernels: 2 so far, for 0:00:10" in capsys.readouterr().err


def test_another_thread_s_compilation_is_shown_by_the_thread_that_waits(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    compilations = Compilations(clock)

    def change(begins: bool) -> None:
        thread = threading.Thread(target=compilations.change, args=(begins,))
        thread.start()
        thread.join()

    with Telling(False, terminal=False, clock=clock, compilations=compilations) as events:
        events.begin("tiles", 4)
        change(True)
        clock.now += 5
        change(True)
        assert capsys.readouterr().err == ""
        events.done(0)
        assert capsys.readouterr().err == "compiling kernels: 1 so far, for 0:00:05\n"
        clock.now += 5
        events.done(0)
        assert capsys.readouterr().err == ""  # the next line without a terminal is due after 30 s
        change(False)
        change(False)
        clock.now += SELDOM
        events.done(1)
    assert capsys.readouterr().err == "tiles: 1/4 tiles 0:01:30 left\n"
    change(True)  # after the command nobody listens
    assert compilations.watchers == [] and capsys.readouterr().err == ""


@pytest.mark.parametrize("terminal", [False, True])
def test_quiet_tells_results_alone(capsys: pytest.CaptureFixture[str], terminal: bool) -> None:
    clock = Clock()
    compilations = Compilations(clock)
    with Telling(True, print, terminal=terminal, clock=clock, compilations=compilations) as events:
        events.begin("tiles", 4)
        clock.now += 10 * SELDOM
        events.done()
        compilations.change(True)
        clock.now += 10 * SELDOM
        compilations.change(False)
        events.talk("hello")
        events.result(7)
    assert capsys.readouterr() == ("7\n", "")


def test_counters_that_do_not_end_at_their_total_are_found() -> None:
    """Every command that a test runs inside of its process, and that ends well, is judged by this."""
    with counters() as phases, Telling(True, terminal=False) as events:
        events.begin("resumed", 3)
        events.done()
        events.kept(2)
        events.begin("short", 2)
        events.done()
        events.begin("of unknown length")
        events.done(5)
        events.begin("growing", 0)
        events.more(4)
        events.done(4)
        events.begin("beyond", 2)
        events.done(3)
    assert unended(phases) == [("short", 2, 1), ("beyond", 2, 3)]
