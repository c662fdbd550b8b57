"""Colour balance of a project: sampling its images on common ground, adjustment, and tables in files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.least_squares import spread
from photoplan.cameras.base import project as into_image
from photoplan.cameras.curvature import MapProjection
from photoplan.engine.execute import MOST_SOURCE_BYTES, Painted, Source, render
from photoplan.engine.executors import executor_factory
from photoplan.engine.run import steps, tiles_in_flight
from photoplan.errors import GeometryError, InputError, PhotoplanError, UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Result, noted
from photoplan.geometry.crs import crs_step, same_crs
from photoplan.geometry.grid import MapGrid, Window
from photoplan.io.disk import lock_of, make_folder, make_parents
from photoplan.io.product import check_output
from photoplan.io.project.edit import ProjectChanges, edit_project
from photoplan.io.project.model import Project
from photoplan.io.quality_files import BalanceBand, write_balance_file
from photoplan.io.raster import RasterReader
from photoplan.io.raster_info import placement_of
from photoplan.io.store import input_entry, locked, run_key, run_times, scratch, together, write_run_record
from photoplan.io.tables import write_table
from photoplan.plain import counted, pick
from photoplan.plan.anchors import AnchorRule
from photoplan.plan.footprint import Bounds, Tile, Tiles, covered_tiles
from photoplan.plan.product import ProductPlan
from photoplan.plan.sources import InSight
from photoplan.products.orthophoto.mosaic import refuse_mixed
from photoplan.products.orthophoto.plan import Looked, look_at, two_figures
from photoplan.products.plausibility import one_colour_told
from photoplan.products.run import BASE_MEMORY, load_on_target, question, refuse_inputs
from photoplan.project.cameras import is_there
from photoplan.project.scene import Attempts, Scene, SceneAddress, input_files, map_order, open_scene, refuse_unusable
from photoplan.radiometry.balance import Balanced, Pairs, balanced, even_images, pairs_of
from photoplan.radiometry.equations import BLOCK, SIDE, Cells, cells_of
from photoplan.requests.ortho import BalanceRequest
from photoplan.surfaces.base import LevelSurface
from photoplan.surfaces.objects import painted_surface
from photoplan.targets.map import MapTarget

_KERNEL, _TOLERANCE = "bilinear", 0.5


def shown(scene: Scene, grid: MapGrid, window: Window, side: int) -> Painted:
    """Return what an image shows of a window of a map whose tiles have a side; nothing where the ground is hidden."""
    rule = AnchorRule.of(_KERNEL, _TOLERANCE)
    plan = ProductPlan(
        name="shown",
        sources=("image",),
        target=MapTarget(grid),
        rule=rule,
        tiles=Tiles.every(grid.window, side),
        owners=InSight(),
    )
    return render(plan, Tile(0, window, (0,)), scene.sources, scene.surface, _KERNEL)


#: Pairs of neighbours that are looked at, places along both axes of what a pair may have in common, pixels of a window.
_PAIRS, _PLACES, _SIDE = 6, 5, 16
#: Places that a pair must have; the difference that is told, part of the range of grey values.
_LEAST, _TOLD = 5, 0.03
#: A median counts if it is larger than so many times what it may be by chance: its spread over the root of the places.
_SURE = 6.0


def colour_advice(project: Project, names: Sequence[str]) -> str | None:
    """A sentence if neighbouring images differ in colour and have no balance files; None if not, or if that cannot be
    seen from a few windows."""
    plain = [n for n in names if project.any_image(n).balance is None and is_there(_file(project, n))]
    if len(plain) < 2 or len(plain) < len(names):
        return None
    order = [plain[k] for k in map_order(project, plain)]
    at = np.unique(np.linspace(0, len(order) - 2, _PAIRS).astype(int))
    try:
        found = [_difference(open_scene(project, order[k]), open_scene(project, order[k + 1])) for k in at.tolist()]
    except PhotoplanError:
        return None  # What is wrong with a file is said elsewhere.
    known = [each for each in found if each is not None]
    if not known:
        return None
    worst, span = max(known, key=lambda each: each[0] / each[1])
    if worst <= _TOLD * span:
        return None
    return (
        f"colours differ by up to {worst:.0f} of {span:.0f} grey values between neighbours: "
        "`photoplan balance` evens them out before a mosaic"
    )


def _file(project: Project, name: str) -> Path:
    return project.resolve(project.any_image(name).file)


def _difference(one: Scene, other: Scene) -> tuple[float, float] | None:
    """Median difference of two images where they overlap, and the range of grey values; None: not known."""
    a, b = one.footprint.bounds, other.footprint.bounds
    if a is None or b is None or (one.reader.bands, one.reader.dtype) != (other.reader.bands, other.reader.dtype):
        return None
    low, high = np.maximum(a[:2], b[:2]), np.minimum(a[2:], b[2:])
    if not (low < high).all():
        return None
    X, Y = (low[k] + (high[k] - low[k]) * (np.arange(_PLACES) + 0.5) / _PLACES for k in (0, 1))
    XY = np.stack(np.meshgrid(X, Y), axis=-1).reshape(-1, 2)
    XYZ = np.concatenate([XY, one.surface.heights(XY)[:, None]], axis=1)
    first, second = _means(one, XYZ), _means(other, XYZ)
    both = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
    if both.sum() < _LEAST:
        return None
    every = np.concatenate([first[both], second[both]])
    span = 255.0 if one.reader.dtype == np.uint8 else float(np.ptp(every))
    # Of single places a difference may be a shadow or a car; what all of them have is exposure and haze.
    apart = first[both] - second[both]
    middle, chance = np.median(apart, axis=0), spread(apart, None)
    if chance > max(spread(first[both], None), _TOLD * span):
        return None  # The images do not show the same.
    sure = np.abs(middle) > _SURE * np.median(np.abs(apart - middle), axis=0) / np.sqrt(len(apart))
    return float(np.abs(middle * sure).max()), max(span, 1e-9)


def _means(scene: Scene, XYZ: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of each band around ground points (n, 3); NaN where the image does not show them."""
    size = np.array(scene.reader.size)
    out = np.full((len(XYZ), scene.reader.bands), np.nan)
    corners = np.rint(into_image(scene.camera, XYZ)) - _SIDE // 2
    for k in np.flatnonzero(((corners >= 0) & (corners + _SIDE <= size)).all(axis=1)):
        col, row = corners[k].astype(int).tolist()
        pixels, valid = scene.reader.read(Window(col, row, _SIDE, _SIDE))
        if valid is None or valid.all():
            out[k] = pixels.reshape(len(pixels), -1).mean(axis=1)
    return out


_REFERENCE_KERNEL, _REFERENCE_TOLERANCE = "bilinear", 0.1


@dataclass(frozen=True)
class Reference:
    """A raster on the map; small, and pickles: it is opened when it is asked for pixels."""

    path: Path
    crs: str
    bounds: tuple[float, float, float, float]
    """CRS and bounds of the map."""
    pixel: float
    """Side of its pixels, units of its CRS."""

    def pixels(self, grid: MapGrid, window: Window) -> tuple[NDArray[np.float32], NDArray[np.bool_]] | None:
        """Return its pixels in a window of the map, (bands, height, width), and where there are any; None if none."""
        rule = AnchorRule.of(_REFERENCE_KERNEL, _REFERENCE_TOLERANCE)
        plan = ProductPlan(
            name="reference",
            sources=("reference",),
            target=MapTarget(grid),
            rule=rule,
            tiles=Tiles.every(grid.window, 512),
        )
        made = render(plan, Tile(0, window), (_source(self),), LevelSurface(0.0), _REFERENCE_KERNEL)
        if made.values is None or made.valid is None:
            return None
        return made.values.astype(np.float32), made.valid


def open_reference(path: Path, grid: MapGrid, bands: int, dtype: np.dtype[Any]) -> Reference:
    """A reference for images of some bands and type, compared on a map."""
    reader = RasterReader(path)
    if reader.bands != bands or reader.dtype != dtype:
        raise InputError(
            f"{path}: {reader.bands} bands of {reader.dtype}; a reference has those of the images, {bands} of {dtype}: "
            "choose and scale its bands before, for instance with gdal_translate"
        )
    placement = placement_of(reader.info)
    if placement.transform is None or placement.crs is None:
        raise InputError(f"{path}: no georeference or no CRS; a reference is a raster on the map")
    if grid.crs is None:
        raise UsageError(f"{path}: a reference lies on the map; on a target set `reference_image`")
    a, b = placement.coefficients[:2]
    return Reference(path, grid.crs, grid.bounds, float(np.hypot(a, b)))


@lru_cache(maxsize=4)
def _source(reference: Reference) -> Source:
    reader = RasterReader(reference.path)
    placement = placement_of(reader.info)
    assert placement.crs is not None
    apart = not same_crs(placement.crs, reference.crs)
    carry = crs_step(reference.crs, placement.crs, reference.bounds, placement.middle[0]) if apart else None
    return Source(MapProjection(placement, carry), reader)


#: Pixels of the map along the shorter side of an image, unless a resolution is chosen.
ACROSS = 256
#: Cells along the side of a tile.
_CELLS = BLOCK
#: Bytes that a band of an image takes in a cell that it shows till all is written.
_KEPT = 1200


@dataclass(frozen=True, eq=False)
class Survey:
    """The images that see terrain, and the map on which they are compared."""

    looked: tuple[Looked, ...]
    blind: tuple[str, ...]
    """A line for each image that sees none."""
    grid: MapGrid
    tiles: Tiles
    cameras: NDArray[np.int64]
    """Numbers of the images' cameras, (n,): images of one camera have one fall-off."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the images."""
        return tuple(one.name for one in self.looked)

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Width and height of the images, (n, 2)."""
        return np.array([one.scene.reader.size for one in self.looked], np.int64)

    @property
    def tile_bytes(self) -> int:
        """Memory of a tile that is looked at, at most: a window of an image, and all images of the tile."""
        bands = self.looked[0].scene.reader.bands
        return 3 * MOST_SOURCE_BYTES + max(8 * bands * tile.pixels * len(tile.sources) for tile in self.tiles)

    @property
    def kept_bytes(self) -> int:
        """Memory of the cells of all tiles, and of their adjustment."""
        rows = sum(tile.pixels * len(tile.sources) for tile in self.tiles) // SIDE**2
        return _KEPT * self.looked[0].scene.reader.bands * rows


def survey(
    project: Project, names: Sequence[str], resolution: float | None, bounds: Bounds | None, events: Events
) -> Survey:
    """Look at images, and choose the map; no pixel is read."""
    events.begin("planning", len(names), "images")
    looked, blind = look_at(project, names, False, events)
    if len(looked) < 2:
        told = "one image sees" if looked else "no image sees"
        raise GeometryError(f"{told} terrain, two at least are compared:\n  " + "\n  ".join(blind or ["the others"]))
    refuse_mixed(looked)
    if resolution is None:
        coarser = [one.look.gsd * max(1.0, min(one.scene.reader.size) / ACROSS) for one in looked]
        resolution = two_figures(float(np.median(coarser)))
    seen = np.array([one.look.footprint.bounds for one in looked], float)
    extent = bounds or (*seen[:, :2].min(axis=0).tolist(), *seen[:, 2:].max(axis=0).tolist())
    grid = MapGrid.covering(extent, resolution, project.plane_crs)
    taken = []
    for one in looked:
        surface = painted_surface(one.scene.surface)
        taken.append(covered_tiles(one.scene.camera, surface, grid, _CELLS * SIDE, one.look.footprint.bounds))
    # Images without a camera of the project, scenes of satellites for instance, are each their own.
    cameras = [getattr(project.any_image(one.name), "camera", None) or f"\n{one.name}" for one in looked]
    numbers = np.unique(cameras, return_inverse=True)[1].reshape(-1)
    return Survey(looked=tuple(looked), blind=tuple(blind), grid=grid, tiles=Tiles.shared(taken), cameras=numbers)


def sample(found: Survey, reference: Reference | None, workers: int, executor: str, events: Events, at: Path) -> Cells:
    """Return what all images show, cell by cell; tiles are read one by one. `at`: folder of the product."""
    seen = [_Seen(tile, tuple(found.looked[row].scene.address for row in tile.sources)) for tile in found.tiles]
    job = _Sampling(found.grid, found.tiles.side, found.looked[0].scene.reader.bands, reference)
    events.begin("comparing", len(seen), "tiles")
    files = [file for one in found.looked for file in one.scene.files]
    asked = question(files if reference is None else [*files, reference.path], at)
    with steps("balance", workers, events, executor=executor, question=asked, scratch=partial(scratch, at)) as run:
        return Cells.joined(run(job, seen, pixels=lambda each: each.tile.pixels))


@dataclass(frozen=True)
class _Seen:
    """A tile as a worker gets it, and the images that see a part of it."""

    tile: Tile
    scenes: tuple[SceneAddress, ...]


@dataclass(frozen=True)
class _Sampling:
    """Job that makes the cells of a tile."""

    grid: MapGrid
    side: int
    bands: int
    reference: Reference | None

    def __call__(self, seen: _Seen) -> Cells:
        """Cells of a tile, with all images that see a part of it."""
        tile, scenes = seen.tile, {row: address.open() for row, address in zip(seen.tile.sources, seen.scenes)}
        window, values, valid, rows = tile.window, [], [], []
        for row, scene in scenes.items():
            made = shown(scene, self.grid, window, self.side)
            if made.values is not None and made.valid is not None:
                values.append(made.values.astype(np.float32))
                valid.append(made.valid)
                rows.append(row)
        if not rows:
            values, valid = [np.zeros((self.bands, 1, 1), np.float32)], [np.zeros((1, 1), bool)]
        known = None if self.reference is None or not rows else self.reference.pixels(self.grid, window)
        number = tile.index * _CELLS**2
        cells = cells_of(np.stack(values), np.stack(valid), np.array(rows or [0], np.int64), number, known)
        corner = np.array([window.col, window.row])
        return self._placed(replace(cells, place=cells.place + corner, uv=cells.uv + corner.astype(np.float32)), scenes)

    def _placed(self, cells: Cells, scenes: dict[int, Scene]) -> Cells:
        """Cells with their places in the images instead of the map; those that have none are left out."""
        uv = np.full_like(cells.uv, np.nan)
        XY = self.grid.to_map(cells.uv)
        for image in np.unique(cells.image).tolist():
            rows, scene = cells.image == image, scenes[image]
            heights = scene.surface.heights(XY[rows])
            uv[rows] = into_image(scene.camera, np.concatenate([XY[rows], heights[..., None]], axis=-1))
        return replace(cells, uv=uv).some(np.flatnonzero(np.isfinite(uv).all(axis=(1, 2))))


#: Pairs that are listed; all are in the table.
_LISTED = 12
#: What the order of curve and fall-off may change over the block without a note, part of the brightness.
_DOUBTFUL = 0.02


@dataclass(frozen=True, eq=False)
class BalanceReport(Result):
    """Tables of the images, and how well these agree."""

    request: BalanceRequest
    survey: Survey
    notes: tuple[str, ...]
    """Images without tables, and other things that a user should know."""
    cells: Cells | None = None
    """None after a dry run, as all that follows."""
    balanced: Balanced | None = None
    pairs: Pairs | None = None
    files: tuple[Path, ...] = ()
    """Balance files, by image as in `balanced`."""
    unusable: Mapping[str, str] = field(default_factory=dict)
    """Images that are left out since their files cannot be used, and why; they are among the notes."""

    def named(self, number: int) -> str:
        """Name of an image."""
        return self.survey.names[number]

    def rms(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Mean over the pairs of images of their differences before and after, by band, grey values."""
        assert self.pairs is not None
        return self.pairs.before.mean(axis=0), self.pairs.after.mean(axis=0)

    def written(self) -> Sequence[Path]:
        """Return the table of overlaps; the balance files are entries of the project."""
        return () if self.pairs is None else (self.request.table,)

    def summary(self) -> Sequence[str]:
        """Return the differences of the overlaps before and after, the worst first, and what is not determined."""
        grid, pairs, made = self.survey.grid, self.pairs, self.balanced
        if pairs is None or made is None:
            pixels = f"{grid.width} × {grid.height} pixels of {grid.resolution:g} m"
            return [f"{counted(len(self.survey.names), 'image')}, compared on {pixels}"]

        def row(name: str, *values: NDArray[np.float64]) -> str:
            return f"{name:32}" + "".join(f"  {' '.join(f'{value:6.1f}' for value in each):>24}" for each in values)

        count = f"{counted(len(made.images), 'image')}, {counted(len(pairs.images), 'overlap')}"
        head = f"{'':32}  {'before':>24}  {'after':>24}"
        lines = [f"{count} at {grid.resolution:g} m: rms differences, grey values", head]
        lines.append(row("mean of the overlaps", *self.rms()))
        for k in (-pairs.after.mean(axis=1)).argsort()[:_LISTED].tolist():
            both = " – ".join(self.named(i)[-15:] for i in pairs.images[k])
            lines.append(row(both, pairs.before[k], pairs.after[k]))
        if len(pairs.images) > _LISTED:
            lines.append(f"and {len(pairs.images) - _LISTED} more, better ones")
        if made.modes:
            parts = ", ".join(f"{mode.name} {100 * mode.sigma:.1f} %" for mode in made.modes)
            lines.append(f"standard deviations over the block, from its middle to its edge: {parts}")
        if held := [mode.name for mode in made.modes if mode.held]:
            what = "held at what the exposures of the images suggest"
            lines.append(f"overlaps do not determine {', '.join(held)}: {what}")
        if made.shoulder:
            lines.append("bright and dark ends of the tables are bent to stay inside the range")
        files = f"{len(self.files)} balance files are entered in the project"
        return [*lines, f"{files}; `ortho` and `mosaic` apply them"]

    def messages(self) -> Sequence[str]:
        """Return the notes."""
        return noted(self.notes)

    def raise_failures(self) -> None:
        """Name the images that could not be used."""
        refuse_unusable(self.unusable, len(self.survey.names) + len(self.survey.blind))

    def json_fields(self) -> dict[str, Any]:
        """Return figures by name."""
        fields: dict[str, Any] = {
            "images": self.survey.names,
            "resolution": self.survey.grid.resolution,
            "notes": self.notes,
        }
        if self.pairs is None or self.balanced is None:
            return fields
        before, after = self.rms()
        pairs = [
            {"images": [self.named(i) for i in both], "pixels": n, "rms_before": b, "rms_after": a}
            for both, n, b, a in zip(self.pairs.images, self.pairs.pixels, self.pairs.before, self.pairs.after)
        ]
        found = self.balanced
        return {
            **fields,
            "rms_before": before,
            "rms_after": after,
            "contrast": found.contrast,
            "shoulder": found.shoulder,
            "block_modes": {
                mode.name: {
                    "value": mode.value,
                    "sigma": mode.sigma,
                    "prior_sigma": mode.prior,
                    "held": mode.held,
                    "order": mode.order,
                }
                for mode in found.modes
            },
            "curve_last": bool(found.bands) and found.bands[0].curve_last,
            "sigma": [each.sigma for each in found.bands],
            "weighted_down": [each.down for each in found.bands],
            "files": {self.named(int(k)): path for k, path in zip(found.images, self.files)},
            "pairs": pairs,
        }


def balance_project(request: BalanceRequest, events: Events = SILENT) -> BalanceReport:
    """Find tables by which the images of a project agree, write them, and enter them into the project.

    Tables that images have already are not applied before: the same command gives the same tables.

    Raises
    ------
    UsageError
        An output exists, an option cannot be, or `memory` does not suffice.
    InputError
        An input cannot be used, or images differ in bands or type of pixels.
    GeometryError
        No two images have enough ground in common.
    """
    times, project = run_times(), _plain(load_on_target(request))
    names = project.select(request.images or None)
    fixed = _check(request, project, names)
    attempts = Attempts(project, request.images or None)
    for attempt in attempts:
        with attempt as usable:
            report = _balance(request, names, fixed, times, events, usable)
    return replace(report, unusable=attempts.left_out)


def _balance(
    request: BalanceRequest,
    names: Sequence[str],
    fixed: str | None,
    times: Callable[[], dict[str, Any]],
    events: Events,
    project: Project,
) -> BalanceReport:
    """Balance a project without images that cannot be used."""
    found = survey(project, names, request.resolution, request.bounds, events)
    notes = [f"left out: {line}" for line in found.blind]
    workers = tiles_in_flight(request.workers, request.memory, BASE_MEMORY + found.kept_bytes, found.tile_bytes)
    if request.dry_run:
        return BalanceReport(request, found, tuple(notes))
    make_folder(request.folder)
    with together(), locked(lock_of(request.table)):
        report = _made(request.replace(workers=workers), project, found, fixed, notes, events)
        _keep(request, project, report, times())
    return report


def _made(
    request: BalanceRequest, project: Project, found: Survey, fixed: str | None, notes: list[str], events: Events
) -> BalanceReport:
    """Tables of the images of a survey."""
    reference = _reference(request, found, notes)
    cells = sample(found, reference, request.workers, request.executor, events, request.folder)
    if reference is not None and not np.isfinite(cells.reference).any():
        raise GeometryError(f"{reference.path}: shows nothing of the ground that the images show")
    made, pairs = _adjusted(request, cells, found, fixed, events, notes)
    files = tuple(request.folder / f"{project.stems[found.names[k]]}.toml" for k in made.images.tolist())
    return BalanceReport(
        request, survey=found, notes=tuple(notes), cells=cells, balanced=made, pairs=pairs, files=files
    )


def _keep(request: BalanceRequest, project: Project, report: BalanceReport, times: dict[str, Any]) -> None:
    """Write the files and the record, and enter them into the project."""
    found = report.survey
    files_in = [request.project, *(one.scene.reader.path for one in found.looked)]
    inputs = [input_entry(path) for path in (*files_in, *([request.reference] if request.reference else []))]
    settings = pick(request, "reference_image", "degree", "factor", "resolution")
    with together():
        _write(request, project, report)
        write_run_record(
            request.table,
            key=run_key("balance", settings, inputs),
            inputs=inputs,
            run={"workers": request.workers, "executor": request.executor, "memory": request.memory, **times},
            kind="balance",
            product=report,
            settings=settings,
        )


def _adjusted(
    request: BalanceRequest, cells: Cells, found: Survey, fixed: str | None, events: Events, notes: list[str]
) -> tuple[Balanced, Pairs]:
    """Tones of the images that can be compared, and what they bring; the others are named in `notes`."""
    limits = limits_of(cells, found.looked[0].scene.reader.dtype)
    usable, even = _usable(cells, found, limits, notes)
    number = None if fixed is None else found.names.index(fixed) if fixed in found.names else -1
    _refuse_useless(usable, found, number, notes)
    events.begin("adjusting", cells.bands, "bands")
    made = balanced(
        usable,
        found.sizes,
        limits,
        degree=request.degree,
        cameras=found.cameras,
        fixed=number,
        factor=request.factor,
        done=events.done,
    )
    _note(made, found, even, notes)
    tones = dict(zip(made.images.tolist(), made.tones))
    return made, pairs_of(usable.shared, tones, found.sizes)


def limits_of(cells: Cells, dtype: np.dtype[Any]) -> tuple[float, float]:
    """Least and largest grey value: of the type for bytes; of others what images show, since few fill their type."""
    if dtype == np.uint8:
        return 0.0, 255.0
    low, high = float(cells.pixels.min()), float(cells.pixels.max())
    return (0.0 if dtype.kind == "u" else low), max(high, low + 1.0)


def _reference(request: BalanceRequest, found: Survey, notes: list[str]) -> Reference | None:
    """The reference that was asked for."""
    if request.reference is None:
        return None
    reader = found.looked[0].scene.reader
    reference = open_reference(request.reference, found.grid, reader.bands, reader.dtype)
    if reference.pixel > SIDE * found.grid.resolution:
        notes.append(
            f"the pixels of {reference.path.name} ({reference.pixel:g} m) are larger than what is compared "
            f"({SIDE * found.grid.resolution:g} m); give a coarser resolution if colours come out uneven"
        )
    return reference


def _plain(project: Project) -> Project:
    """The project without tables."""
    images = tuple(image.model_copy(update={"balance": None}) for image in project.images)
    return project.model_copy(update={"images": images})


def _check(request: BalanceRequest, project: Project, names: Sequence[str]) -> str | None:
    """Name of the reference image, and everything that can be refused before any work."""
    executor_factory(request.executor, request.workers)
    if len(names) < 2:
        raise UsageError(f"{len(names)} image; two at least are compared")
    if request.folder.exists() and not request.folder.is_dir():
        raise UsageError(f"{request.folder}: is a file; give the name of a folder")
    if not request.dry_run:
        outputs = [request.table, *(request.folder / f"{project.stems[name]}.toml" for name in names)]
        refuse_inputs(
            [request.project, *input_files(project), *([request.reference] if request.reference else [])], outputs
        )
        for path in outputs:
            check_output(path, overwrite=request.overwrite)
    if request.reference_image is None:
        return None
    (fixed, *more) = project.select([request.reference_image])
    if more or fixed not in names:
        raise UsageError(f"reference image {request.reference_image!r}; give the name of one of the images")
    return fixed


def _usable(
    cells: Cells, found: Survey, limits: tuple[float, float], notes: list[str]
) -> tuple[Cells, NDArray[np.bool_]]:
    """Cells without images that are all of one colour; these are named."""
    even = even_images(cells, len(found.names), limits[1] - limits[0])
    for k in np.flatnonzero(even):
        grey = float(np.median(cells.pixels[cells.image == k]))
        notes.append(f"left out: {one_colour_told(found.names[k], grey)}")
    return cells.some(~even[cells.image]), even


def _refuse_useless(cells: Cells, found: Survey, fixed: int | None, notes: Sequence[str]) -> None:
    shared = cells.shared
    if not len(shared):
        more = "\n  ".join(["", *notes])
        raise GeometryError(
            f"no two of {len(found.names)} images show enough of the same ground to be compared at "
            f"{found.grid.resolution:g} m; give a finer resolution if their overlap is narrow{more}"
        )
    if fixed is not None and (fixed < 0 or fixed not in shared.image):
        raise UsageError("the reference image shows no ground that another image shows; choose another one")


def _note(made: Balanced, found: Survey, even: NDArray[np.bool_], notes: list[str]) -> None:
    """Images that get no tables, and parts of the block that do not hang together."""
    alone = [found.names[k] for k in range(len(found.names)) if k not in made.images and not even[k]]
    if alone:
        some = ", ".join(map(repr, alone[:5])) + (f" and {len(alone) - 5} more" if len(alone) > 5 else "")
        notes.append(f"no overlap with other images, so no tables: {some}; they stay as they are")
    parts, counts = np.unique(made.parts, return_counts=True)
    if len(parts) > 1:
        sizes = ", ".join(map(str, sorted(counts.tolist(), reverse=True)))
        notes.append(f"the images hang together in {len(parts)} parts ({sizes} images), each is balanced by itself")
    modes = [mode for mode in made.modes if mode.order > max(_DOUBTFUL, mode.sigma / 2)]
    doubtful = ", ".join(f"{mode.name} {100 * mode.order:.0f} %" for mode in modes)
    if doubtful:
        notes.append(
            f"the images have different tone curves; whether these act before or after the fall-off changes the mosaic "
            f"from its middle to its edge ({doubtful}); give `reference` if that is too much"
        )


def _write(request: BalanceRequest, project: Project, report: BalanceReport) -> None:
    """Balance files, the table of overlaps, entries of the project."""
    found, names = report.balanced, report.survey.names
    assert found is not None and report.pairs is not None
    make_parents(request.folder)
    gauge = f"{request.reference_image} stays" if request.reference_image else "the block keeps mean and contrast"
    gauge = gauge if request.reference is None else f"colours of {request.reference.name}"
    home = request.project.resolve().parent
    entries: dict[str, dict[str, str | None]] = {}
    for k, path, tones, sigmas in zip(found.images.tolist(), report.files, found.tones, found.sigmas):
        bands = [
            BalanceBand(
                grey=tone.grey,
                becomes=tone.becomes,
                sigma=sigma,
                trend=tone.terms,
                curve_grey=tone.curve[0],
                curve_light=tone.curve[1],
            )
            for tone, sigma in zip(tones, sigmas)
        ]
        width, height = report.survey.sizes[k].tolist()
        write_balance_file(path, (width, height), f"{names[k]}, among {len(found.images)} images; {gauge}", bands)
        whole = path.resolve()
        entry = whole.relative_to(home).as_posix() if whole.is_relative_to(home) else str(whole)
        entries[names[k]] = {"balance": entry}
    # Tables of an earlier run do not fit to those of this one.
    entries |= {name: {"balance": None} for name in project.select(request.images or None) if name not in entries}
    pairs = report.pairs
    bands_ = range(1, pairs.before.shape[1] + 1)
    header = ["image", "other", "pixels", *(f"before_{b}" for b in bands_), *(f"after_{b}" for b in bands_)]
    rows = [
        [names[i], names[j], int(n), *(f"{v:.2f}" for v in before), *(f"{v:.2f}" for v in after)]
        for (i, j), n, before, after in zip(pairs.images.tolist(), pairs.pixels, pairs.before, pairs.after)
    ]
    write_table(request.table, header, rows)
    edit_project(request.project, ProjectChanges(images=entries))
