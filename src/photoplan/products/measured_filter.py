"""Filters measured in images: point spread of a flight, chromatic aberration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError
from photoplan.events import SILENT, Events
from photoplan.geometry.grid import Window
from photoplan.io.quality_files import read_chromatic, write_chromatic
from photoplan.io.raster import RasterReader
from photoplan.plain import pick, plain
from photoplan.products.mtf.edges import LightImage, measure_edges
from photoplan.products.mtf.result import ImageMtf, MtfReport
from photoplan.project.steps import linearisation_of
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
from photoplan.quality.edges.groups import LEAST_EDGES, sharpness_of
from photoplan.quality.edges.response import EdgeMeasurement
from photoplan.quality.restoration.design import (
    BLOCK,
    Design,
    DesignOptions,
    Sharpness,
    block_noise,
    curve_transfer,
    design_filter,
    image_noise,
    kept_by_compression,
)
from photoplan.quality.restoration.restorer import (
    FilterKernel,
    RestorationFilter,
    SceneStatistics,
    block_spectra,
    scenes_of,
)
from photoplan.requests.quality import MtfRequest, RestoreRequest

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


#: Windows of an image in which its contrast is looked for, in each direction, and their side.
_WINDOWS = 5
_SIDE = 256
#: Share of the blocks of an image that must hold no saturated pixel, for the noise to be looked for in these alone.
_CLEAN = 0.1


@dataclass(frozen=True, eq=False)
class DesignedPart:
    """The filter of one band in one part of the field."""

    band: int | None
    """Its number; None if the filter is for all bands."""
    at: tuple[float, float] | None
    """Column and row of the middle of the part; None: the whole field."""
    edges: int
    """Edges it was measured with."""
    sharpness: tuple[Sharpness, Sharpness]
    """Along rows and along columns."""
    missing: tuple[str, ...]
    """``x`` or ``y`` where no edges show the sharpness along rows or columns and that of the other stands for it."""
    scenes: tuple[SceneStatistics, ...]
    """Scenes that the images may show: more than one if noise and texture cannot be separated."""
    design: Design

    @property
    def scene(self) -> SceneStatistics:
        """The scene that the filter is judged by."""
        return self.design.scene or self.scenes[0]

    def facts(self) -> dict[str, Any]:
        """Figures for the filter's file."""
        return {
            "band": self.band,
            "at": None if self.at is None else list(self.at),
            "edges": self.edges,
            "noise": self.scene.noise,
            "contrast": self.scene.contrast,
            "exponent": round(self.scene.exponent, 3),
            "noise_smoothed": round(self.scene.smoothed, 3),
            "texture": self.scene.texture,
            "mtf50_x": round(self.sharpness[0].modulation().mtf50, 4),
            "mtf50_y": round(self.sharpness[1].modulation().mtf50, 4),
            "spread_x": [round(float(v), 5) for v in self.sharpness[0].spread.side()],
            "spread_y": [round(float(v), 5) for v in self.sharpness[1].spread.side()],
            "condition_x": str(self.design.condition_x),
            "condition_y": str(self.design.condition_y),
            "noise_gain": round(self.design.noise_gain, 3),
            "method": self.design.method,
            "expected_error": {method: float(f"{error:.4g}") for method, error in self.design.expected.items()},
            "rule": self.design.reason,
        }


@dataclass(frozen=True, eq=False)
class MeasuredFilter:
    """A filter and what it was measured with."""

    filter: RestorationFilter
    parts: tuple[DesignedPart, ...]
    mtf: MtfReport
    notes: tuple[str, ...]
    """Remarks: edge enhancement, parts of the field without edges."""

    def lines(self) -> list[str]:
        """Return what was measured, and what to mind, for people."""
        lines = []
        for part in self.parts[:9]:
            name = "all bands" if part.band is None else f"band {part.band}"
            where = "" if part.at is None else f" at column {part.at[0]:.0f}, row {part.at[1]:.0f}"
            sides = ["  ".join(f"{v:.3f}" for v in one.spread.side()[:4]) for one in part.sharpness]
            lines.append(
                f"{name}{where}: {part.edges} edges; spread function along rows {sides[0]}, along columns {sides[1]}; "
                f"{part.design.method}, noise grows {part.design.noise_gain:.1f} times"
            )
        if len(self.parts) > 9:
            lines.append(f"… and {len(self.parts) - 9} more parts; the filter file has them all")
        return lines + list(self.notes)


def design_restoration(request: RestoreRequest, events: Events = SILENT) -> MeasuredFilter:
    """Measure the sharpness of images at their edges, all together, and design the filter that restores them.

    Raises
    ------
    UsageError
        Images of different size or bands: they cannot have one filter.
    InputError
        No image can be used, the edges are too few, or an exact inverse is asked for that does not exist.
    """
    band = "all" if request.per_band else None
    asked = MtfRequest(
        images=request.images,
        linearisation=request.linearisation,
        band=band,
        most_edges=request.most_edges,
        least_length=request.least_length,
        grid=1,
    )
    mtf = measure_edges(asked, events)
    if not mtf.images:
        raise InputError("no image can be measured: " + "; ".join(mtf.failed.values()))
    size = _common_size(mtf.images)
    light = linearisation_of(request.linearisation or "linear")
    opened = [LightImage.open(image.file, light) for image in mtf.images]
    parts: list[DesignedPart] = []
    notes = [f"not measured: {why}" for why in mtf.failed.values()]
    for channel in _channels(mtf.images, request.per_band):
        scene = _spectrum(opened, channel)
        edges = [e.measured for image in mtf.images for e in image.edges if e.channel == channel]
        parts += _parts(request, channel if request.per_band else None, size, edges, scene, notes)
    if mtf.enhancement is not None and mtf.enhancement.enhanced:
        notes.append(mtf.enhancement.warning)
    return MeasuredFilter(_filter(request, parts, size), tuple(parts), mtf, tuple(notes))


def _common_size(images: Sequence[ImageMtf]) -> tuple[int, int]:
    sizes = {image.size for image in images}
    if len(sizes) > 1:
        listed = ", ".join(f"{w} × {h}" for w, h in sorted(sizes))
        raise UsageError(
            f"the images are of different size ({listed}); measure a filter for those of each camera alone"
        )
    return sizes.pop()


def _channels(images: Sequence[ImageMtf], per_band: bool) -> list[int]:
    """Channels that get a filter of their own."""
    channels = sorted({edge.channel for image in images for edge in image.edges})
    return [c for c in channels if c > 0] if per_band else channels[:1]


def _parts(
    request: RestoreRequest,
    band: int | None,
    size: tuple[int, int],
    edges: Sequence[EdgeMeasurement],
    scene: SceneSpectrum,
    notes: list[str],
) -> list[DesignedPart]:
    """The filters of a band: for the whole field, or for each part of it that has edges enough."""
    whole = _designed(request, band, None, edges, scene)
    for axis in whole.missing:
        lacking, other = ("rows", "columns") if axis == "x" else ("columns", "rows")
        notes.append(f"too few edges show the sharpness along {lacking}; that along {other} stands for it")
    if request.cells == 1:
        return [whole]
    n, found = request.cells, []
    poor = 0
    for row in range(n):
        for col in range(n):
            at = ((col + 0.5) * size[0] / n - 0.5, (row + 0.5) * size[1] / n - 0.5)
            here = [edge for edge in edges if _cell(edge, size, n) == (col, row)]
            part = _designed(request, band, at, here, scene, whole)
            poor += part.edges == 0
            found.append(part)
    if poor:
        name = "" if band is None else f"band {band}: "
        notes.append(
            f"{name}{poor} of {n * n} parts of the field have fewer than {LEAST_EDGES} edges along rows and along "
            "columns; they get the filter of the whole field"
        )
    return found


def _cell(edge: EdgeMeasurement, size: tuple[int, int], n: int) -> tuple[int, int]:
    """Column and row of the part of the field that an edge lies in."""
    return int((edge.col + 0.5) * n / size[0]), int((edge.row + 0.5) * n / size[1])


def _options(request: RestoreRequest) -> DesignOptions:
    return DesignOptions(request.method, request.rotation, None if request.size is None else request.size // 2)


def _designed(
    request: RestoreRequest,
    band: int | None,
    at: tuple[float, float] | None,
    edges: Sequence[EdgeMeasurement],
    spectrum: SceneSpectrum,
    whole: DesignedPart | None = None,
) -> DesignedPart:
    """The filter of edges; what a part of the field does not show is taken from the whole."""
    try:
        x, y, missing = sharpness_of(edges)
    except InputError:
        if whole is None:
            raise
        return replace(whole, band=band, at=at, edges=0)
    if whole is not None:
        x = whole.sharpness[0] if "x" in missing or x.doubt else x
        y = whole.sharpness[1] if "y" in missing or y.doubt else y
    transfer = curve_transfer(x.modulation(), y.modulation())
    scenes = whole.scenes if whole is not None else scenes_of(spectrum.power, transfer, spectrum.noise, request.noise)
    design = design_filter(x, y, scenes, _options(request), spectrum.kept)
    return DesignedPart(
        band=band, at=at, edges=len(edges), sharpness=(x, y), missing=missing, scenes=scenes, design=design
    )


@dataclass(frozen=True, eq=False)
class SceneSpectrum:
    """Statistics of the scenes of images, in their light."""

    power: NDArray[np.float64]
    """Mean spectrum of their blocks."""
    noise: float
    """Standard deviation in the most even blocks; 0 if there is none."""
    kept: NDArray[np.float64]
    """Part of the frequencies of a block that compression has left, shape (8, 8)."""


def _spectrum(images: Sequence[LightImage], channel: int) -> SceneSpectrum:
    """Spectrum and noise of images, from windows over the whole of them, in their light."""
    noises: list[list[NDArray[np.float64]]] = [[], []]
    # All blocks, and those without a saturated pixel: number of them, sum of their spectra.
    sums: list[list[Any]] = [[0, 0.0], [0, 0.0]]
    for image in images:
        for window in _windows(image.size):
            picture = image.picture(window, channel)
            grey = picture.grey.astype(np.float64)
            if picture.valid is not None:
                grey[~picture.valid] = np.nan
            usable = [None, None if picture.saturated is None else ~picture.saturated]
            for mask, blocks, total in zip(usable, noises, sums, strict=True):
                blocks.append(block_noise(grey, mask))
                spectra = block_spectra(grey, mask)
                total[0] += len(spectra)
                total[1] = total[1] + spectra.sum(axis=0)
    every, whole = (np.concatenate(blocks) for blocks in noises)
    # A full sky seems to have no noise, and its few pixels below the end seem to be all of it.
    noise = image_noise(whole if whole.size >= _CLEAN * every.size else every)
    count, total = sums[1] if sums[1][0] >= _CLEAN * sums[0][0] else sums[0]
    if count == 0 or not total.any():
        raise InputError("the images have no contrast")
    kept = np.mean([_kept(image, channel) for image in images], axis=0)
    return SceneSpectrum(total / count, noise if np.isfinite(noise) else 0.0, kept)


def _kept(image: LightImage, channel: int) -> NDArray[np.float64]:
    """Return the part of the frequencies that compression has left of an image."""
    size = image.size[0] // BLOCK * BLOCK, image.size[1] // BLOCK * BLOCK
    if image.reader.dtype != np.uint8 or 0 in size:
        return np.ones((BLOCK, BLOCK))
    at = [replace(w, col=w.col // BLOCK * BLOCK, row=w.row // BLOCK * BLOCK) for w in _windows(size)]
    return kept_by_compression(np.array([image.stored(window, channel) for window in at]))


def _windows(size: tuple[int, int]) -> list[Window]:
    """Windows spread over an image."""
    side = min(_SIDE, size[0]), min(_SIDE, size[1])
    places = [
        (round(j * (size[0] - side[0]) / (_WINDOWS - 1)), round(i * (size[1] - side[1]) / (_WINDOWS - 1)))
        for i in range(_WINDOWS)
        for j in range(_WINDOWS)
    ]
    return [Window(*place, *side) for place in sorted(set(places))]


def _where(part: DesignedPart, parts: Sequence[DesignedPart]) -> str:
    """Return which of several parts is meant, and how many are restored how; empty for a single one."""
    if len(parts) == 1:
        return ""
    methods = [one.design.method for one in parts]
    counted = ", ".join(f"{methods.count(each)} {each}" for each in ("exact", "regularised", "none") if each in methods)
    band = [] if part.band is None else [f"band {part.band}"]
    place = [] if part.at is None else [f"at column {part.at[0]:.0f}, row {part.at[1]:.0f}"]
    which = " ".join(band + place)
    return f"of {len(parts)} parts {counted}; the noisiest, {which}: "


def _filter(request: RestoreRequest, parts: Sequence[DesignedPart], size: tuple[int, int]) -> RestorationFilter:
    kernels = tuple(FilterKernel(part.design.kernel, part.at, part.band) for part in parts)
    # Of several parts the one that restoration costs most tells of the condition.
    worst = max(parts, key=lambda part: part.design.noise_gain)
    names = ", ".join(path.name for path in request.images[:3])
    more = f" and {len(request.images) - 3} more" if len(request.images) > 3 else ""
    scale = ", full scale 1" if request.linearisation in (None, "linear", "srgb") else ""
    facts: dict[str, Any] = {
        "condition": _where(worst, parts)
        + f"along rows: {worst.design.condition_x}; along columns: {worst.design.condition_y}",
        "rule": _where(worst, parts) + worst.design.reason,
        "expected": _where(worst, parts) + f"error {worst.design.expectation} (rms in light{scale})",
        "rotation": f"{request.rotation}: weights off the axes follow from those on them",
        "linearisation": request.linearisation or "linear",
        "noise_gain": round(max(part.design.noise_gain for part in parts), 3),
        "parts": [{k: v for k, v in part.facts().items() if v is not None} for part in parts],
    }
    placed = any(part.at is not None for part in parts)
    return RestorationFilter(kernels, size if placed else None, f"measured at edges of {names}{more}", facts)
