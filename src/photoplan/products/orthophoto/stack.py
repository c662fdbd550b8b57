"""Orthophotos as bands of one raster: lines of one camera on the same ground."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from photoplan.io.files import safe_stem
from photoplan.io.product import write_stacked
from photoplan.products.orthophoto.finished import ProductResult
from photoplan.products.orthophoto.plan import OrthoPlan


def stack_index(plan: OrthoPlan, folder: Path) -> list[Path]:
    """The file that shows orthophotos as bands; none where it is not asked for."""
    name = plan.settings.stack
    return [folder / f"{safe_stem(name)}.vrt"] if name else []


def write_stack(plan: OrthoPlan, path: Path, results: Sequence[ProductResult]) -> None:
    """Write it, of the orthophotos that are there."""
    images = {product.plan.name: product.images[0] for product in plan.products}
    if results:
        write_stacked(path, {images[result.path.stem]: result.path for result in results})
