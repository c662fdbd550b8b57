"""Requests of commands that orient images: convert, fiducials, interior, tie, control, resect, adjust."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from photoplan.errors import UsageError
from photoplan.io.orientation.block import Direction, TableFormat
from photoplan.request import (
    BEYOND_AREA,
    DRY_RUN,
    IMAGES,
    ONE_WORKER,
    OVERWRITE,
    PICTURE,
    PROJECT,
    REPORT_FORMAT,
    Request,
    arg,
    opt,
    path_or,
)


class ConvertRequest(Request):
    """Options of the conversion of orientations."""

    orientation: Path = arg("Orientation file, folder of a format with several files, or a project.")
    target: str | None = opt("Format to write: csv, toml, patb, bingo, rpc (of a project) …", None, flag="to",
                             metavar="FORMAT", section="result")  # fmt: skip
    output: Path | None = opt("File to write, or folder of several [beside the input].", None, writes=True)
    format: str | None = opt("Format of the orientation file [by its content].", None, metavar="FORMAT",
                             section="input")  # fmt: skip
    form: TableFormat = TableFormat()
    camera: Path | None = opt("Cameras: TOML, YAML, JSON [the orientation's].", None, section="input")
    crs: str | None = opt("CRS to write; also declares the CRS of a file that states none.", None, metavar="CRS",
                          section="result")  # fmt: skip
    camera_axes: Literal["up-back", "down-forward"] = opt(
        "Camera axes y and z of the file; down-forward as in computer vision.", "up-back", section="input"
    )
    turned: int = opt(
        "Angle by which images are turned against the camera axes of the file, counter-clockwise, degrees.",
        0,
        choices={"0": 0, "90": 90, "180": 180, "270": 270},
        flag="image-turned",
        section="input",
    )
    matrix: Direction | None = opt("Direction of written rotation matrices (patb, inpho).", None, section="result")
    beyond_area: bool = BEYOND_AREA
    drop_lens: bool = opt("Write cameras without a lens that the format cannot hold.", False, section="result")
    list_readings: bool = opt("Only list the angle conventions of the file that fit measured points.", False)
    image_points: Path | None = opt("Measured image points for `list_readings`.", None, section="input")
    control: Path | None = opt("Ground points of the measured image points.", None, section="input")
    dry_run: bool = opt("Print what would be written and lost, and stop.", False, section="run")
    overwrite: bool = OVERWRITE

    def check(self) -> None:
        """Refuse a list of readings without points, and points without it."""
        if self.list_readings and (self.image_points is None or self.control is None):
            raise UsageError("`list_readings` requires `image_points` FILE and `control` FILE")
        if not self.list_readings and self.target is None:
            raise UsageError("the format is missing: set `target` FORMAT")
        if not self.list_readings and (self.image_points is not None or self.control is not None):
            raise UsageError("`image_points` and `control` require `list_readings`")


_AUTO = {"auto": None, "yes": True, "no": False}
#: A dry run that computes and draws all the same.
_KEEP_PROJECT = opt("Do not write into the project.", False, section="run", draws=True)


class FiducialsRequest(Request):
    """Options of the search for fiducial marks."""

    images: tuple[Path, ...] = arg("Scans, or one project file.", metavar="IMAGE…")
    camera: Path | None = opt("File that describes the camera and its marks; a project describes its own.", None,
                              metavar="FILE", section="input")  # fmt: skip
    camera_name: str | None = opt("Camera of a file that describes several.", None, metavar="NAME", section="input")
    select: tuple[str, ...] = opt("Images or patterns of a project; may be repeated [all film].", (), listed=True,
                                  flag="images", metavar="NAME,…", section="input")  # fmt: skip
    scan_resolution: str | None = opt("Resolution, such as 1200dpi or 21um [what the files state, else found].", None,
                                      metavar="DPI|UM", section="input")  # fmt: skip
    rotation: int | None = opt(
        "Angle by which the film was turned before it was scanned, counter-clockwise, degrees.",
        None,
        choices={"auto": None, "0": 0, "90": 90, "180": 180, "270": 270},
    )
    mirrored: bool | None = opt("The scan has left and right exchanged.", None, choices=_AUTO)
    negative: bool | None = opt("The scan has dark and bright exchanged.", None, choices=_AUTO)
    band: int | None = opt("Band to use [luminance of the first three].", None, ge=1, metavar="N")
    least_correlation: float = opt("Smallest correlation of a mark.", 0.6, ge=0.3, le=0.99, metavar="R")
    pictures: Path | None = opt("Write a drawing of the marks of each image.", None, folder=True, metavar="FOLDER",
                                writes=True)  # fmt: skip
    dry_run: bool = _KEEP_PROJECT
    overwrite: bool = OVERWRITE

    @property
    def project(self) -> Path | None:
        """The project that is given in place of scans."""
        return self.images[0] if len(self.images) == 1 and self.images[0].suffix.lower() == ".toml" else None

    def check(self) -> None:
        """Refuse options of scans with a project, and the other way round."""
        if self.project is not None:
            if self.camera is not None or self.camera_name is not None:
                raise UsageError("a project describes its cameras itself; leave out `camera` and `camera_name`")
        elif not self.images:
            raise UsageError("no image is set; set scans and `camera` FILE, or a project file")
        elif self.select:
            raise UsageError("`select` requires a project; the images are already set one by one")
        elif self.camera is None:
            raise UsageError("`camera` FILE, which describes the fiducial marks, or a project file is required")
        if twice := sorted({str(f) for f in self.images if self.images.count(f) > 1}):
            raise UsageError(f"image {twice[0]} is set twice")


class InteriorRequest(Request):
    """Options of the interior orientation of film scans."""

    project: Path = PROJECT
    images: tuple[str, ...] = opt("Images or patterns; may be repeated [all film].", (), listed=True, metavar="NAME,…",
                                  section="input")  # fmt: skip
    model: Literal["similarity", "affine", "bilinear"] | None = opt(
        "Transformation from marks to scan [what the camera states].", None
    )
    scan_resolution: str | None = opt("Resolution, such as 1200dpi or 21um [what the files state].", None,
                                      metavar="DPI|UM", section="input")  # fmt: skip
    report: Path | None = opt("Write figures and plots as a page, HTML or PDF.", None, metavar="FILE", writes=True)
    plot: Path | None = opt("Write the residual vectors as a drawing.", None, metavar="PNG", writes=True)
    write: bool = opt("Make the model that of the cameras in the project file.", False, section="result")
    overwrite: bool = OVERWRITE

    def check(self) -> None:
        """Refuse to write no model."""
        if self.write and self.model is None:
            raise UsageError("`write` requires `model`, which it writes into the cameras")


class ControlRequest(Request):
    """Options of control points from an orthophoto and heights."""

    project: Path = PROJECT
    ortho: tuple[Path, ...] = opt(
        "Orthophotos in the project's CRS, of one resolution; may be repeated; the first with a value counts.",
        metavar="FILE",
        section="input",
    )
    height_sigma: float = opt("Standard deviation of the heights, metres.", metavar="M")
    heights: Path | None = opt("Heights [the project's terrain].", None, metavar="FILE", section="input")
    height_system: str | None = opt("Height system of the heights, if their file states none.", None, metavar="NAME",
                                    section="input")  # fmt: skip
    ortho_sigma: float | None = opt(
        "Standard deviation of X and of Y in the orthophoto, metres [one pixel].", None, metavar="M"
    )
    images: tuple[str, ...] = IMAGES
    grid: int = opt("Number of patches along each side of an image.", 8)
    search: float = opt("Largest error of the approximate orientation on the ground, metres.", 30.0, metavar="M")
    radius: int = opt("Radius of a patch, pixels of the coarser image.", 15)
    correlation: float = opt("Smallest correlation of a patch.", 0.7)
    output: Path | None = opt("Control points to write [control.csv by the project].", None, metavar="CSV", writes=True)
    dry_run: bool = DRY_RUN
    workers: int = ONE_WORKER
    overwrite: bool = OVERWRITE


class TieRequest(Request):
    """Options of tie points between the images of a project."""

    project: Path = PROJECT
    images: tuple[str, ...] = IMAGES
    pairs: Annotated[Path | Literal["auto", "all"], path_or("auto", "all")] = opt(
        "Pairs of images that are compared: auto, all, or a file with two names in each line.",
        "auto",
        metavar="auto|all|FILE",
    )
    scale: float | None = opt("Scale of the images in which features are searched, e.g. 0.5 [by their size].", None)
    features: int = opt("Number of features for each image.", 4000)
    levels: int = opt(
        "Number of kinds of features that are tried while images stay unconnected: as stated, coarser, then more.",
        4,
        ge=1,
        le=4,
    )
    per_image: int = opt("Number of tie points for each image.", 500)
    refine: bool = opt("Refine the places of features by least-squares matching.", True, flag="no-refine",
                       off="Leave out least-squares matching of the features.")  # fmt: skip
    use_orientation: bool = opt("Use the positions and orientations that images have.", True, flag="ignore-orientation",
                                off="Ignore the stated orientations and positions.")  # fmt: skip
    output: Path | None = opt("Tie points to write [tie_points.csv by the project].", None, metavar="CSV", writes=True)
    picture: bool = PICTURE
    dry_run: bool = DRY_RUN
    workers: int = ONE_WORKER
    overwrite: bool = OVERWRITE

    def check(self) -> None:
        """Refuse numbers with which nothing is found, and names that other files need."""
        if self.features < 50 or self.per_image < 1:
            raise UsageError(f"`features` {self.features} must be at least 50, `per_image` {self.per_image} at least 1")
        if self.scale is not None and not 0.01 <= self.scale <= 1:
            raise UsageError(f"`scale` {self.scale:g} must be from 0.01 to 1, such as 0.5")
        if self.product.suffix.lower() in (".png", ".matches", ".json"):
            raise UsageError(f"{self.product}: must be the name of a table, such as tie_points.csv")

    @property
    def product(self) -> Path:
        """The table of tie points."""
        return self.output or self.project.resolve().parent / "tie_points.csv"

    @property
    def pairs_table(self) -> Path:
        """The table of all pairs beside it."""
        return self.product.with_name(f"{self.product.stem}_pairs.csv")


class ResectRequest(Request):
    """Options of the resection of single images by control points."""

    project: Path = PROJECT
    images: tuple[str, ...] = opt("Images or patterns; may be repeated [all with 3 control points].", (), listed=True,
                                  metavar="NAME,…", section="input")  # fmt: skip
    image_points: tuple[Path, ...] = opt("Image points instead of the project's; may be repeated.", (), metavar="FILE",
                                         section="input")  # fmt: skip
    control: tuple[Path, ...] = opt("Control instead of the project's; may be repeated.", (), metavar="FILE",
                                    section="input")  # fmt: skip
    sigma_image: float | None = opt("Standard deviation of image points, pixels [the project's].", None, gt=0)
    sigma_control: tuple[float, float] | None = opt(
        "Standard deviations of control, horizontal and height, metres [the project's].", None, metavar="XY Z"
    )
    free: tuple[str, ...] = opt(
        "Camera parameters that are unknowns, from c, x0, y0, k1, k2, k3, p1, p2, b1, b2; for one image.",
        (),
        listed=True,
        metavar="c,x0,y0,k1",
    )
    unknown_camera_constant: bool = opt("Estimate the camera constant without an initial value; for one image.", False)
    critical: float = opt("Normalised residual from which a point is a gross error.", 4.0, ge=2, le=20)
    report: Path | None = opt(
        "Write residuals with drawings as a page, HTML or PDF.", None, metavar="FILE", writes=True
    )
    dry_run: bool = _KEEP_PROJECT
    overwrite: bool = OVERWRITE

    def check(self) -> None:
        """Refuse negative standard deviations."""
        if min(self.sigma_control or (0.0,)) < 0:
            raise UsageError(f"`sigma_control` {self.sigma_control} must be at least 0 metres each")


class AdjustRequest(Request):
    """Options of the bundle adjustment of a project."""

    project: Path = PROJECT
    calibrate: tuple[str, ...] = opt(
        "Camera parameters that are unknowns, with their a priori standard deviations; may be repeated [as stated].",
        (),
        metavar="CAMERA=c:SIGMA,x0,…",
    )
    datum: Literal["observations", "orientations"] | None = opt(
        "Datum of the block: control and observed positions, or the orientations in PROJECT [as stated].", None
    )
    images: tuple[str, ...] = IMAGES
    robust: bool = opt("Search gross errors.", True, flag="no-robust", off="Do not reject gross errors.")
    critical: float = opt("Normalised residual from which an observation is a gross error.", 4.0)
    variance_components: bool = opt(
        "Weight groups of observations as their residuals show.",
        True,
        flag="no-variance-components",
        off="Weight groups as stated, not as their residuals show.",
    )
    correlation: bool = opt("Take errors of neighbouring image points as correlated.", True, flag="no-correlation",
                            off="Treat errors of neighbouring image points as independent.")  # fmt: skip
    iterations: int = opt("Largest number of iterations of each solution.", 40, ge=1)
    output: Path | None = opt("Folder of the report [PROJECT/adjustment].", None, folder=True, metavar="FOLDER",
                              section="result")  # fmt: skip
    report_format: Literal["html", "pdf"] = REPORT_FORMAT
    dry_run: bool = opt("Adjust and print the figures; write nothing.", False, section="run")
    overwrite: bool = OVERWRITE

    def check(self) -> None:
        """Refuse a critical value that rejects everything."""
        if not self.critical > 0:
            raise UsageError(f"`critical` {self.critical:g} must be a positive number of standard deviations")

    @property
    def folder(self) -> Path:
        """The folder of the report."""
        return self.output if self.output is not None else self.project.resolve().parent / "adjustment"

    @property
    def drawn(self) -> Mapping[str, Path]:
        """The page of the report."""
        return {"report": self.folder / f"report.{self.report_format}"}
