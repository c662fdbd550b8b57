"""Requests of commands that measure in images: register (two images), monoplot (ground points of image points)."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from photoplan.request import DRY_RUN, ONE_WORKER, OVERWRITE, PICTURE, PROJECT, Request, arg, opt


class RegisterRequest(Request):
    """Options of the comparison of two images."""

    first: Path = arg("Image in whose pixels vectors are measured.")
    second: Path = arg("Image that is compared.")
    output: Path = opt("Vectors to write, with NAME.csv next to them.", metavar="GPKG", writes=True)
    radius: int = opt("Radius of a round patch, pixels, 4 to 50.", 10)
    spacing: int | None = opt("Distance of the patches, pixels [they touch].", None, metavar="PX")
    search: float = opt("Largest displacement in x and y, pixels, up to 30.", 3.0)
    correlation: float = opt("Smallest correlation of a patch.", 0.7)
    sigma: float = opt("Largest standard deviation of a coordinate, pixels.", 0.2)
    model: Literal["none", "shift", "affine"] = opt("Model that is fitted to the vectors.", "affine")
    picture: bool = PICTURE
    dry_run: bool = DRY_RUN
    workers: int = ONE_WORKER
    overwrite: bool = OVERWRITE

    @property
    def step(self) -> int:
        """Distance of the patches, pixels."""
        return 2 * self.radius + 1 if self.spacing is None else self.spacing

    @property
    def table(self) -> Path:
        """Table of the vectors."""
        return self.output.with_suffix(".csv")


class MonoplotRequest(Request):
    """Options of ground points of image points."""

    project: Path = PROJECT
    image: str = arg("Name of the image.")
    points: Path = arg("Table with columns x, y, or vector file with points or lines in pixels.")
    output: Path = opt("Ground points to write.", metavar="CSV", writes=True)
    vectors: Path | None = opt("Write the points or lines also in space.", None, metavar="GPKG", writes=True)
    gis_axes: bool = opt(
        "Vectors were drawn in a GIS: (0, 0) is the upper-left corner of the image, y points up.",
        False,
        section="input",
    )
    sigma_image: float = opt("Standard deviation of image coordinates, pixels.", 0.5)
    sigma_terrain: float | None = opt("Standard deviation of terrain heights, metres [the model's own].", None)
    sigma_position: tuple[float, float, float] = opt(
        "Standard deviation of the projection centre, metres [0].", (0.0, 0.0, 0.0)
    )
    sigma_angles: tuple[float, float, float] = opt(
        "Standard deviation of ω φ κ, in the project's unit [0].", (0.0, 0.0, 0.0)
    )
    overwrite: bool = OVERWRITE
