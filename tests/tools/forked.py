"""Commands in processes that begin with everything loaded: they can be killed, starved and counted, and cost no start.

A server without threads loads the package once and forks a process for each command.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import re
import signal
import sqlite3
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from multiprocessing import forkserver
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Any

import pytest

from tools.command import Said
from tools.events import Told


@dataclass(frozen=True)
class Ran(Said):
    """What a command left behind, and what it did."""

    tasks: list[str]
    """Tasks that were computed to their end."""
    phases: list[tuple[str, int, int]]
    """Name, units that were promised, units that were done."""


@dataclass(frozen=True)
class Mishap:
    """What is to happen to a command."""

    end_at: int = -1
    """It gets a signal when so many tasks have been computed and the next one begins."""
    sign: signal.Signals = signal.SIGKILL
    fail_at: int = -1
    """This task fails when it is tried first."""
    most_bytes: int = 0
    """No file can become larger: it stands for the end of the disk."""
    names: int = -1
    """It is killed when so many files have got their names."""
    shuffled: bool = False
    """Tasks are handed to the workers in another order."""


QUIET = Mishap()

_LOADED = "tools.loaded"


def forked(words: Sequence[object], folder: Path, mishap: Mishap = QUIET) -> Ran:
    """Run a command to its end; `folder` gets what it says."""
    folder.mkdir(parents=True, exist_ok=True)
    child = _server().Process(target=_run, args=([str(word) for word in words], folder, mishap))
    child.start()
    child.join()
    code = child.exitcode
    assert code is not None
    told = [json.loads(line) for line in (folder / "told").read_text().splitlines()]
    tasks = [each["task"] for each in told if "task" in each]
    phases = next((each["phases"] for each in told if "phases" in each), [])
    out, err = ((folder / name).read_text() for name in ("out", "err"))
    return Ran(code, out, err, tasks, [tuple(phase) for phase in phases])


def scripted(script: str, folder: Path, *words: object) -> tuple[int, str]:
    """Exit code and stdout of a script that finds `words` in `sys.argv`; `folder` gets what it says."""
    folder.mkdir(parents=True, exist_ok=True)
    child = _server().Process(target=_script, args=(script, [str(word) for word in words], folder / "out"))
    child.start()
    child.join()
    assert child.exitcode is not None
    return child.exitcode, (folder / "out").read_text()


def _script(script: str, words: list[str], out: Path) -> None:
    assert _LOADED in sys.modules  # or each script would cost a start
    os.dup2(os.open(out, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 1)
    sys.argv = ["-c", *words]
    exec(script, {"__name__": "__main__"})


@cache
def _server() -> ForkServerContext:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([_LOADED])
    with pytest.MonkeyPatch.context() as patch:
        # Python 3.11 does not tell its server where modules are: it would load none, and not say so.
        patch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))
        forkserver.ensure_running()
    return context


def content(path: Path) -> bytes:
    """Bytes of a file; of a GeoPackage all but the times at which its tables were written."""
    if path.suffix != ".gpkg":
        return path.read_bytes()
    db = sqlite3.connect(path)
    try:
        return re.sub(r"\d{4}-\d\d-\d\dT[\d:.]+Z", "", "\n".join(db.iterdump())).encode()
    finally:
        db.close()


class _Telling(Told):
    """Events of a command, kept; what is talked of goes to stderr."""

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__()
        self.begin("")

    def __enter__(self) -> _Telling:
        return self

    def __exit__(self, *error: object) -> None:
        return None

    def talk(self, text: str) -> None:
        print(text, file=sys.stderr)


def _run(words: list[str], folder: Path, mishap: Mishap) -> None:
    import resource

    assert _LOADED in sys.modules  # or each command would cost a start
    from photoplan.cli import telling
    from photoplan.cli.main import run
    from photoplan.engine import run as engine_run

    # A shell that runs the tests in the background ignores it, and so would all of its children.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    told = os.open(folder / "told", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream, name in ((1, "out"), (2, "err")):
        os.dup2(os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), stream)
    done, failed = 0, False
    compute, run_tiles = engine_run.Runner._compute, engine_run.run_tiles

    def computing(self: Any, work: Any) -> Any:
        # A class of the saboteur would have to be found by worker processes: they are counted by what they deliver.
        return compute(self, replace(work, job=watched(work)) if "--executor" not in words else work)

    def watched(work: Any) -> Any:
        def job(task: Any) -> Any:
            nonlocal done, failed
            if done == mishap.end_at:
                os.kill(os.getpid(), mishap.sign)
                for _ in range(6000):  # another thread may get the signal: it ends a sleep of this one only afterwards
                    time.sleep(0.01)
                raise RuntimeError("the signal did not come")
            if done == mishap.fail_at and not failed:
                failed = True
                raise RuntimeError("the drive is gone for a moment")
            made = work.job(task)
            done += 1
            os.write(told, (json.dumps({"task": f"{work.name} {task.index}"}) + "\n").encode())
            return made

        return job

    def shuffled(tasks: Any, *rest: Any) -> Iterator[Any]:
        tasks = list(tasks)
        random.Random(1).shuffle(tasks)
        return run_tiles(tasks, *rest)

    named = 0
    replace_file = Path.replace

    def naming(self: Path, target: Path) -> Path:
        nonlocal named
        there = replace_file(self, target)
        if not Path(target).name.startswith("."):
            named += 1
            if named == mishap.names:
                os.kill(os.getpid(), signal.SIGKILL)
        return there

    if mishap.names > 0:
        Path.replace = naming  # type: ignore[method-assign, assignment]
    kept: list[_Telling] = []
    engine_run.Runner._compute = computing  # type: ignore[method-assign]
    if mishap.shuffled:
        engine_run.run_tiles = shuffled
    telling.Telling = lambda *a, **k: kept.append(_Telling()) or kept[-1]  # type: ignore[assignment, misc]
    if mishap.most_bytes:
        resource.setrlimit(resource.RLIMIT_FSIZE, (mishap.most_bytes, mishap.most_bytes))
    code = run(words)
    phases = [(name, units + each.added[name], each.units[name]) for each in kept for name, units, _ in each.phases]
    os.write(told, (json.dumps({"phases": phases}) + "\n").encode())
    os._exit(code)
