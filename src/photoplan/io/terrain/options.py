"""What files of measured terrain do not say of themselves: columns, codes, layers, CRS."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from photoplan.codec import storable
from photoplan.errors import InputError, UsageError
from photoplan.geometry.units import metres_in
from photoplan.io.plain_files import read_toml
from photoplan.io.table_lines import decimal
from photoplan.io.tables import Columns, Dialect, read_table
from photoplan.surfaces.measured import LINE_KINDS, POINT_KINDS

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
