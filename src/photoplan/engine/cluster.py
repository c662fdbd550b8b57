"""A Dask cluster as workers: asked before any tile who they are, watched while they work.

A worker with another photoplan would paint other pixels without a word, so each is asked for a fingerprint of its
sources, and every tile asks again: workers may come later. Results go by files in a folder that both sides see, where
there is one, and from worker to client otherwise; never through the scheduler.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from photoplan.codec import NotData, decode, encode
from photoplan.errors import InputError, ResourceError, UsageError
from photoplan.events import Events

#: Seconds within which a cluster that cannot work is told so.
PATIENCE = 10.0
#: Packages whose other version is told, since it may move a grey value.
_NAMED = ("GDAL", "numba", "numpy", "rasterio")


@dataclass(frozen=True)
class Question:
    """What workers are asked before any tile."""

    versions: Callable[[], Mapping[str, str]]
    """Versions of packages by their names."""
    inputs: tuple[str, ...] = ()
    """Files that they must see."""
    folder: str = ""
    """Where results may go, if they see that as well."""


@dataclass(frozen=True)
class Answer:
    """What one worker says."""

    fingerprint: str
    """Of photoplan's sources."""
    versions: Mapping[str, str]
    unseen: tuple[str, ...]
    """Inputs that it does not see."""
    token: str
    """Content of the file in the common folder; empty: it does not see it."""


@cache
def source_fingerprint() -> str:
    """Digest of photoplan's own sources: two of the same version number may differ."""
    top = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for path in sorted(top.rglob("*.py")):
        digest.update(path.relative_to(top).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def answer(question: Question, token: str) -> Answer:
    """What this process says; runs on the workers."""
    unseen = tuple(path for path in question.inputs if not Path(path).is_file())
    try:
        found = Path(token).read_text() if token else ""
    except OSError:
        found = ""
    return Answer(source_fingerprint(), dict(question.versions()), unseen, found)


def judge(address: str, own: Answer, answers: Mapping[str, Answer | BaseException]) -> list[str]:
    """Notes on workers that differ without harm."""
    notes: dict[str, None] = {}
    for worker, said in answers.items():
        if isinstance(said, BaseException) or said.fingerprint != own.fingerprint:
            which = f"cannot be asked: {said}" if isinstance(said, BaseException) else said.versions.get("photoplan")
            raise UsageError(
                f"executor {address}: worker {worker} has another photoplan ({which}, here is "
                f"{own.versions.get('photoplan')}); install the same one everywhere, its pixels would differ"
            )
        if said.unseen:
            raise InputError(
                f"executor {address}: worker {worker} does not see {said.unseen[0]}"
                f"{f' and {len(said.unseen) - 1} more inputs' if len(said.unseen) > 1 else ''}; put the inputs in a "
                "folder that all machines have under the same name"
            )
        for name in _NAMED:
            here, there = own.versions.get(name), said.versions.get(name)
            if here != there:
                notes[f"note: workers have {name} {there}, here is {here}; grey values may differ by one"] = None
    return list(notes)


@dataclass(frozen=True)
class Parcel:
    """A result that lies in a file."""

    path: str
    digest: bytes

    def open(self) -> Any:
        """The result; its file is gone then."""
        path = Path(self.path)
        try:
            content = path.read_bytes()
            path.unlink()
        except OSError as error:
            raise ResourceError(f"{path}: a worker's tile cannot be read ({error.strerror}); run again") from error
        if hashlib.blake2b(content).digest() != self.digest:
            raise ResourceError(f"{path}: a worker's tile came damaged; run the same command again")
        try:
            return decode(content)
        except NotData as error:
            raise ResourceError(f"{path}: a worker's tile cannot be read ({error}); run again") from error


@dataclass(frozen=True)
class RemoteJob:
    """A job on a worker of a cluster."""

    job: Callable[[Any], Any]
    fingerprint: str
    folder: str | None
    """Where results go; None: to the client."""

    def __call__(self, task: Any) -> Any:
        """The job's result, or where it lies."""
        if source_fingerprint() != self.fingerprint:
            raise UsageError("a worker that came later has another photoplan; install the same one everywhere")
        made = self.job(task)
        if self.folder is None:
            return made
        content = encode(made)
        path = Path(self.folder) / secrets.token_hex(8)
        path.write_bytes(content)
        return Parcel(str(path), hashlib.blake2b(content).digest())


class Cluster(Executor):
    """A cluster that was asked and found good; it is the cluster that tries a tile again when its worker dies."""

    def __init__(self, address: str, retries: int) -> None:
        try:
            from distributed import Client  # noqa: PLC0415  (an optional package)
        except ImportError as error:
            raise UsageError(
                f"executor {address}: Dask is not installed; install it with: pip install 'photoplan[cluster]'"
            ) from error
        self.address = address
        try:
            self._client = Client(
                address, timeout=f"{PATIENCE:.0f}s", set_as_default=False, direct_to_workers=True, name="photoplan"
            )
        except (OSError, TimeoutError, ValueError) as error:
            raise UsageError(f"executor {address}: no usable Dask scheduler ({error})") from error
        try:
            self._client.wait_for_workers(1, timeout=PATIENCE)
            self._client.get_versions(check=True)
        except TimeoutError as error:
            self._client.close()
            raise ResourceError(
                f"executor {address}: the scheduler has no workers; start some with `dask worker {address}`"
            ) from error
        except ValueError as error:
            self._client.close()
            raise UsageError(f"executor {address}: versions do not fit ({error})") from error
        self._inner = self._client.get_executor(retries=retries, pure=False)
        self._seen = time.monotonic()
        self.shares_folder = False
        self.versions: list[dict[str, str]] = []
        """Versions of the workers, each combination once."""

    @property
    def threads(self) -> int:
        """Threads of all workers."""
        return sum(self._client.nthreads().values())

    def ask(self, question: Question, events: Events) -> None:
        """Ask all workers who they are and what they see."""
        token = ""
        folder = Path(question.folder) if question.folder else None
        if folder is not None and folder.is_dir():
            place = folder / f".{secrets.token_hex(8)}.seen"
            token = str(place.resolve())
        try:
            if token:
                Path(token).write_text(token)
            own = answer(question, token)
            answers = self._client.run(answer, question, token, on_error="return")
        finally:
            if token:
                Path(token).unlink(missing_ok=True)
        for note in judge(self.address, own, answers):
            events.talk(note)
        self.shares_folder = bool(token) and all(each.token == token for each in answers.values())
        self.versions = [dict(each) for each in {tuple(sorted(a.versions.items())) for a in answers.values()}]

    def prepared(self, job: Callable[[Any], Any], folder: Path | None) -> RemoteJob:
        """A job as workers get it; they leave results in the folder if they see it."""
        shared = folder if self.shares_folder else None
        if shared is not None:
            shared.mkdir(exist_ok=True)
        return RemoteJob(job, source_fingerprint(), None if shared is None else os.fspath(shared.resolve()))

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Submit to the cluster."""
        try:
            return self._inner.submit(fn, *args, **kwargs)
        except (OSError, RuntimeError) as error:
            raise self.lost() from error

    def check(self) -> None:
        """Make sure that somebody works."""
        if self._client.status != "running":
            raise self.lost()
        try:
            workers = self._client.nthreads()
        except (OSError, TimeoutError, RuntimeError) as error:
            raise self.lost() from error
        if workers:
            self._seen = time.monotonic()
        elif time.monotonic() - self._seen > PATIENCE / 2:
            raise ResourceError(
                f"executor {self.address}: no workers are left; start some and run the same command again: finished "
                "tiles are kept"
            )

    def lost(self) -> ResourceError:
        """What to say when the scheduler is gone."""
        return ResourceError(
            f"executor {self.address}: the scheduler is gone; start it again, or choose another executor, and run the "
            "same command again: finished tiles are kept"
        )

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Leave the cluster; the cluster itself goes on."""
        if self._client.status == "running":
            self._inner.shutdown(wait=wait and not cancel_futures)
        self._client.close(timeout=2)


def opened(result: Any) -> Any:
    """A result as the job made it, wherever it lies."""
    return result.open() if isinstance(result, Parcel) else result
