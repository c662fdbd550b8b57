"""Requests of commands that orient images: control from orthophotos."""

from __future__ import annotations

from pathlib import Path

from photoplan.request import DRY_RUN, IMAGES, ONE_WORKER, OVERWRITE, PROJECT, Request, opt


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
