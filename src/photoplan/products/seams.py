"""Seams of a mosaic: where to join its images so that the seams are least visible."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.engine.execute import MOST_SOURCE_BYTES
from photoplan.engine.executors import executor_factory, threads
from photoplan.engine.run import Steps, steps, tiles_in_flight
from photoplan.errors import GeometryError
from photoplan.events import SILENT, Events
from photoplan.findings import Result, noted
from photoplan.geometry.grid import MapGrid, Window
from photoplan.io.disk import make_folder
from photoplan.io.product import check_output
from photoplan.io.project.model import Project
from photoplan.io.store import (
    ResultLog,
    input_entry,
    run_key,
    run_times,
    scratch,
    together,
    when_named,
    write_run_record,
)
from photoplan.io.vector_layer import check_vectors, label_polygons, read_regions, write_regions
from photoplan.plain import counted
from photoplan.products.balance import Survey, shown, survey
from photoplan.products.plausibility import one_colour_told
from photoplan.products.run import BASE_MEMORY, load_on_target, question
from photoplan.project.scene import Attempts, SceneAddress, input_files, refuse_unusable
from photoplan.radiometry.seams import AROUND, find_seams, standing_out, without_overlap
from photoplan.radiometry.shown import ArrayStore, SeamFeatures, SeamLayer, Shown, features_of
from photoplan.requests.ortho import SeamsRequest
from photoplan.surfaces.objects import painted_surface
from photoplan.targets.map import MapTarget

#: What seams cost where ground stands out, and the side of the parts in which that is looked at.
_COSTS, _PART = 3.0, 1024
#: Bytes that a pixel and band of an image takes while it is looked at, and a pixel of the map.
_PIXEL, _MAP = 60, 24


@dataclass(frozen=True, eq=False)
class SeamsReport(Result):
    """What was found."""

    survey: Survey
    notes: tuple[str, ...]
    path: Path | None = None
    """None after a dry run, as all that follows."""
    shapes: dict[str, Any] | None = None
    """Multipolygon of each image that has one."""
    differences: tuple[float | None, float | None] | None = None
    """Mean difference at a pixel of seam: halfway between the images, and as found; grey values. None: no seam."""
    unusable: Mapping[str, str] = field(default_factory=dict)
    """Images that are left out since their files cannot be used, and why; they are among the notes."""

    def json_fields(self) -> dict[str, Any]:
        """Figures by name."""
        grid = self.survey.grid
        facts: dict[str, Any] = {"images": self.survey.names, "resolution": grid.resolution, "notes": self.notes}
        if self.shapes is None or self.differences is None:
            return facts
        halfway, found = self.differences
        areas = {name: shape.area for name, shape in self.shapes.items()}
        return {**facts, "path": self.path, "halfway": halfway, "found": found, "areas_m2": areas}

    def summary(self) -> Sequence[str]:
        """Return how many images are joined, and how much they differ along the seams."""
        grid, names = self.survey.grid, self.survey.names
        if self.shapes is None or self.differences is None:
            return [f"{counted(len(names), 'image')} on {grid.width} × {grid.height} pixels of {grid.resolution:g} m"]
        halfway, best = self.differences
        along = "no seams"
        if best is not None and halfway is not None:
            along = f"fine detail of the two images along seams differs by {best:.2f} grey values"
            along += f", halfway between them by {halfway:.2f}"
        return [f"{len(self.shapes)} of {len(names)} images joined at {grid.resolution:g} m · {along}"]

    def messages(self) -> Sequence[str]:
        """Return the notes."""
        return noted(self.notes)

    def raise_failures(self) -> None:
        """Name the images that could not be used."""
        refuse_unusable(self.unusable, len(self.survey.names) + len(self.survey.blind))


def make_seams(request: SeamsRequest, events: Events = SILENT) -> SeamsReport:
    """Find where the images of a project are best joined, and write the regions.

    What images show and parts that are solved are kept beside the output till it is complete: a run that was killed or
    interrupted goes on.

    Raises
    ------
    UsageError
        The output exists, an option cannot be, or `memory` does not suffice.
    InputError
        An input cannot be used, or images differ in bands or type of pixels.
    GeometryError
        No two images see the same terrain.
    """
    times, project = run_times(), load_on_target(request)
    files = [*input_files(project), *([request.keep] if request.keep else [])]
    check_output(request.product, files, overwrite=request.overwrite)
    check_vectors(request.product)
    executor_factory(request.executor, request.workers)
    attempts = Attempts(project, request.images or None)
    for attempt in attempts:
        with attempt as usable:
            report = _make(request, times, events, usable)
    return replace(report, unusable=attempts.left_out)


def _make(request: SeamsRequest, times: Callable[[], dict[str, Any]], events: Events, project: Project) -> SeamsReport:
    """Find the seams of a project without images that cannot be used."""
    names = project.select(request.images or None)
    found = survey(project, names, request.resolution, request.bounds, events)
    files = [*input_files(project.alone(found.names)), *([request.keep] if request.keep else [])]
    notes = tuple(f"left out: {line}" for line in found.blind)
    images = _images(found)
    kept = BASE_MEMORY + _MAP * found.grid.window.size
    workers = tiles_in_flight(request.workers, request.memory, kept, _image_bytes(found, images))
    if request.dry_run:
        return SeamsReport(found, notes)
    make_folder(request.product.parent)
    settings = {"resolution": found.grid.resolution, "images": list(found.names)}
    inputs = [input_entry(file) for file in files]
    key = run_key("seams", settings, inputs)
    with together(), ResultLog.beside(request.product, key, locked=False) as log:
        layers = _read(request.replace(workers=workers), found, images, log, events)
        notes += _odd(found, layers, log)
        with threads(workers) as pool:
            run = Steps(request.product.name, pool, events, log, root="seams")
            labels, differences = _seams(request, found, layers, log, run, events, notes)
        polygons = label_polygons(labels.astype(np.int32), found.grid)
        shapes = {row: _multi(shape) for row, shape in sorted(polygons.items())}
        write_regions(request.product, found.names, shapes, found.grid.crs)
        named = {found.names[row - 1]: shape for row, shape in shapes.items()}
        report = SeamsReport(survey=found, notes=notes, path=request.product, shapes=named, differences=differences)
        ran = {"workers": request.workers, "executor": request.executor, "memory": request.memory, **times()}
        write_run_record(
            request.product, key=key, inputs=inputs, run=ran, kind="seams", product=report, settings=settings
        )
        when_named(log.remove)
    return report


def _read(
    request: SeamsRequest, found: Survey, images: Sequence[_Image], log: ResultLog, events: Events
) -> list[tuple[SeamLayer, ...] | float | None]:
    """What all images show, in the log."""

    def kept(made: tuple[SeamFeatures, ...] | float | None) -> tuple[SeamLayer, ...] | float | None:
        return tuple(each.kept(log) for each in made) if isinstance(made, tuple) else made

    events.begin("reading", len(found.looked), "images")
    asked = question((file for one in found.looked for file in one.scene.files), request.product.parent)
    parcels = partial(scratch, request.product.parent)
    with steps(
        request.product.name, request.workers, events, log, executor=request.executor, question=asked, scratch=parcels
    ) as run:
        return list(run(_Map(found.grid, found.tiles.side), images, kept=kept))


def _seams(
    request: SeamsRequest,
    found: Survey,
    images: Sequence[tuple[SeamLayer, ...] | float | None],
    store: ArrayStore,
    run: Steps,
    events: Events,
    notes: Sequence[str],
) -> tuple[NDArray[np.uint16], tuple[float | None, float | None]]:
    """The image of each pixel of the map, and the differences of a report."""
    layers = [each if isinstance(each, tuple) else () for each in images]
    if not sum(map(bool, layers)) > 1:
        told = "\n  ".join(["fewer than two images show anything of the terrain; there is nothing to join", *notes])
        raise GeometryError(told)
    grid = found.grid
    fixed = None if request.keep is None else read_regions(request.keep, found.names, grid).rows(grid.window)
    events.begin("finding seams", 0, "parts")
    labels, *means = find_seams(layers, store, _weight(found), fixed, run=run)
    halfway, best = (None if np.isnan(mean) else mean for mean in means)
    return labels, (halfway, best)


def _odd(found: Survey, images: Sequence[tuple[SeamLayer, ...] | float | None], store: ArrayStore) -> tuple[str, ...]:
    """A line for each image that has no seam: all of one colour, or without another beside it."""
    notes, shape = [], (found.grid.height, found.grid.width)
    alone = without_overlap([each if isinstance(each, tuple) else () for each in images], store, shape)
    for name, each, apart in zip(found.names, images, alone):
        if isinstance(each, float):
            notes.append(f"left out: {one_colour_told(name, each)}")
        elif apart:
            notes.append(f"no overlap with other images: {name!r}; if it should have one, look at its orientation")
    return tuple(notes)


@dataclass(frozen=True)
class _Image:
    """An image as a worker gets it, and what of the map it may show."""

    scene: SceneAddress
    windows: tuple[Window, ...]

    @property
    def box(self) -> tuple[int, int, int, int]:
        """Left, top, width and height of the box around its windows."""
        left, top = min(w.col for w in self.windows), min(w.row for w in self.windows)
        return left, top, max(w.stop[0] for w in self.windows) - left, max(w.stop[1] for w in self.windows) - top


@dataclass(frozen=True)
class _Map:
    """From an image to what it shows of a map."""

    grid: MapGrid
    side: int
    """Of the map's tiles, pixels."""

    def __call__(self, one: _Image) -> tuple[SeamFeatures, ...] | float | None:
        """All that it shows, tile by tile, put together; one grey value if it has no other; None: it shows nothing."""
        if not one.windows:
            return None
        scene, (left, top, width, height) = one.scene.open(), one.box
        values = np.zeros((scene.reader.bands, height, width), np.float32)
        valid = np.zeros(values.shape[1:], np.bool_)
        for window in one.windows:
            made = shown(scene, self.grid, window, self.side)
            if made.values is not None and made.valid is not None:
                at = np.s_[window.row - top : window.stop[1] - top, window.col - left : window.stop[0] - left]
                values[(slice(None), *at)], valid[at] = made.values, made.valid
        if not valid.any():
            return None
        grey = values[:, valid]
        if grey.min() == grey.max():
            return float(grey[0, 0])
        rows, cols = (np.flatnonzero(valid.any(axis=axis)) for axis in (1, 0))
        at = np.s_[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
        return features_of(Shown(top + int(rows[0]), left + int(cols[0]), values[:, *at], valid[at]))


def _images(found: Survey) -> list[_Image]:
    windows: list[list[Window]] = [[] for _ in found.looked]
    for tile in found.tiles:
        for row in tile.sources:
            windows[row].append(tile.window)
    return [_Image(one.scene.address, tuple(mine)) for one, mine in zip(found.looked, windows)]


def _image_bytes(found: Survey, images: Sequence[_Image]) -> int:
    """What one image at a time takes at most, beside what all take."""
    pixels = max((one.box[2] * one.box[3] for one in images if one.windows), default=0)
    return 3 * MOST_SOURCE_BYTES + _PIXEL * found.looked[0].scene.reader.bands * pixels


def _weight(found: Survey) -> NDArray[np.float32]:
    """What seams cost at a place: more on what stands out of the ground, whose parallax no picture hides."""
    grid, surface = found.grid, painted_surface(found.looked[0].scene.surface)
    weight = np.ones((grid.height, grid.width), np.float32)
    for part in grid.window.tiles(_PART):
        wide = Window(part.col - AROUND, part.row - AROUND, part.width + 2 * AROUND, part.height + 2 * AROUND)
        relief = surface.relief(MapTarget(grid), wide & grid.window)
        weight[part.slices(grid.window)][standing_out(relief)[part.slices(wide & grid.window)]] = _COSTS
    return weight


def _multi(shape: Any) -> Any:
    return shape if shape.geom_type == "MultiPolygon" else shapely.MultiPolygon([shape])
