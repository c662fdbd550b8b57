"""Requests of commands that make orthophotos and mosaics, of their seams, colours, light and haze."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import BeforeValidator

from photoplan.errors import UsageError
from photoplan.plan.options import Weights
from photoplan.request import (
    BOUNDS,
    DRY_RUN,
    EXECUTOR,
    IMAGES,
    MEMORY,
    ONE_WORKER,
    OVERWRITE,
    PICTURE,
    PROJECT,
    TARGET,
    WORKERS,
    Request,
    arg,
    opt,
)

Kernel = Literal["nearest", "bilinear", "bicubic", "bicubic-1", "lanczos3"]
Hidden = Literal["show", "nodata", "mark"]
Method = Literal["indirect", "direct"]
Compression = Literal["deflate", "zstd", "lzw", "jpeg", "none"]

#: Gaps wider than twice this, and hidden holes wider than this, are not filled, pixels.
MOST_FILLED = 32

_WEIGHTS: Any = opt("Weights of slant, coarseness, border, occlusion, sharpness [1, 1, 1, 0.5, 0].", Weights(),
                    flag="score", listed=True, metavar="NAME=WEIGHT,…")  # fmt: skip
_PREFER: Any = opt("Images that are preferred wherever they see the ground.", (), listed=True, metavar="NAME,…")
_SOURCES: Any = opt("Write which image painted each pixel: NAME_sources.tif, NAME_seams.gpkg.", False, section="result")


def _one_of(what: str, names: Any) -> BeforeValidator:
    """Return a check whose message names what may be given, whether a command, a call or a project states it."""

    def judged(given: Any) -> Any:
        if given is not None and given not in get_args(names):
            raise UsageError(f"{what} {given!r} must be one of {', '.join(get_args(names))}")
        return given

    return BeforeValidator(judged)


class Choice(Request):
    """Options by which a mosaic chooses among its images."""

    name: str = opt("Base name of the output files.", "mosaic", section="result")
    weights: Weights = _WEIGHTS
    prefer: tuple[str, ...] = _PREFER
    seams: Path | None = opt(
        "Regions with the image that paints each, in preference to the score: an edited NAME_seams.gpkg.", None,
        metavar="FILE", section="input"
    )  # fmt: skip
    feather: float = opt(
        "Width of the transition between images along seams, metres, where both see the ground [0].", 0.0, metavar="W"
    )
    blend: Literal["mean", "multiband"] = opt(
        "mean: all detail blends over W; multiband: coarse detail over W, fine detail at the seam.", "mean"
    )
    sheets: Annotated[str | float | None, BeforeValidator(lambda given: _number_or_text(given))] = opt(
        "Cut the mosaic into squares of SIZE metres or into polygons, with STAC items; NAME.vrt joins them.", None,
        metavar="SIZE|FILE", section="result"
    )  # fmt: skip

    def check(self) -> None:
        """Refuse a blending without a width."""
        if self.blend == "multiband" and self.feather == 0:
            raise UsageError("`blend` multiband requires `feather`, the width over which coarse detail passes")


def _number_or_text(given: Any) -> Any:
    try:
        return float(given)
    except (TypeError, ValueError):
        return given


class PixelOptions(Request):
    """Options that decide the pixels and files of all products; those that are not set may be the project's."""

    resolution: float | None = opt("Ground pixel size, metres [the images' mean GSD].", None, nan=True, metavar="R")
    bounds: tuple[float, float, float, float] | None = BOUNDS
    kernel: Annotated[Kernel, _one_of("kernel", Kernel)] = opt(
        "Resampling kernel: nearest, bilinear, bicubic, bicubic-1 or lanczos3 [bicubic].", "bicubic", metavar="NAME"
    )
    tolerance: float = opt(
        "Largest approximation error of the anchors, pixels; 0 computes every pixel strictly [0.02].",
        0.02,
        metavar="PX",
    )
    hidden: Annotated[Hidden | None, _one_of("hidden", Hidden)] = opt(
        "Hidden ground: show, nodata, or mark (in a second raster) [show; mosaics, true orthophotos: nodata].",
        None, metavar="HOW"
    )  # fmt: skip
    fill_hidden: int = opt(
        "Fill hidden holes up to PX wide and high, and mark them in NAME_sources.tif [0: fill none].", 0, ge=0,
        le=MOST_FILLED, metavar="PX"
    )  # fmt: skip
    accuracy: bool = opt("Write a raster of standard deviations, and a preview.", False, section="result")
    compress: Annotated[Compression, _one_of("compression", Compression)] = opt(
        "Compression of the file: deflate, zstd, lzw, jpeg or none [deflate].", "deflate", metavar="NAME",
        section="result"
    )  # fmt: skip
    nodata: Annotated[str | float, BeforeValidator(str)] = opt(
        "Nodata value: a number, mask, or auto (0 for integers, NaN for floats).", "auto", section="result"
    )
    overviews: bool = opt("Write overviews into the file [yes].", True, section="result")
    tile: int = opt("Side of a tile, a multiple of 16.", 512, metavar="PX", section="run")


class SingleOptions(Request):
    """Options of orthophotos of single images."""

    true: bool = opt("Place objects where they stand, or rectify for the ground alone [ground].", False, other="ground")
    method: Annotated[Method, _one_of("method", Method)] = opt(
        "indirect: look up each product pixel in the image; direct: carry image pixels to the ground [indirect].",
        "indirect", metavar="NAME"
    )  # fmt: skip
    fill: int = opt("Largest distance from which gaps of the direct method are filled, pixels.", 0, metavar="PX")
    stack: str = opt("Show all orthophotos as bands of one raster, NAME.vrt [no].", "", metavar="NAME",
                     section="result")  # fmt: skip


class OrthoSettings(SingleOptions, PixelOptions):
    """Choices that change the pixels or the file of an orthophoto or mosaic; they go together."""

    choice: Choice | None = None
    """Choice among the images of a mosaic; None for an orthophoto of each image."""
    sources: bool = _SOURCES

    def check(self) -> None:
        """Refuse what does not go together; `hidden` and `sources` follow from others where they are not set."""
        if self.resolution is not None:
            from photoplan.geometry.grid import check_resolution  # needs NumPy, which the help does not

            check_resolution(self.resolution)
        if self.hidden is None:
            object.__setattr__(self, "hidden", "nodata" if self.true or self.method == "direct" else "show")
        if not (self.tolerance == 0 or 1e-6 <= self.tolerance <= 10):
            raise UsageError(
                f"`tolerance` {self.tolerance} px must be 0 (every pixel strictly by its camera) or 1e-6 to 10 "
                "(usual is 0.02)"
            )
        if self.tile < 128 or self.tile > 4096 or self.tile % 16:
            raise UsageError(f"`tile` {self.tile} must be a multiple of 16 from 128 to 4096")
        if self.nodata not in ("auto", "mask") and isinstance(_number_or_text(self.nodata), str):
            raise UsageError(f"`nodata` {self.nodata!r} must be auto, mask or a number")
        if not 0 <= self.fill <= MOST_FILLED or (self.fill and self.method != "direct"):
            raise UsageError(f"`fill` {self.fill} must be from 0 to {MOST_FILLED} pixels, and requires `method` direct")
        if self.method == "direct" and (self.choice is not None or self.accuracy or self.hidden != "nodata"):
            raise UsageError(
                "`method` direct makes orthophotos of single images, paints no hidden ground and knows no `accuracy`: "
                "leave `hidden` and `accuracy` out, or take the indirect method"
            )
        if self.fill_hidden and (self.hidden != "nodata" or self.method == "direct"):
            raise UsageError(
                f"`fill_hidden` {self.fill_hidden} fills hidden ground that is left empty; it requires `hidden` nodata "
                f"(found {self.hidden}) and `method` indirect (found {self.method})"
            )
        if self.fill_hidden:
            # Filled pixels are never without their mark.
            object.__setattr__(self, "sources", True)
        if self.stack and self.choice is not None:
            raise UsageError(f"`stack` {self.stack!r} shows orthophotos as bands; a mosaic is one raster already")

    @property
    def exactness(self) -> str:
        """Exactness of positions, in words."""
        return f"tolerance {self.tolerance:g} px" if self.tolerance else "every pixel strictly by its camera"

    @property
    def asks_hidden(self) -> bool:
        """True if hidden ground is searched for."""
        return self.hidden != "show" or self.choice is not None

    @property
    def filling(self) -> str:
        """Hidden holes that are filled, in words; empty if none are."""
        return f", hidden holes up to {self.fill_hidden} px filled" if self.fill_hidden else ""

    @property
    def nodata_value(self) -> float | Literal["auto", "mask"]:
        """`nodata` as the product's writer takes it."""
        return self.nodata if self.nodata in ("auto", "mask") else float(self.nodata)  # type: ignore[return-value]


class OnTarget(Request):
    """Options of commands whose products may lie on a wall, a vault, a column or along an image instead of the map."""

    target: str = TARGET
    relief: str | None = opt(
        "Offset of the target's surface along its normal: metres, or a raster made by `surface` [0].", None,
        metavar="M|FILE", section="input"
    )  # fmt: skip
    relief_sigma: str | None = opt(
        "Standard deviation of these offsets: metres, or a raster made by `surface`.", None, metavar="M|FILE",
        section="input"
    )  # fmt: skip


class ProductRequest(OnTarget, PixelOptions):
    """Options of all commands that plan products and execute them."""

    project: Path = PROJECT
    images: tuple[str, ...] = IMAGES
    output: Path | None = opt(
        "Folder of the products [products, next to the project].", None, folder=True, section="result"
    )
    plan_file: Path | None = opt("Write the plan (GeoPackage), and stop.", None, flag="plan", writes=True,
                                  section="run")  # fmt: skip
    show_quadtree: bool = opt("Also show the objects of a plan or dry run as squares.", False, section="result")
    force: bool = opt(
        "Continue although an orientation has a FAULT, or the resolution is finer than a quarter of the GSD.", False,
        section="run"
    )  # fmt: skip
    quicklook: bool = opt("Write a preview of the products.", True, flag="no-quicklook", section="result",
                          off="Write no preview of the products.")  # fmt: skip
    dry_run: bool = opt("Compile the plan, print it, and stop.", False, section="run")
    workers: int = ONE_WORKER
    executor: str = EXECUTOR
    memory: int | None = MEMORY
    overwrite: bool = OVERWRITE

    def check(self) -> None:
        """Refuse squares of a plan that is not shown."""
        if self.show_quadtree and not self.dry_run and self.plan_file is None:
            raise UsageError("`show_quadtree` requires `plan_file` or `dry_run`")

    @property
    def folder(self) -> Path:
        """Folder of the products."""
        return self.output or self.project.resolve().parent / "products"

    @property
    def changes(self) -> dict[str, Any]:
        """Settings that are set; the others are the project's."""
        return {name: getattr(self, name) for name in OrthoSettings.model_fields if name in self.model_fields_set}


class OrthoRequest(SingleOptions, ProductRequest):
    """Options of orthophotos."""


class MosaicRequest(ProductRequest):
    """Options of a mosaic; its files of seams and sheets are relative to the working folder."""

    choice: Choice = Choice()
    sources: bool = _SOURCES

    @property
    def changes(self) -> dict[str, Any]:
        """Settings that are set, and how images are chosen."""
        seams, sheets = self.choice.seams, self.choice.sheets
        choice = self.choice.replace(
            seams=None if seams is None else seams.absolute(),
            sheets=str(Path(sheets).absolute()) if isinstance(sheets, str) else sheets,
        )
        return {**super().changes, "choice": choice}


class ObjectRequest(ProductRequest):
    """Options of products of single objects."""

    polygons: Path = arg("Polygons with heights, CityJSON, or a mesh.")
    weights: Weights = _WEIGHTS
    prefer: tuple[str, ...] = _PREFER
    sources: bool = _SOURCES
    objects: tuple[str, ...] = opt("Objects of the file, or patterns; may be repeated [all].", (), listed=True,
                                   metavar="NAME,…", section="input")  # fmt: skip
    below: bool = opt("Also make the ground below each object: NAME_below.tif.", False, section="result")
    layer: str | None = opt("Layer of the file, or object type in CityJSON.", None, section="input")
    crs: str | None = opt("CRS of a file that states none.", None, metavar="CRS", section="input")
    height_system: str | None = opt(
        "Height system of the file, or `same` as that of the terrain.", None, metavar="NAME", section="input"
    )
    offset: tuple[float, float, float] | None = opt(
        "Offset that is added to all coordinates, metres.", None, metavar="X Y Z", section="input"
    )
    sigma: tuple[float, float] | None = opt("Standard deviations of the file's coordinates, metres.", None,
                                            metavar="XY Z", section="input")  # fmt: skip

    @property
    def changes(self) -> dict[str, Any]:
        """Settings that are set, and how images are chosen."""
        return {**super().changes, "choice": Choice(weights=self.weights, prefer=self.prefer)}


class RunRequest(Request):
    """Options of the execution of a plan."""

    plan: Path = arg("Plan, a GeoPackage.")
    output: Path | None = opt("Folder of the products [as planned].", None, folder=True, section="result")
    quicklook: bool = opt("Write a preview of the products.", True, flag="no-quicklook", section="result",
                          off="Write no preview of the products.")  # fmt: skip
    workers: int = ONE_WORKER
    executor: str = EXECUTOR
    memory: int | None = MEMORY
    overwrite: bool = OVERWRITE


class DemoRequest(Request):
    """Options of the demonstration."""

    folder: Path = arg("Folder to create.", default=Path("photoplan-demo"), folder=True)
    resolution: float = opt("Ground pixel size, metres.", 0.1)
    workers: int = ONE_WORKER
    overwrite: bool = OVERWRITE


class SeamsRequest(OnTarget):
    """Options of the search for seams."""

    project: Path = PROJECT
    images: tuple[str, ...] = IMAGES
    bounds: tuple[float, float, float, float] | None = BOUNDS
    resolution: float | None = opt(
        "Pixel size of the grid on which seams run, metres [256 pixels across an image].", None, gt=0, metavar="R"
    )
    keep: Path | None = opt("Regions whose images stay unchanged.", None, metavar="FILE", section="input")
    output: Path | None = opt("Regions to write [products/seams.gpkg, next to the project].", None, metavar="FILE",
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


class BalanceRequest(OnTarget):
    """Options of even colours between the images of a project."""

    project: Path = PROJECT
    images: tuple[str, ...] = IMAGES
    bounds: tuple[float, float, float, float] | None = BOUNDS
    reference_image: str | None = opt(
        "Name of the image that stays unchanged [mean and contrast of all images stay].", None, metavar="NAME"
    )
    reference: Path | None = opt("Raster on the map whose colours the images take.", None, metavar="FILE",
                                 section="input")  # fmt: skip
    degree: int = opt("Degree of the trend over an image; 0 for tables alone.", 2)
    factor: bool = opt("Compute one factor for each image and band from means, instead of tables.", False)
    resolution: float | None = opt(
        "Size of the pixels that are compared, metres [by the images' size].", None, metavar="R"
    )
    output: Path | None = opt("Folder of the tables [balance, next to the project].", None, metavar="FOLDER",
                              folder=True, section="result")  # fmt: skip
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
            raise UsageError("`reference` does not go with `factor`; set `reference_image`, or leave `factor` out")
        if self.reference is not None and self.reference_image is not None:
            raise UsageError("`reference_image` and `reference` exclude each other; set one of them")
        if not 0 <= self.degree <= 4:
            raise UsageError(f"`degree` {self.degree} must be from 0 (tables alone) to 4, usually 2")


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
