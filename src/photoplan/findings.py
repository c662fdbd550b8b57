"""Results and findings of operations: figures with standard deviations, tables and charts, as text, JSON and report."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from photoplan.errors import InputError, TilesFailed

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

#: Side of a picture, pixels, to which larger ones are reduced.
MOST_PIXELS = 900


def number(value: float, sigma: float = math.nan) -> str:
    """Format a number to two digits of its standard deviation; without one to four digits, and to whole numbers."""
    if not math.isfinite(value):
        return "–"
    if not (math.isfinite(sigma) and sigma > 0):
        if 1e4 <= abs(value) < 1e9:
            return f"{value:.0f}"
        rounded = float(f"{value:.4g}")
        return f"{rounded:.10g}" if 1e-4 <= abs(rounded) < 1e4 else f"{value:.4g}"
    size, last = max(abs(value), sigma), math.floor(math.log10(sigma)) - 1
    if not 1e-4 <= size < 1e9:
        return f"{value:.{min(math.floor(math.log10(size)) - last + 1, 9)}g}"
    decimals = min(-last, 9)
    return f"{round(value, decimals) + 0.0:.{max(decimals, 0)}f}"


def with_sigma(value: float, sigma: float, unit: str = "", signed: bool = False) -> str:
    """Format a value, its standard deviation unless that is NaN, and its unit: ``0.5230 ± 0.0012 px``."""
    sign = "+" if signed and value > 0 else ""
    return " ".join(filter(None, [sign + number(value, sigma), sigma_text(sigma), unit]))


def sigma_text(sigma: float) -> str:
    """Format a standard deviation: ``± 0.0012``; nothing if it is NaN."""
    return f"± {number(sigma, sigma)}" if math.isfinite(sigma) else ""


def columns(rows: Iterable[Sequence[str]]) -> list[str]:
    """Return lines in which the cells of a column stand below each other."""
    listed = list(rows)
    wide = [max(map(len, column)) for column in zip(*listed)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, wide)).rstrip() for row in listed]


@dataclass(frozen=True)
class Estimate:
    """One number that was found."""

    name: str
    """Its name in JSON: small letters with the unit, such as ``read_noise_e``."""
    value: float
    sigma: float = math.nan
    """Its standard deviation; NaN if none can be stated."""
    label: str = ""
    """Its name for people."""
    unit: str = ""
    plane: str = ""
    """Colour plane; empty if there is one plane, or it holds for all."""
    at: str = ""
    """Condition, if there are several: ``500 nm``."""
    remark: str = ""
    """Remark, such as its source."""
    stated: float | None = None
    """Value that is stated elsewhere, to compare."""

    @property
    def row(self) -> tuple[str, str, str]:
        """Its name, value and remark as they are printed."""
        where = spaced(self.plane, self.at)
        stated = "" if self.stated is None else f"  (stated: {number(self.stated)})"
        name = f"{self.label} ({where})" if where else self.label
        return name, with_sigma(self.value, self.sigma, self.unit), self.remark + stated

    @property
    def texts(self) -> tuple[str, str]:
        """Its value and standard deviation as they are printed."""
        return number(self.value, self.sigma), sigma_text(self.sigma)

    def json_fields(self) -> dict[str, Any]:
        """Return the fields; keys that say nothing are left out."""
        more = {key: value for key in ("plane", "at", "remark", "label") if (value := getattr(self, key))}
        return {"name": self.name, "value": self.value, "sigma": self.sigma, "unit": self.unit, **more}


@dataclass(frozen=True, eq=False)
class Trace:
    """One series of a chart."""

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    label: str = ""
    style: Literal["points", "line", "line and points", "dashed", "steps"] = "points"
    sigma: NDArray[np.float64] | None = None
    """Standard deviation of y, drawn as bars."""
    colour: int | None = None
    """Number of a colour; None: the next."""
    vectors: NDArray[np.float64] | None = None
    """From each point, shape (n, 2): drawn enlarged by what the legend says."""


@dataclass(frozen=True, eq=False)
class Chart:
    """Curves over one axis."""

    title: str
    caption: str
    x_label: str
    y_label: str
    curves: tuple[Trace, ...]
    log_x: bool = False
    log_y: bool = False
    marks: tuple[tuple[float, str], ...] = ()
    """Vertical lines: where, and what they mean."""


@dataclass(frozen=True)
class Bars:
    """Values by name, as bars; the last is their total."""

    title: str
    caption: str
    values: Mapping[str, float]
    label: str
    """Name of the values, with their unit."""


@dataclass(frozen=True, eq=False)
class Picture:
    """An image with a scale, and positions in it."""

    title: str
    caption: str
    values: NDArray[Any]
    """Shape (h, w)."""
    label: str
    """Name of the scale."""
    points: tuple[tuple[float, float], ...] = ()
    """(x, y) in pixels of `values`; drawn as circles."""
    limits: tuple[float, float] | None = None
    """Limits of the scale [0.5 % and 99.5 % of the values]."""
    factor: int = 1
    """Side of the block of pixels of which each value is the mean, see `shrunk`; positions count whole pixels."""
    extent: tuple[float, float, float, float] | None = field(default=None)
    """Left, right, bottom, top of the axes where they are no pixels of `values`."""


def shrunk(values: NDArray[Any]) -> tuple[NDArray[np.float64], int]:
    """Return an image as small as a report shows it anyway, and the side of the blocks that were averaged."""
    factor = max(1, -(-max(values.shape) // MOST_PIXELS))
    height, width = (side // factor for side in values.shape)
    blocks = values[: height * factor, : width * factor].astype("float64").reshape(height, factor, width, factor)
    return blocks.mean(axis=(1, 3)), factor


def spaced(*parts: str) -> str:
    """Return the parts that are not empty, with spaces between them."""
    return " ".join(filter(None, parts))


@dataclass(frozen=True)
class Subject:
    """Subject of figures: a colour plane and a condition, either of which may be empty."""

    plane: str = ""
    at: str = ""

    def figure(self, name: str, value: float, sigma: float, label: str, unit: str = "", remark: str = "") -> Estimate:
        """Return a figure of it."""
        return Estimate(
            name=name, value=value, sigma=sigma, label=label, unit=unit, plane=self.plane, at=self.at, remark=remark
        )

    def under(self, condition: str) -> Subject:
        """Return the same under one more condition."""
        return Subject(self.plane, spaced(self.at, condition))

    def named(self, *words: str) -> str:
        """Return words with the subject, as a title or the key of a refusal."""
        return spaced(*words, self.plane, self.at)

    def key(self, word: str) -> str:
        """Return words with the subject as a name among the details."""
        return self.named(word).replace(" ", "_")


def known(*figures: Estimate) -> tuple[Estimate, ...]:
    """Return the figures whose value is known, not NaN."""
    return tuple(figure for figure in figures if math.isfinite(figure.value))


@dataclass(frozen=True)
class Table:
    """Rows of figures; written as CSV and shown in the report."""

    head: tuple[str, ...]
    rows: tuple[tuple[str | float | int, ...], ...]
    caption: str = ""
    printed: bool = False
    """It is short and part of the text for people."""

    def texts(self) -> list[list[str]]:
        """Return head and rows as they are printed, without columns that are empty."""
        rows = [[cell if isinstance(cell, str) else f"{cell:.5g}" if cell == cell else "–" for cell in row]
                for row in self.rows]  # fmt: skip
        shown = [k for k in range(len(self.head)) if any(row[k] for row in rows)]
        return [[row[k] for k in shown] for row in (self.head, *rows)]

    @classmethod
    def of(cls, caption: str, **columns: Any) -> Table:
        """Return rows from columns by their heads; a single value stands in every row, yes and no become 1 and 0."""
        lists = {head: v.tolist() if hasattr(v, "tolist") else v for head, v in columns.items()}
        count = next(len(v) for v in lists.values() if isinstance(v, list | tuple))
        filled = (v if isinstance(v, list | tuple) else [v] * count for v in lists.values())
        cells = ([int(v) if isinstance(v, bool) else v for v in column] for column in filled)
        return cls(tuple(columns), tuple(zip(*cells)), caption)


@dataclass(frozen=True, eq=False)
class Findings:
    """Estimates that belong together, and what goes with them; its fields are the keys of JSON."""

    figures: tuple[Estimate, ...] = ()
    refused: Mapping[str, str] = field(default_factory=dict)
    """Figures that the data do not allow, and why, one sentence each."""
    tables: Mapping[str, Table] = field(default_factory=dict)
    """By the stem of their CSV file."""
    plots: tuple[Chart | Bars | Picture, ...] = ()
    notes: tuple[str, ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict)
    """More plain values for JSON."""
    files: Mapping[str, bytes | Table | NDArray[Any]] = field(default_factory=dict)
    """More files by name, written beside the tables: contents, a table, or an image of type float32."""
    title: str = ""

    def lines(self) -> list[str]:
        """Return figures, what is not known, and short tables for people."""
        tables = [columns(table.texts()) for table in self.tables.values() if table.printed]
        lines = [
            *columns(figure.row for figure in self.figures),
            *(f"not known: {what}: {why}" for what, why in self.refused.items()),
            *(line for table in tables for line in table),
        ]
        return [self.title, *(f"  {line}" for line in lines)] if self.title else lines

    def json_fields(self) -> dict[str, Any]:
        """Return figures, what is not known, notes, details and tables."""
        tables = {name: {"head": table.head, "rows": table.rows} for name, table in self.tables.items()}
        return {"figures": self.figures, "refused": self.refused, "notes": self.notes, "details": self.details,
                "tables": tables}  # fmt: skip


def joined(outcomes: Sequence[Findings]) -> Findings:
    """Join findings of planes or wavelengths; tables of one name are put below each other."""
    tables: dict[str, Table] = {}
    for outcome in outcomes:
        for name, table in outcome.tables.items():
            known = tables.get(name)
            rows = table.rows if known is None else known.rows + table.rows
            tables[name] = Table(table.head, rows, table.caption)
    return Findings(
        figures=tuple(f for o in outcomes for f in o.figures),
        refused={key: why for o in outcomes for key, why in o.refused.items()},
        tables=tables,
        plots=tuple(p for o in outcomes for p in o.plots),
        notes=tuple(dict.fromkeys(n for o in outcomes for n in o.notes)),
        details={key: value for o in outcomes for key, value in o.details.items()},
        files={name: content for o in outcomes for name, content in o.files.items()},
    )


class Result:
    """Result of an operation, a data class; its JSON holds its fields, see `photoplan.plain`."""

    def written(self) -> Sequence[Path]:
        """Return the files that were written; the first is the product. By default all fields that are paths."""
        values: dict[str, Any] = vars(self)
        return [value for value in values.values() if isinstance(value, Path)]

    def outcome(self) -> Sequence[Findings]:
        """Return what was found."""
        return ()

    def summary(self) -> Sequence[str]:
        """Return the figures for people, printed on stdout after the files."""
        return [line for each in self.outcome() for line in each.lines()]

    def raise_failures(self) -> None:
        """Raise if a part of the inputs failed, after the rest is written; by default for the `failed` of `images`."""
        failed = getattr(self, "failed", None)
        if isinstance(failed, Mapping):
            raise_failed(failed, len(getattr(self, "images", ())))

    def remarks(self) -> Sequence[str]:
        """Return what to mind in any case, printed on stderr as it is."""
        return ()

    def messages(self) -> Sequence[str]:
        """Return remarks, printed on stderr; ``note:`` and ``warning:`` also with `quiet`."""
        return ()


def noted(notes: Iterable[str]) -> list[str]:
    """Return notes that begin with ``note:``, but for warnings, once each."""
    return [note if note.startswith(("note:", "warning:")) else f"note: {note}" for note in dict.fromkeys(notes)]


def raise_failed(failed: Mapping[str, str], done: int, what: str = "images failed") -> None:
    """Name the images that failed, with the reasons, if any did."""
    if failed and not done:
        raise InputError("\n".join(failed.values()))
    if failed:
        listed = "\n".join(f"  {reason}" for reason in failed.values())
        raise TilesFailed(f"{len(failed)} of {len(failed) + done} {what}:\n{listed}")
