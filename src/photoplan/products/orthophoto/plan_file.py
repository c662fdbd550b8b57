"""Write a plan with its figures, and read it back to execute it."""

from __future__ import annotations

import hashlib
import os
import sqlite3
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan import __version__
from photoplan.errors import InputError, ResourceError, UsageError
from photoplan.events import SILENT, Events
from photoplan.geometry.grid import MOST_TILES, MapGrid
from photoplan.io.disk import disk_error, free_megabytes
from photoplan.io.plan_file import PlanTables, read_plan_tables, write_plan_tables
from photoplan.io.product import check_output
from photoplan.io.project.file import parse_project
from photoplan.plain import pick
from photoplan.plan.compile import AnchorRule
from photoplan.plan.footprint import Footprint
from photoplan.plan.product import ProductPlan, compile_tile
from photoplan.plan.tiles import Tiles
from photoplan.products.orthophoto.plan import OrthoPlan, OrthoProduct, product_key, product_name
from photoplan.products.orthophoto.settings import OrthoSettings
from photoplan.project.scene import input_files, open_scene, scene_address
from photoplan.targets.map import MapTarget


@dataclass(frozen=True, eq=False)
class PlanFigures:
    """What compiling every tile of a plan tells, one row a tile, in the plan's order."""

    product: NDArray[np.uint32]
    """Place of the tile's product in the plan."""
    cells_of_tile: NDArray[np.int64]
    residual_of_tile: NDArray[np.float64]
    source: NDArray[np.int32]
    """Column, row, width, height of the source window; shape (n, 4)."""

    @property
    def tiles(self) -> int:
        """Tiles that hold a part of their image."""
        return int((self.cells_of_tile > 0).sum())

    @property
    def cells(self) -> int:
        """Boxes of all anchors."""
        return int(self.cells_of_tile.sum())

    @property
    def residual(self) -> float:
        """Worst residual of the anchors, pixels."""
        return float(self.residual_of_tile.max(initial=0.0))

    def json_of(self, plan: OrthoPlan) -> dict[str, Any]:
        """Figures of a plan and of each of its products."""
        return {
            **pick(self, "tiles", "cells", worst_anchor_residual_px="residual"),
            "products": [self._product(place, product) for place, product in enumerate(plan.products)],
            "blind": plan.blind,
        }

    def _product(self, place: int, product: OrthoProduct) -> dict[str, Any]:
        mine = slice(*np.searchsorted(self.product, (place, place + 1)))
        return {
            "name": product.plan.name,
            "image": product.image,
            **pick(product.grid, "width", "height", "resolution", "bounds"),
            "gsd": product.gsd,
            "tiles": (self.cells_of_tile[mine] > 0).sum(),
            "cells": self.cells_of_tile[mine].sum(),
            "worst_anchor_residual_px": self.residual_of_tile[mine].max(initial=0.0),
        }


def compile_figures(plan: OrthoPlan, events: Events = SILENT) -> PlanFigures:
    """Compile relief and anchors of every tile, keep the figures, forget the rest.

    Parameters
    ----------
    plan : OrthoPlan
    events : Events
        Told of each tile.
    """
    counts = [len(p.plan.tiles) for p in plan.products]
    events.begin("compiling tiles", sum(counts))
    product = np.repeat(np.arange(len(counts), dtype=np.uint32), counts)
    cells, residual = np.zeros(len(product), np.int64), np.zeros(len(product))
    source = np.zeros((len(product), 4), np.int32)
    rows = iter(range(len(product)))
    for p in plan.products:
        scene = open_scene(plan.project, p.image)
        for tile, row in zip(p.plan.tiles, rows):
            compiled = compile_tile(p.plan, tile, {0: scene.camera}, scene.surface)
            cells[row], residual[row] = compiled.cells, compiled.residual
            for layer in compiled.layers:
                read = layer.window(scene.camera.size)
                source[row] = read.col, read.row, read.width, read.height
            events.done(1, tile.window.size)
    return PlanFigures(product, cells, residual, source)


def write_plan(path: Path, plan: OrthoPlan, figures: PlanFigures, output: Path, overwrite: bool = False) -> None:
    """Write a plan as a GeoPackage with the layers `tiles` and `footprints`.

    Parameters
    ----------
    path : Path
    plan : OrthoPlan
    figures : PlanFigures
        Of this plan, from `compile_figures`.
    output : Path
        Folder for the products when the plan is executed.
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    UsageError
        The file exists and `overwrite` is False, is an input or the project, or cannot be written.
    ResourceError
        The disk is full.
    """
    check_plan_path(path, plan, overwrite)
    there = figures.cells_of_tile > 0
    counts = np.bincount(figures.product[there], minlength=len(plan.products))
    header = {
        "photoplan": __version__,
        "project": plan.project.model_dump(mode="json", exclude_none=True),
        "folder": os.path.relpath(plan.project.folder.resolve(), path.resolve().parent),
        "output": os.path.relpath(output.resolve(), path.resolve().parent),
        "settings": asdict(plan.settings),
        "blind": list(plan.blind),
        "products": [_product_header(p, count) for p, count in zip(plan.products, counts.tolist())],
    }
    tiles = [p.plan.tiles for p in plan.products]
    windows = np.concatenate([t.windows for t in tiles])[there]
    bounds = np.concatenate([t.bounds(p.grid) for t, p in zip(tiles, plan.products)])[there]
    names, images = (np.array(each, object) for each in zip(*((p.plan.name, p.image) for p in plan.products)))
    columns = {
        "product": names[figures.product[there]],
        "image": images[figures.product[there]],
        "tile": np.concatenate([t.indices for t in tiles])[there].astype(np.int64),
        "cells": figures.cells_of_tile[there],
        "residual_px": figures.residual_of_tile[there],
        **{name: windows[:, i] for i, name in enumerate(("col", "row", "width", "height"))},
        **{f"source_{name}": figures.source[there, i] for i, name in enumerate(("col", "row", "width", "height"))},
    }
    footprints = {
        "product": names,
        "image": images,
        "gsd": np.array([p.gsd for p in plan.products]),
        "resolution": np.array([p.grid.resolution for p in plan.products]),
        "on_terrain": np.array([p.footprint.on_surface for p in plan.products]),
    }
    outlines = [_outline(p) for p in plan.products]
    tables = PlanTables(header, columns, bounds, footprints, outlines, plan.project.crs)
    try:
        write_plan_tables(path, tables, overwrite)
    except OSError as error:
        raise disk_error(path, error) from error
    except (RuntimeError, sqlite3.Error) as error:
        # What the libraries of vector files and of SQLite raise does not tell a full disk from a place without rights.
        if free_megabytes(path) < 1:
            raise ResourceError(f"{path}: cannot be written, the disk is full; free some space") from error
        raise UsageError(f"{path}: cannot be written ({error}); choose a folder that can be written") from error


def check_plan_path(path: Path, plan: OrthoPlan, overwrite: bool = False) -> None:
    """Refuse a place for a plan before the work of compiling it.

    Raises
    ------
    UsageError
        The name is not that of a GeoPackage, the file exists and `overwrite` is False, or it is an input.
    """
    if path.suffix.lower() != ".gpkg":
        raise UsageError(f"{path}: a plan is a GeoPackage; give it a name that ends in .gpkg")
    check_output(path, input_files(plan.project), overwrite=overwrite)


def _outline(product: OrthoProduct) -> NDArray[np.float64]:
    """Footprint polygon; the product's rectangle where the image's border does not meet the terrain."""
    seen = product.footprint.outline[np.isfinite(product.footprint.outline).all(axis=1), :2]
    if len(seen) >= 3:
        return seen
    xmin, ymin, xmax, ymax = product.grid.bounds
    return np.array([(xmin, ymin), (xmax, ymin), (xmax, ymax), (xmin, ymax)])


def read_plan(path: Path | str) -> tuple[OrthoPlan, Path]:
    """Read a plan back, and make sure that it still means what it meant.

    Returns
    -------
    plan : OrthoPlan
    output : Path
        Folder that was chosen for the products.

    Raises
    ------
    InputError
        The file is no plan, or an input, the project or the version has changed since it was written.
    """
    path = Path(path)
    try:
        header, tiles = read_plan_tables(path)
        folder = (path.resolve().parent / header["folder"]).resolve()
        project = parse_project(header["project"], folder, str(path))
        settings = OrthoSettings.from_dict(header["settings"])
        listed: dict[str, set[int]] = {}
        for name, index in zip(tiles["product"].tolist(), tiles["tile"].tolist()):
            listed.setdefault(name, set()).add(index)
        products = [_product(entry, listed, settings) for entry in header["products"]]
        changed = [
            p.image
            for p, entry in zip(products, header["products"])
            if product_key(scene_address(project, p.image), p.plan, settings) != entry["key"]
        ]
        if changed:
            raise InputError(
                f"{path}: inputs have changed since the plan was written ({', '.join(changed)}); make the plan again "
                "with `photoplan ortho`"
            )
        plan = OrthoPlan(project, settings, tuple(p for p in products if len(p.plan.tiles)), tuple(header["blind"]))
    except (KeyError, TypeError, ValueError, UsageError) as error:
        raise InputError(f"{path}: the plan is damaged ({error}); make it again with `photoplan ortho`") from error
    if not plan.products:
        raise InputError(f"{path}: the plan has no tiles left; make it again with `photoplan ortho`")
    return plan, (path.resolve().parent / header["output"]).resolve()


def _product_header(product: OrthoProduct, tiles: int) -> dict[str, Any]:
    """All of a product but its tiles, as plain values."""
    plan, seen = product.plan, product.footprint
    return {
        "image": product.image,
        "key": product.key,
        "gsd": product.gsd,
        "grid": asdict(product.grid),
        "tile_side": plan.tiles.side,
        "rule": asdict(plan.rule),
        "outline": seen.outline.tolist(),
        "bounds": seen.bounds,
        "on_surface": seen.on_surface,
        "height_range": seen.height_range,
        "tiles": tiles,
    }


def _product(entry: dict[str, Any], listed: dict[str, set[int]], settings: OrthoSettings) -> OrthoProduct:
    """What `_product_header` says, with the tiles that the layer lists.

    A person may have deleted some: it is then another product.
    """
    grid, name = MapGrid(**entry["grid"]), product_name(entry["image"])
    side = int(entry["tile_side"])
    if side < 1 or -(-grid.width // side) * -(-grid.height // side) > MOST_TILES:
        raise ValueError(f"{grid.width} × {grid.height} pixels in tiles of {side}")
    every = Tiles.every(grid.window, side)
    tiles = every.only(sorted(listed.get(name, set()) & set(range(every.total))))
    key = entry["key"]
    if len(tiles) != entry["tiles"]:
        key = hashlib.sha256(f"{key} {tiles.indices.tolist()}".encode()).hexdigest()
    rule = AnchorRule(**entry["rule"])
    plan = ProductPlan(name, (entry["image"],), MapTarget(grid), rule, tiles, settings.owners)
    outline = np.array(entry["outline"], float).reshape(-1, 3)
    bounds = None if entry["bounds"] is None else tuple(entry["bounds"])
    low, high = entry["height_range"]
    return OrthoProduct(plan, Footprint(outline, bounds, entry["on_surface"], (low, high)), entry["gsd"], key)
