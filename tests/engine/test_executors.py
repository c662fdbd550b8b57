"""Tiles on workers: each exactly once, bounded, tried again, and blamed only for their own deaths."""

from __future__ import annotations

import os
import re
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from photoplan.engine import executors
from photoplan.engine.executors import RETRIES, Outcome, Workers, executor_factory, run_tiles
from photoplan.errors import InputError, UsageError


def square(task: int) -> int:
    return task * task


def outcomes(tasks: Any, work: Callable[[Any], Any], make: Callable[[], Executor], in_flight: int = 4) -> list[Outcome]:
    with Workers(make) as workers:
        return list(run_tiles(tasks, work, workers, in_flight))


@given(count=st.integers(0, 40), workers=st.integers(1, 4), in_flight=st.integers(1, 9))
def test_every_task_once(count: int, workers: int, in_flight: int) -> None:
    done = outcomes(range(count), square, executor_factory("threads", workers), in_flight)
    assert sorted(o.task for o in done) == list(range(count))
    assert all(o.result == o.task**2 and o.error is None for o in done)


@pytest.mark.parametrize("in_flight", [1, 2, 5])
def test_no_more_in_flight_than_allowed(in_flight: int) -> None:
    """Neither running nor finished and not yet taken: memory is bounded by both."""
    begun = 0

    def work(task: int) -> int:
        nonlocal begun
        begun += 1
        return task

    taken = 0
    with Workers(executor_factory("threads", 4)) as workers:
        for _ in run_tiles(range(30), work, workers, in_flight):
            time.sleep(0.002)
            assert begun - taken <= in_flight
            taken += 1
    assert taken == 30


@pytest.mark.parametrize("in_flight", [1, 3, 8])
def test_tasks_are_taken_as_they_are_needed(in_flight: int) -> None:
    """A product of a million tiles holds some of them at a time; the order in which they begin stays."""
    asked, begun = 0, []

    def tasks() -> Iterator[int]:
        nonlocal asked
        for k in range(500):
            asked += 1
            yield k

    def work(task: int) -> int:
        begun.append(task)
        return task

    with Workers(executor_factory("threads", 1)) as workers:
        for done, _ in enumerate(run_tiles(tasks(), work, workers, in_flight)):
            assert asked - done <= 2 * in_flight + 1
    assert begun == list(range(500))


def test_the_executor_stays_for_the_next_call() -> None:
    made: list[Executor] = []

    def make() -> Executor:
        made.append(ThreadPoolExecutor(1))
        return made[-1]

    with Workers(make) as workers:
        assert made == []
        list(run_tiles(range(3), square, workers, 1))
        list(run_tiles(range(3), square, workers, 1))
    assert len(made) == 1


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_is_tried_again_and_then_told(workers: int) -> None:
    """An unforeseen error may pass (a network drive); one that stays costs its own tile only."""
    calls: Counter[int] = Counter()

    def work(task: int) -> int:
        calls[task] += 1
        if task == 3 or (task == 5 and calls[task] <= RETRIES):
            raise RuntimeError("the drive is gone")
        return task

    done = {o.task: o for o in outcomes(range(8), work, executor_factory("threads", workers))}
    assert calls == {**dict.fromkeys(range(8), 1), 3: RETRIES + 1, 5: RETRIES + 1}
    assert done[3] == Outcome(3, None, "RuntimeError: the drive is gone")
    assert [t for t, o in done.items() if o.error is not None] == [3]
    assert done[5].result == 5


@pytest.mark.parametrize("error", [InputError("bad"), MemoryError()])
def test_errors_that_concern_all_tiles_stop_the_run(error: Exception) -> None:
    begun = []
    blocked = threading.Event()

    def work(task: int) -> int:
        begun.append(task)
        if task == 2:
            raise error
        blocked.wait(0.05)
        return task

    with pytest.raises(type(error)):
        outcomes(range(100), work, executor_factory("threads", 2))
    assert len(begun) < 12


def test_what_is_pending_is_cancelled_when_the_caller_leaves() -> None:
    begun = []

    def work(task: int) -> int:
        begun.append(task)
        time.sleep(0.01)
        return task

    with Workers(executor_factory("threads", 1 + 1)) as workers:
        running = run_tiles(range(100), work, workers, 10)
        next(running)
        running.close()  # type: ignore[attr-defined]
        at = len(begun)
        time.sleep(0.1)
        assert len(begun) <= at + 2


class Mortal(Executor):
    """Runs tasks in this thread; a task in `deadly` kills the executor and all that was submitted beside it."""

    def __init__(self, deadly: Callable[[Any], bool], together: int) -> None:
        self.deadly, self.together = deadly, together
        self.waiting: list[tuple[Future[Any], Callable[[Any], Any], Any]] = []
        self.dead = False

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        if self.dead:
            raise BrokenProcessPool("dead already")
        future: Future[Any] = Future()
        self.waiting.append((future, fn, args[0]))
        threading.Timer(0.001, self._step).start()
        return future

    def _step(self) -> None:
        waiting, self.waiting = self.waiting, []
        if any(self.deadly(task) for _, _, task in waiting):
            self.dead = True
        for future, fn, task in waiting:
            if self.dead:
                future.set_exception(BrokenProcessPool("died"))
            else:
                future.set_result(fn(task))


def test_fault_05_only_the_deadly_tile_is_blamed() -> None:
    """Its neighbours die with it several times, and are all computed in the end."""
    deaths: Counter[int] = Counter()

    def deadly(task: int) -> bool:
        deaths[task] += task == 6
        return task == 6

    done = outcomes(range(12), square, lambda: Mortal(deadly, 4))
    assert sorted(o.task for o in done) == list(range(12))
    assert [o for o in done if o.error is not None] == [Outcome(6, None, "its worker died, also when it ran alone")]
    assert {o.task: o.result for o in done if o.error is None} == {t: t * t for t in range(12) if t != 6}
    assert RETRIES + 1 <= deaths[6] <= RETRIES + 2


def test_fault_05_a_death_that_passes_costs_nothing() -> None:
    once = iter([True])
    done = outcomes(range(12), square, lambda: Mortal(lambda task: task == 6 and next(once, False), 4))
    assert sorted(o.task for o in done) == list(range(12))
    assert all(o.error is None for o in done)


def die_once(task: tuple[int, str]) -> int:
    number, victim = task
    if number == 3:
        try:
            Path(victim).unlink()
        except FileNotFoundError:
            pass
        else:
            os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()


@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
def test_fault_05_a_real_worker_process_dies(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.touch()
    done = outcomes([(i, str(victim)) for i in range(8)], die_once, executor_factory("processes", 2))
    assert sorted(o.task[0] for o in done) == list(range(8))
    assert all(o.error is None and o.result != os.getpid() for o in done)
    assert not victim.exists()


@pytest.mark.parametrize(
    ("kind", "workers", "message"),
    [
        ("threads", 0, "^0 workers; 1 to 4096 are accepted"),
        ("processes", 10**30, "0 workers; 1 to 4096 are accepted"),
        ("fibres", 2, "executor 'fibres'; allowed are threads, processes or a Dask scheduler's address"),
    ],
)
def test_unknown_executors_are_refused(kind: str, workers: int, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        executor_factory(kind, workers)


def test_no_other_pool_in_the_package() -> None:
    """Whoever wants workers gets them from the engine: one place for their number, their deaths and interrupts."""
    source = Path(executors.__file__).parents[1]
    pools = re.compile(r"ThreadPool|ProcessPool|multiprocessing\.(?!active_children)|from multiprocessing|Thread\(")
    found = {
        str(path.relative_to(source))
        for path in source.rglob("*.py")
        if path.parent.name != "engine" and pools.search(path.read_text(encoding="utf-8"))
    }
    # Threads that end the process, or wait for processes that compile, do no work; `jit` asks for its parent process.
    assert found == {"cli/interrupt.py", "kernels/jit.py", "kernels/precompile.py"}


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Two Dask workers inside this process, reached by their scheduler's address."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None, protocol="tcp"
    ) as cluster:
        yield cluster


class TestDask:
    def test_fault_26_a_cluster_is_an_executor_like_others(self, cluster: Any) -> None:
        done = outcomes(range(20), square, executor_factory(cluster.scheduler_address, 2))
        assert {o.task: o.result for o in done} == {t: t * t for t in range(20)}

    def test_leaving_a_cluster_leaves_it_running(self, cluster: Any) -> None:
        make = executor_factory(cluster.scheduler_address, 2)
        for _ in range(2):
            outcomes(range(3), square, make)
        from distributed import Client

        with Client(cluster.scheduler_address, set_as_default=False) as client:
            assert len(client.scheduler_info()["workers"]) == 2
            # This one alone: those that left are gone.
            assert (
                len(client.run_on_scheduler(lambda dask_scheduler: dask_scheduler.clients.keys() - {"fire-and-forget"}))
                == 1
            )

    def test_an_error_on_the_cluster_stops_the_run_too(self, cluster: Any) -> None:
        def work(task: int) -> int:
            raise InputError(f"tile {task}: damaged")

        with pytest.raises(InputError, match="damaged"):
            outcomes(range(5), work, executor_factory(cluster.scheduler_address, 2))

    def test_fault_28_no_scheduler_at_the_address(self) -> None:
        pytest.importorskip("distributed")
        with pytest.raises(UsageError, match="executor nonsense://nowhere: no usable Dask scheduler"):
            outcomes(range(5), square, executor_factory("nonsense://nowhere", 2))
