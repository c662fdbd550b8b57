"""Simulated images of scenes and projects."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, Strict, create_model

from photoplan.cameras.base import Camera
from photoplan.engine.run import Steps, Store, steps
from photoplan.errors import InputError, ResourceError, UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Result
from photoplan.geometry.grid import MapGrid, Placement, Window
from photoplan.io.camera.model import Entry, Number
from photoplan.io.disk import make_folder
from photoplan.io.files import read_entries
from photoplan.io.product import check_output, is_product
from photoplan.io.project.file import load_project
from photoplan.io.project.model import Project
from photoplan.io.raster import RasterReader, write_whole_image
from photoplan.io.raster_info import ImageForm
from photoplan.io.store import ResultLog, record_path, recorded_result, run_key, run_times, write_run_record
from photoplan.plain import pick
from photoplan.products.dtm.rasters import GridOptions, GridTile, write_grid
from photoplan.products.orthophoto.plan import two_figures
from photoplan.project.cameras import camera_without_pixels
from photoplan.project.rendered import ProjectScene, ground_pixel
from photoplan.quality.formation.model import MOST_PIXELS, FormedFrame, ImageModel, exposed, frame_light, model_mtf50
from photoplan.quality.formation.optics import Quantisation
from photoplan.quality.formation.scenes import PATTERNS, LightScene, PatternScene, RenderedScene, parse_pattern
from photoplan.requests.quality import SimulateRequest

#: A description with a table of defects for every element of a large sensor stays below.
_MAX_BYTES = 20_000_000
_PLAIN: dict[Any, Any] = {
    float: Number,
    int: Annotated[int, Strict(), Field(ge=0, le=2**62)],
    bool: Annotated[bool, Strict()],
}
#: Of a pair for which one number stands for both directions.
_EVEN = BeforeValidator(lambda value: (value, value) if isinstance(value, float | int) else value)


def entry_of(part: Any) -> type[Entry]:
    """Return the TOML table of a part: an entry for each field; defaults stand for entries that are left out."""
    kinds = get_type_hints(part)
    entries: dict[str, Any] = {}
    for field in dataclasses.fields(part):
        kind = _strict(kinds[field.name])
        if field.name in ("gaussian", "width") and kind is not Number:
            kind = Annotated[kind, _EVEN]
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        entries[field.name] = (kind, ...) if required else (kind | None, None)
    return create_model(part.__name__, __base__=Entry, **entries)


def _strict(kind: Any) -> Any:
    """The type of an entry for the type of a field: a number is no text, a table is a part."""
    if dataclasses.is_dataclass(kind):
        return entry_of(kind)
    if kind in _PLAIN or get_origin(kind) is Literal:
        return _PLAIN.get(kind, kind)
    inner: Any = tuple(each if each is ... else _strict(each) for each in get_args(kind) if each is not type(None))
    return tuple.__class_getitem__(inner) if get_origin(kind) is tuple else inner[0]


def read_model(path: Path) -> ImageModel:
    """Model of a description."""
    return model_of(read_entries(path, entry_of(ImageModel), _MAX_BYTES), str(path))


def model_of(described: Entry, source: str) -> ImageModel:
    """Model of checked entries; the message of an `InputError` begins with the source."""
    try:
        made: ImageModel = _made(ImageModel, described)
    except InputError as error:
        raise InputError(f"{source}: {error}") from None
    return made


def _made(kind: Any, value: Any) -> Any:
    """A value of a field's type from what an entry holds."""
    part: Any = next((each for each in (kind, *get_args(kind)) if dataclasses.is_dataclass(each)), None)
    if part is None:
        return value
    if isinstance(value, tuple):
        return tuple(_made(part, each) for each in value)
    kinds = get_type_hints(part)
    return part(**{key: _made(kinds[key], each) for key, each in value if each is not None})


@dataclass(frozen=True)
class SimulatedImage:
    """One frame."""

    path: Path
    frame: int
    exposure: float
    gain: float
    """Automatic gain."""
    facts: Mapping[str, object]


def is_kept(store: Store, frame: int, path: Path) -> bool:
    """Return whether an earlier run has written a frame, and it is there."""
    return store.index(("frame", frame)) in store.finished and path.is_file()


def count_parts(model: ImageModel, scene: LightScene, frames: int) -> int:
    """Tiles of light and frames that `form_frames` makes."""
    tiles = len(frame_light(model, scene, 0).tiles)
    return frames + tiles * (frames if model.jitter.sigma else 1)


def form_frames(
    model: ImageModel,
    scene: LightScene,
    frames: Sequence[tuple[Path, float]],
    dtype: str,
    tags: Mapping[str, str],
    run: Steps,
    store: Store,
) -> list[SimulatedImage]:
    """Form frames one after the other, since automatic gain runs through them, and write each."""
    images: list[SimulatedImage] = []
    gain, light = 1.0, None
    for n, (path, exposure) in enumerate(frames):
        if light is None or model.jitter.sigma:
            sampled = frame_light(model, scene, n)
            # Put together for the first frame that needs it, once: light may be the same in all of them.
            light = cache(partial(sampled.whole, run(sampled, sampled.tiles, pixels=lambda tile: tile.size)))
        again = store.index(("frame", n)) in store.finished and not is_kept(store, n, path)
        name = ("frame", n, "again") if again else ("frame", n)
        ((own, gain, facts),) = run(
            partial(_write, model, light, path, dtype, tags), [FormedFrame(n, exposure, gain)], [name]
        )
        images.append(SimulatedImage(path=path, frame=n, exposure=exposure, gain=own, facts=facts))
    return images


def _write(
    model: ImageModel,
    light: Callable[[], NDArray[np.float64]],
    path: Path,
    dtype: str,
    tags: Mapping[str, str],
    frame: FormedFrame,
) -> tuple[float, float, dict[str, object]]:
    """Expose and write a frame; its gain, that of the next one, and what is known of it."""
    made = exposed(model, light(), frame)
    values = made.values.astype(dtype, copy=False)
    write_whole_image(path, values, {**tags, "PHOTOPLAN_FRAME": str(frame.number)})
    return made.gain, made.next_gain, dict(made.facts)


_BITS = {"uint8": 8, "uint16": 16}


@dataclass(frozen=True)
class SimulateReport(Result):
    """Images of a file or a pattern that were made, or would be."""

    images: tuple[SimulatedImage, ...]
    size: tuple[int, int]
    bands: int
    dtype: str
    mtf50: tuple[float, float]
    """MTF50 of the model along x and y in the middle of the image, cycles per pixel; NaN if above 20."""
    notes: tuple[str, ...]
    record: Path | None

    def json_fields(self) -> dict[str, Any]:
        """Return the images with what is known of each."""
        images = [{**pick(i, "path", "frame", "exposure", automatic_gain="gain"), **i.facts} for i in self.images]
        mtf50 = dict(zip("xy", self.mtf50))
        return {
            **pick(self, "size", "bands", "dtype", "notes", run_record="record"),
            "images": images,
            "model_mtf50": mtf50,
        }

    def written(self) -> list[Path]:
        """Return the images."""
        return [image.path for image in self.images]

    def messages(self) -> list[str]:
        """Return the form of the images and the sharpness of the model."""
        along = " ".join(f"{axis} {value:.4f}" for axis, value in zip("xy", self.mtf50))
        return [
            f"{len(self.images)} images of {self.bands} × {self.size[0]} × {self.size[1]} pixels, {self.dtype} · MTF50 "
            f"of the model: {along} cycles per pixel"
        ]

    def remarks(self) -> tuple[str, ...]:
        """Return the notes."""
        return self.notes


@dataclass(frozen=True, eq=False)
class Forming:
    """Images of one scene that are to be formed."""

    _: KW_ONLY
    kind: str
    """Kind of the images, for the record."""
    name: str
    """Name of the scene."""
    scene: LightScene
    model: ImageModel
    dtype: str
    """Type of the files' pixels."""
    frames: Sequence[tuple[Path, float]]
    """File and exposure of each."""
    output: Path
    """File beside which the record and the log of the run stand."""
    inputs: Sequence[Path]
    """Files that decide what is formed."""
    settings: Mapping[str, Any]
    """All else that does."""
    notes: tuple[str, ...] = ()
    """Remarks on the scene."""
    workers: int = 1
    overwrite: bool = False

    @property
    def key(self) -> str:
        """The digest of all that decides the images."""
        return run_key(self.kind, self.settings, self.inputs)

    @property
    def begun(self) -> bool:
        """Return whether an earlier run has left its log; its frames are among the outputs."""
        return ResultLog.place(self.output).exists()

    def planned(self) -> SimulateReport:
        """Return the report of a dry run."""
        for path, _ in self.frames:
            check_output(path, self.inputs, overwrite=self.overwrite)
        return self._report(
            [SimulatedImage(path=p, frame=n, exposure=e, gain=1.0, facts={}) for n, (p, e) in enumerate(self.frames)]
        )

    def form(self, events: Events) -> SimulateReport:
        """Form and write the images, and their record."""
        times, key = run_times(), self.key
        with ResultLog.beside(self.output, key, locked=False) as log:
            for frame, (path, _) in enumerate(self.frames):
                # A run that died may have given the name and not yet kept that it had.
                mine = is_kept(log, frame, path) or (log.finished and is_product(path, "PHOTOPLAN_SEED"))
                check_output(path, self.inputs, overwrite=self.overwrite or bool(mine))
            tags = {"PHOTOPLAN_SCENE": self.name, "PHOTOPLAN_SEED": str(self.model.seed)}
            with steps(self.output.name, self.workers, events, log) as run:
                events.begin("images", count_parts(self.model, self.scene, len(self.frames)), "parts")
                try:
                    images = form_frames(self.model, self.scene, self.frames, self.dtype, tags, run, log)
                except MemoryError:
                    text = f"{self.scene.bands} × {self.scene.size[0]} × {self.scene.size[1]}"
                    raise ResourceError(f"too little memory for an image of {text} pixels; cut the scene") from None
            report = self._report(images)
            ran = {"workers": self.workers, **times()}
            told: dict[str, Any] = {"kind": self.kind, "product": report, "settings": self.settings}
            record = write_run_record(self.output, key=key, inputs=self.inputs, run=ran, **told)
            log.remove()
        return dataclasses.replace(report, record=record)

    def _report(self, images: list[SimulatedImage]) -> SimulateReport:
        return SimulateReport(
            images=tuple(images),
            size=self.scene.size,
            bands=self.scene.bands,
            dtype=self.dtype,
            mtf50=(model_mtf50(self.model, 0.0), model_mtf50(self.model, 90.0)),
            notes=(*_notes(images), *self.notes),
            record=None,
        )


def stated_model(path: Path | None, seed: int | None, dtype: str | None) -> tuple[ImageModel, str]:
    """The model of a file with another seed and type of pixels, where these are given, and the type of the files."""
    model = ImageModel() if path is None else read_model(path)
    if seed is not None:
        model = dataclasses.replace(model, seed=seed)
    if model.quantisation is None and dtype in _BITS:
        model = dataclasses.replace(model, quantisation=Quantisation(_BITS[dtype]))
    if model.quantisation is None:
        return model, dtype or "float32"
    bits = model.quantisation.bits
    if dtype == "uint8" and bits > 8:
        raise UsageError(f"uint8 files for grey values of {bits} bits; choose uint16, or other bits in the model")
    return model, dtype or ("uint8" if bits <= 8 else "uint16")


def check_fit(scene: LightScene, name: str, model: ImageModel, described: Path | None) -> None:
    """Refuse scenes that are too large, or lack a band that a model, with the file that describes it, speaks of."""
    if scene.size[0] * scene.size[1] * scene.bands > MOST_PIXELS:
        raise InputError(
            f"{name}: {scene.bands} × {scene.size[0]} × {scene.size[1]} pixels; at most {MOST_PIXELS:,} are "
            "formed at once: cut the scene"
        )
    absent = [each.band for each in model.lateral if each.band > scene.bands]
    if absent:
        raise InputError(
            f"{described}: [[lateral]] describes band {absent[0]}, but {name} has "
            f"{scene.bands} {'band' if scene.bands == 1 else 'bands'}; leave the entry out, or give a scene with it"
        )


def _notes(images: list[SimulatedImage]) -> list[str]:
    """Return remarks on the images."""
    notes = []
    clipped = [i for i in images if i.facts.get("saturated_pixels")]
    if clipped:
        most = max(int(str(i.facts["saturated_pixels"])) for i in clipped)
        notes.append(f"saturated pixels in {len(clipped)} of {len(images)} frames, up to {most}")
    lost = max((float(str(i.facts.get("lost", 0.0))) for i in images), default=0.0)
    if lost > 0.5:
        notes.append(f"charge that overflowed beyond the border: up to {lost:.0f} electrons")
    return notes


@dataclass(frozen=True, eq=False)
class FileScene:
    """An image file as a scene; beyond its border it goes on as at the border, pixels without value count as 0."""

    reader: RasterReader
    oversampling: int = 1

    def __post_init__(self) -> None:
        if any(side % self.oversampling for side in self.reader.size):
            raise InputError(
                f"{self.reader.path}: {self.reader.size[0]} × {self.reader.size[1]} pixels are no multiple of the "
                f"oversampling {self.oversampling}; cut the image or choose another"
            )

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image that is formed, pixels."""
        width, height = self.reader.size
        return width // self.oversampling, height // self.oversampling

    @property
    def bands(self) -> int:
        """Number of bands."""
        return self.reader.bands

    @property
    def continuous(self) -> bool:
        """Pixels of the file are even squares if they are the image's pixels, else means of a continuous scene."""
        return self.oversampling > 1

    @property
    def has_values(self) -> bool:
        """Return whether any pixel of the file has a value; reads as far as the first one."""
        masks = (self.reader.read(tile)[1] for tile in Window(0, 0, *self.reader.size).tiles(1024))
        return any(valid is None or bool(valid.any()) for valid in masks)

    def cells(self, window: Window) -> NDArray[np.float64]:
        """Cells of a window of pixels, shape (bands, height · k, width · k)."""
        k = self.oversampling
        wanted = Window(window.col * k, window.row * k, window.width * k, window.height * k)
        inside = wanted & Window(0, 0, *self.reader.size)
        pixels, valid = self.reader.read(inside)
        values = pixels.astype(np.float64)
        if valid is not None:
            values[:, ~valid] = 0.0
        before = (inside.row - wanted.row, inside.col - wanted.col)
        after = (wanted.stop[1] - inside.stop[1], wanted.stop[0] - inside.stop[0])
        return np.pad(values, ((0, 0), (before[0], after[0]), (before[1], after[1])), mode="edge")


def simulate(request: SimulateRequest, events: Events = SILENT) -> SimulateReport | SceneReport:
    """Form images of a scene, or of all images of a project, and write them.

    Raises
    ------
    UsageError
        Options contradict each other, or an output exists that this very command has not made, or all of them do.
    InputError
        Scene, project, texture or model cannot be used.
    GeometryError
        An image of a project has nothing to look at.
    """
    report = _simulate_project(request, events) if request.scene is None else _simulate_scene(request, events)
    if request.dry_run:
        events.talk("dry run: nothing was written")
    return report


def _simulate_scene(request: SimulateRequest, events: Events) -> SimulateReport:
    name = str(request.scene)
    model, dtype = stated_model(request.model, request.seed, request.dtype)
    scene = _scene(request, model)
    exposures = _exposures(request)
    settings = {
        "model": model,
        "scene": Path(name).name,
        "size": scene.size,
        "oversampling": scene.oversampling,
    }
    masked = isinstance(scene, FileScene) and scene.reader.info.has_mask
    forming = Forming(
        kind="simulated images",
        name=Path(name).name,
        scene=scene,
        model=model,
        dtype=dtype,
        frames=tuple(zip(_paths(request), exposures)),
        output=_output(request),
        inputs=_inputs(request),
        settings=settings | {**pick(request, "levels", "phase"), "exposures": exposures, "dtype": dtype},
        notes=("pixels without value in the scene count as 0",) if masked else (),
        workers=request.workers,
        overwrite=request.overwrite,
    )
    return forming.planned() if request.dry_run else forming.form(events)


def _scene(request: SimulateRequest, model: ImageModel) -> LightScene:
    name = str(request.scene)
    pattern = parse_pattern(name)
    k = request.oversampling
    scene: LightScene
    if pattern is None:
        if request.size is not None or request.levels is not None or request.phase is not None:
            raise UsageError(f"`size`, `levels` and `phase` are for patterns ({', '.join(PATTERNS)}), not for files")
        if not Path(name).exists() and ":" in name:
            raise UsageError(f"scene {name!r}: no such file, and no pattern; patterns are {', '.join(PATTERNS)}")
        scene = FileScene(RasterReader(Path(name)), k or 1)
    else:
        bands = max((each.band for each in model.lateral), default=1)
        scene = PatternScene(
            kind=pattern[0],
            size=request.size or (512, 512),
            numbers=pattern[1],
            oversampling=k or 8,
            levels=request.levels or (0.0, 1.0),
            phase=request.phase or (0.0, 0.0),
            bands=bands,
        )
    check_fit(scene, name, model, request.model)
    if isinstance(scene, FileScene) and not scene.has_values:
        raise InputError(f"{name}: not one pixel has a value; nothing can be imaged, give another file")
    return scene


def _exposures(request: SimulateRequest) -> list[float]:
    given = request.exposure or (1.0,)
    if any(not np.isfinite(e) or e < 0.0 for e in given):
        raise UsageError(f"exposures {given}; none may be negative")
    if len(given) not in (1, request.frames):
        raise UsageError(f"{len(given)} exposures for {request.frames} frames; give one, or one for each frame")
    return list(given) * request.frames if len(given) == 1 else list(given)


def _output(request: SimulateRequest) -> Path:
    if request.output is not None:
        if request.output.suffix.lower() not in (".tif", ".tiff"):
            raise UsageError(f"{request.output}: images are written as TIFF; give a name that ends in .tif")
        return request.output
    pattern = parse_pattern(str(request.scene))
    stem = Path(str(request.scene)).stem if pattern is None else pattern[0]
    return Path(f"{stem}_simulated.tif")


def _paths(request: SimulateRequest) -> list[Path]:
    """One file for each frame."""
    output = _output(request)
    if not output.parent.is_dir():
        raise UsageError(f"{output}: its folder does not exist")
    numbered = [output.with_name(f"{output.stem}_{n:04d}{output.suffix}") for n in range(1, request.frames + 1)]
    return [output] if request.frames == 1 else numbered


def _inputs(request: SimulateRequest) -> list[Path]:
    """Files that decide what is formed."""
    scene = [] if parse_pattern(str(request.scene)) is not None else [Path(str(request.scene))]
    return scene + ([] if request.model is None else [request.model])


#: Origins of stored coordinates are multiples of this, metres.
_ORIGIN = 1000.0


@dataclass(frozen=True, eq=False)
class TruthRaster:
    """A raster of what rays meet, to be written."""

    path: Path
    placement: Placement
    dtype: type
    tile: Callable[[Window], GridTile]
    options: GridOptions
    bands: int = 4

    def write(self) -> None:
        """Compute and write it, see `write_grid`."""
        write_grid(self.path, self.placement, self.dtype, self.bands, "auto", self.tile, self.options)


def image_truth(scene: RenderedScene, camera: Camera, path: Path, options: GridOptions) -> TruthRaster:
    """X, Y, Z and object of what the middles of an image's pixels show; NaN: nothing.

    Values of X and Y are stored from an origin, the bands' offset, which GDAL's readers add.
    """
    origin = np.round(camera.vantage.point / _ORIGIN) * _ORIGIN * (1.0, 1.0, 0.0)
    form = ImageForm(
        descriptions=("X", "Y", "Z", "object"), units=("metre", "metre", "metre", ""), offsets=(*origin.tolist(), 0.0)
    )
    return TruthRaster(
        path=path,
        placement=Placement(scene.size),
        dtype=np.float32,
        tile=partial(scene.places, origin=origin),
        options=replace(options, form=form, overviews=False),
    )


def true_orthophoto(
    scene: ProjectScene,
    resolution: float,
    bounds: tuple[float, float, float, float] | None,
    path: Path,
    options: GridOptions,
) -> TruthRaster:
    """The scene's own colours on the map: means over the pixels of what lies uppermost."""
    bounds = bounds or scene.ground.bounds
    if bounds is None:
        raise UsageError("the terrain has no bounds; give `bounds` of the true orthophoto")
    grid = MapGrid.covering(bounds, resolution, scene.project.crs)
    seen = scene.from_above(grid)
    return TruthRaster(
        path=path, placement=grid.placement, dtype=np.uint8, tile=seen.means, options=options, bands=seen.bands
    )


#: Shortest wavelength of the pattern, ground pixels.
_GRAIN = 8.0
_ORTHO = "true_orthophoto.tif"


@dataclass(frozen=True)
class SceneReport(Result):
    """Images of a project that were made, or would be."""

    images: tuple[SimulateReport, ...]
    """One for each image that was made now."""
    rasters: tuple[Path, ...]
    """Truth of the images, and the true orthophoto, as far as they were made now."""
    kept: tuple[Path, ...]
    """Files that an earlier run of the same command had made."""
    grain: float
    """Shortest wavelength of the pattern, metres."""

    def json_fields(self) -> dict[str, Any]:
        """Return the images with what is known of each, and all other files."""
        images = [
            {**image, **pick(report, "size", "bands", "dtype", "notes", run_record="record")}
            for report in self.images
            for image in report.json_fields()["images"]
        ]
        return {"images": images, **pick(self, "rasters", "kept", grain_m="grain")}

    def written(self) -> list[Path]:
        """Return images and rasters."""
        return [*(path for each in self.images for path in each.written()), *self.rasters]

    def remarks(self) -> list[str]:
        """Return the notes of each image."""
        return [note for each in self.images for note in each.notes]

    def messages(self) -> list[str]:
        """Return the messages of each image, and the pattern's finest wave."""
        kept = f" · {len(self.kept)} files of an earlier run kept" if self.kept else ""
        lines = [line for each in self.images for line in each.messages()]
        return [*lines, f"finest wave of the pattern: {self.grain:g} m{kept}"]


def _simulate_project(request: SimulateRequest, events: Events) -> SceneReport:
    assert request.project is not None
    project = load_project(request.project)
    names = project.select(request.images or None)
    grain = two_figures(_GRAIN * ground_pixel(project)) if request.grain is None else request.grain
    works = list(_works(request, project, names, grain, events))
    kept, todo = _divided(works, project, request.overwrite)
    images: list[SimulateReport] = []
    rasters: list[Path] = []
    if not request.dry_run:
        make_folder(_folder(request, project))
    for work in todo:
        if isinstance(work, Forming):
            images.append(work.planned() if request.dry_run else work.form(events))
        else:
            rasters.append(work.path)
            if not request.dry_run:
                work.write()
    return SceneReport(tuple(images), tuple(rasters), tuple(kept), grain)


def _folder(request: SimulateRequest, project: Project) -> Path:
    return request.output or project.folder / "rendered"


def _works(
    request: SimulateRequest, project: Project, names: Sequence[str], grain: float, events: Events
) -> Iterator[Forming | TruthRaster]:
    """All that is asked for."""
    model, dtype = stated_model(request.model, request.seed, request.dtype)
    if dtype == "float32" and request.dtype is None:
        model, dtype = stated_model(request.model, request.seed, "uint8")
    k = request.oversampling or 2
    scene = ProjectScene.of(project, request.texture, grain, model.seed, k)
    stated = [project.ground.file, *(objects.file for objects in project.objects)]
    inputs = [project.resolve(file) for file in stated if file is not None]
    inputs += [] if request.texture is None else [request.texture]
    folder = _folder(request, project)

    def raster(kind: str, settings: dict[str, Any]) -> GridOptions:
        return GridOptions(
            kind=kind,
            settings=settings,
            inputs=inputs,
            workers=request.workers,
            overwrite=request.overwrite,
            events=events,
        )

    for name in names:
        seen, path = scene.seen_by(name), folder / f"{project.stems[name]}.tif"
        check_fit(seen, f"image {name!r}", model, request.model)
        settings = {"scene": _facts(project, name), "grain": grain, "oversampling": k, "seed": model.seed}
        yield Forming(
            kind="rendered image",
            name=name,
            scene=seen,
            model=model,
            dtype=dtype,
            frames=((path, 1.0),),
            output=path,
            inputs=[*inputs, *([] if request.model is None else [request.model])],
            settings=settings | {"model": model, "dtype": dtype},
            workers=request.workers,
            overwrite=request.overwrite,
        )
        if request.truth:
            camera = camera_without_pixels(project, name)
            truth = path.with_name(f"{path.stem}_truth.tif")
            yield image_truth(seen, camera, truth, raster("truth of a rendered image", settings))
    if request.resolution is not None:
        settings = {"scene": _facts(project, None), "grain": grain, "oversampling": k, "seed": model.seed}
        settings |= pick(request, "resolution", "bounds")
        options = raster("true orthophoto of a scene", settings)
        yield true_orthophoto(scene, request.resolution, request.bounds, folder / _ORTHO, options)


def _facts(project: Project, name: str | None) -> dict[str, Any]:
    """Return what a project states of its scene and, unless `name` is None, of one image."""
    said = project.model_dump_json(include={"crs", "terrain", "objects", "orientation"}, exclude_none=True)
    found: dict[str, Any] = json.loads(said)
    if name is not None:
        image = project.any_image(name)
        found["image"] = json.loads(image.model_dump_json(exclude_none=True, exclude={"file"}))
        if image.described_by is not None:
            found["camera"] = json.loads(project.cameras[image.described_by].model_dump_json(exclude_none=True))
    return found


def _divided(
    works: Sequence[Forming | TruthRaster], project: Project, overwrite: bool
) -> tuple[list[Path], list[Forming | TruthRaster]]:
    """Files that an earlier run of this command has made, and what is to be made; anything else there is refused.

    When all are there the earlier run was not interrupted: doing it again needs `overwrite`.
    """
    photos = {project.resolve(image.file).resolve() for image in project.images}
    kept: list[Path] = []
    todo: list[Forming | TruthRaster] = []
    for work in works:
        path, options = (work.output, work) if isinstance(work, Forming) else (work.path, work.options)
        if path.exists() and not record_path(path).exists() and path.resolve() in photos:
            raise UsageError(f"{path}: an image of the project that was not rendered; choose another output")
        if not overwrite and path.is_file() and recorded_result(path, options.key, lambda product, settings: True):
            kept.append(path)
            continue
        begun = isinstance(work, Forming) and work.begun
        check_output(path, options.inputs, overwrite=overwrite or begun)
        todo.append(work)
    if works and not todo:
        raise UsageError(f"{kept[0]}: exists already, as all others do; choose another output or say `overwrite`")
    return kept, todo
