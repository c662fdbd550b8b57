"""Measured terrain from LAS and LAZ files (laspy, an optional package).

Points of the wanted classes are mass points; points that the file flags as withheld are left out.
"""

from __future__ import annotations

import importlib.util
import os
import struct
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from photoplan.arrays import Floats, Ints
from photoplan.codec import NotData, decode, encode, storable
from photoplan.errors import InputError, UsageError
from photoplan.geometry.crs import canonical_crs, parse_crs, split_compound
from photoplan.geometry.units import agreed_metres, metres_in, metric_heights
from photoplan.io.terrain.options import ReadOptions
from photoplan.surfaces.units import MeasuredTerrain, PointGroup

try:
    import resource
except ImportError:  # Windows has no such limits.
    resource = None  # type: ignore[assignment]

CHUNK = 1_000_000
"""Points that are decoded at once."""
ROOM = 2 << 30
"""Memory in bytes that decoding may take besides its points: libraries, and what they hold of the file."""
KEPT = 32
"""Bytes of a point that is kept: three coordinates and its number."""
GROUND = 2
MAX_RATIO = 250.0
"""Decoded bytes per stored byte of a LAZ file; real ones stay below 50."""
RATIO_FROM = 1 << 30
"""Decoded size in bytes from which `MAX_RATIO` is asked."""
# Sizes of point records by their format (ASPRS LAS 1.4-R15, tables 7 to 17).
_RECORD_SIZES = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
# GeoTIFF keys (OGC 19-008r4): model, geographic CRS, projected CRS, linear unit, vertical CRS, vertical unit.
_GEOGRAPHIC, _PROJECTED, _UNIT, _VERTICAL, _VERTICAL_UNIT = 2048, 3072, 3076, 4096, 4099
_USER_DEFINED = 32767
#: Vertical codes of GeoTIFF 1.0 (section 6.3.4.2), which EPSG does not know, as codes of EPSG in metres; they state no
#: unit of their own. Those from 5001 to 5033 are heights above ellipsoids.
_OLD_VERTICAL = {5101: 5701, 5102: 7968, 5103: 5703, 5104: 5736, 5105: 5705, 5106: 5706}


def read(path: Path, options: ReadOptions) -> MeasuredTerrain:
    """Mass points of a LAS or LAZ file."""
    if importlib.util.find_spec("laspy") is None:
        raise UsageError(f"{path}: LAS and LAZ need laspy; install it with `pip install 'photoplan[points]'`")
    head = _check_header(path)
    return _decoded_apart(path, options, head) if head.packed else _decoded(path, options, head)


def _decoded(path: Path, options: ReadOptions, head: _Header) -> MeasuredTerrain:
    import laspy  # type: ignore[import-untyped]  # noqa: PLC0415  # an optional package

    try:
        with laspy.open(path) as file:
            header = file.header
            scaling = np.array([header.scales, header.offsets], float)
            if not (np.isfinite(scaling).all() and (scaling[0] != 0).all()):
                raise InputError(f"{path}: scale {header.scales} and offset {header.offsets} of the header are damaged")
            crs, heights, units = _crs(path, header)
            xyz, records, notes = _points(path, file, options)
    except (InputError, MemoryError):
        raise
    except BaseException as error:
        # Damaged files come out of the decoders as many kinds of errors, panics of lazrs (no Exception) among them.
        if isinstance(error, KeyboardInterrupt | SystemExit):
            raise
        raise _unreadable(path, head, " ".join(str(error).split())[:200] or type(error).__name__) from None
    group = PointGroup(path.name, "mass", xyz, records)
    return MeasuredTerrain(
        points=(group,),
        lines=(),
        crs=crs,
        height_system=heights,
        tin=None,
        files=(path,),
        notes=tuple(notes),
        fields=(f"{path.name}: LAS",),
        unit=units[0],
        height_unit=units[1],
    )


def _unreadable(path: Path, head: _Header, cause: str) -> InputError:
    return InputError(
        f"{path}: cannot be read ({cause}); the header promises {head.count} points: the file is damaged or cut off, "
        "get a fresh copy"
    )


def _decoded_apart(path: Path, options: ReadOptions, head: _Header) -> MeasuredTerrain:
    """The same in a process of its own with bounded memory.

    A decoder of damaged data may ask for any amount of memory and end the process that it runs in.
    """
    command = [sys.executable, "-c", "from photoplan.io.terrain import las; las.decode_from_stdin()"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    pipe, nowhere = subprocess.PIPE, subprocess.DEVNULL
    with subprocess.Popen(command, env=environment, stdin=pipe, stdout=pipe, stderr=nowhere) as child:
        assert child.stdin is not None and child.stdout is not None
        try:
            child.stdin.write(encode((path, options, head)))
            child.stdin.close()
            kind, found = decode(child.stdout.read())
        except (NotData, BrokenPipeError):
            raise _unreadable(path, head, "its decoder ended abnormally") from None
        except BaseException:
            child.kill()
            raise
    if kind == "refused":
        raise InputError(found)
    if kind == "memory":
        raise MemoryError(found)
    if not isinstance(found, MeasuredTerrain):
        raise _unreadable(path, head, "its decoder failed")
    return found


def decode_from_stdin() -> None:
    """What the process of `_decoded_apart` does: a request from stdin, the points or the refusal to stdout."""
    path, options, head = decode(sys.stdin.buffer.read())
    if resource is not None:
        limit = ROOM + head.count * (head.record + 2 * KEPT)
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    answer: tuple[str, Any]
    try:
        answer = "points", _decoded(path, options, head)
    except InputError as error:
        answer = "refused", str(error)
    except MemoryError as error:
        answer = "memory", str(error)
    sys.stdout.buffer.write(encode(answer))


@storable
@dataclass(frozen=True)
class _Header:
    """What the header promises."""

    count: int
    record: int
    """Bytes of a point."""
    packed: bool


def _check_header(path: Path) -> _Header:
    """What the header promises, after it was compared with the size of the file."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(375)
    if len(head) < 227 or head[:4] != b"LASF":
        raise InputError(f"{path}: not a LAS file, or cut off in its header; get a fresh copy")
    minor = head[25]
    header_size, offset, vlrs, form, record, count = struct.unpack_from("<HIIBHI", head, 94)
    if minor >= 4 and len(head) >= 255:
        start, evlrs, count = struct.unpack_from("<QIQ", head, 235)
        if evlrs and (start > size or evlrs > (size - start) // 60):
            raise InputError(f"{path}: the header promises {evlrs} records behind the end of the file; it is cut off")
    packed = bool(form & 0xC0)
    form &= 0x3F
    if form >= len(_RECORD_SIZES) or record < _RECORD_SIZES[form]:
        raise InputError(f"{path}: point format {form} with {record} bytes a point; LAS knows formats 0 to 10")
    if header_size > offset or offset > size or vlrs > (size - header_size) // 54:
        raise InputError(
            f"{path}: the header leads behind the end of the file ({size} bytes); it is damaged or cut off"
        )
    if count == 0:
        raise InputError(f"{path}: holds no points")
    decoded, stored = count * record, size - offset
    if not packed and decoded > stored:
        raise InputError(
            f"{path}: the header promises {count} points ({decoded} bytes), the file has {stored} bytes for them; "
            "it is damaged or cut off, get a fresh copy"
        )
    if packed and decoded > RATIO_FROM and decoded > MAX_RATIO * stored:
        raise InputError(
            f"{path}: promises {decoded / (1 << 30):.1f} GiB of points, {decoded / max(stored, 1):.0f} times what is "
            f"stored (limit {MAX_RATIO:.0f}); a file that is trusted can be stored again without compression"
        )
    return _Header(int(count), int(record), packed)


def _points(path: Path, file: Any, options: ReadOptions) -> tuple[Floats, Ints, list[str]]:
    """Coordinates and numbers of the wanted points, and notes."""
    wanted = options.las_classes
    kept: list[tuple[Floats, Ints]] = []
    counts: Counter[int] = Counter()
    withheld, done, classified = 0, 0, wanted is not None
    for chunk in file.chunk_iterator(CHUNK):
        classes = np.asarray(chunk.classification)
        use = ~np.asarray(chunk.withheld, bool)
        withheld += int((~use).sum())
        counts.update(dict(enumerate(np.bincount(classes[use], minlength=1).tolist())))
        if not classified and (classes[use] > 1).any():
            # Points read so far were of the classes "never classified" and "unclassified": none of them is ground.
            classified = True
            kept.clear()
        if classified:
            use &= np.isin(classes, (GROUND,) if wanted is None else wanted)
        at = np.flatnonzero(use)
        kept.append((np.stack([np.asarray(v)[at] for v in (chunk.x, chunk.y, chunk.z)], axis=1), at + done + 1))
        done += len(classes)
    if done != file.header.point_count:
        raise InputError(f"{path}: holds {done} of {file.header.point_count} promised points; it is cut off")
    total = sum(len(k[1]) for k in kept)
    present = ", ".join(f"{c} ({n} points)" for c, n in sorted(counts.items()) if n)
    if not total:
        asked = ", ".join(str(c) for c in ((GROUND,) if wanted is None else wanted))
        raise InputError(f"{path}: no points of class {asked}; the file has classes {present}; choose with las_classes")
    notes = []
    if wanted is None:
        what = f"points of class {GROUND} (ground) taken, {done - total} others left out"
        notes.append(f"{path.name}: {what if classified else f'points are not classified, all {total} taken'}")
    if withheld:
        notes.append(f"{path.name}: {withheld} points are flagged as withheld and left out")
    xyz = np.concatenate([np.asarray(k[0], np.float64) for k in kept])
    return xyz, np.concatenate([k[1] for k in kept]).astype(np.int64), notes


_Units = tuple[float | None, float | None]
"""Metres in the units of X and Y and of Z that GeoTIFF keys state beside the CRS; None: none."""


def _crs(path: Path, header: Any) -> tuple[str | None, str | None, _Units]:
    """Horizontal CRS, height system and units of the file's WKT or GeoTIFF keys."""
    vlrs = list(header.vlrs) + list(getattr(header, "evlrs", None) or [])
    for vlr in vlrs:
        text = getattr(vlr, "string", None)
        if vlr.user_id.strip("\0 ") == "LASF_Projection" and vlr.record_id == 2112 and text and text.strip("\0 "):
            return *split_compound(text.strip("\0 "), f"{path}: CRS"), (None, None)
    for vlr in vlrs:
        entries = getattr(vlr, "geo_keys", None)
        if vlr.user_id.strip("\0 ") == "LASF_Projection" and entries:
            return _of_geokeys(path, {k.id: k.value_offset for k in entries if k.tiff_tag_location == 0})
    return None, None, (None, None)


def _of_geokeys(path: Path, keys: dict[int, int]) -> tuple[str | None, str | None, _Units]:
    plan, up = (
        metres_in(keys[key], f"{path}: {what}") if keys.get(key, 0) not in (0, _USER_DEFINED) else None
        for key, what in ((_UNIT, "unit of X and Y"), (_VERTICAL_UNIT, "unit of heights"))
    )
    if _PROJECTED not in keys:
        plan = None
    code, vertical = keys.get(_PROJECTED) or keys.get(_GEOGRAPHIC), keys.get(_VERTICAL, 0)
    if code and code != _USER_DEFINED:
        parse_crs(f"EPSG:{code}", f"{path}: CRS")
    crs = canonical_crs(f"EPSG:{code}") if code and code != _USER_DEFINED else None
    heights = None
    if 5001 <= vertical <= 5033:
        heights = "ellipsoidal"
    elif vertical in _OLD_VERTICAL:
        heights = canonical_crs(f"EPSG:{_OLD_VERTICAL[vertical]}")
    elif 1024 <= vertical < _USER_DEFINED and parse_crs(f"EPSG:{vertical}", f"{path}: heights").is_vertical:
        heights = canonical_crs(f"EPSG:{vertical}")
        agreed_metres(up, metric_heights(heights)[1], f"{path}: heights", in_one_file=True)
    return crs, heights, (plan, up)
