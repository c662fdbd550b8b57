"""Requests of commands about a project as a whole: its file, its check, its error budget; and descriptions of files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from photoplan.errors import UsageError
from photoplan.io.orientation.block import TableFormat
from photoplan.request import BEYOND_AREA, IMAGES, OVERWRITE, PROJECT, WORKERS, Request, arg, opt


def _input(help: str, metavar: str) -> Any:
    return opt(help, None, metavar=metavar, section="input")


class InitRequest(Request):
    """Options of a project file from the files that users have; relative paths start at the current folder."""

    folder: Path = arg("Folder of the project, in which `project.toml` is written.", metavar="DIR", folder=True)
    images: tuple[str, ...] = opt("Image files or patterns with *, ? and **; may be repeated.", listed=True,
                                  metavar="PATTERN,…", section="input")  # fmt: skip
    camera: Path | None = _input("Cameras: TOML, YAML or JSON [images have RPC].", "FILE")
    orientation: Path | None = _input("Orientation: TOML, JSON, table … [images are to be oriented].", "FILE")
    terrain: str | None = _input("Raster of heights, or one height in metres; products require it.", "FILE|HEIGHT")
    crs: str | None = _input("CRS of the project, EPSG:nnnn or WKT [the orientation's].", "CRS")
    height_system: str | None = _input(
        "Height system of files that state none: ellipsoidal, EPSG:nnnn (a vertical CRS), or same.", "NAME"
    )
    terrain_crs: str | None = _input("CRS of a terrain file that states none (ASC).", "CRS")
    terrain_height_system: str | None = _input("Height system of the terrain, also against its file.", "NAME")
    orientation_height_system: str | None = _input("Height system of the orientation, also against its file.", "NAME")
    form: TableFormat = TableFormat()
    format: str | None = _input("Format of the orientation file [by its content].", "FORMAT")
    earth_curvature: Literal["none", "correction", "strict"] | None = opt(
        "Curved earth and map scale [strict for poses in true metres, such as OpenSfM's; else none].", None
    )
    refraction: bool = opt("Correct for refraction by a standard atmosphere.", False)
    scene: Literal["z < 0", "z > 0"] = opt(
        "Side of the image on which the scene lies in the camera system of angles and fiducial marks.",
        "z < 0",
        choices={"z<0": "z < 0", "z>0": "z > 0"},
    )
    image_points: tuple[Path, ...] = opt("Measured image points; may be repeated.", (), metavar="FILE", section="input")
    control: tuple[Path, ...] = opt("Ground points, control and check; may be repeated.", (), metavar="FILE",
                                    section="input")  # fmt: skip
    positions: Path | None = _input("Observed projection centres (GNSS).", "FILE")
    beyond_area: bool = BEYOND_AREA
    overwrite: bool = OVERWRITE

    @property
    def path(self) -> Path:
        """The project file."""
        return self.folder / "project.toml"


class CheckRequest(Request):
    """Options of the check of a project."""

    project: Path = PROJECT
    images: tuple[str, ...] = IMAGES


class BudgetRequest(Request):
    """Options of an error budget: of a project, or of a vertical image that numbers state."""

    project: Path | None = opt("Project file, or the folder that holds `project.toml`.", None, argument=True,
                               project=True)  # fmt: skip
    images: tuple[str, ...] = IMAGES
    camera_constant: float | None = opt("Camera constant of a vertical image, without a project.", None, metavar="MM",
                                        section="input")  # fmt: skip
    format: tuple[float, float] = opt(
        "Width and height of the image format, mm [230 230].", (230.0, 230.0), metavar="MM MM", section="input"
    )
    pixel: float = opt("Side of a pixel, µm [15].", 15.0, metavar="UM", section="input")
    height: float | None = opt("Flying height above ground.", None, metavar="M", section="input")
    sigma_terrain: float | None = opt("Standard deviation of heights, metres [the project's].", None, metavar="M",
                                      section="input")  # fmt: skip
    sigma_center: tuple[float, float, float] | None = opt(
        "Standard deviations of projection centres, metres [the project's].", None, metavar="X Y Z", section="input"
    )
    sigma_angles: tuple[float, float, float] | None = opt(
        "Standard deviations of angles [the project's].", None, metavar="A B C", section="input"
    )
    angle_unit: Literal["deg", "gon", "rad"] = opt("Unit of angles without a project [gon].", "gon", section="input")
    kernel: str = opt("Resampling kernel [bicubic].", "bicubic")
    tolerance: float = opt("Largest approximation error of the anchors, pixels [0.02].", 0.02, metavar="PX")
    tables: bool = opt("Print the tables and examples of Ecker 1991 instead.", False, section="result")
    picture: Path | None = opt("Write a drawing of the contributions, and a map of the total.", None, metavar="PNG",
                               writes=True)  # fmt: skip
    overwrite: bool = OVERWRITE

    def check(self) -> None:
        """Refuse a project with numbers, and numbers that are incomplete or not positive."""
        if self.tables:
            return
        if (self.project is None) == (self.camera_constant is None):
            raise UsageError("a budget requires PROJECT, or `camera_constant` and `height`")
        if self.project is None and self.height is None:
            raise UsageError("a budget of numbers requires the flying height above ground: set `height` METRES")
        numbers = [self.camera_constant, self.height, *self.format, self.pixel, self.tolerance]
        if not all(n is None or n > 0 for n in numbers):
            raise UsageError(f"numbers of the flight must be positive, found {numbers}")


class ReportRequest(Request):
    """Options of the quality report of a project."""

    project: Path = PROJECT
    output: Path | None = opt("Report to write, HTML or PDF by its ending [report.html beside the project file].", None,
                              metavar="FILE", writes=True)  # fmt: skip
    checked: bool = opt("Include the check and the error budget, which open the images.", True, flag="no-check",
                        off="Leave out the check and the error budget, which open the images.")  # fmt: skip
    overwrite: bool = OVERWRITE

    @property
    def drawn(self) -> Mapping[str, Path]:
        """The report."""
        return {"report": self.output or self.project.resolve().parent / "report.html"}


class DescribeRequest(Request):
    """Options of the description of a file."""

    file: Path = arg("File of any kind that a command reads or writes, or folder of images.")
    picture: Path | None = opt("Draw a restoration filter as PNG.", None, flag="plot", metavar="PICTURE", writes=True)
    overwrite: bool = OVERWRITE


class SchemaRequest(Request):
    """Options of the description of commands."""

    verb: tuple[str, ...] = opt("Words of the command.", (), argument=True)


class WarmupRequest(Request):
    """Options of the compilation of kernels before the first run."""

    command: tuple[str, ...] = opt("Commands, such as ortho or terrain [all].", (), argument=True)
    dtypes: tuple[Literal["uint8", "uint16", "int16", "float32"], ...] = opt(
        "Types of the images' pixels [uint8].", ("uint8",), flag="dtype", metavar="TYPE", listed=True, section="input"
    )
    bands: int = opt("Bands of the images [3].", 3, ge=1, section="input")
    kernel: Literal["nearest", "bilinear", "bicubic", "bicubic-1", "lanczos3"] = opt(
        "Resampling kernel [bicubic].", "bicubic"
    )
    workers: int | None = WORKERS
