"""How far the tiles are that are under way: what their jobs tell is kept, for whoever waits for them to ask."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import CancelledError
from typing import Any

from photoplan.events import listening


class Shared:
    """A job whose tiles can be asked how far they are; what pickles of it is the job alone."""

    def __init__(self, job: Callable[[Any], Any]) -> None:
        self._job = job
        self._begun: dict[int, tuple[float, str]] = {}
        self._left = False

    def __call__(self, task: Any) -> Any:
        """What the job makes of a task."""

        def told(share: float, what: str) -> None:
            if self._left:
                raise CancelledError
            self._begun[task.index] = share, what

        with listening(told):
            return self._job(task)

    def __reduce__(self) -> tuple[Any, ...]:
        return _itself, (self._job,)

    def __enter__(self) -> Shared:
        return self

    def __exit__(self, *error: object) -> None:
        # Nobody waits for what is still under way: it ends where it next tells how far it is.
        self._left = True

    def ended(self, task: Any) -> None:
        """A task is no longer under way."""
        self._begun.pop(task.index, None)

    def under_way(self) -> tuple[float, str]:
        """How many tasks the parts add up to that are done of those under way, and what is done in the oldest."""
        now = list(self._begun.values())
        return sum(share for share, _ in now), next((what for _, what in now), "")


def _itself(job: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return job
