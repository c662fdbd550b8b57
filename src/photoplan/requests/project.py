"""Requests of commands about a project as a whole: its file, its check, its error budget; and descriptions of files."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from photoplan.io.orientation.form import TableFormat
from photoplan.request import BEYOND_AREA, OVERWRITE, Request, arg, opt


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
