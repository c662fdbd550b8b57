"""Images formed from scenes by a described model: files in, files out."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.engine.steps import steps
from photoplan.errors import InputError, ResourceError, UsageError
from photoplan.events import SILENT, Events
from photoplan.geometry.grid import Window
from photoplan.io.product import check_output
from photoplan.io.raster import RasterReader
from photoplan.io.result_log import ResultLog
from photoplan.io.run_record import run_key, run_times, write_run_record
from photoplan.plain import pick
from photoplan.products.simulate.model import SimulatedImage, count_parts, form_frames, is_kept, read_model
from photoplan.quality.formation.model import MOST_PIXELS, ImageModel, model_mtf50
from photoplan.quality.formation.parts import Quantisation
from photoplan.quality.formation.scenes import PATTERNS, LightScene, PatternScene, parse_pattern

_MOST_FRAMES = 10_000
_BITS = {"uint8": 8, "uint16": 16}


@dataclass(frozen=True)
class SimulateRequest:
    """What is asked."""

    scene: str
    """An image file, or a pattern such as ``edge:5``."""
    model: Path | None = None
    """Description of the model; None: nothing happens to the scene but sampling."""
    output: Path | None = None
    """File; with several frames their number is added to the name. None: made from the scene's name, here."""
    frames: int = 1
    seed: int | None = None
    """In place of the model's."""
    exposure: tuple[float, ...] = ()
    """One for all frames or one for each; 1 if empty."""
    size: tuple[int, int] | None = None
    """Of a pattern; 512 × 512 if not given."""
    levels: tuple[float, float] | None = None
    """Dark and bright of a pattern; 0 and 1 if not given."""
    phase: tuple[float, float] | None = None
    """Place of a pattern; the image's middle if not given."""
    oversampling: int | None = None
    """Cells of the scene along a side of a pixel; 1 for files, 8 for patterns if not given."""
    dtype: str | None = None
    """Of the files: uint8, uint16 or float32; None: as the model's quantisation says, else float32."""
    workers: int = 1
    overwrite: bool = False
    dry_run: bool = False


@dataclass(frozen=True)
class SimulateReport:
    """What was made, or would be."""

    images: tuple[SimulatedImage, ...]
    size: tuple[int, int]
    bands: int
    dtype: str
    mtf50: tuple[float, float]
    """What the model puts in, along x and y in the middle of the image, cycles per pixel; NaN: above 20."""
    notes: tuple[str, ...]
    record: Path | None

    def json_fields(self) -> dict[str, Any]:
        """The images with what is known of each."""
        images = [{**pick(i, "path", "frame", "exposure", automatic_gain="gain"), **i.facts} for i in self.images]
        mtf50 = dict(zip("xy", self.mtf50))
        return {
            **pick(self, "size", "bands", "dtype", "notes", run_record="record"),
            "images": images,
            "model_mtf50": mtf50,
        }


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
        """Whether any pixel of the file has a value; reads as far as the first one."""
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


def simulate(
    request: SimulateRequest,
    events: Events = SILENT,
) -> SimulateReport:
    """Form images of a scene and write them.

    Parameters
    ----------
    request : SimulateRequest
    events : Events
        Told how far it is.

    Raises
    ------
    UsageError
        Options contradict each other, or an output exists.
    InputError
        Scene or model cannot be used.
    """
    times = run_times()
    model, dtype = _model(request)
    scene = _scene(request, model)
    exposures = _exposures(request)
    output = _output(request)
    paths, inputs = _paths(request), _inputs(request)
    settings = {
        "model": model,
        "scene": Path(request.scene).name,
        "size": scene.size,
        "oversampling": scene.oversampling,
    }
    settings |= {**pick(request, "levels", "phase"), "exposures": exposures, "dtype": dtype}
    key = run_key("simulated images", settings, inputs)
    if request.dry_run:
        for path in paths:
            check_output(path, inputs, overwrite=request.overwrite)
        images = [SimulatedImage(p, n, e, 1.0, {}) for n, (p, e) in enumerate(zip(paths, exposures))]
        return _report(model, scene, dtype, images)
    with ResultLog.beside(output, key, locked=False) as log:
        for frame, path in enumerate(paths):
            check_output(path, inputs, overwrite=request.overwrite or is_kept(log, frame, path))
        tags = {"PHOTOPLAN_SCENE": Path(request.scene).name, "PHOTOPLAN_SEED": str(model.seed)}
        with steps(output.name, request.workers, events, log) as run:
            events.begin("images", count_parts(model, scene, len(paths)), "parts")
            try:
                images = form_frames(model, scene, list(zip(paths, exposures)), (dtype, tags), run, log)
            except MemoryError:
                text = f"{scene.bands} × {scene.size[0]} × {scene.size[1]}"
                raise ResourceError(f"too little memory for an image of {text} pixels; cut the scene") from None
        report = _report(model, scene, dtype, images)
        ran = {"workers": request.workers, **times()}
        record = write_run_record(
            output, key=key, inputs=inputs, run=ran, kind="simulated images", product=report, settings=settings
        )
        log.remove()
    return dataclasses.replace(report, record=record)


def _report(model: ImageModel, scene: LightScene, dtype: str, images: list[SimulatedImage]) -> SimulateReport:
    return SimulateReport(
        images=tuple(images),
        size=scene.size,
        bands=scene.bands,
        dtype=dtype,
        mtf50=(model_mtf50(model, 0.0), model_mtf50(model, 90.0)),
        notes=tuple(_notes(scene, dtype, images)),
        record=None,
    )


def _model(request: SimulateRequest) -> tuple[ImageModel, str]:
    """The model, and the type of the files."""
    model = ImageModel() if request.model is None else read_model(request.model)
    if request.seed is not None:
        if not 0 <= request.seed < 2**62:
            raise UsageError(f"seed {request.seed}; a whole number from 0 on is needed")
        model = dataclasses.replace(model, seed=request.seed)
    dtype = request.dtype
    if model.quantisation is None and dtype in _BITS:
        model = dataclasses.replace(model, quantisation=Quantisation(_BITS[dtype]))
    if model.quantisation is None:
        return model, dtype or "float32"
    bits = model.quantisation.bits
    if dtype == "uint8" and bits > 8:
        raise UsageError(f"uint8 files for grey values of {bits} bits; choose uint16, or other bits in the model")
    return model, dtype or ("uint8" if bits <= 8 else "uint16")


def _scene(request: SimulateRequest, model: ImageModel) -> LightScene:
    pattern = parse_pattern(request.scene)
    k = request.oversampling
    scene: LightScene
    if pattern is None:
        if request.size is not None or request.levels is not None or request.phase is not None:
            raise UsageError(f"`size`, `levels` and `phase` are for patterns ({', '.join(PATTERNS)}), not for files")
        if not Path(request.scene).exists() and ":" in request.scene:
            raise UsageError(
                f"scene {request.scene!r}: no such file, and no pattern; patterns are {', '.join(PATTERNS)}"
            )
        scene = FileScene(RasterReader(Path(request.scene)), k or 1)
    else:
        bands = max((each.band for each in model.lateral), default=1)
        scene = PatternScene(
            pattern[0],
            request.size or (512, 512),
            pattern[1],
            k or 8,
            request.levels or (0.0, 1.0),
            request.phase or (0.0, 0.0),
            bands,
        )
    if scene.size[0] * scene.size[1] * scene.bands > MOST_PIXELS:
        raise InputError(
            f"{request.scene}: {scene.bands} × {scene.size[0]} × {scene.size[1]} pixels; at most {MOST_PIXELS:,} are "
            "formed at once: cut the scene"
        )
    absent = [each.band for each in model.lateral if each.band > scene.bands]
    if absent:
        raise InputError(
            f"{request.model}: [[lateral]] describes band {absent[0]}, but {request.scene} has "
            f"{scene.bands} {'band' if scene.bands == 1 else 'bands'}; leave the entry out, or give a scene with it"
        )
    if isinstance(scene, FileScene) and not scene.has_values:
        raise InputError(f"{request.scene}: not one pixel has a value; nothing can be imaged, give another file")
    return scene


def _exposures(request: SimulateRequest) -> list[float]:
    if not 1 <= request.frames <= _MOST_FRAMES:
        raise UsageError(f"{request.frames} frames; allowed are 1 to {_MOST_FRAMES}")
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
    pattern = parse_pattern(request.scene)
    stem = Path(request.scene).stem if pattern is None else pattern[0]
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
    scene = [] if parse_pattern(request.scene) is not None else [Path(request.scene)]
    return scene + ([] if request.model is None else [request.model])


def _notes(scene: LightScene, dtype: str, images: list[SimulatedImage]) -> Iterator[str]:
    """What a user should know."""
    clipped = [i for i in images if i.facts.get("saturated_pixels")]
    if clipped:
        most = max(int(str(i.facts["saturated_pixels"])) for i in clipped)
        yield f"saturated pixels in {len(clipped)} of {len(images)} frames, up to {most}"
    lost = max((float(str(i.facts.get("lost", 0.0))) for i in images), default=0.0)
    if lost > 0.5:
        yield f"charge that overflowed beyond the border: up to {lost:.0f} electrons"
    if isinstance(scene, FileScene) and scene.reader.info.has_mask:
        yield "pixels without value in the scene count as 0"
