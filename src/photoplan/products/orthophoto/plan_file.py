"""Write a plan with its figures, and read it back to execute it."""

from __future__ import annotations

import hashlib
import math
import os
import sqlite3
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan import __version__
from photoplan.errors import InputError, UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Result
from photoplan.geometry.grid import MOST_TILES, MapGrid
from photoplan.io.disk import disk_error, library_error
from photoplan.io.files import file_in
from photoplan.io.product import check_output
from photoplan.io.project.file import parse_project
from photoplan.io.project.model import Project
from photoplan.io.vector_layer import PlanTables, Regions, read_plan_tables, write_plan_tables
from photoplan.plain import counted, pick, plain
from photoplan.plan.footprint import Footprint, Tiles
from photoplan.plan.product import compile_tile
from photoplan.products.orthophoto.mosaic import drawn_regions
from photoplan.products.orthophoto.plan import Look, OrthoPlan, OrthoProduct, keyed, product_plan
from photoplan.project.scene import input_files, refuse_unusable
from photoplan.requests.ortho import OrthoSettings, ProductRequest
from photoplan.surfaces.objects import ObjectSurface, SingleObject
from photoplan.surfaces.polygon_faces import decompose, outlines


@dataclass(frozen=True, eq=False)
class PlanSquares:
    """Squares of all objects that the products of a plan show: large inside and small along their borders."""

    bounds: NDArray[np.float64]
    """Outer edges xmin, ymin, xmax, ymax, shape (n, 4)."""
    columns: dict[str, NDArray[Any]]
    """product, object, level (how often a tile was divided), side, and height of the object in the middle, metres."""
    counts: tuple[dict[str, Any], ...]
    """For each object of a product: product, object, squares, and of_level, squares by level."""

    @property
    def lines(self) -> list[str]:
        """Return the counts, a line for each."""
        told = []
        for each in self.counts:
            levels = ", ".join(f"{count} of level {level}" for level, count in enumerate(each["of_level"]) if count)
            told.append(f"  {each['product']}: {each['object']}: {each['squares']} squares ({levels})")
        return told


@dataclass(frozen=True, eq=False)
class PlanFigures:
    """Figures of the compiled tiles of a plan, one row a tile, in the plan's order."""

    product: NDArray[np.uint32]
    """Place of the tile's product in the plan."""
    cells_of_tile: NDArray[np.int64]
    residual_of_tile: NDArray[np.float64]
    source: NDArray[np.int32]
    """Column, row, width, height of the source window; shape (n, 4), 0 where there are several sources."""

    @property
    def tiles(self) -> int:
        """Tiles that a run computes: those that their images may see."""
        return len(self.cells_of_tile)

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
            "images": product.images,
            **pick(product.grid, "width", "height", "resolution", "bounds"),
            "gsd": product.gsd,
            "tiles": len(self.cells_of_tile[mine]),
            "cells": self.cells_of_tile[mine].sum(),
            "worst_anchor_residual_px": self.residual_of_tile[mine].max(initial=0.0),
        }


@dataclass(frozen=True, eq=False)
class PlanReport(Result):
    """A plan that was not executed, with the figures of its tiles."""

    plan: OrthoPlan
    figures: PlanFigures
    path: Path | None = None
    """File of the plan, if it was written."""
    squares: PlanSquares | None = None
    """Objects as squares, if they were asked for."""
    unusable: Mapping[str, str] = field(default_factory=dict)
    """Images that are left out since their files cannot be used, and why."""
    asked: int = 0
    """Number of images that were asked for."""

    def json_fields(self) -> dict[str, Any]:
        """Return figures of the plan and of each of its products."""
        more = {} if self.squares is None else {"quadtree": self.squares.counts}
        return {**self.figures.json_of(self.plan), "plan": self.path, **more}

    def summary(self) -> Sequence[str]:
        """Return the plan, sums over its tiles, images that are left out, and squares."""
        plan, figures = self.plan, self.figures
        worst = f"worst anchor residual {figures.residual:.3g} px"
        return [
            str(plan),
            f"plan: {plan.what}, {counted(figures.tiles, 'tile')}, {figures.cells} cells, "
            + (worst if plan.settings.tolerance else plan.settings.exactness),
            *(f"  left out: {line}" for line in plan.blind),
            *([] if self.squares is None else [f"quadtree: {len(self.squares.bounds)} squares", *self.squares.lines]),
        ]

    def raise_failures(self) -> None:
        """Name the images that could not be used."""
        refuse_unusable(self.unusable, self.asked)


def show_plan(plan: OrthoPlan, request: ProductRequest, events: Events, **left: Any) -> PlanReport:
    """Compile the geometry of every tile, and write the plan if asked for, with objects as squares if asked for."""
    squares, path = plan_squares(plan) if request.show_quadtree else None, request.plan_file
    if path is not None:
        check_plan_path(path, plan, request.overwrite)
    figures = compile_figures(plan, events)
    if path is not None:
        write_plan(path, plan, figures, request.folder, request.overwrite, squares)
    return PlanReport(plan, figures, path, squares, **left)


def compile_figures(plan: OrthoPlan, events: Events = SILENT) -> PlanFigures:
    """Compile relief and anchors of every tile, keep the figures, forget the rest."""
    counts = [len(p.plan.tiles) for p in plan.products]
    events.begin("compiling tiles", sum(counts))
    product = np.repeat(np.arange(len(counts), dtype=np.uint32), counts)
    cells, residual = np.zeros(len(product), np.int64), np.zeros(len(product))
    source = np.zeros((len(product), 4), np.int32)
    rows = iter(range(len(product)))
    for p in plan.products:
        scenes = p.address(plan.project).open()
        for tile, row in zip(p.plan.tiles, rows):
            cameras = {source: scenes[source].camera for source in tile.sources}
            compiled = compile_tile(p.plan, tile, cameras, scenes.surface)
            cells[row], residual[row] = compiled.cells, compiled.residual
            for layer in compiled.layers if len(p.images) == 1 else ():
                read = layer.window(cameras[layer.source].size)
                source[row] = read.col, read.row, read.width, read.height
            events.done(1, tile.window.size)
    return PlanFigures(product, cells, residual, source)


def write_plan(
    path: Path,
    plan: OrthoPlan,
    figures: PlanFigures,
    output: Path,
    overwrite: bool = False,
    squares: PlanSquares | None = None,
) -> None:
    """Write a plan as a GeoPackage with the layers `tiles` and `footprints`, and `quadtree` if there are squares."""
    check_plan_path(path, plan, overwrite)
    counts = np.bincount(figures.product, minlength=len(plan.products))
    header = {
        "photoplan": __version__,
        "project": plan.project.model_dump(mode="json", exclude_none=True),
        "folder": os.path.relpath(plan.project.folder.resolve(), path.resolve().parent),
        "output": os.path.relpath(output.resolve(), path.resolve().parent),
        "settings": plain(plan.settings),
        "blind": list(plan.blind),
        "products": [_product_header(p, count) for p, count in zip(plan.products, counts.tolist())],
    }
    tiles = [p.plan.tiles for p in plan.products]
    windows = np.concatenate([t.windows for t in tiles])
    bounds = np.concatenate([t.bounds(p.grid) for t, p in zip(tiles, plan.products)])
    names = np.array([p.plan.name for p in plan.products], object)
    columns = {
        "product": names[figures.product],
        "tile": np.concatenate([t.indices for t in tiles]).astype(np.int64),
        "sources": np.array([" ".join(map(str, tile.sources)) for t in tiles for tile in t], object),
        "cells": figures.cells_of_tile,
        "residual_px": figures.residual_of_tile,
        **{name: windows[:, i] for i, name in enumerate(("col", "row", "width", "height"))},
        **{f"source_{name}": figures.source[:, i] for i, name in enumerate(("col", "row", "width", "height"))},
    }
    seen = [(p, row, image, look) for p in plan.products for row, (image, look) in enumerate(zip(p.images, p.looks))]
    footprints = {
        "product": np.array([p.plan.name for p, _, _, _ in seen], object),
        "image": np.array([image for _, _, image, _ in seen], object),
        "source": np.array([row for _, row, _, _ in seen], np.int64),
        "gsd": np.array([look.gsd for _, _, _, look in seen]),
        "resolution": np.array([p.grid.resolution for p, _, _, _ in seen]),
        "on_terrain": np.array([look.footprint.on_surface for _, _, _, look in seen]),
    }
    outlines = [_outline(p, look.footprint) for p, _, _, look in seen]
    layer = None if squares is None else (squares.bounds, squares.columns)
    tables = PlanTables(
        header=header,
        tiles=columns,
        tile_bounds=bounds,
        footprints=footprints,
        outlines=outlines,
        crs=plan.project.plane_crs,
        squares=layer,
    )
    try:
        write_plan_tables(path, tables, overwrite)
    except OSError as error:
        raise disk_error(path, error) from error
    except (RuntimeError, sqlite3.Error) as error:
        raise library_error(path, error) from error


def check_plan_path(path: Path, plan: OrthoPlan, overwrite: bool = False) -> None:
    """Refuse a place for a plan before the work of compiling it."""
    if path.suffix.lower() != ".gpkg":
        raise UsageError(f"{path}: a plan is a GeoPackage; give it a name that ends in .gpkg")
    check_output(path, input_files(plan.project), overwrite=overwrite)


def _outline(product: OrthoProduct, footprint: Footprint) -> NDArray[np.float64]:
    """Footprint polygon; the product's rectangle where the image's border does not meet the terrain."""
    seen = footprint.outline[np.isfinite(footprint.outline).all(axis=1), :2]
    if len(seen) >= 3:
        return seen
    xmin, ymin, xmax, ymax = product.grid.bounds
    return np.array([(xmin, ymin), (xmax, ymin), (xmax, ymax), (xmin, ymax)])


def read_plan(path: Path | str) -> tuple[OrthoPlan, Path | None]:
    """Read a plan back, and make sure that it still means what it meant.

    Returns
    -------
    plan : OrthoPlan
    output : Path or None
        Folder that was chosen for the products; None if it is outside the folders of the plan and of its project: a
        plan that comes from elsewhere does not decide where files are written.

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
        settings = OrthoSettings(**header["settings"])
        listed: dict[str, dict[int, tuple[int, ...]]] = {}
        for name, index, rows in zip(*(tiles[column].tolist() for column in ("product", "tile", "sources"))):
            listed.setdefault(name, {})[index] = tuple(map(int, rows.split()))
        products = [_product(entry, listed, settings, project) for entry in header["products"]]
        names = [file_in(folder, entry["name"]).name.casefold() for entry in header["products"]]
        if len(set(names)) < len(names):
            raise InputError(f"{path}: the plan is damaged: two products would write the same file; make it again")
        changed = [
            p.images[0] if len(p.images) == 1 else p.plan.name
            for p, entry in zip(products, header["products"])
            if keyed(project, p.plan, settings, p.part) != entry["key"]
        ]
        if changed:
            raise InputError(
                f"{path}: inputs have changed since the plan was written ({', '.join(changed)}); make the plan again "
                "with the command that wrote it"
            )
        plan = OrthoPlan(project, settings, tuple(p for p in products if len(p.plan.tiles)), tuple(header["blind"]))
    except (KeyError, TypeError, ValueError, UsageError) as error:
        raise InputError(
            f"{path}: the plan is damaged ({error}); make it again with the command that wrote it"
        ) from error
    if not plan.products:
        raise InputError(f"{path}: the plan has no tiles left; make it again with the command that wrote it")
    return plan, _planned_folder(path, folder, header["output"])


def _planned_folder(path: Path, project: Path, text: Any) -> Path | None:
    """Return the folder of the products as a plan states it; None if it leads out of the folders of plan and project.

    The folder of the project counts if it holds a project file and the plan.
    """
    home = path.resolve().parent
    homes = [home, *([project] if home.is_relative_to(project) and any(project.glob("*.toml")) else [])]
    try:
        output = (home / str(text)).resolve()
    except (OSError, RuntimeError, ValueError):
        return None
    return output if any(output.is_relative_to(each) for each in homes) else None


def _product_header(product: OrthoProduct, tiles: int) -> dict[str, Any]:
    """All of a product but its tiles, as plain values."""
    plan = product.plan
    return {
        "name": plan.name,
        "key": product.key,
        "grid": asdict(product.grid),
        "tile_side": plan.tiles.side,
        "images": [_look_header(image, look) for image, look in zip(product.images, product.looks)],
        "tiles": tiles,
        **({} if product.part is None else {"part": asdict(product.part)}),
        **({} if not isinstance(plan.clip, Regions) else {"clip": shapely.to_wkt(plan.clip.shapes[0][0], -1)}),
    }


def _look_header(image: str, look: Look) -> dict[str, Any]:
    seen = look.footprint
    return {
        "image": image,
        "gsd": look.gsd,
        "blur": look.blur,
        "outline": plain(seen.outline),
        **pick(seen, "bounds", "on_surface", "height_range"),
    }


def _look(entry: dict[str, Any]) -> Look:
    outline = np.array(entry["outline"], float).reshape(-1, 3)
    bounds = None if entry["bounds"] is None else tuple(entry["bounds"])
    low, high = entry["height_range"]
    return Look(Footprint(outline, bounds, entry["on_surface"], (low, high)), entry["gsd"], entry["blur"])


def _product(
    entry: dict[str, Any], listed: dict[str, dict[int, tuple[int, ...]]], settings: OrthoSettings, project: Project
) -> OrthoProduct:
    """Return the product that `_product_header` states, with the tiles that the layer lists.

    A person may have deleted some: it is then another product.
    """
    grid, name = MapGrid(**entry["grid"]), entry["name"]
    images = tuple(each["image"] for each in entry["images"])
    side = int(entry["tile_side"])
    if side < 1 or -(-grid.width // side) * -(-grid.height // side) > MOST_TILES:
        raise ValueError(f"{grid.width} × {grid.height} pixels in tiles of {side}")
    every = Tiles.every(grid.window, side)
    mine = {index: rows for index, rows in listed.get(name, {}).items() if 0 <= index < every.total}
    if any(row < 0 or row >= len(images) for rows in mine.values() for row in rows):
        raise ValueError("a tile of an image that is not listed")
    by_row = ([i for i, rows in mine.items() if row in rows] for row in range(len(images)))
    tiles = every.only(sorted(mine)) if len(images) == 1 else Tiles.shared([every.only(sorted(i)) for i in by_row])
    key = entry["key"]
    if len(tiles) != entry["tiles"]:
        key = hashlib.sha256(f"{key} {tiles.indices.tolist()}".encode()).hexdigest()
    looks = tuple(_look(each) for each in entry["images"])
    regions = drawn_regions(project, settings, images, grid, project.select(None))
    plan = product_plan(name, images, grid, tiles, settings, looks, regions)
    if entry.get("clip") is not None:
        plan = replace(plan, clip=Regions(grid, ((shapely.from_wkt(entry["clip"]), 1),)))
    part = entry.get("part")
    return OrthoProduct(plan, looks, key, part and SingleObject(tuple(part["objects"]), bool(part["below"])))


def plan_squares(plan: OrthoPlan) -> PlanSquares:
    """Return objects decomposed in the way of Behr (1989, §6.2): a mesh is a tile, and is divided until its squares are
    no larger than a pixel.
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
