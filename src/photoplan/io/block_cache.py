"""A bounded store of blocks that forgets the least recently used first (Ecker 1991, §7.1; Behr 1989, §5.2.2)."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any

from numpy.typing import NDArray

from photoplan.errors import UsageError


class BlockCache:
    """Arrays by key, at most `limit` bytes of them; safe to use from several threads.

    A block that two threads want at once may be loaded twice; it is kept once.
    """

    def __init__(self, limit: int) -> None:
        if limit < 0:
            raise UsageError(f"a block cache of {limit} bytes; the limit must not be negative")
        self._limit = limit
        self._blocks: OrderedDict[Hashable, NDArray[Any]] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    @property
    def bytes(self) -> int:
        """Bytes held now; never above the limit."""
        return self._bytes

    def get(self, key: Hashable, load: Callable[[], NDArray[Any]]) -> NDArray[Any]:
        """The block of a key; `load` makes it when it is not held. The block must not be changed."""
        with self._lock:
            block = self._blocks.get(key)
            if block is not None:
                self._blocks.move_to_end(key)
                return block
        block = load()
        block.setflags(write=False)
        with self._lock:
            if key not in self._blocks and block.nbytes <= self._limit:
                self._blocks[key] = block
                self._bytes += block.nbytes
                while self._bytes > self._limit:
                    self._bytes -= self._blocks.popitem(last=False)[1].nbytes
        return block

    def clear(self) -> None:
        """Forget everything."""
        with self._lock:
            self._blocks.clear()
            self._bytes = 0
