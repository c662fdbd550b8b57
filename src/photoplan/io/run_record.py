"""The record beside a product: what it was made from, how, with which versions."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from datetime import UTC, datetime
from functools import cache
from hashlib import sha256
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

import rasterio

from photoplan import __version__
from photoplan.errors import UsageError
from photoplan.io.disk import read_own
from photoplan.io.fingerprint import fingerprint
from photoplan.io.gdal import gdal_settings, not_georeferenced
from photoplan.io.names import stated_path, stated_text
from photoplan.io.naming import together, write_atomically
from photoplan.plain import HasJsonFields, json_text, pick
from photoplan.request import Request

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

#: A picture of 16 × 16 pixels, 4:2:0, whose decoded bytes tell decoders apart: the standard leaves rounding and the
#: interpolation of colour to them, and files of other decoders differ by up to 7 grey values in 8 % of the samples.
_PICTURE = base64.b64decode(
    b"/9j/4AAQSkZJRgABAQAAAQABAAD/2wBDABQODxIPDRQSEBIXFRQYHjIhHhwcHj0sLiQySUBMS0dARkVQWnNiUFVtVkVGZIhlbXd7gYKBTmCNl4x9"
    b"lnN+gXz/2wBDARUXFx4aHjshITt8U0ZTfHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHx8fHz/wAARCAAQABAD"
    b"ASIAAhEBAxEB/8QAFQABAQAAAAAAAAAAAAAAAAAAAwH/xAAgEAACAgICAgMAAAAAAAAAAAABAgMRAAQhIhITMUFC/8QAFQEBAQAAAAAAAAAAAAAA"
    b"AAAAAQL/xAAbEQEAAgIDAAAAAAAAAAAAAAABAhEAMWHh8P/aAAwDAQACEQMRAD8AjeltWOWWg8V2wPJwVZdlHEXQfjtiaQi2VCJGEDWDR+eMfxgg"
    b"UyR0iIaBX7NYM1bC2/aybjBSuDvP/9k="
)
#: Decoders by the beginning of the digest of what they make of it.
_DECODERS = {"dda6fb8a7330": "libjpeg 9 of the IJG", "0626c3e14946": "libjpeg-turbo"}
T = TypeVar("T")
#: Fields of requests that decide no value.
_IDLE = {"memory", "workers", "executor", "overwrite", "dry_run"}
#: Texts from here on are no messages, but the tiles that a record keeps.
_LONG = 100_000
_PACKAGES = ("photoplan", "numpy", "numba", "scipy", "rasterio", "pyproj", "pyogrio", "shapely")


def recorded_result(product: Path, key: str, result: Callable[[dict[str, Any], Any], T | None]) -> T | None:
    """What `result` makes of the entries product and settings of a product's record; None if it has no such key."""
    try:
        record = json.loads(read_own(record_path(product)))
        return result(record["product"], record["settings"]) if record["key"] == key else None
    except (OSError, ValueError, KeyError, TypeError, RecursionError, UsageError):
        return None


def record_path(product: Path) -> Path:
    """Where the record of a product stands: `NAME.run.json` beside it."""
    return product.with_name(f"{product.stem}.run.json")


def refuse_foreign_record(path: Path) -> None:
    """Refuse to replace a file that has the name of a run record and is none."""
    if os.path.exists(path) and _read_record(path) is None:  # noqa: PTH110 - a name may be too long for `Path.exists`
        raise UsageError(f"{path}: exists already and is no run record; move it away, or say `overwrite`")


def _read_record(path: Path) -> dict[str, Any] | None:
    try:
        record = json.loads(read_own(path))
    except (OSError, ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) and {"file", "key", "inputs", "versions"} <= record.keys() else None


def input_entry(path: Path | str, digest: str | None = None) -> dict[str, Any]:
    """How a record names an input; its digest is sampled if it is not known."""
    return {"path": Path(path), "sampled_sha256": digest or fingerprint(path).digest, "size": Path(path).stat().st_size}


def run_key(kind: str, settings: object, inputs: Iterable[Path | Mapping[str, Any]]) -> str:
    """The digest of all that decides a product, of files or their entries: a run with another one starts afresh."""
    digests = [_entry(each)["sampled_sha256"] for each in inputs]
    known = {"by": __version__, "kind": kind, "settings": settings, "inputs": digests}
    return sha256(json_text(known, "settings").encode()).hexdigest()


def settings_of(request: Any) -> dict[str, Any]:
    """Fields of a request that may decide values: not its files, which are inputs or outputs."""
    options = (
        dict(request) if isinstance(request, Request) else {f.name: getattr(request, f.name) for f in fields(request)}
    )
    return {name: value for name, value in options.items() if name not in _IDLE and not _of_files(value)}


def _of_files(value: Any) -> bool:
    return isinstance(value, Path) or (
        isinstance(value, tuple) and bool(value) and all(isinstance(v, Path) for v in value)
    )


@contextmanager
def recording(kind: str, request: Any, inputs: Iterable[Any]) -> Iterator[Callable[[Iterable[Path | None], Any], None]]:
    """The record of a command that measures or converts: what it reads is looked at now, before it changes any of it.

    What is written inside gets its names together with the record, see `photoplan.io.naming.together`.
    """
    times, settings = run_times(), settings_of(request)
    read = {Path(each): None for each in inputs if each is not None and Path(each).is_file()}
    entries = [input_entry(each) for each in read]
    key = run_key(kind, settings, entries)

    def record(written: Iterable[Path | None], product: Any) -> None:
        files = [path for path in written if path is not None]
        if files:
            path = files[0].with_name(f"{files[0].stem}.{kind}.run.json") if files[0] in read else None
            told = {"kind": kind, "product": product, "settings": settings, "files": files}
            write_run_record(files[0], path=path, key=key, inputs=entries, run=times(), **told)

    with together():
        yield record


def write_run_record(
    product: Path,
    /,
    *,
    key: str,
    inputs: Iterable[Path | Mapping[str, Any]],
    run: Mapping[str, Any],
    path: Path | None = None,
    **told: Any,
) -> Path:
    """Write the record of a product as JSON; the name holds the old or the whole new record."""
    entries = [_entry(each) for each in inputs]
    record = {"file": product.name, **told, "key": key, "inputs": entries, "run": run, "versions": versions()}
    if path is None:
        path = record_path(product)
        if _of_another(path, product):
            path = product.with_name(f"{product.name}.run.json")
    record["peak_memory_bytes"] = peak_memory_bytes()
    write_atomically(path, stated_json(record, path.parent))
    return path


def stated_json(values: Any, folder: Path) -> bytes:
    """JSON for a file in a folder: paths in it are written from there, with slashes on every system."""
    text = json_text(_stated(values, folder), "record")
    return (text + "\n").encode()


def _stated(value: Any, folder: Path) -> Any:
    if isinstance(value, Path):
        return stated_path(value, folder)
    if isinstance(value, str):
        return stated_text(value, folder) if len(value) < _LONG else value
    if isinstance(value, HasJsonFields):
        value = value.json_fields()
    if is_dataclass(value) and not isinstance(value, type):
        value = pick(value, *(each.name for each in fields(value)))
    if isinstance(value, Mapping):
        return {key: _stated(item, folder) for key, item in value.items()}
    return [_stated(item, folder) for item in value] if isinstance(value, list | tuple) else value


def _entry(each: Path | Mapping[str, Any]) -> Mapping[str, Any]:
    return each if isinstance(each, Mapping) else input_entry(each)


def _of_another(path: Path, product: Path) -> bool:
    """Whether a record belongs to another file of the same name but for its extension, such as a model and a raster."""
    record = _read_record(path)
    other = product.name if record is None else record["file"]
    return other != product.name and product.with_name(str(other)).exists()


def versions() -> dict[str, str]:
    """Versions of all that takes part in a result; no word of the machine's name, user or folders."""
    found = {"python": platform.python_version(), "system": f"{platform.system()} {platform.machine()}"}
    for name in _PACKAGES:
        found[name] = _installed(name)
    found["GDAL"] = rasterio.__gdal_version__
    found["PROJ"] = rasterio.__proj_version__
    found["JPEG decoder"] = jpeg_decoder()
    return found


@cache
def _installed(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


@cache
def jpeg_decoder() -> str:
    """What GDAL decodes JPEG with, by the digest of a decoded picture, with its name where it is known."""
    with not_georeferenced(), gdal_settings(), rasterio.MemoryFile(_PICTURE) as file, file.open() as picture:
        digest = hashlib.sha256(picture.read().tobytes()).hexdigest()[:12]
    return f"{_DECODERS.get(digest, 'another')} ({digest})"


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
        import psutil  # noqa: PLC0415 - for Windows alone; 6 ms of each start elsewhere

        return int(psutil.Process().memory_info().peak_wset)
    # Linux counts in KiB, macOS in bytes.
    return int(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * (1 if sys.platform == "darwin" else 1024)
