"""Processor time by test, with that of the processes that it started; `make test-times` prints the dearest."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Generator
from contextlib import suppress
from operator import itemgetter
from typing import Any

import psutil
import pytest

_TIMES: dict[str, float] = defaultdict(float)
_SHOWN = 60
_second = itemgetter(1)


def _spent() -> float:
    try:
        import resource
    except ImportError:  # not on Windows
        return time.process_time()
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime + _of_servers()


def _of_servers() -> float:
    """What children took that still live, and theirs: the server of `tools.forked` has forked hundreds of commands."""
    total = 0.0
    for child in psutil.Process().children(recursive=True):
        with suppress(psutil.Error):
            spent = child.cpu_times()
            total += spent.user + spent.system + spent.children_user + spent.children_system
    return total


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, Any, Any]:
    """A test with its fixtures; what files or modules share counts for the first that asks."""
    begin = _spent()
    done = yield
    _TIMES[item.nodeid] += _spent() - begin
    return done


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Totals by folder, the dearest files and tests."""
    places = ((0.5, lambda name: "/".join(name.split("/")[:2])), (5.0, lambda name: name.split("::")[0]))
    terminalreporter.section(f"processor time: {sum(_TIMES.values()):.0f} s in {len(_TIMES)} tests")
    for least, place in places:
        sums: dict[str, float] = defaultdict(float)
        for name, spent in _TIMES.items():
            sums[place(name)] += spent
        for name, spent in sorted(sums.items(), key=_second, reverse=True):
            if spent >= least:
                terminalreporter.write_line(f"{spent:8.1f} {name}")
        terminalreporter.write_line("")
    for name, spent in sorted(_TIMES.items(), key=_second, reverse=True)[:_SHOWN]:
        terminalreporter.write_line(f"{spent:8.2f} {name}")
