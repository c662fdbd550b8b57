"""Requests of commands that make orthophotos and mosaics: seams, light and haze."""

from __future__ import annotations

from pathlib import Path

from photoplan.errors import UsageError
from photoplan.request import (
    DRY_RUN,
    EXECUTOR,
    IMAGES,
    MEMORY,
    ONE_WORKER,
    OVERWRITE,
    PICTURE,
    PROJECT,
    WORKERS,
    Request,
    arg,
    opt,
)


class SeamsRequest(Request):
    """Options of the search for seams."""

    project: Path = PROJECT
    images: tuple[str, ...] = IMAGES
    resolution: float | None = opt(
        "Pixels along whose edges seams run, metres [256 of them across an image].", None, gt=0, metavar="R"
    )
    keep: Path | None = opt("Regions with their images that stay as they are.", None, metavar="FILE", section="input")
    output: Path | None = opt("Regions to write [products/seams.gpkg by the project].", None, metavar="FILE",
                              writes=True)  # fmt: skip
    picture: bool = PICTURE
    dry_run: bool = DRY_RUN
    workers: int = ONE_WORKER
    executor: str = EXECUTOR
    memory: int | None = MEMORY
    overwrite: bool = OVERWRITE

    @property
    def product(self) -> Path:
        """The file of regions."""
        return self.output or self.project.resolve().parent / "products" / "seams.gpkg"


class IlluminationRequest(Request):
    """Options of the correction of light on slopes, and of haze."""

    picture: Path = arg("Orthophoto.")
    terrain: Path = opt("Terrain model or raster of heights.", metavar="MODEL", section="input")
    output: Path = opt("Corrected orthophoto to write.", metavar="TIF", writes=True)
    sun: tuple[float, float] = opt("Direction of the sun from grid north, and its height above the horizon, degrees.",
                                   metavar="AZIMUTH ALTITUDE")  # fmt: skip
    correct: tuple[str, ...] = opt("Corrections: cosine or c; haze or haze-by-height; both of them [c].", ("c",),
                                   listed=True, metavar="NAME,…")  # fmt: skip
    preview: bool = PICTURE
    dry_run: bool = DRY_RUN
    workers: int | None = WORKERS
    overwrite: bool = OVERWRITE

    def check(self) -> None:
        """Refuse a sun below the horizon."""
        if not 0 < self.sun[1] <= 90:
            raise UsageError(f"`sun`: altitude {self.sun[1]:g} must be greater than 0 and at most 90 degrees")
