"""Requests of the terrain commands: heights, profiles, contours, shading, volumes, visibility, flow, export."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

from photoplan.errors import UsageError
from photoplan.request import (
    BEYOND_AREA,
    BOUNDS,
    ONE_WORKER,
    OVERWRITE,
    REPORT_FORMAT,
    WORKERS,
    Request,
    arg,
    crs_option,
    opt,
    path_or,
)
from photoplan.terrain.shading import ContourOptions, Lighting


def _model() -> Path:
    return arg("Terrain model (.gpkg) or raster of heights.")


_SAME = "Declare with `same` that both models have the same height system."


class BuildRequest(Request):
    """Options of a terrain model from measured points and lines."""

    inputs: tuple[Path, ...] = arg("Files of points and lines.", metavar="POINTS…")
    output: Path = opt("Terrain model to write.", metavar="GPKG", writes=True)
    grid_width: float | None = opt("Grid width, metres [half the spacing; half of that at breaklines].", None, gt=0,
                                   metavar="M")  # fmt: skip
    adapt: float | None = opt(
        "Widen the grid of a unit while its surface stays within this distance, metres; 0 for never "
        "[a quarter of its standard deviation].",
        None,
        ge=0,
        metavar="M",
    )
    unit_meshes: int = opt("Number of meshes along the side of a unit: a power of two.", 64)
    filters: tuple[str, ...] = opt(
        "Standard deviation of measurement of mass, spot, breakline, formline, border or hole, metres [mass: "
        "estimated; others: a share of it].", (), flag="filter", metavar="CLASS=M",
    )  # fmt: skip
    covariance: str = opt("Covariance function: auto, gaussian, matern or exponential.", "auto")
    gross: float = opt("Normalised residual from which a point is a gross error; 0 if none is rejected.", 5.0, ge=0)
    reach: float | None = opt("Half the width from which on gaps stay open, metres [10 spacings].", None, gt=0,
                              metavar="M")  # fmt: skip
    codes: Annotated[Path | object | None, path_or()] = opt(
        "Codes and layers: TOML, or CSV with code, class, sigma.", None, metavar="FILE", section="input"
    )
    columns: str | None = opt("Columns of text files, such as x=East,y=North,z=Height,code=Art or x,y,z,-,code.", None,
                              section="input")  # fmt: skip
    delimiter: str | None = opt("Delimiter of text files: comma, semicolon, tab or space [what fits].", None,
                                section="input")  # fmt: skip
    decimal_comma: bool = opt("Numbers are written 1,5.", False, section="input")
    attribute: str | None = opt("Attribute of vector files that holds the code [kind, class or code].", None,
                                section="input")  # fmt: skip
    layers: tuple[str, ...] = opt("Layer or surface to read; may be repeated [all].", (), flag="layer", section="input")
    las_classes: tuple[int, ...] = opt("Class of LAS points to read; may be repeated [2].", (), flag="las-class",
                                       section="input")  # fmt: skip
    tin_points: bool = opt("Take the vertices of a LandXML triangulation as points, if it has no others.", False,
                           section="input")  # fmt: skip
    nodata: float | None = opt("Height that stands for no height.", None, section="input")
    crs: str | None = crs_option("files that state none")
    height_field: str | None = opt(
        "Attribute of vector files that holds heights, as of contours; of drawings that of blocks, or Text.", None,
        metavar="NAME", section="input",
    )  # fmt: skip
    unit: str | None = opt("Unit of drawings whose header states none or a wrong one [as $INSUNITS states].", None,
                           section="input")  # fmt: skip
    height_system: str | None = opt("Height system of files that state none: ellipsoidal or EPSG:nnnn.", None,
                                    section="input")  # fmt: skip
    beyond_area: bool = BEYOND_AREA
    report: bool | None = opt("Write a page with plots next to the model [if matplotlib is installed].", None,
                              section="result")  # fmt: skip
    report_format: Literal["html", "pdf"] = REPORT_FORMAT
    dry_run: bool = opt("Read, clean and plan; print it and stop.", False, section="run")
    workers: int = ONE_WORKER
    overwrite: bool = OVERWRITE

    def check(self) -> None:
        """Refuse standard deviations that are no numbers."""
        _ = self.sigmas

    @property
    def sigmas(self) -> dict[str, float]:
        """Standard deviations of measurement by class, metres."""
        found = {}
        for text in self.filters:
            name, _, value = text.partition("=")
            try:
                found[name.strip()] = float(value)
            except ValueError:
                raise UsageError(f"`filter` {text!r} must be a class and a number, such as mass=0.15") from None
        return found

    @property
    def drawn(self) -> dict[str, Path]:
        """The page of the report."""
        name = f"{self.output.stem}.report.{self.report_format}"
        return {} if self.report is False else {"report": self.output.with_name(name)}


class InfoRequest(Request):
    """Options of the description of a terrain model."""

    model: Path = _model()
    gross: bool = opt("List the measurements that were flagged as gross errors, and suspects.", False)


class SampleRequest(Request):
    """Options of heights at points."""

    model: Path = _model()
    points: Path = arg("Table of points.")
    output: Path = opt("Table to write.", metavar="CSV", writes=True)
    x: str | None = opt("Column of X, by name or number [x, east, easting].", None, metavar="NAME", section="input")
    y: str | None = opt("Column of Y [y, north, northing].", None, metavar="NAME", section="input")
    delimiter: str | None = opt(
        "Delimiter of the table: comma, semicolon, tab or space [the one that splits the first line].",
        None,
        section="input",
    )
    decimal_comma: bool = opt("Numbers of the table are written 1,5.", False, section="input")
    header: bool = opt("The first line names the columns.", True, flag="no-header", section="input",
                       off="The first line is a point; columns are numbers, X and Y are 1 and 2.")  # fmt: skip
    names: tuple[str, str] = opt("Names of the new columns.", ("height", "sigma"), metavar="HEIGHT SIGMA",
                                 section="result")  # fmt: skip
    digits: int = opt("Decimals of the heights.", 4, ge=0, le=9, section="result")
    points_crs: str | None = opt("CRS of the points [the model's].", None, metavar="CRS", section="input")
    crs: str | None = crs_option()
    overwrite: bool = OVERWRITE


class ProfileRequest(Request):
    """Options of profiles over lines."""

    model: Path = _model()
    lines: Path = arg("Vector file of lines, or a table of points along them.")
    outputs: tuple[Path, ...] = opt("Tables .csv, and a plot .png; may be repeated.", (), flag="output",
                                    metavar="FILE", writes=True, required=True)  # fmt: skip
    tolerance: float = opt("Largest distance in height from the surface, metres.", 0.001, gt=0, metavar="M")
    x: str | None = opt("Column of X, by name or number [x, east, easting].", None, metavar="NAME", section="input")
    y: str | None = opt("Column of Y [y, north, northing].", None, metavar="NAME", section="input")
    line_column: str | None = opt("Column that names the line of a point [line, if there is one].", None, flag="line",
                                  metavar="NAME", section="input")  # fmt: skip
    decimal_comma: bool = opt("Numbers of the table are written 1,5.", False, section="input")
    crs: str | None = crs_option()
    overwrite: bool = OVERWRITE


class ContourRequest(Request):
    """Options of contour lines."""

    model: Path = _model()
    output: Path = opt("Contours to write: .gpkg, .shp, .geojson or .dxf.", metavar="FILE", writes=True)
    options: ContourOptions
    bounds: tuple[float, float, float, float] | None = BOUNDS
    labels: bool = opt("Find places for labels: a second layer or file.", False, section="result")
    label_all: bool = opt("Label every contour, not only index contours.", False, section="result")
    text_height: float | None = opt(
        "Height of labels, metres on the ground [1/200 of the extent].", None, gt=0, section="result"
    )
    label_spacing: float | None = opt(
        "Distance of labels along a line, metres [60 text heights].", None, gt=0, section="result"
    )
    crs: str | None = crs_option()
    preview: Path | None = opt("Write a preview of the contours.", None, metavar="PNG", writes=True)
    overwrite: bool = OVERWRITE


class PictureRequest(Request):
    """Options that all pictures of a terrain have."""

    model: Path = _model()
    output: Path = opt("GeoTIFF to write.", metavar="TIF", writes=True)
    resolution: float | None = opt("Pixel size, metres [the model's mesh width].", None, gt=0, metavar="R")
    bounds: tuple[float, float, float, float] | None = BOUNDS
    crs: str | None = crs_option()
    preview: Path | None = opt("Write a preview.", None, metavar="PNG", writes=True)
    overwrite: bool = OVERWRITE
    workers: int | None = WORKERS


class ShadeRequest(PictureRequest):
    """Options of a hillshade."""

    light: Lighting = Lighting()


class SlopeRequest(PictureRequest):
    """Options of slopes and aspects."""

    percent: bool = opt("Percent instead of degrees, also for the classes.", False)
    classes: tuple[float, ...] = opt("Write classes: 1 below A, 2 from A to B, …; e.g. 5,10,20,35.", (), listed=True,
                                     metavar="A,B,…")  # fmt: skip
    aspect: bool = opt("Write the direction of fall instead, degrees from north; flat: -1.", False)

    def check(self) -> None:
        """Refuse options of slopes with aspects."""
        if self.aspect and (self.percent or self.classes):
            raise UsageError("`aspect` goes with neither `percent` nor `classes`")


class TintRequest(PictureRequest):
    """Options of height tints."""

    ramp: str = opt("Colour ramp: hypsometric, grey, spectral, or a text file with lines `height red green blue`.",
                    "hypsometric", metavar="NAME|FILE")  # fmt: skip
    heights: tuple[float, float] | None = opt("Heights at the ends of a built-in ramp [those of the model].", None,
                                              metavar="LOW HIGH")  # fmt: skip
    classes: int | None = opt("Number of classes of a built-in ramp [blended].", None, ge=1, le=1000, metavar="N")
    classed: bool = opt("Give each height the colour of the entry of a ramp file below it.", False)
    shade: bool = opt("Combine the tints with a hillshade.", False)
    strength: float = opt("Strength of the hillshade.", 0.6, ge=0, le=1)
    light: Lighting = Lighting()

    def check(self) -> None:
        """Refuse options of built-in ramps with files, and the other way round."""
        built_in = self.ramp in ("hypsometric", "grey", "spectral")
        if not built_in and (self.heights is not None or self.classes is not None):
            raise UsageError("`heights` and `classes` go with a built-in `ramp`; a file states its heights itself")
        if built_in and self.classed:
            raise UsageError("`classed` goes with a ramp file; set `classes` for a built-in ramp")


class VolumeRequest(Request):
    """Options of cut and fill; the volume is that of B − A."""

    a: Path = arg("First terrain.", metavar="A")
    b: Path = arg("Second terrain.", metavar="B")
    polygons: Path | None = opt("Polygons to integrate over, each with its own figures [the common rectangle].", None,
                                flag="polygon", section="input")  # fmt: skip
    resolution: float | None = opt(
        "Cell size of the integration, metres [the finer mesh width, halved until settled].", None, gt=0
    )
    tolerance: float = opt("Relative change of the volume below which cells are no longer halved.", 1e-3)
    sigma_a: float | None = opt("Standard deviation of A's heights, metres [the model's own].", None, ge=0)
    sigma_b: float | None = opt("Standard deviation of B's heights, metres [the model's own].", None, ge=0)
    correlation: float | None = opt("Correlation length of height errors, metres [each mesh width].", None)
    bias: float = opt("Standard deviation of a common height error, metres.", 0.0)
    height_system: str | None = opt(_SAME, None, metavar="same", section="input")
    crs: str | None = crs_option()
    difference: Path | None = opt("Write the raster of B − A.", None, metavar="TIF", writes=True)
    workers: int | None = WORKERS
    overwrite: bool = OVERWRITE


class VisibleRequest(Request):
    """Options of a visibility map."""

    model: Path = _model()
    output: Path = opt("Map to write.", metavar="TIF", writes=True)
    points: tuple[tuple[float, float], ...] = opt("Observer; may be repeated.", (), flag="from", metavar="X Y",
                                                  section="input")  # fmt: skip
    file: Path | None = opt("Table (x, y, h, name) or vector file of observers.", None, flag="observers",
                            section="input")  # fmt: skip
    height_observer: float = opt("Height of the eye above ground, metres.", 1.7)
    height_target: float = opt("Height of the target above ground, metres.", 0.0)
    radius: float = opt("Largest distance of a target, metres [all].", math.inf, infinite=True)
    refraction: float = opt("Coefficient of refraction k.", 0.13)
    curvature: bool = opt("Take the curvature of the earth into account [yes].", True)
    minimum_height: bool = opt("Write the height above ground from which a place is seen.", False)
    resolution: float | None = opt("Pixel size, metres [mesh width].", None, gt=0)
    memory: int = opt("Largest memory of the grids.", 2 << 30, size=True, metavar="SIZE", section="run")
    workers: int | None = WORKERS
    crs: str | None = crs_option()
    overwrite: bool = OVERWRITE


class FlowRequest(Request):
    """Options of catchments and flow lengths."""

    model: Path = _model()
    output: Path = opt("Raster to write.", metavar="TIF", writes=True)
    resolution: float | None = opt("Cell size, metres [mesh width].", None, gt=0)
    outlets: Path | None = opt("Outlets whose catchments are computed: table x, y, name, or vector file.", None,
                               section="input")  # fmt: skip
    snap: float = opt("Move outlets to the largest flow within this distance, metres.", 0.0, ge=0)
    catchments: Path | None = opt("Write the catchments as polygons.", None, metavar="GPKG", writes=True)
    method: Literal["d8", "dinf"] = opt("How upstream areas are summed.", "d8")
    memory: int = opt("Largest memory of the grid.", 2 << 30, size=True, metavar="SIZE", section="run")
    workers: int | None = WORKERS
    crs: str | None = crs_option()
    overwrite: bool = OVERWRITE


class RefineRequest(Request):
    """Options of a finer model inside polygons."""

    coarse: Path = arg("Terrain that is refined.")
    fine: Path = arg("Terrain that counts inside the polygons.")
    polygons: Path = opt("Polygons in which the fine terrain counts.", metavar="FILE", section="input")
    output: Path = opt("Model to write, a .gpkg.", metavar="MODEL", writes=True)
    transition: float = opt("Width of the band inside the polygons in which the two are joined, metres.", ge=0,
                            metavar="M")  # fmt: skip
    width: float | None = opt("Largest grid width inside the polygons [the fine model's finest].", None, gt=0,
                              metavar="M")  # fmt: skip
    crs: str | None = crs_option()
    height_system: str | None = opt(_SAME, None, metavar="same", section="input")
    overwrite: bool = OVERWRITE


class ExportRequest(Request):
    """Options of the export of a terrain model."""

    model: Path = _model()
    output: Path = opt("File to write: .tif, .obj, .ply, .xml (LandXML), .xyz or .csv.", metavar="FILE", writes=True)
    resolution: float | None = opt("Pixel size of a raster, metres [finest grid width].", None, gt=0, metavar="R")
    bounds: tuple[float, float, float, float] | None = BOUNDS
    sigma: Path | None = opt("Write a raster of the standard deviations.", None, metavar="TIF", writes=True)
    crs: str | None = crs_option()
    workers: int | None = WORKERS
    overwrite: bool = OVERWRITE
