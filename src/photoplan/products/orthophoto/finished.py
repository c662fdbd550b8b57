"""Products that an earlier run has finished: their files, results and records, and what is kept of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from photoplan.engine.execute import OutputName
from photoplan.errors import UsageError
from photoplan.findings import Result
from photoplan.io.files import file_in, safe_stem
from photoplan.io.store import (
    is_unfinished,
    record_path,
    recorded_result,
    refuse_foreign_record,
    tidy,
)
from photoplan.plain import pick
from photoplan.products.orthophoto.plan import OrthoPlan, OrthoProduct
from photoplan.requests.ortho import OrthoSettings


@dataclass(frozen=True)
class ProductResult(Result):
    """Files and figures of one product."""

    path: Path
    others: tuple[Path, ...]
    """More files of it: where ground is hidden, which image painted what."""
    images: tuple[str, ...]
    seconds: float
    valid_share: float
    """Valid pixels among all pixels of the product, 0 to 1."""
    residual: float
    """Worst residual of the anchors over all tiles, pixels of the source image."""
    cells: int
    """Boxes that the anchors of all tiles have."""
    tiles: int
    """Tiles that are computed: those that its images may see; all others are empty."""
    resumed: int
    """Tiles taken over from an earlier run."""
    hidden: float | None
    """Ground in the images that none of them sees, m²; None: nobody has asked."""
    filled: dict[str, float] | None
    """Hidden ground that is filled from `images` and from `surroundings`, m²; None if nobody has asked."""
    bare: float | None
    """Ground of a mosaic that lies in none of its images, m²; None: it is no mosaic."""
    gaps: float | None
    """Ground that the image sees and the direct method has not reached, m²; None: it was the indirect one."""
    painted: dict[str, float] | None
    """Ground that each image paints, m², where that is asked for."""
    accuracy: dict[str, float] | None
    """Median and 95 % of the pixels' standard deviations of position, metres, where that is asked for."""
    failed: tuple[int, ...]
    """Tiles that could not be computed; the product is then not written."""
    reason: str = ""
    """Reason why the first of them failed."""

    def written(self) -> Sequence[Path]:
        """Return the product and what belongs to it; nothing if tiles failed."""
        return () if self.failed else (self.path, *self.others)

    def json_fields(self) -> dict[str, Any]:
        """Return figures without the reason of a failure."""
        own = ("path", "seconds", "valid_share", "cells", "tiles")
        images = {"image": self.images[0]} if self.bare is None else {"images": self.images, "outside_m2": self.bare}
        more = {"worst_anchor_residual_px": "residual", "resumed_tiles": "resumed", "failed_tiles": "failed"}
        return {
            **images,
            **pick(
                self,
                *own,
                hidden_m2="hidden",
                **({} if self.filled is None else {"filled_m2": "filled"}),
                gaps_m2="gaps",
                painted_m2="painted",
                accuracy_m="accuracy",
                other_files="others",
                **more,
            ),
        }


def outputs(folder: Path, product: OrthoProduct, settings: OrthoSettings) -> dict[OutputName, Path]:
    """Rasters of a product: itself, where ground is hidden, which image painted a pixel, how exactly it lies."""
    path = file_in(folder, f"{product.plan.name}.tif")
    asked: dict[OutputName, bool] = {
        "hidden": settings.hidden == "mark",
        "sources": settings.sources,
        "accuracy": settings.accuracy,
    }
    more = {name: path.with_name(f"{path.stem}_{name}.tif") for name, ask in asked.items() if ask}
    return {"picture": path, **more}


def seams_path(picture: Path) -> Path:
    """The GeoPackage of a mosaic's regions."""
    return picture.with_name(f"{picture.stem}_seams.gpkg")


def stale_files(folder: Path, product: OrthoProduct, settings: OrthoSettings) -> list[Path]:
    """Return where another kind of run would have put files next to a product, for another orthophoto."""
    path = outputs(folder, product, settings)["picture"]
    every = [
        *(path.with_name(f"{path.stem}_{name}.tif") for name in ("hidden", "sources", "accuracy")),
        seams_path(path),
    ]
    return [each for each in every if each not in all_files(folder, product, settings)]


def all_files(folder: Path, product: OrthoProduct, settings: OrthoSettings) -> list[Path]:
    """Files of a product: its rasters, and regions where sources are asked for."""
    paths = outputs(folder, product, settings)
    return [*paths.values(), *([seams_path(paths["picture"])] if "sources" in paths else [])]


def overview_path(plan: OrthoPlan, folder: Path) -> Path:
    """Return the path of the preview of all products: each command, and each mosaic by its name, has its own."""
    choice, command = plan.settings.choice, plan.command
    return folder / f"{safe_stem(choice.name) if choice and command == 'mosaic' else command}_overview.png"


def finished_products(
    plan: OrthoPlan, folder: Path, overwrite: bool, more: Sequence[Path] | None
) -> dict[str, ProductResult]:
    """Products that exist: those of this very run, interrupted, are kept; any other is refused before any work.

    When all products of a plan exist, and `more` that is made of them, the run was not interrupted: doing it again
    needs `overwrite`; None: it was interrupted. Sheets of a mosaic that would come out the same are kept also then.
    """
    if overwrite and (plan.settings.choice is None or plan.settings.choice.sheets is None):
        return {}
    kept, existing = {}, []
    for product in plan.products:
        files = all_files(folder, product, plan.settings)
        there = [path for path in (*files, *stale_files(folder, product, plan.settings)) if _is_there(path)]
        found = _finished(plan, product, folder) if files[0].exists() else None
        if found is not None:
            kept[product.plan.name] = found
            tidy([*files, record_path(files[0])])
            continue
        existing += there
        if not there:
            refuse_foreign_record(record_path(files[0]))
    if overwrite:
        return kept
    complete = more is not None and len(kept) == len(plan.products) and all(path.exists() for path in more)
    if existing or complete:
        first, *more = existing or [result.path for result in kept.values()]
        they = (
            f"and {len(more)} more exist; give `overwrite` to replace them"
            if more
            else ("exists; give `overwrite` to replace it")
        )
        raise UsageError(f"{first} {they}, or another `output`")
    return kept


def _without_seams(settings: OrthoSettings) -> OrthoSettings:
    """Settings without the names of files of seams and of sheets: their content decides, which is part of the key."""
    if settings.choice is None:
        return settings
    return settings.replace(choice=settings.choice.replace(seams=None, sheets=None))


def _is_there(path: Path) -> bool:
    return (path.exists() or path.is_symlink()) and not is_unfinished(path)


def _finished(plan: OrthoPlan, product: OrthoProduct, folder: Path) -> ProductResult | None:
    """The result of an earlier run with the same key and settings; None if the product is not one."""
    path, *others = all_files(folder, product, plan.settings)
    if not all(other.exists() for other in others):
        return None

    def result(made: dict[str, Any], recorded: dict[str, Any]) -> ProductResult | None:
        if _without_seams(OrthoSettings(**recorded)) != _without_seams(plan.settings):
            return None
        return ProductResult(
            path=path,
            others=tuple(others),
            images=product.images,
            seconds=made["seconds"],
            valid_share=made["valid_share"],
            residual=made["worst_anchor_residual_px"],
            cells=made["cells"],
            tiles=made["tiles"],
            resumed=made["tiles"],
            hidden=made.get("hidden_m2"),
            filled=made.get("filled_m2"),
            bare=made.get("outside_m2"),
            gaps=made.get("gaps_m2"),
            painted=made.get("painted_m2"),
            accuracy=made.get("accuracy_m"),
            failed=(),
        )

    return recorded_result(path, product.key, result)
