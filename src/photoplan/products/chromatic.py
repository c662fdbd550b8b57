"""Lateral chromatic aberration of images: measured on their own discs or edges, kept in files, corrected."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import Window
from photoplan.io.quality_files import read_chromatic, write_chromatic
from photoplan.io.raster import RasterReader
from photoplan.plain import pick, plain
from photoplan.quality.colour import (
    BandModel,
    ChromaticModel,
    Displacements,
    disc_displacements,
    edge_displacements,
    find_discs,
    fit_band,
    patch_displacements,
)
from photoplan.quality.edges.find import EdgePicture, find_edges

#: Side of the parts in which edges are sought, pixels; it bounds memory.
_PART = 2048
#: Pixels of a band in which discs are sought at once.
_MOST_DISC_PIXELS = 60_000_000
#: Edges that are used of a part, the best ones.
_MOST_EDGES = 300
#: Windows that are matched in an image, evenly spread.
_MOST_WINDOWS = 600
#: Discs from which on an image counts as a chart.
_CHART = 12

_Grey = NDArray[np.float64]
_OfPart = Callable[[_Grey, _Grey, float, int], Displacements]
"""Displacements of a part of a band: reference, band, saturation, number of parts of the image."""


@dataclass(frozen=True)
class ChromaticRequest:
    """How lateral chromatic aberration is measured."""

    image: Path
    reference: int | None = None
    """Band that stays; None: the second (green) of three and more, else the first."""
    method: Literal["auto", "discs", "windows", "edges"] = "auto"
    """``auto``: discs where the image shows twelve and more, else windows that are matched, else straight edges."""
    kind: str | None = None
    """A name of `photoplan.quality.colour.KINDS`; None: chosen by cross-validation."""


def measure_chromatic(request: ChromaticRequest) -> ChromaticModel:
    """Measure where the bands of an image lie against its reference band.

    Raises
    ------
    UsageError
        The reference is no band of the image.
    InputError
        The image has a single band, or shows nothing that can be measured in all bands; the message says what was
        found.
    """
    source = RasterReader(request.image)
    if source.bands < 2:
        raise InputError(
            f"{request.image}: has a single band; lateral chromatic aberration is a difference between bands: give an "
            "image with its colours"
        )
    reference = request.reference or (2 if source.bands >= 3 else 1)
    if not 1 <= reference <= source.bands:
        raise UsageError(f"{request.image}: reference band {reference}; the image has {source.bands}")
    others = [band for band in range(1, source.bands + 1) if band != reference]
    try:
        method, measured = _measured(source, request.method, reference, others)
        bands = tuple(fit_band(band, source.size, measured[band], request.kind) for band in others)
    except InputError as error:
        raise type(error)(f"{request.image}: {error}") from None
    return ChromaticModel(source.size, reference, bands, f"{method} of {request.image.name}")


def measured_once(image: Path) -> ChromaticModel:
    """What `measure_chromatic` says of an image; an image that did not change since is not measured again."""
    try:
        state = image.stat()
    except OSError:
        return measure_chromatic(ChromaticRequest(image))
    return _known(image.resolve(), (state.st_mtime_ns, state.st_size))


@lru_cache(maxsize=64)
def _known(image: Path, state: tuple[int, int]) -> ChromaticModel:
    return measure_chromatic(ChromaticRequest(image))


def _measured(
    source: RasterReader, method: str, reference: int, others: list[int]
) -> tuple[str, dict[int, Displacements]]:
    """By which method, and the displacements of each band."""
    ways: dict[str, Callable[[], dict[int, Displacements]]] = {
        "discs": lambda: _by_discs(source, reference, others, 4 if method == "discs" else _CHART),
        "windows": lambda: _by_parts(source, reference, others, _windows_of),
        "edges": lambda: _by_parts(source, reference, others, _edges_of),
    }
    if method != "auto":
        return method, ways[method]()
    told = []
    for name, measure in ways.items():
        try:
            return name, measure()
        except InputError as error:
            told.append(f"by {name}: {error}")
    raise InputError("; ".join(told))


def _by_discs(source: RasterReader, reference: int, others: list[int], least: int) -> dict[int, Displacements]:
    width, height = source.size
    if width * height > _MOST_DISC_PIXELS:
        raise InputError(
            f"{width} × {height} pixels; discs are sought in at most {_MOST_DISC_PIXELS:,} at once: measure a part"
        )
    pixels, valid = source.read(Window(0, 0, width, height))
    found = {}
    for band in (reference, *others):
        grey: NDArray[Any] = pixels[band - 1]
        if valid is not None:
            grey = np.where(valid, grey.astype(np.float64), np.nan)
        try:
            found[band] = find_discs(grey, _saturation(source))
        except InputError as error:
            raise InputError(f"band {band}: {error}") from None
        if len(found[band]) < least:
            raise InputError(f"band {band}: {len(found[band])} discs; a chart shows at least {least}")
    return {band: disc_displacements(found[reference], found[band]) for band in others}


def _saturation(source: RasterReader) -> float:
    return float(np.iinfo(source.dtype).max) if source.dtype.kind in "iu" else float("inf")


def _by_parts(source: RasterReader, reference: int, others: list[int], measure: _OfPart) -> dict[int, Displacements]:
    """Displacements of each band from all parts of an image."""
    parts = list(Window(0, 0, *source.size).tiles(_PART))
    gathered: dict[int, list[Displacements]] = {band: [] for band in others}
    why = dict.fromkeys(others, "")
    for number, window in enumerate(parts):
        pixels, valid = source.read(window)
        bands = pixels.astype(np.float64)
        if valid is not None:
            bands[:, ~valid] = np.nan
        if not np.isfinite(bands).any() or min(bands.shape[1:]) < 24:
            continue
        for band in others:
            try:
                found = measure(bands[reference - 1], bands[band - 1], _saturation(source), len(parts))
            except InputError as error:
                why[band] = str(error)
                continue
            place = found.place + np.array([window.col, window.row])
            group = found.group + 100_000 * number
            gathered[band].append(
                Displacements(place=place, direction=found.direction, value=found.value, sigma=found.sigma, group=group)
            )
    for band in others:
        if not gathered[band]:
            raise InputError(f"band {band}: {why[band] or 'no part of the image is large enough'}")
    return {band: _joined(found) for band, found in gathered.items()}


def _edges_of(base: _Grey, other: _Grey, limit: float, parts: int) -> Displacements:
    valid = np.isfinite(base)
    grey = np.nan_to_num(base).astype(np.float32)
    edges, _ = find_edges(EdgePicture(grey, None if valid.all() else valid, base >= limit))
    return edge_displacements(base, other, sorted(edges, key=lambda e: -e.merit)[:_MOST_EDGES], limit)


def _windows_of(base: _Grey, other: _Grey, limit: float, parts: int) -> Displacements:
    return patch_displacements(base, other, limit, most=max(25, _MOST_WINDOWS // parts))


def _joined(parts: list[Displacements]) -> Displacements:
    return Displacements(
        *(np.concatenate([getattr(p, n) for p in parts]) for n in ("place", "direction", "value", "sigma", "group"))
    )


def load_chromatic(path: Path) -> ChromaticModel:
    """The model of a file."""
    entries = read_chromatic(path)
    try:
        nan = float("nan")
        stated = [{**dict(each), "residual": nan if each.residual is None else each.residual} for each in entries.bands]
        bands = tuple(BandModel(**each) for each in stated)
        return ChromaticModel(entries.image_size, entries.reference, bands, entries.description)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def save_chromatic(path: Path, model: ChromaticModel) -> None:
    """Write a model; raises as `photoplan.io.store.write_atomically`."""
    contents = {"image_size": model.size, **pick(model, "reference", "description")}
    keys = ("band", "kind", "terms", "sigmas", "residual", "count", "rejected")
    write_chromatic(path, contents, [pick(band, *keys) for band in model.bands])


def model_figures(model: ChromaticModel) -> dict[str, Any]:
    """A model as plain values for JSON and records."""
    keys = ("band", "kind", "residual", "count", "rejected", "terms", "sigmas")
    bands = [
        {
            **pick(band, *keys, tried="trials"),
            "shift": _middle(model, band.band),
            "corner": model.corner(band.band),
            "largest": model.largest(band.band),
        }
        for band in model.bands
    ]
    found: dict[str, Any] = plain({**pick(model, "description", "reference", image_size="size"), "bands": bands})
    return found


def model_lines(model: ChromaticModel) -> list[str]:
    """A model in words, a line for each band, with the criterion that chose it."""
    lines = []
    for band in model_figures(model)["bands"]:
        text = (
            f"band {band['band']} against {model.reference}: {band['kind']}, shift {band['shift'][0]:+.3f} "
            f"{band['shift'][1]:+.3f} px, {band['corner']:+.3f} px more in the corners"
        )
        if band["residual"] is not None:
            text += f"; residuals {band['residual']:.3f} px of {band['count'] - band['rejected']} {model.description}"
        if band["tried"]:
            predicted = ", ".join(f"{t['kind']} {t['predicted']:.3f}" for t in band["tried"])
            text += f"; errors of prediction: {predicted} px"
        lines.append(text)
    return lines


def _middle(model: ChromaticModel, band: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    w, h = model.size
    return model.displacement(band, np.array((w - 1) / 2.0), np.array((h - 1) / 2.0))
