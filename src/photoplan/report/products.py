"""Drawings of each product as soon as it is complete: accuracy, source regions, objects of a plan as squares."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from photoplan.products.orthophoto.finished import ProductResult, seams_path


def draw_product(part: Any, request: Any, can_draw: Callable[[bool], bool]) -> Iterator[str]:
    """Draw what was asked for of a product or plan, and return what there is to say of it.

    Drawings are imported here alone, since most products have none.
    """
    if not isinstance(part, ProductResult):
        if getattr(part, "squares", None) is not None and part.path is not None and can_draw(request.quicklook):
            from photoplan.report.maps import draw_squares  # noqa: PLC0415

            # Products of images show the same objects again and again.
            columns = part.squares.columns
            own = (columns["product"] == columns["product"][0]) | part.plan.of_objects
            title = f"{own.sum()} squares of {len(set(columns['object'][own]))} objects"
            picture = part.path.with_name(f"{part.path.stem}_quadtree.png")
            yield f"quadtree: drawn in {draw_squares(picture, part.squares.bounds[own], title)}"
        return
    if part.accuracy is not None and not part.failed:
        raster, drawn = part.path.with_name(f"{part.path.stem}_accuracy.tif"), ""
        if can_draw(request.quicklook):
            from photoplan.report.maps import draw_accuracy  # noqa: PLC0415

            drawn = f", drawn in {draw_accuracy(raster)}"
        figures = "median {median:.3g} m, 95 % of the pixels below {p95:.3g} m".format(**part.accuracy)
        yield f"standard deviation of position: {figures}: {raster}{drawn}"
    if (regions := seams_path(part.path)) in part.written():
        drawn = ""
        if can_draw(True):
            from photoplan.io.vector_layer import read_features  # noqa: PLC0415
            from photoplan.report.maps import draw_regions  # noqa: PLC0415

            shapes = {item.name: item.geometry for item in read_features(regions, "Polygon").items}
            of = f"{len(part.painted or {})} images paints, of {len(part.images)} that see the ground"
            title = f"{part.path.name}: what each of {of}"
            drawn = f", drawn in {draw_regions(regions.with_suffix('.png'), shapes, title)}"
        yield f"regions: {regions}{drawn}"
