"""Requests of commands that orient images: tie points, control from orthophotos."""

from __future__ import annotations

from pathlib import Path

from photoplan.errors import UsageError
from photoplan.request import DRY_RUN, IMAGES, ONE_WORKER, OVERWRITE, PICTURE, PROJECT, Request, opt


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
    pairs: str = opt("Pairs of images that are compared: auto, all, or a file with two names in each line.", "auto",
                     metavar="auto|all|FILE")  # fmt: skip
    scale: float | None = opt("Scale of the images in which features are searched, e.g. 0.5 [by their size].", None)
    features: int = opt("Features per image.", 4000)
    levels: int = opt(
        "Kinds of features that are tried while images stay unconnected: as stated, coarser, then more.", 4, ge=1, le=4
    )
    per_image: int = opt("Tie points that an image is to have.", 500)
    refine: bool = opt("Take features as they are, without least-squares matching.", True, flag="no-refine")
    use_orientation: bool = opt("Work as if no image had a position.", True, flag="ignore-orientation", off=True)
    output: Path | None = opt("Tie points to write [tie_points.csv by the project].", None, metavar="CSV", writes=True)
    picture: bool = PICTURE
    dry_run: bool = DRY_RUN
    workers: int = ONE_WORKER
    overwrite: bool = OVERWRITE

    def check(self) -> None:
        """Refuse numbers with which nothing is found, and names that other files need."""
        if self.features < 50 or self.per_image < 1:
            raise UsageError(f"{self.features} features and {self.per_image} points per image; 50 and 1 are the least")
        if self.scale is not None and not 0.01 <= self.scale <= 1:
            raise UsageError(f"scale {self.scale:g}; a number from 0.01 to 1 is needed, such as 0.5")
        if self.product.suffix.lower() in (".png", ".matches", ".json"):
            raise UsageError(f"{self.product}: a table is written; give it a name such as tie_points.csv")

    @property
    def product(self) -> Path:
        """The table of tie points."""
        return self.output or self.project.resolve().parent / "tie_points.csv"

    @property
    def pairs_table(self) -> Path:
        """The table of all pairs beside it."""
        return self.product.with_name(f"{self.product.stem}_pairs.csv")
