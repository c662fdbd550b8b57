"""The record beside a product: what it was made from, how, with which versions."""

from __future__ import annotations

import dataclasses
import json
import math
import platform
import sys
from datetime import date, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import rasterio

from photoplan.errors import UsageError
from photoplan.io.disk import write_atomically

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

    Data classes become objects, paths text, arrays lists; NaN and infinity become null.

    Raises
    ------
    UsageError
        If the record holds something that JSON cannot say, or the folder cannot be written.
    ResourceError
        If the disk is full.
    """
    text = json.dumps(_plain(record, "record"), indent=2, ensure_ascii=False, allow_nan=False)
    write_atomically(Path(path), (text + "\n").encode())
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


def peak_memory_bytes() -> int:
    """Largest resident memory of this process so far, bytes."""
    if resource is None:
        return int(psutil.Process().memory_info().peak_wset)
    # Linux counts in KiB, macOS in bytes.
    return int(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * (1 if sys.platform == "darwin" else 1024)


def _plain(value: Any, where: str) -> Any:
    """What JSON can say of a value."""
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.integer | np.bool_):
        return value.item()
    if isinstance(value, np.ndarray):
        return _plain(value.tolist(), where)
    if isinstance(value, Path):
        return value.as_posix()
    if isinstance(value, datetime | date):
        return value.isoformat()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name), f"{where}.{f.name}") for f in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {str(key): _plain(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        items = sorted(value) if isinstance(value, set | frozenset) else value
        return [_plain(item, f"{where}[{i}]") for i, item in enumerate(items)]
    raise UsageError(f"{where} is a {type(value).__name__}; a run record holds numbers, texts, lists and tables")
