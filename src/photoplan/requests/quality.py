"""Requests of commands about image quality: mtf, restore, characterise, sensor, simulate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from photoplan.errors import UsageError
from photoplan.request import BOUNDS, DRY_RUN, IMAGES, MEMORY, ONE_WORKER, OVERWRITE, Request, arg, opt, path_or

REPORT: Any = opt("Report with plots to write, HTML or PDF.", None, metavar="FILE", writes=True)


class SensorRequest(Request):
    """Options of the figures of a sensor."""

    file: Path = arg("Description of the sensor (TOML).")
    report: Path | None = REPORT
    csv: Path | None = opt("Table of the figures to write.", None, metavar="CSV", writes=True)
    dry_run: bool = DRY_RUN
    overwrite: bool = OVERWRITE


class MtfRequest(Request):
    """Options of the measurement of sharpness, at edges or in test patterns."""

    images: tuple[Path, ...] = arg("Images.")
    rois: tuple[tuple[int, int, int, int], ...] = opt(
        "Window with one edge or pattern; may be repeated [edges are sought in the whole image].", (), flag="roi",
        metavar="COL ROW WIDTH HEIGHT", section="input",
    )  # fmt: skip
    pattern: Literal["bars", "star", "usaf"] | None = opt("Test pattern that is measured.", None)
    sectors: int | None = opt("Number of bright sectors of a star [counted].", None, ge=4, le=360)
    group: int | None = opt("Largest group of a USAF target in the image.", None, ge=-6, le=12)
    levels: tuple[float, float] | None = opt(
        "Grey values of wide dark and bright areas beside bars or a star [found].", None, metavar="LOW HIGH"
    )
    coltman: bool = opt("Compute the MTF of bars also by Coltman's series.", False)
    linearisation: str | None = opt("Conversion of grey values into light [linear].", None,
                                    metavar="linear|srgb|TABLE", section="input")  # fmt: skip
    band: str | None = opt("Band, or luminance and every band [luminance, or the only band].", None, metavar="N|all",
                           section="input")  # fmt: skip
    pixel_um: float | None = opt("Pixel size on the sensor, µm, for cycles/mm; for USAF targets on the target.", None,
                                 flag="pixel-size", metavar="UM", section="input")  # fmt: skip
    lab: Path | None = opt("MTF values of a laboratory to compare.", None, metavar="FILE", section="input")
    flight: Literal["x", "y"] | None = opt("Flight direction along rows (x) or columns (y).", None, section="input")
    grid: int = opt("Number of cells of the field, each way.", 3, ge=1, le=50)
    most_edges: int = opt("Number of edges that are measured in an image.", 60, ge=1, le=5000)
    least_length: float | None = opt("Shortest edge, pixels [20; with `roi` 12].", None, ge=8, le=10_000)
    half_width: int = opt("Largest distance from the edge that is used, pixels.", 20, ge=6, le=60)
    least_snr: float = opt("Smallest contrast of an edge over its noise.", 8.0, ge=3, le=1e6)
    csv: Path | None = opt("Table to write, with a row for each edge or point of a curve.", None, metavar="CSV",
                           writes=True)  # fmt: skip
    report: Path | None = REPORT
    overwrite: bool = OVERWRITE

    def check(self) -> None:
        """Refuse options of another pattern than the one that is measured."""
        of_edges = ("lab", "flight", "grid", "most_edges", "least_length", "half_width", "least_snr")
        patterns = {"sectors": ("star",), "group": ("usaf",), "levels": ("bars", "star"), "coltman": ("bars",)}
        for name in (*of_edges, *patterns):
            if getattr(self, name) == type(self).model_fields[name].default:
                continue
            if name in of_edges and self.pattern is not None:
                raise UsageError(f"`{name}` is for edges, not for `pattern` {self.pattern}")
            if name in patterns and self.pattern not in patterns[name]:
                raise UsageError(f"`{name}` requires `pattern` {' or '.join(patterns[name])}")
        low, high = (0.01, 1e4) if self.pattern is None else (1e-3, 1e6)
        if self.pixel_um is not None and not low <= self.pixel_um <= high:
            raise UsageError(f"`pixel_size` {self.pixel_um:g} must be from {low:g} to {high:.0f} micrometres")

    def files_read(self) -> list[Path]:
        """Return images and tables."""
        return [*super().files_read(), *table_of(self.linearisation)]


class RestoreRequest(Request):
    """Options of the restoration of images, and of the measurement of a filter."""

    images: tuple[Path, ...] = arg("Images.")
    filter: Annotated[Path | object | None, path_or("none")] = opt(
        "Filter: TOML, or one kernel as rows of numbers; none: no filter [measured at edges of the images].", None,
        metavar="FILE|none", section="input",
    )  # fmt: skip
    output: Path | None = opt("Folder of the results [restored, beside the first image].", None, metavar="FOLDER",
                              folder=True, writes=True)  # fmt: skip
    bands: tuple[int, ...] = opt("Band to restore; may be repeated [all]. Others stay as they are.", (), flag="band",
                                 metavar="N")  # fmt: skip
    linearisation: str | None = opt("Conversion of grey values into the light that is filtered [linear].", None,
                                    metavar="linear|srgb|TABLE", section="input")  # fmt: skip
    dtype: str = opt("Type of the results: same, float32 or uint16.", "same", metavar="TYPE", section="result")
    chromatic: Annotated[Path | object | None, path_or("measure")] = opt(
        "Align the bands first: by a model, or as measured in each image.", None, metavar="FILE|measure",
        section="input",
    )  # fmt: skip
    fall_off: Path | None = opt("Correct the light fall-off first, by a model of `photoplan characterise`.",
                                None, metavar="TOML", section="input")  # fmt: skip
    aperture: str | None = opt("Aperture of a scanner to undo: square or round, RATIO of aperture by step [1].", None,
                               metavar="SHAPE[:RATIO]")  # fmt: skip
    method: Literal["auto", "exact", "regularised"] = opt(
        "Method of a measured filter; auto: the one of least expected error.", "auto"
    )
    rotation: Literal["radial", "separable"] = opt("Form of an exact inverse in two dimensions.", "radial")
    size: int | None = opt("Side of a measured filter, pixels [11 or more].", None, ge=3, le=101, metavar="N")
    cells: int = opt("Filters for N by N parts of the field, interpolated between them.", 1, ge=1, le=15, metavar="N")
    per_band: bool = opt("Measure a filter for each band.", False)
    most_edges: int = opt("Number of edges that are measured in an image.", 200, ge=1, le=5000)
    least_length: float | None = opt("Shortest edge, pixels [20].", None, ge=8, le=10_000, metavar="PX")
    noise: float | None = opt(
        "Standard deviation of the noise in light, full scale 1 [found in the images].", None, ge=0, metavar="SIGMA"
    )
    save_filter: Path | None = opt("Measured filter to write [restoration_filter.toml by the results].", None,
                                   metavar="TOML", writes=True)  # fmt: skip
    compress: str = opt("Compression: deflate, zstd, lzw, jpeg or none.", "deflate", section="result")
    report: Path | None = REPORT
    quicklook: bool = opt("Write previews.", True, flag="no-quicklook", section="result", off="Write no previews.")
    dry_run: bool = DRY_RUN
    workers: int = ONE_WORKER
    memory: int | None = MEMORY
    overwrite: bool = OVERWRITE

    def check(self) -> None:
        """Refuse options of a measurement beside a filter."""
        if not self.images:
            raise UsageError("no image is set; set one or more")
        if self.filter is not None and self.aperture is not None:
            raise UsageError("`filter` and `aperture` exclude each other; set one, or none to measure a filter")
        given = "filter" if self.filter is not None else "aperture"
        measuring = ("method", "rotation", "size", "cells", "per_band", "most_edges", "least_length", "noise",
                     "save_filter")  # fmt: skip
        for name in measuring if getattr(self, given) is not None else ():
            if getattr(self, name) != type(self).model_fields[name].default:
                raise UsageError(f"`{name}` is for filters that are measured; leave out `{given}`")
        if self.size is not None and self.size % 2 == 0:
            raise UsageError(f"`size` {self.size} must be odd: a filter has as many rows and columns")
        if self.dtype not in ("same", "float32", "uint16"):
            raise UsageError(f"`dtype` {self.dtype!r} must be same, float32 or uint16")

    @property
    def folder(self) -> Path:
        """Folder of the results."""
        return self.images[0].parent / "restored" if self.output is None else self.output

    def files_read(self) -> list[Path]:
        """Return images, filter, corrections and tables."""
        return [*super().files_read(), *table_of(self.linearisation)]


class CharacteriseRequest(Request):
    """Options of the measurement of a camera in image series."""

    series: Path = arg("Image series (TOML).")
    only: tuple[str, ...] = opt("Analysis to run; may be repeated [all possible].", (), metavar="NAME")
    report: Path | None = REPORT
    csv: Path | None = opt("Folder for the figures as tables.", None, metavar="FOLDER", folder=True, writes=True)
    dry_run: bool = DRY_RUN
    overwrite: bool = OVERWRITE

    def files_read(self) -> list[Path]:
        """Return the series and its files."""
        from photoplan.io.series import read_series

        return [self.series, *read_series(self.series).inputs]


class SimulateRequest(Request):
    """Options of images that are formed of a file, a pattern or a project by a described camera."""

    scene: str | None = arg("Image file, or a pattern such as edge:5.", default=None, metavar="[SCENE]")
    project: Path | None = opt("Render the images of a project from its terrain and objects.", None, flag="scene",
                               metavar="PROJECT", project=True, section="input")  # fmt: skip
    model: Path | None = opt("Description of the camera [changes nothing].", None, metavar="FILE", section="input")
    output: Path | None = opt(
        "TIFF to write [SCENE_simulated.tif]; folder for the images of a project [rendered, in its folder].", None,
        metavar="PATH", writes=True,
    )  # fmt: skip
    images: tuple[str, ...] = IMAGES
    texture: Path | None = opt("Raster of the ground's colours [a pattern].", None, metavar="FILE", section="input")
    grain: float | None = opt("Shortest wavelength of the pattern, metres [8 ground pixels].", None, gt=0, metavar="M")
    truth: bool = opt("Write also X, Y, Z and object of each pixel: NAME_truth.tif.", False, section="result")
    resolution: float | None = opt(
        "Ground pixel of a true orthophoto of the scene that is also written, metres [none].",
        None,
        metavar="R",
        section="result",
    )
    bounds: tuple[float, float, float, float] | None = BOUNDS
    frames: int = opt("Number of images to form, in numbered files.", 1, ge=1, le=10_000)
    seed: int | None = opt("Seed of the random numbers [the model's, else 0].", None, ge=0, lt=2**62)
    exposure: tuple[float, ...] = opt("Factor of the exposure, one or one for each frame [1].", (),
                                      metavar="FACTOR")  # fmt: skip
    size: tuple[int, int] | None = opt("Size of a pattern, pixels [512 512].", None, metavar="WIDTH HEIGHT")
    levels: tuple[float, float] | None = opt("Values of a pattern [0 1].", None, metavar="DARK BRIGHT")
    phase: tuple[float, float] | None = opt("Shift of a pattern from the middle, pixels [0 0].", None,
                                            metavar="X Y")  # fmt: skip
    oversampling: int | None = opt(
        "Cells of the scene along a side of a pixel [files 1, patterns 8, projects 2].", None, ge=1, le=64
    )
    dtype: Literal["uint8", "uint16", "float32"] | None = opt("Type of the files [as the model states].", None,
                                                              section="result")  # fmt: skip
    dry_run: bool = DRY_RUN
    workers: int = ONE_WORKER
    overwrite: bool = OVERWRITE

    def check(self) -> None:
        """Refuse options that do not belong to the kind of scene."""
        if (self.scene is None) == (self.project is None):
            raise UsageError("SCENE, a file or a pattern, or `project` is required")
        of_projects, of_patterns = "images texture grain truth resolution bounds", "frames exposure size levels phase"
        idle, kind = (of_patterns, "project") if self.scene is None else (of_projects, "file or pattern")
        for name in idle.split():
            if getattr(self, name) != type(self).model_fields[name].default:
                raise UsageError(f"`{name}` does not go with a {kind}; leave it out")
        if self.bounds is not None and self.resolution is None:
            raise UsageError("`bounds` of the true orthophoto require its `resolution`")
        if self.size is not None and min(self.size) < 1:
            raise UsageError(f"`size` {self.size[0]} {self.size[1]}: each side must be at least 1 pixel")


def table_of(linearisation: str | None) -> list[Path]:
    """Return the file of a linearisation, if it has one."""
    return [] if linearisation in (None, "linear", "srgb") else [Path(str(linearisation))]
