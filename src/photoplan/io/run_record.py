"""The record beside a product: what it was made from, how, with which versions."""

from __future__ import annotations

import platform
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import psutil
import rasterio

from photoplan.io.disk import write_atomically
from photoplan.plain import json_text

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

_PACKAGES = ("photoplan", "numpy", "numba", "scipy", "rasterio", "pyproj", "pyogrio", "shapely")


def record_path(product: Path) -> Path:
    """Where the record of a product stands: `NAME.run.json` beside it."""
    return product.with_name(f"{product.stem}.run.json")


def write_run_record(path: Path, record: dict[str, Any]) -> Path:
    """Write a record as JSON; the name holds the old or the whole new record.

    Raises
    ------
    UsageError
        If the record holds something that JSON cannot say, or the folder cannot be written.
    ResourceError
        If the disk is full.
    """
    write_atomically(Path(path), (json_text(record, "record") + "\n").encode())
    return Path(path)


def versions() -> dict[str, str]:
    """Versions of all that takes part in a result; no word of the machine's name, user or folders."""
    found = {"python": platform.python_version(), "system": f"{platform.system()} {platform.machine()}"}
    for name in _PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    found["GDAL"] = rasterio.__gdal_version__
    found["PROJ"] = rasterio.__proj_version__
    return found


def run_times() -> Callable[[], dict[str, Any]]:
    """A clock that starts now; called at the end it gives `started` and `finished` (UTC) and `seconds`."""
    began, started = datetime.now(UTC), time.perf_counter()

    def ended() -> dict[str, Any]:
        seconds = time.perf_counter() - started
        return {"started": began, "finished": datetime.now(UTC), "seconds": round(seconds, 3)}

    return ended


def peak_memory_bytes() -> int:
    """Largest resident memory of this process so far, bytes."""
    if resource is None:
        return int(psutil.Process().memory_info().peak_wset)
    # Linux counts in KiB, macOS in bytes.
    return int(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * (1 if sys.platform == "darwin" else 1024)
