"""Points and codes sorted into the classes of measured terrain: shared by all readers of terrain files."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.io.terrain.options import OTHER, CodeClass, ReadOptions
from photoplan.surfaces.measured import LINE_KINDS, POINT_KINDS, MeasuredTerrain, PointGroup

MAX_CODES = 1000
"""More codes than this in one file are names rather than classes: their points become one group for each class."""
MAX_SIGMAS = 100
"""More standard deviations than this are rounded up to two figures."""


class CodeIndex:
    """Numbers for texts in the order in which they first appear; number 0 is the empty text."""

    def __init__(self) -> None:
        self._number: defaultdict[str, int] = defaultdict()
        self._number.default_factory = self._number.__len__
        self._number[""]

    def numbers(self, texts: Iterable[str], count: int) -> NDArray[np.int32]:
        """Number of each of `count` texts; unknown ones get the next."""
        return np.fromiter((self._number[t] for t in texts), np.int32, count)

    @property
    def texts(self) -> list[str]:
        """All texts by their numbers."""
        return list(self._number)


@dataclass(frozen=True, eq=False)
class PointColumns:
    """Points of one file as columns."""

    xyz: NDArray[np.float64]
    records: NDArray[np.int64]
    codes: NDArray[np.int32] | None = None
    """Number of each point's code."""
    sigma: NDArray[np.float64] | None = None
    """Standard deviation of each point; NaN: that of its code or class."""
    names: NDArray[Any] | None = None

    def take(self, which: NDArray[Any]) -> PointColumns:
        """The chosen points."""
        return PointColumns(
            xyz=self.xyz[which],
            records=self.records[which],
            codes=None if self.codes is None else self.codes[which],
            sigma=None if self.sigma is None else self.sigma[which],
            names=None if self.names is None else self.names[which],
        )


def class_of(code: str, options: ReadOptions, default: str, where: str) -> CodeClass:
    """Class of a code; `default` where there is no code, or no table to look it up in."""
    found = options.codes.find(code)
    if found is not None:
        return found
    if code and options.codes.classes:
        raise InputError(
            f"{where}: code {code!r} is not in the table of codes"
            + (f" ({options.codes.file})" if options.codes.file else "")
            + '; add it (`ignore` leaves it out), or give a class for all other codes with the code "*"'
        )
    return CodeClass(default)


def check_matched(measured: MeasuredTerrain, options: ReadOptions) -> None:
    """Refuse a table of codes of which the files hold none: what it says would be lost without a word."""
    named = [code for code in options.codes.classes if code != OTHER]
    if not named or any(code in measured.codes for code in named):
        return
    held = sorted(code for code in measured.codes if code)
    raise InputError(
        f"{options.codes.file or 'table of codes'}: none of its codes ({_some(named)}) is in the files; they hold "
        f"{f'the codes {_some(held)}' if held else 'no codes'} ({'; '.join(measured.fields)}); say which column holds "
        "them (`columns` x=…,y=…,z=…,code=… of text, `attribute` of vector files), or leave `codes` out"
    )


def _some(texts: Sequence[str]) -> str:
    return ", ".join(texts[:10]) + (f" and {len(texts) - 10} more" if len(texts) > 10 else "")


def make_groups(
    path: Path, columns: PointColumns, codes: Sequence[str], classes: Sequence[CodeClass]
) -> list[PointGroup]:
    """Point groups of one file: one for each code and standard deviation.

    `codes` and `classes` are by the numbers of `columns.codes`; points whose class is no point class are left out.
    """
    used = np.zeros(1, np.int32) if columns.codes is None else np.unique(columns.codes)
    by_code = len(used) <= MAX_CODES
    numbers = np.zeros(len(columns.xyz), np.int32) if columns.codes is None else columns.codes
    keys: dict[tuple[str, str, float | None], list[int]] = {}
    for number in used.tolist():
        cls = classes[number]
        if cls.kind in POINT_KINDS:
            keys.setdefault((codes[number] if by_code else "", cls.kind, cls.sigma), []).append(number)
    groups: list[PointGroup] = []
    for (code, kind, sigma), members in keys.items():
        part = columns if len(used) == 1 else columns.take(np.isin(numbers, members))
        name = f"{path.name} {code}".strip()
        groups += [
            PointGroup(name=name, kind=kind, xyz=p.xyz, records=p.records, sigma=s, names=p.names)  # type: ignore[arg-type]
            for s, p in _by_sigma(part, sigma)
            if len(p.xyz)
        ]
    return groups


def _by_sigma(part: PointColumns, default: float | None) -> list[tuple[float | None, PointColumns]]:
    """Points parted by their own standard deviation."""
    if part.sigma is None or np.isnan(part.sigma).all():
        return [(default, part)]
    sigma = part.sigma
    if len(np.unique(sigma[~np.isnan(sigma)])) > MAX_SIGMAS:
        with np.errstate(divide="ignore", invalid="ignore"):
            unit = 10.0 ** (np.floor(np.log10(sigma)) - 1)
            sigma = np.where(sigma > 0, np.ceil(sigma / unit - 1e-9) * unit, sigma)
    out: list[tuple[float | None, PointColumns]] = []
    for value in np.unique(sigma):  # NaN comes last, once
        which = np.isnan(sigma) if np.isnan(value) else sigma == value
        out.append((default if np.isnan(value) else float(value), part.take(which)))
    return out


def is_line(cls: CodeClass) -> bool:
    """Whether a class is one of lines."""
    return cls.kind in LINE_KINDS
