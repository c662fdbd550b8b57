"""Requests of surface reconstruction: heights and grey values from all images at once."""

from __future__ import annotations

from pathlib import Path

from photoplan.errors import UsageError
from photoplan.request import (
    BOUNDS,
    DRY_RUN,
    EXECUTOR,
    IMAGES,
    MEMORY,
    ONE_WORKER,
    OVERWRITE,
    PROJECT,
    TARGET,
    Request,
    opt,
)


class SurfaceSettings(Request):
    """Options that decide a surface."""

    resolution: float = opt("Distance of the heights, metres.", metavar="R")
    target: str = TARGET
    bounds: tuple[float, float, float, float] | None = BOUNDS
    start: str = opt("Initial heights: terrain (the project's), a height, or a file [terrain; 0].", "terrain",
                     metavar="WHAT", section="input")  # fmt: skip
    reach: float | None = opt("Largest error of the initial heights, metres [a tenth of the flying height].", None,
                              metavar="M")  # fmt: skip
    search: bool | None = opt(
        "Search for heights within the reach first, for strong relief [from a reach of 24 px of parallax on].", None
    )
    bands: tuple[int, ...] = opt("Bands whose mean is a grey value [all; of three luminance].", (),
                                 listed="numbers from 1 on are needed", metavar="N,…")  # fmt: skip
    residuals: bool = opt("Write the residuals of every image: NAME_residuals.tif.", False, section="result")
    points: tuple[Path, ...] = opt("Write also points, .las, .laz or .ply; may be repeated.", (), metavar="FILE",
                                   writes=True)  # fmt: skip
    name: str = opt("Base name of the output files [surface].", "surface", metavar="NAME", section="result")

    def check(self) -> None:
        """Refuse bands that no image has."""
        if len(set(self.bands)) < len(self.bands) or any(band < 1 for band in self.bands):
            raise UsageError(f"`bands` {', '.join(map(str, self.bands))} must be numbers from 1 on, each once")

    @property
    def seen(self) -> str:
        """Name of the target in messages: ground or target."""
        return "ground" if self.target == "map" else "target"

    @property
    def start_height(self) -> float | None:
        """The height with which it begins; None if it begins with those of a terrain or file."""
        try:
            return float(self.start)
        except ValueError:
            return None

    @property
    def start_file(self) -> Path | None:
        """The file of heights with which it begins, if it begins with one."""
        return None if self.start == "terrain" or self.start_height is not None else Path(self.start)


class SurfaceRequest(SurfaceSettings):
    """Options of surface reconstruction."""

    project: Path = PROJECT
    images: tuple[str, ...] = IMAGES
    report: Path | None = opt(
        "Report of the accuracy by classes, images and levels, HTML or PDF.", None, metavar="FILE", writes=True
    )
    output: Path | None = opt("Folder of the files [products by the project].", None, folder=True, section="result")
    quicklook: bool = opt("Write a preview of the surface.", True, flag="no-quicklook", section="result",
                          off="Write no preview of the surface.")  # fmt: skip
    force: bool = opt(
        "Continue although orientations have a FAULT, or the images contradict the surface.", False, section="run"
    )
    dry_run: bool = DRY_RUN
    workers: int = ONE_WORKER
    executor: str = EXECUTOR
    memory: int | None = MEMORY
    overwrite: bool = OVERWRITE

    @property
    def folder(self) -> Path:
        """Folder of the files."""
        return self.output or self.project.resolve().parent / "products"

    @property
    def product(self) -> Path:
        """The raster of heights."""
        return self.folder / f"{self.name}.tif"
