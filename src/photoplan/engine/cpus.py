"""How many processors this process may use: those of the machine, less what affinity and a container leave."""

from __future__ import annotations

import math
import os
import sys
from pathlib import Path


def available_cpus(root: Path = Path("/")) -> int:
    """Number of processors that work can be spread over, at least one.

    The least of the machine's processors, those that the process is bound to, and the quota of its control groups, also
    of those around them: ``cpu.max`` of version 2, ``cpu.cfs_quota_us`` and ``cpu.cfs_period_us`` of version 1. A quota
    of two and a half processors counts as three.

    Parameters
    ----------
    root : Path
        Where the system's files begin; another folder in tests.
    """
    counts = [float(os.cpu_count() or 1)]
    if sys.platform == "linux":
        counts.append(len(os.sched_getaffinity(0)))
    groups = root / "sys/fs/cgroup"
    for line in _text(root / "proc/self/cgroup").splitlines():
        _, controllers, path = [*line.split(":", 2), "", ""][:3]
        if controllers == "":
            counts += _quotas(groups, path, "cpu.max")
        elif "cpu" in controllers.split(","):
            # A container sees its own group at the top, under the name that it has outside.
            counts += _quotas(groups / controllers, path, "cpu.cfs_quota_us")
            counts += _quotas(groups / "cpu", path, "cpu.cfs_quota_us")
    return max(1, math.ceil(min(counts)))


def _quotas(top: Path, path: str, name: str) -> list[float]:
    """Processors that a group and those around it may use, where they are limited."""
    found = []
    parts = [part for part in path.split("/") if part not in ("", "..")]
    for depth in range(len(parts) + 1):
        folder = top.joinpath(*parts[:depth])
        words = _text(folder / name).split()
        if name != "cpu.max":
            words += _text(folder / "cpu.cfs_period_us").split()
        try:
            quota, period = map(float, words)
        except ValueError:
            # "max" of version 2: no limit; or there is no such file.
            continue
        if quota > 0 and period > 0:
            found.append(quota / period)
    return found


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""
