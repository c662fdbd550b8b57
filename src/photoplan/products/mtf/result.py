"""Results of MTF measurements: edges, their means by direction, channel and place, as values, tables and JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.findings import Findings, Result, Table
from photoplan.plain import pick
from photoplan.quality.curves import MtfCurve, SpreadFunction
from photoplan.quality.edges.find import REASONS
from photoplan.quality.edges.groups import CombinedValue, Enhancement, GaussianFit
from photoplan.quality.edges.response import EdgeMeasurement, spread_of_edge
from photoplan.quality.restoration.design import point_spread

#: Of a measured edge, in JSON under their own names.
_FIGURES = ("angle_deg", "length", "sampling", "dark", "bright", "snr", "mtf50", "mtf50_interval", "mtf10",
            "mtf10_interval", "fwhm", "fwhm_interval", "gaussian_fwhm", "overshoot", "overshoot_sigma", "undershoot",
            "undershoot_sigma", "window", "beyond", "beyond_sigma")  # fmt: skip


@dataclass(frozen=True, eq=False)
class MeasuredEdge:
    """One edge in one channel."""

    number: int
    """From 1; the same edge in another channel has the same number."""
    line: int
    """Number of the straight line that it is a part of: long ones are measured in parts."""
    ends: tuple[tuple[float, float], tuple[float, float]]
    """Column and row of both ends."""
    half: int
    """Pixels reach so far to both sides."""
    aligned: bool
    """It crosses less than a row or column along its length."""
    channel: int
    """0: luminance, else the band."""
    band: str
    """The channel's name."""
    flight: str | None
    """``along`` or ``across`` the flight direction; None if that was not told."""
    measured: EdgeMeasurement
    """Profile, MTF and figures, in pixels of the image."""

    @property
    def col(self) -> float:
        """Column of its middle."""
        return self.measured.col

    @property
    def row(self) -> float:
        """Row of its middle."""
        return self.measured.row

    @property
    def direction(self) -> str:
        """``x``: brightness changes along the rows, the spread function in x is measured; ``y``: along the columns."""
        return self.measured.direction

    def json_fields(self) -> dict[str, Any]:
        """The figures, without profiles and curves."""
        found = spread_of_edge(self.measured)
        return {
            **pick(self, "number", "line", "col", "row", "ends", "band", "direction", "aligned"),
            **pick(self, flight_direction="flight", half_width="half"),
            **pick(self.measured, *_FIGURES, modulation_at_half="nyquist"),
            "spread": [] if found is None else found.spread.values,
            "spread_beyond": None if found is None else found.beyond,
        }


@dataclass(frozen=True, eq=False)
class LabComparison:
    """Values of a laboratory beside those of a mean curve."""

    frequency: NDArray[np.float64]
    """Cycles per pixel, shape (n,)."""
    laboratory: NDArray[np.float64]
    measured: NDArray[np.float64]
    """NaN beyond the curve."""

    @property
    def rms(self) -> float:
        """Root mean square of the differences; NaN if there is no common frequency."""
        known = np.isfinite(self.measured)
        return float(np.sqrt(np.mean((self.measured - self.laboratory)[known] ** 2))) if known.any() else float("nan")

    def json_fields(self) -> dict[str, Any]:
        """With the difference."""
        return pick(self, "laboratory", "measured", cycles_per_px="frequency", rms_difference="rms")


@dataclass(frozen=True, eq=False)
class EdgeGroup:
    """The mean of the edges of a channel, in a direction or in all, in a cell of the field or in all."""

    channel: int
    band: str
    direction: str | None
    """``x``, ``y``; None: both together."""
    flight: str | None
    """``along``, ``across``; None: both together or not known."""
    cell: tuple[int, int] | None
    """Row and column of the cell of the field; None: the whole field."""
    bounds: tuple[float, float, float, float] | None
    """First column, first row, last column and row of the cell."""
    mtf50: CombinedValue
    mtf10: CombinedValue
    fwhm: CombinedValue
    overshoot: CombinedValue
    undershoot: CombinedValue
    mtf50_range: tuple[float, float, float]
    """Quantiles 0.1, 0.5 and 0.9 of the edges' MTF50."""
    curve: MtfCurve
    gaussian: GaussianFit
    spread: tuple[CombinedValue, ...]
    """Shares of light on the pixel itself and on those 1, 2, 3 pixels away (Kölbl's Z, A, B …); empty unless for one
    direction."""
    laboratory: LabComparison | None

    def json_fields(self) -> dict[str, Any]:
        """The figures flat, the curve as an object."""
        return {
            **pick(self, "band", "direction", "laboratory", flight_direction="flight", mtf50_quantiles="mtf50_range"),
            "cell": self.cell and {"row": self.cell[0], "col": self.cell[1], "bounds": self.bounds},
            "edges": self.mtf50.edges,
            **_combined("mtf50", self.mtf50),
            **_combined("mtf10", self.mtf10),
            **_combined("fwhm", self.fwhm),
            "overshoot": self.overshoot.value,
            "undershoot": self.undershoot.value,
            "gaussian": {"fwhm": self.gaussian.fwhm, "rms_difference": self.gaussian.rms},
            "spread": [share.value for share in self.spread],
            "spread_sigma": [share.sigma for share in self.spread],
            "curve": pick(self.curve, "modulation", "sigma", cycles_per_px="frequency"),
        }


def _combined(name: str, value: CombinedValue) -> dict[str, Any]:
    return {
        name: value.value,
        f"{name}_interval": value.interval,
        f"{name}_sigma": value.sigma,
        f"{name}_scatter": value.scatter,
    }


@dataclass(frozen=True, eq=False)
class ImageMtf:
    """Measurements in one image."""

    name: str
    file: Path
    size: tuple[int, int]
    linearisation: str
    """In words."""
    edges: tuple[MeasuredEdge, ...]
    groups: tuple[EdgeGroup, ...]
    """The first is that of all edges of the first channel."""
    enhancement: Enhancement
    found: int
    """Edges that could have been measured; at most as many as asked for were."""
    grid: int
    """Cells of the field in each direction."""
    rejected: dict[str, int]
    """Number of edges that were rejected, by reason."""
    notes: tuple[str, ...]

    @property
    def total(self) -> EdgeGroup:
        """All edges of the first channel."""
        return self.groups[0]

    def cells_of(self, channel: int) -> list[EdgeGroup]:
        """Groups of a channel in the cells of the field."""
        return [g for g in self.groups if g.channel == channel and g.cell is not None]

    def json_fields(self) -> dict[str, Any]:
        """With the point spread function of both directions together."""
        return {
            **pick(self, "file", "size", "linearisation", "edges", "enhancement", "rejected", "notes"),
            **pick(self, image="name", summary="groups", edges_found="found"),
            "point_spread": point_spread_of(self.groups),
        }

    @property
    def found_here(self) -> Findings:
        """The means over the whole field, with how many edges there are."""
        number = len({edge.number for edge in self.edges})
        title = f"{self.name}: {number} {'edge' if number == 1 else 'edges'} of {self.found} · {self.linearisation}"
        return Findings(tables={"means": means(self.groups)}, title=title)


def point_spread_of(groups: Sequence[EdgeGroup]) -> list[list[float]] | None:
    """Point spread function of the first channel from both directions' shares; None if one is not known."""
    shares = {
        group.direction: [share.value for share in group.spread if isfinite(share.value)]
        for group in groups
        if group.cell is None and group.channel == groups[0].channel and group.spread
    }
    if not shares.get("x") or not shares.get("y"):
        return None
    both = (SpreadFunction.symmetric(shares[name]) for name in ("x", "y"))
    return [[round(float(v), 6) for v in row] for row in point_spread(*both)]


def means(groups: Sequence[EdgeGroup]) -> Table:
    """Return the means over the whole field as a table."""
    head = (
        "edges of",
        "MTF50 cy/px",
        "95 % interval",
        "MTF10",
        "FWHM px",
        "Gaussian px",
        "rms",
        "edges",
        "Z",
        "A",
        "B",
    )
    rows = []
    for group in groups:
        if group.cell is not None:
            continue
        low, high = group.mtf50.interval
        flight = "" if group.flight is None else f" ({group.flight} flight)"
        shares = [f"{share.value:.3f}" for share in group.spread[:3]]
        rows.append((
            f"{group.band} {group.direction or 'all'}{flight}", f"{group.mtf50.value:.4f}", f"{low:.4f} – {high:.4f}",
            _number(group.mtf10.value), _number(group.fwhm.value), f"{group.gaussian.fwhm:.2f}",
            f"{group.gaussian.rms:.3f}", str(group.mtf50.edges), *shares, *[""] * (3 - len(shares)),
        ))  # fmt: skip
    return Table(head, tuple(rows), printed=True)


def _number(value: float) -> str:
    return f"{value:.3f}" if isfinite(value) else "–"


def rejected_words(rejected: dict[str, int]) -> str:
    """Return the numbers of edges that were rejected, by reason, the most frequent first; empty if none was."""
    ordered = sorted(rejected.items(), key=lambda item: -item[1])
    return ", ".join(f"{count} {REASONS.get(reason, reason)}" for reason, count in ordered if count)


@dataclass(frozen=True, eq=False)
class MtfReport(Result):
    """Edges of all images, and their means."""

    images: tuple[ImageMtf, ...]
    failed: dict[str, str]
    """Reasons of the failures, by name of the image."""
    groups: tuple[EdgeGroup, ...]
    """Means over the edges of all images; the first is that of all edges of the first channel."""
    enhancement: Enhancement | None
    """By the edges of all images; None if there is none."""
    linearisation: str
    pixel_um: float | None
    flight: str | None
    csv: Path | None

    def json_fields(self) -> dict[str, Any]:
        """Means in cycles per millimetre too, where the distance of pixels is known."""
        return {
            **pick(self, "linearisation", "flight", "enhancement", "csv", pixel_size_um="pixel_um"),
            "images": [{**image.json_fields(), "summary": self._summary(image.groups)} for image in self.images],
            "summary": self._summary(self.groups),
            "failed": [{"image": name, "reason": reason} for name, reason in self.failed.items()],
        }

    def outcome(self) -> list[Findings]:
        """Return the means of each image, and of all together."""
        found = [image.found_here for image in self.images]
        if len(self.images) > 1:
            title = f"all {len(self.images)} images"
            found.append(Findings(tables={"means": means(self.groups)}, title=title))
        return found

    def remarks(self) -> list[str]:
        """Return the notes of each image, and of all together."""
        notes = [f"{image.name}: {note}" for image in self.images for note in image.notes]
        if len(self.images) > 1 and self.enhancement is not None and self.enhancement.enhanced:
            notes.append(f"all images: {self.enhancement.warning}")
        return notes

    def _summary(self, groups: Sequence[EdgeGroup]) -> list[dict[str, Any]]:
        if self.pixel_um is None:
            return [group.json_fields() for group in groups]
        per_mm = 1000.0 / self.pixel_um
        return [
            group.json_fields()
            | {"mtf50_cycles_per_mm": per_mm * group.mtf50.value, "mtf10_cycles_per_mm": per_mm * group.mtf10.value}
            for group in groups
        ]

    @property
    def csv_rows(self) -> tuple[Sequence[str], list[list[object]]]:
        """Header and a row for each edge."""
        header = [*_COLUMNS]
        rows = [
            [image.name, *(_field(values[name]) for name in header[1:])]
            for image in self.images
            for values in (_flat(edge) for edge in image.edges)
        ]
        return header, rows


_COLUMNS = (
    "image",
    "number",
    "line",
    "col",
    "row",
    "band",
    "direction",
    "flight_direction",
    "angle_deg",
    "length",
    "half_width",
    "aligned",
    "dark",
    "bright",
    "snr",
    "mtf50",
    "mtf50_low",
    "mtf50_high",
    "mtf10",
    "fwhm",
    "fwhm_low",
    "fwhm_high",
    "overshoot",
    "undershoot",
)


def _flat(edge: MeasuredEdge) -> dict[str, Any]:
    values = edge.json_fields()
    for name in ("mtf50", "fwhm"):
        values[f"{name}_low"], values[f"{name}_high"] = values[f"{name}_interval"]
    return values


def _field(value: object) -> object:
    """A field of the table: empty for what is not known."""
    if isinstance(value, float | np.floating):
        return f"{float(value):.6g}" if isfinite(value) else ""
    return "" if value is None else value
