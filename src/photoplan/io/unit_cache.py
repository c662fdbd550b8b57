"""A bounded store of values of any kind that forgets the least recently used first."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

T = TypeVar("T")


class UnitCache(Generic[T]):
    """Values by key, at most `limit` bytes of them; safe to use from several threads.

    Other than in a `BlockCache`, arrays of the values stay writable: kernels are compiled anew for arrays that are not.
    A value that two threads want at once may be loaded twice; it is kept once.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._held: OrderedDict[Hashable, tuple[T, int]] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    @property
    def bytes(self) -> int:
        """Bytes held now; never above the limit."""
        return self._bytes

    def get(self, key: Hashable, load: Callable[[], tuple[T, int]]) -> T:
        """The value of a key; `load` makes it, and says its bytes, when it is not held. It must not be changed."""
        with self._lock:
            held = self._held.get(key)
            if held is not None:
                self._held.move_to_end(key)
                return held[0]
        value, size = load()
        with self._lock:
            if key not in self._held and size <= self._limit:
                self._held[key] = value, size
                self._bytes += size
                while self._bytes > self._limit:
                    self._bytes -= self._held.popitem(last=False)[1][1]
        return value
