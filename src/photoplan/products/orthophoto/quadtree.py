"""Objects of a plan as squares, large inside and small along their borders (Behr 1989, §6.2): a layer to look at."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import UsageError
from photoplan.products.orthophoto.plan import OrthoPlan
from photoplan.surfaces.objects import ObjectSurface
from photoplan.surfaces.quadtree import decompose, outlines


@dataclass(frozen=True, eq=False)
class PlanSquares:
    """Squares of all objects that the products of a plan show."""

    bounds: NDArray[np.float64]
    """Outer edges xmin, ymin, xmax, ymax, shape (n, 4)."""
    columns: dict[str, NDArray[Any]]
    """product, object, level (how often a tile was divided), side, and height of the object in the middle, metres."""
    counts: tuple[dict[str, Any], ...]
    """For each object of a product: product, object, squares, and of_level, squares by level."""

    @property
    def lines(self) -> list[str]:
        """The counts, a line for each."""
        told = []
        for each in self.counts:
            levels = ", ".join(f"{count} of level {level}" for level, count in enumerate(each["of_level"]) if count)
            told.append(f"  {each['product']}: {each['object']}: {each['squares']} squares ({levels})")
        return told


def plan_squares(plan: OrthoPlan) -> PlanSquares:
    """Objects decomposed in the way of Behr: a mesh is a tile, and is divided until its squares are no larger than a
    pixel.
    """
    bounds, counts = [np.empty((0, 4))], []
    columns: dict[str, list[NDArray[Any]]] = {name: [] for name in ("product", "object", "level", "side", "height")}
    for product in plan.products:
        surface = product.address(plan.project).open().surface
        below = product.part is not None and product.part.below
        faces = surface.shown if isinstance(surface, ObjectSurface) and not below else None
        for name, own, outline in [] if faces is None else outlines(faces, product.grid.bounds):
            tile, grid = product.plan.tiles.side, product.grid
            levels = math.ceil(math.log2(tile))
            squares = decompose(outline, (grid.left, grid.top), tile * grid.resolution, levels)
            many = len(squares.side)
            bounds.append(squares.bounds)
            middle = (squares.bounds[:, :2] + squares.bounds[:, 2:]) / 2
            height = own.heights(middle)
            row: dict[str, Any] = {"level": squares.level, "side": squares.side}
            row["height"] = np.where(np.isneginf(height), np.nan, height)
            row |= {"product": np.full(many, product.plan.name, object), "object": np.full(many, name, object)}
            for key, values in row.items():
                columns[key].append(values)
            of_level = np.bincount(squares.level, minlength=levels + 1).tolist()
            counts.append({"product": product.plan.name, "object": name, "squares": many, "of_level": of_level})
    if not counts:
        raise UsageError(
            "no product of the plan shows an object: its quadtree is asked for with [[objects]] in the project, and "
            "`photoplan ortho` with `true`, `photoplan mosaic` or `photoplan object`"
        )
    return PlanSquares(np.concatenate(bounds), {k: np.concatenate(v) for k, v in columns.items()}, tuple(counts))
