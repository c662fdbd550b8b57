"""What became of products, and which of them an earlier run has made already."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from photoplan.errors import UsageError
from photoplan.io.run_record import recorded_result
from photoplan.plain import pick
from photoplan.products.orthophoto.plan import OrthoPlan, OrthoProduct
from photoplan.products.orthophoto.settings import OrthoSettings


@dataclass(frozen=True)
class ProductResult:
    """What became of one product."""

    path: Path
    image: str
    seconds: float
    valid_share: float
    """Valid pixels among all pixels of the product, 0 to 1."""
    residual: float
    """Worst residual of the anchors over all tiles, pixels of the source image."""
    cells: int
    """Boxes that the anchors of all tiles have."""
    tiles: int
    """Tiles that the product has, the empty ones included."""
    resumed: int
    """Tiles taken over from an earlier run."""
    failed: tuple[int, ...]
    """Tiles that could not be computed; the product is then not written."""
    reason: str = ""
    """Why the first of them failed."""

    def json_fields(self) -> dict[str, Any]:
        """Figures without the reason of a failure."""
        own = ("path", "image", "seconds", "valid_share", "cells", "tiles")
        more = {"worst_anchor_residual_px": "residual", "resumed_tiles": "resumed", "failed_tiles": "failed"}
        return pick(self, *own, **more)


def product_path(folder: Path, product: OrthoProduct) -> Path:
    """Where a product is written."""
    return folder / f"{product.plan.name}.tif"


def finished_products(plan: OrthoPlan, folder: Path, overwrite: bool) -> dict[str, ProductResult]:
    """Products that exist: those of this very run, interrupted, are kept; any other is refused before any work.

    When all products of a plan exist, the run was not interrupted: doing it again needs `overwrite`.
    """
    existing = [p for p in plan.products if product_path(folder, p).exists()]
    if overwrite or not existing:
        return {}
    kept = {p.plan.name: _kept(plan, p, folder) for p in existing}
    foreign = [name for name, result in kept.items() if result is None]
    if foreign or len(existing) == len(plan.products):
        first = product_path(folder, plan[foreign[0]] if foreign else existing[0])
        more = f" and {len(existing) - 1} more" if len(existing) > 1 else ""
        raise UsageError(f"{first}{more} exists; give `overwrite` to replace it, or another `output`")
    return {name: result for name, result in kept.items() if result is not None}


def _kept(plan: OrthoPlan, product: OrthoProduct, folder: Path) -> ProductResult | None:
    """The result of an earlier run with the same key and settings; None if the product is not one."""
    path = product_path(folder, product)

    def result(made: dict[str, Any], recorded: dict[str, Any]) -> ProductResult | None:
        if OrthoSettings.from_dict(recorded) != plan.settings:
            return None
        return ProductResult(
            path=path,
            image=product.image,
            seconds=made["seconds"],
            valid_share=made["valid_share"],
            residual=made["worst_anchor_residual_px"],
            cells=made["cells"],
            tiles=made["tiles"],
            resumed=made["tiles"],
            failed=(),
        )

    return recorded_result(path, product.key, result)
