"""Options and known ranges of terrain measurements."""

from __future__ import annotations

import hashlib
import os
import tempfile
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from photoplan.arrays import Floats32, Ints
from photoplan.codec import storable
from photoplan.errors import InputError, UsageError
from photoplan.geometry.units import metres_in
from photoplan.io.disk import cache_folder
from photoplan.io.files import fingerprint, read_toml
from photoplan.io.raster import TerrainReader
from photoplan.io.tables import Columns, Dialect, decimal, read_table
from photoplan.surfaces.units import LINE_KINDS, POINT_KINDS

KINDS: tuple[str, ...] = (*POINT_KINDS, *LINE_KINDS, "ignore")
"""Classes that a code may mean."""
#: Words that mean a class wherever a code or the name of a layer stands (in small letters, signs left out).
WORDS = {
    **{kind: kind for kind in KINDS},
    **{f"{kind}s": kind for kind in KINDS},
    **dict.fromkeys(("masspoint", "masspoints", "ground", "groundpoints"), "mass"),
    **dict.fromkeys(("spotheight", "spotheights", "spotpoint", "spotpoints"), "spot"),
    **dict.fromkeys(("hardbreakline", "hardbreaklines", "wall", "walls"), "breakline"),
    **dict.fromkeys(("softbreakline", "softbreaklines", "contour", "contours"), "formline"),
    **dict.fromkeys(("borderline", "borderlines", "boundary", "boundaries", "outer"), "border"),
    **dict.fromkeys(("void", "voids"), "hole"),
    **dict.fromkeys(("ignored", "skip"), "ignore"),
}
MAX_BYTES = 10_000_000
OTHER = "*"


@storable
@dataclass(frozen=True)
class CodeClass:
    """What a code means."""

    kind: str
    """One of `KINDS`."""
    sigma: float | None = None
    """Standard deviation of the heights, metres (the filter value); None: that of the class."""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"class {self.kind!r}; allowed are {', '.join(KINDS)}")
        if self.sigma is not None and not (np.isfinite(float(self.sigma)) and self.sigma >= 0):
            raise InputError(f"sigma {self.sigma}; a standard deviation in metres, zero or more, is needed")


@storable
@dataclass(frozen=True)
class CodeTable:
    """Classes of codes, layer names and survey codes."""

    classes: Mapping[str, CodeClass] = field(default_factory=dict)
    """By code; ``*`` stands for all codes that are not named."""
    file: Path | None = None
    """Where it was read from."""

    def find(self, code: str) -> CodeClass | None:
        """Class of a code: by the table, else by ``*``, else where the code is itself the word for a class."""
        found = self.classes.get(code) or self.classes.get(OTHER)
        if found is None:
            word = WORDS.get("".join(c for c in code.casefold() if c.isalnum()))
            found = CodeClass(word) if word else None
        return found


@storable
@dataclass(frozen=True)
class ReadOptions:
    """How files of measured terrain are to be read; checked at birth."""

    dialect: Dialect = field(default_factory=Dialect)
    """Of text files. Columns that neither a header nor this names are ``x,y,z,code,sigma,name,line,z_right`` as far as
    there are columns."""
    codes: CodeTable = field(default_factory=CodeTable)
    """What the codes mean."""
    attribute: str | None = None
    """Attribute of vector files that holds the code; None: ``kind``, ``class`` or ``code``, else the layer's name."""
    layers: tuple[str, ...] | None = None
    """Layers of vector files (of DXF too) and surfaces of LandXML that are read; None: all."""
    las_classes: tuple[int, ...] | None = None
    """Classes of LAS points that are read; None: ground (2) in files with classified points, else all."""
    tin_points: bool = False
    """Take the vertices of a LandXML triangulation as mass points where the file holds nothing measured."""
    nodata: float | None = None
    """Height that means "none": such points are left out."""
    crs: str | None = None
    """CRS of all files, declared; files that state another one are refused."""
    beyond_area: bool = False
    """Whether coordinates far outside the area of use of the CRS are meant."""
    height_system: str | None = None
    """Height system of all files, declared; its unit is that of heights of files that state none."""
    height_field: str | None = None
    """Attribute of vector files that holds the heights of features, such as contours; None: their geometry does."""
    unit: str | None = None
    """Unit of X, Y and Z of drawings, whatever their header states; None: as it states."""

    def __post_init__(self) -> None:
        if self.unit is not None:
            metres_in(self.unit, "unit of drawings")
        if self.las_classes is not None and not all(0 <= c <= 255 for c in self.las_classes):
            raise UsageError(f"LAS classes {self.las_classes}; allowed are numbers from 0 to 255")


def read_code_table(path: Path) -> CodeTable:
    """Table of codes from a TOML or a CSV file.

    TOML: ``121 = "breakline"`` or ``"D124" = { kind = "spot", sigma = 0.05 }``, at the top or under ``[codes]``.
    CSV (comma, semicolon or tab): code, kind and, if wanted, sigma in metres; a header is allowed. ``*`` as a code
    stands for all others.
    """
    if path.suffix.casefold() == ".toml":
        content, _ = read_toml(path, MAX_BYTES)
        entries = content.get("codes", content)
        if not isinstance(entries, dict):
            raise InputError(f'{path}: codes is not a table; write [codes] and below it: 121 = "breakline"')
        classes = {str(code): _of_toml(value, f"{path}: code {code!r}") for code, value in entries.items()}
    else:
        classes = _of_csv(path)
    if not classes:
        raise InputError(f"{path}: holds no code; a line of it is, for example: 121,breakline,0.05")
    return CodeTable(classes, path)


def _of_toml(value: Any, where: str) -> CodeClass:
    kind, sigma = (value, None) if isinstance(value, str) else (None, None)
    if isinstance(value, dict) and set(value) <= {"kind", "sigma"}:
        kind, sigma = value.get("kind"), value.get("sigma")
    number = sigma is None or (isinstance(sigma, int | float) and not isinstance(sigma, bool))
    if not isinstance(kind, str) or not number:
        raise InputError(f'{where}: {value!r}; write "breakline", or {{ kind = "breakline", sigma = 0.05 }}')
    return _class(kind, sigma, where)


_COLUMNS = Columns(
    roles={"code": ("code",), "kind": ("kind", "class"), "sigma": ("sigma",)},
    needed=("code", "kind"),
    orders=(("code", "kind"), ("code", "kind", "sigma")),
    row="code",
)


def _of_csv(path: Path) -> dict[str, CodeClass]:
    table = read_table(path, _COLUMNS, max_bytes=MAX_BYTES)
    classes: dict[str, CodeClass] = {}
    for k, (code, kind, sigma) in enumerate(zip(*(table.texts(role) for role in _COLUMNS.roles))):
        if code in classes:
            raise InputError(f"{table.where(k)}: code {code!r} is given twice; keep one of them")
        value = decimal(sigma, decimal_comma=True) if sigma else None
        if sigma and value is None:
            raise InputError(f"{table.where(k)}: sigma {sigma!r} is not a number; metres are needed")
        classes[code] = _class(kind, value, table.where(k))
    return classes


def _class(kind: str, sigma: float | None, where: str) -> CodeClass:
    word = WORDS.get("".join(c for c in kind.casefold() if c.isalnum()), kind)
    try:
        return CodeClass(word, sigma)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


#: Posts of a grid from which on reading it once more takes longer than anybody notices.
WORTH_KEEPING = 1 << 25
#: Terrains whose ranges are kept (16 MB each at most); those used longest ago go.
MOST_FILES = 32
_MAGIC = b"PPRANGE1"


@dataclass(frozen=True)
class KnownRanges:
    """What was found of a terrain before; several threads and processes may add to it at once."""

    path: Path
    """Its file."""
    state: str
    """What the terrain is: its files, and how they are read."""
    _key: list[bytes] = field(default_factory=list, init=False, repr=False, compare=False)
    """Of the records that belong here; empty: nothing is kept."""

    @classmethod
    def of(cls, reader: TerrainReader) -> KnownRanges | None:
        """For a terrain file; None: it is so small that all of it is read in no time, or there is no place."""
        info = reader.info
        if info.size[0] * info.size[1] < WORTH_KEEPING:
            return None
        try:
            where = info.path.resolve()
            beside = (where.with_name(where.name + suffix) for suffix in (".msk", ".MSK", ".aux.xml"))
            state: list[Any] = [info.size, info.dtype, info.nodata, info.scales, info.offsets, reader.metres]
            state += [
                (file.name, file.stat().st_mtime_ns, fingerprint(file)) for file in (where, *beside) if file.is_file()
            ]
            name = hashlib.sha256(os.fsencode(where)).hexdigest()[:32]
            return cls(cache_folder() / "terrain" / f"{name}.ranges", repr(state))
        except (OSError, RuntimeError):  # no home
            return None

    def load(self, layout: tuple[int, ...]) -> tuple[Ints, Floats32]:
        """Numbers of parts (n,), and the lowest and highest heights of their cells (n, 2, rows, columns)."""
        key = hashlib.sha256(f"{self.state} {layout}".encode()).digest()
        record, head = _record(layout), _MAGIC + key
        content = b""
        with suppress(OSError):
            if self.path.is_file():  # a pipe would be waited for
                content = self.path.read_bytes()
        begun = content[: len(head)] == head
        body = content[len(head) :] if begun else b""
        size = record.itemsize
        found, start = np.frombuffer(body[: len(body) // size * size], record), zlib.crc32(key)
        sums = [zlib.crc32(body[k * size + 4 : (k + 1) * size], start) for k in range(len(found))]
        kept = found[found["check"] == np.array(sums, np.uint32)]
        try:
            if not begun or len(kept) * size != len(body):
                _replace(self.path, head + kept.tobytes())
            os.utime(self.path)
            self._key[:] = [key]
        except OSError:
            self._key.clear()
        return kept["part"].astype(np.int64), kept["cells"].astype(np.float32)

    def keep(self, layout: tuple[int, ...], part: int, cells: Floats32) -> None:
        """Keep what was found of a part, shape (2, rows, columns); where it cannot be written it is not kept."""
        if not self._key:
            return
        one = np.zeros((), _record(layout))
        one["part"], one["cells"] = part, cells
        one["check"] = zlib.crc32(one.tobytes()[4:], zlib.crc32(self._key[0]))
        try:
            # Whole records are appended, and each knows the state of the terrain that it belongs to.
            descriptor = os.open(self.path, os.O_WRONLY | os.O_APPEND | getattr(os, "O_BINARY", 0))
            try:
                os.write(descriptor, one.tobytes())
            finally:
                os.close(descriptor)
        except OSError:
            self._key.clear()


def _record(layout: tuple[int, ...]) -> np.dtype[Any]:
    return np.dtype([("check", "<u4"), ("part", "<u4"), ("cells", "<f4", (2, *layout[-2:]))])


def _replace(path: Path, content: bytes) -> None:
    """Write a file at once; the oldest of its kind go."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".new-", delete=False) as file:
        try:
            file.write(content)
            file.close()
            Path(file.name).replace(path)
        except OSError:
            Path(file.name).unlink(missing_ok=True)
            raise
    files = sorted(path.parent.glob("*.ranges"), key=lambda file: file.stat().st_mtime)
    for old in files[:-MOST_FILES]:
        old.unlink(missing_ok=True)
