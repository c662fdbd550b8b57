"""What an analysis of a camera gives: figures with their sigmas, tables, plots, and what could not be known and why."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from photoplan.plain import pick

#: Side of a picture, pixels, to which larger ones are reduced.
MOST_PIXELS = 900


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


@dataclass(frozen=True, eq=False)
class Plate:
    """An image with a scale, and positions in it."""

    title: str
    caption: str
    values: NDArray[Any]
    """Shape (h, w)."""
    label: str
    """Of the scale."""
    points: tuple[tuple[float, float], ...] = ()
    """(x, y) in pixels of `values`; drawn as circles."""
    limits: tuple[float, float] | None = None
    """Of the scale; None: 0.5 % and 99.5 % of the values."""
    factor: int = 1
    """Side of the block of pixels of which each value is the mean, see `shrunk`; positions count whole pixels."""
    extent: tuple[float, float, float, float] | None = field(default=None)
    """Left, right, bottom, top of the axes where they are no pixels of `values`."""


def shrunk(values: NDArray[Any]) -> tuple[NDArray[np.float64], int]:
    """An image as small as a picture of the report shows it anyway, and the side of the blocks it was averaged over."""
    image = np.asarray(values, np.float64)
    factor = max(1, -(-max(image.shape) // MOST_PIXELS))
    return np.array(block_means(image, factor)), factor


def block_means(values: NDArray[np.float64], factor: int) -> NDArray[np.float64]:
    """Means of blocks, which a picture of the report's size would show anyway."""
    if factor == 1:
        return values
    height, width = values.shape[0] // factor * factor, values.shape[1] // factor * factor
    blocks = values[:height, :width].reshape(height // factor, factor, width // factor, factor)
    return np.asarray(blocks.mean(axis=(1, 3)))


@dataclass(frozen=True)
class Figure:
    """One number that was found."""

    name: str
    """As in JSON: small letters with the unit, such as ``read_noise_e``."""
    value: float
    sigma: float
    """Its standard deviation; NaN where none can be stated."""
    label: str
    """What it is, for people."""
    unit: str = ""
    plane: str = ""
    """Of which colour; empty where there is one plane, or it holds for all."""
    at: str = ""
    """Under which condition, where there are several: ``500 nm``."""
    remark: str = ""

    def __str__(self) -> str:
        sigma = f" ± {_plain(self.sigma, 2)}" if math.isfinite(self.sigma) else ""
        where = spaced(self.plane, self.at)
        unit = f" {self.unit}" if self.unit else ""
        more = f" · {self.remark}" if self.remark else ""
        return f"{self.label}{f' ({where})' if where else ''}: {_short(self.value, self.sigma)}{sigma}{unit}{more}"

    @property
    def texts(self) -> tuple[str, str, str]:
        """Value, standard deviation (empty: none) and unit as they are printed."""
        return _short(self.value, self.sigma), _plain(self.sigma, 2) if math.isfinite(self.sigma) else "", self.unit

    def json_fields(self) -> dict[str, Any]:
        """Keys that say nothing are left out."""
        more = {key: value for key, value in pick(self, "plane", "at", "remark", "label").items() if value}
        return {**pick(self, "name", "value", "sigma", "unit"), **more}


def spaced(*parts: str) -> str:
    """Parts that say something, with spaces between them."""
    return " ".join(filter(None, parts))


@dataclass(frozen=True)
class Subject:
    """Of what figures are: a colour plane and a condition, either of which may be empty."""

    plane: str = ""
    at: str = ""

    def figure(self, name: str, value: float, sigma: float, label: str, unit: str = "", remark: str = "") -> Figure:
        """A figure of it."""
        return Figure(
            name=name, value=value, sigma=sigma, label=label, unit=unit, plane=self.plane, at=self.at, remark=remark
        )

    def under(self, condition: str) -> Subject:
        """The same under one more condition."""
        return Subject(self.plane, spaced(self.at, condition))

    def named(self, *words: str) -> str:
        """Words and what it is, as a title or the key of a refusal."""
        return spaced(*words, self.plane, self.at)

    def key(self, word: str) -> str:
        """The same as a name among the details."""
        return self.named(word).replace(" ", "_")


def known(*figures: Figure) -> tuple[Figure, ...]:
    """Those whose value is known, not NaN."""
    return tuple(figure for figure in figures if math.isfinite(figure.value))


def _short(value: float, sigma: float = math.nan) -> str:
    """A number with as many digits as its standard deviation allows (two of it)."""
    if not math.isfinite(value):
        return "–"
    if not (math.isfinite(sigma) and sigma > 0) or value == 0:
        return _plain(value, 4)
    digits = min(max(math.floor(math.log10(abs(value))) - math.floor(math.log10(sigma)) + 2, 2), 9)
    text = _plain(value, digits)
    if "e" in text or len(text.lstrip("-").replace(".", "").lstrip("0")) >= digits:
        return text
    # Zeros at the end tell how well a number is known.
    return f"{value:.{max(digits - 1 - math.floor(math.log10(abs(value))), 0)}f}"


def _plain(value: float, digits: int) -> str:
    """A number with so many digits; powers of ten only where it would be very long."""
    rounded = float(f"{value:.{digits}g}")
    return f"{rounded:.10g}" if 1e-4 <= abs(rounded) < 1e7 or rounded == 0 else f"{value:.{digits}g}"


@dataclass(frozen=True)
class Listing:
    """Rows of figures; written as CSV and shown in the report."""

    head: tuple[str, ...]
    rows: tuple[tuple[str | float | int, ...], ...]
    caption: str = ""

    @classmethod
    def of(cls, caption: str, **columns: Any) -> Listing:
        """Rows of columns by their heads; a text or a number stands in every row, yes and no become 1 and 0."""
        lists = {head: v.tolist() if isinstance(v, np.ndarray) else v for head, v in columns.items()}
        count = next(len(v) for v in lists.values() if isinstance(v, list | tuple))
        filled = (v if isinstance(v, list | tuple) else [v] * count for v in lists.values())
        cells = ([int(v) if isinstance(v, bool) else v for v in column] for column in filled)
        return cls(tuple(columns), tuple(zip(*cells)), caption)


@dataclass(frozen=True, eq=False)
class Findings:
    """What one analysis found."""

    figures: tuple[Figure, ...] = ()
    refused: Mapping[str, str] = field(default_factory=dict)
    """Figures that the data do not allow, and why, one sentence each."""
    tables: Mapping[str, Listing] = field(default_factory=dict)
    """By the stem of their CSV file."""
    plots: tuple[Chart | Plate, ...] = ()
    notes: tuple[str, ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict)
    """More plain values for JSON."""
    files: Mapping[str, bytes | Listing | NDArray[Any]] = field(default_factory=dict)
    """More files by name, written beside the tables: contents, a table, or an image of type float32."""


def joined(outcomes: Sequence[Findings]) -> Findings:
    """Several outcomes (of planes, of wavelengths) as one; later tables of one name are put below earlier ones."""
    tables: dict[str, Listing] = {}
    for outcome in outcomes:
        for name, table in outcome.tables.items():
            known = tables.get(name)
            rows = table.rows if known is None else known.rows + table.rows
            tables[name] = Listing(table.head, rows, table.caption)
    return Findings(
        figures=tuple(f for o in outcomes for f in o.figures),
        refused={key: why for o in outcomes for key, why in o.refused.items()},
        tables=tables,
        plots=tuple(p for o in outcomes for p in o.plots),
        notes=tuple(dict.fromkeys(n for o in outcomes for n in o.notes)),
        details={key: value for o in outcomes for key, value in o.details.items()},
        files={name: content for o in outcomes for name, content in o.files.items()},
    )
