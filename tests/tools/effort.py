"""Limits of effort that do not depend on what else the machine does."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def at_most(seconds: float) -> Iterator[None]:
    """What happens inside takes less processor time than this; a clock would count the work of others too."""
    begin = time.process_time()
    yield
    assert time.process_time() - begin < seconds
