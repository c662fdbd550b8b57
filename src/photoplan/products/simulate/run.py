"""Images formed from scenes by a described model: files in, files out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError
from photoplan.events import SILENT, Events
from photoplan.geometry.grid import Window
from photoplan.io.raster import RasterReader
from photoplan.plain import pick
from photoplan.products.simulate.form import Forming, SimulateReport, check_fit, stated_model
from photoplan.quality.formation.model import ImageModel
from photoplan.quality.formation.scenes import PATTERNS, LightScene, PatternScene, parse_pattern

_MOST_FRAMES = 10_000


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


def simulate(request: SimulateRequest, events: Events = SILENT) -> SimulateReport:
    """Form images of a scene and write them.

    Raises
    ------
    UsageError
        Options contradict each other, or an output exists.
    InputError
        Scene or model cannot be used.
    """
    model, dtype = stated_model(request.model, request.seed, request.dtype)
    scene = _scene(request, model)
    exposures = _exposures(request)
    settings = {
        "model": model,
        "scene": Path(request.scene).name,
        "size": scene.size,
        "oversampling": scene.oversampling,
    }
    masked = isinstance(scene, FileScene) and scene.reader.info.has_mask
    forming = Forming(
        kind="simulated images",
        name=Path(request.scene).name,
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
            kind=pattern[0],
            size=request.size or (512, 512),
            numbers=pattern[1],
            oversampling=k or 8,
            levels=request.levels or (0.0, 1.0),
            phase=request.phase or (0.0, 0.0),
            bands=bands,
        )
    check_fit(scene, request.scene, model, request.model)
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
