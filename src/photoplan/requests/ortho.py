"""Requests of commands that make orthophotos and mosaics: seams, balance, light and haze."""

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


class BalanceRequest(Request):
    """Options of even colours between the images of a project."""

    project: Path = PROJECT
    images: tuple[str, ...] = IMAGES
    reference_image: str | None = opt("Image that stays as it is [mean and contrast of all stay].", None,
                                      metavar="NAME")  # fmt: skip
    reference: Path | None = opt("Raster on the map whose colours the images get.", None, metavar="FILE",
                                 section="input")  # fmt: skip
    degree: int = opt("Degree of the trend over an image; 0: tables alone.", 2)
    factor: bool = opt("Find one factor for each image and band from means, instead of tables.", False)
    resolution: float | None = opt("Pixels that are compared, metres [by the images' size].", None, metavar="R")
    output: Path | None = opt("Folder of the tables [balance by the project].", None, metavar="FOLDER", folder=True,
                              section="result")  # fmt: skip
    picture: bool = PICTURE
    dry_run: bool = DRY_RUN
    workers: int = ONE_WORKER
    executor: str = EXECUTOR
    memory: int | None = MEMORY
    overwrite: bool = OVERWRITE

    @property
    def folder(self) -> Path:
        """Folder of the tables."""
        return self.output or self.project.resolve().parent / "balance"

    @property
    def product(self) -> Path:
        """File whose name the picture has."""
        return self.folder / "balance.csv"

    @property
    def table(self) -> Path:
        """The table of overlaps."""
        return self.folder / "overlaps.csv"

    def check(self) -> None:
        """Refuse what does not go together."""
        if self.reference is not None and self.factor:
            raise UsageError("factors from ratios know no reference; set `reference_image`, or leave `factor` out")
        if self.reference is not None and self.reference_image is not None:
            raise UsageError("a reference image and a reference; give one of them")
        if not 0 <= self.degree <= 4:
            raise UsageError(f"degree {self.degree}; allowed are 0 (tables alone) to 4, usual is 2")


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
