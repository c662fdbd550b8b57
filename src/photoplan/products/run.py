"""Options of the execution of plans (workers, memory, overwriting), and protection of input files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from photoplan.engine.execute import MOST_SOURCE_BYTES
from photoplan.engine.executors import Question, Workers, executor_factory, open_workers
from photoplan.engine.run import Runner, tiles_in_flight
from photoplan.errors import UsageError
from photoplan.events import SILENT, Events
from photoplan.io.project.file import load_project
from photoplan.io.project.model import Project
from photoplan.io.store import run_times, versions
from photoplan.project.target import with_target

#: Memory of the interpreter with all libraries, GDAL's cache and the assembly of a product, bytes.
BASE_MEMORY = 320 * 2**20
#: And of a tile: its source window as read and as packed for the kernel, relief and result.
_EACH = 3 * MOST_SOURCE_BYTES
#: Of each pixel of a tile that is computed strictly: it has a box of its own. Below this tolerance that may happen.
_STRICT_PIXEL, _NEARLY_STRICT = 512, 1e-3


def load_on_target(request: Any) -> Project:
    """Load the project of a request whose products may lie on a target, and place them there."""
    project = load_project(request.project)
    return with_target(project, request.target, request.bounds, request.relief, request.relief_sigma)


def tile_bytes(tolerance: float, side: int) -> int:
    """Memory that a tile of some pixels along its side takes."""
    return _EACH + (_STRICT_PIXEL * side**2 if tolerance < _NEARLY_STRICT else 0)


@dataclass(frozen=True)
class Run:
    """Options of the execution of a plan; none of them changes a pixel."""

    workers: int = 1
    """Threads or processes."""
    executor: str = "threads"
    """``threads``, ``processes`` or a Dask scheduler's address."""
    memory: int | None = None
    """Bytes the run should stay under; None: no bound but the tiles in flight."""
    overwrite: bool = False
    """True if finished products may be replaced."""
    again: bool = False
    """True if an earlier attempt of the same command made some products, which are kept without objection."""
    quicklook: bool = True
    """True if a preview of the products is written, such as `ortho_overview.png`."""
    events: Events = SILENT
    """Receiver of tiles that are done, and of each product's result, also if some of its tiles failed."""

    @classmethod
    def of(cls, request: Any, events: Events, again: bool = False) -> Run:
        """Return what a request states of its run."""
        options = dict(request)
        known = {f.name: options[f.name] for f in fields(cls) if f.name in options}
        return cls(**known, events=events, again=again)

    def check(self, each: int = _EACH) -> None:
        """Refuse what cannot work, before any work.

        Raises
        ------
        UsageError
            An unknown executor, less than one worker, or too little memory for one tile.
        """
        self.in_flight(Workers(executor_factory(self.executor, self.workers), self.workers), each)

    def in_flight(self, workers: Workers, each: int = _EACH) -> int:
        """Tiles that may be under way at once, each of which takes so many bytes; raises as `check`."""
        return tiles_in_flight(workers.in_flight, self.memory, BASE_MEMORY, each)

    @contextmanager
    def runner(self, inputs: Iterable[Path], folder: Path, each: int = _EACH) -> Iterator[Runner[Any]]:
        """Yield what makes products whose tiles take `each` bytes; workers of a cluster must see the inputs, and may
        see the folder of the products. For errors see `open_workers`."""
        with open_workers(self.executor, self.workers, question(inputs, folder), self.events) as workers:
            yield Runner(workers, self.in_flight(workers, each), self.events)

    def clock(self, workers: Workers) -> Callable[[], dict[str, Any]]:
        """Gives what a record says of the run when a product is complete: times from now on, and who worked."""
        times, how = run_times(), {"workers": self.workers, "executor": self.executor, "memory": self.memory}
        return lambda: {**how, **times(), "workers_versions": workers.versions}


def refuse_inputs(inputs: Iterable[Path], outputs: Iterable[Path]) -> None:
    """No output may be an input, whichever product it belongs to and by whatever link."""
    known = {_identity(file) for file in inputs}
    for path in outputs:
        if _identity(path) in known:
            raise UsageError(f"{path}: the output is an input of the project; choose another `output`")


def _identity(path: Path) -> object:
    """Return what two names of one file have in common."""
    try:
        state = path.stat()
        return state.st_dev, state.st_ino
    except OSError:
        return path.resolve()


def question(files: Iterable[Path], folder: Path) -> Question:
    """Return the question to workers of a cluster: do they see the files, and the folder of the product?"""
    return Question(versions, tuple(str(path.resolve()) for path in files), str(folder.resolve()))
