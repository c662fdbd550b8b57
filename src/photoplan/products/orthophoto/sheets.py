"""Sheets of a mosaic: squares or polygons, their STAC items, and a virtual raster of them all."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from photoplan.errors import InputError, UsageError
from photoplan.geometry.crs import crs_step, nearest_turn
from photoplan.geometry.grid import MapGrid
from photoplan.io.files import safe_stem
from photoplan.io.image_metadata import read_image_metadata
from photoplan.io.product import write_virtual
from photoplan.io.project.model import Project
from photoplan.io.store import write_atomically
from photoplan.io.vector_layer import Regions, read_features
from photoplan.products.orthophoto.finished import ProductResult
from photoplan.products.orthophoto.plan import (
    OrthoPlan,
    OrthoProduct,
)

#: Sheets of one run at most.
_MOST = 10_000


#: Points along a side of a sheet's outline in degrees: lines of a map are bent there.
_POINTS = 8


_UNKNOWN = "0001-01-01T00:00:00Z"


@dataclass(frozen=True, eq=False)
class Sheet:
    """A part of a mosaic that is a file of its own."""

    end: str
    """End of its name."""
    grid: MapGrid
    clip: Regions | None = None
    """Part of the grid that it shows; None for all."""


def drawn_sheets(grid: MapGrid, path: Path) -> list[Sheet]:
    """Polygons of a file that touch a grid, each on whole pixels of it; a pixel belongs to the polygon that holds its
    centre, so that sheets with a common line share none.
    """
    found: list[Sheet] = []
    names: dict[str, str] = {}
    extent = shapely.box(*grid.bounds)
    for each in read_features(path, "Polygon", crs=grid.crs).items:
        end = f"_{safe_stem(each.name)}"
        # Many file systems do not tell capitals from small letters.
        if end.casefold() in names:
            raise InputError(
                f"{path}: sheets {names[end.casefold()]!r} and {each.name!r} would have one file; give every polygon a "
                "name of its own, in a column `name`"
            )
        names[end.casefold()] = each.name
        shape = shapely.force_2d(each.geometry)
        if not shape.intersection(extent).area > 0:
            continue
        sheet = MapGrid.covering(shape.bounds, grid.resolution, grid.crs)
        whole = shapely.box(*sheet.bounds).buffer(-1e-6 * grid.resolution, join_style="mitre")
        found.append(Sheet(end, sheet, None if shape.contains(whole) else Regions(sheet, ((shape, 1),))))
    if not found:
        raise InputError(f"{path}: no polygon touches the mosaic; see to its coordinates: bounds are {grid.bounds}")
    if len(found) > _MOST:
        raise UsageError(f"{path}: {len(found)} sheets, more than {_MOST}; choose among them by `bounds`")
    return found


def sheets_of(grid: MapGrid, size: float) -> list[Sheet]:
    """Squares between multiples of a size that touch a grid, from north to south; their names end with the coordinates
    of their south-west corner.
    """
    if not (math.isfinite(size) and size > 0):
        raise UsageError(f"`sheets` {size:g}; the side of a sheet in metres is needed")
    pixels = size / grid.resolution
    if pixels < 1 - 1e-6 or abs(pixels - round(pixels)) > 1e-6 * max(pixels, 1.0):
        raise UsageError(f"`sheets` {size:g} m is {pixels:g} pixels of {grid.resolution:g} m; a whole number is needed")
    left, bottom, right, top = grid.bounds
    slack = 1e-6
    columns = range(math.floor(left / size + slack), math.ceil(right / size - slack))
    rows = range(math.floor(bottom / size + slack), math.ceil(top / size - slack))
    if len(columns) * len(rows) > _MOST:
        raise UsageError(f"`sheets` {size:g} m gives {len(columns) * len(rows)} sheets, more than {_MOST}; take larger")
    found = []
    for row in reversed(rows):
        for col in columns:
            bounds = (col * size, row * size, (col + 1) * size, (row + 1) * size)
            sheet = MapGrid.covering(bounds, grid.resolution, grid.crs)
            found.append(Sheet(f"_{_number(bounds[0])}_{_number(bounds[1])}", sheet))
    return found


def sheet_index(plan: OrthoPlan, folder: Path) -> list[Path]:
    """The file that shows all sheets as one; none where there are no sheets."""
    choice = plan.settings.choice
    return [] if choice is None or choice.sheets is None else [folder / f"{safe_stem(choice.name)}.vrt"]


def write_index(plan: OrthoPlan, path: Path, results: Sequence[ProductResult]) -> None:
    """A STAC item beside each sheet that is there, if it lies on the map, and a VRT of them all."""
    products = {product.plan.name: product for product in plan.products}
    for result in results if plan.project.target is None else ():
        item = _item(products[result.path.stem], result, plan.project)
        write_atomically(result.path.with_suffix(".stac.json"), item.encode())
    if results:
        write_virtual(path, [result.path for result in results])


def _item(product: OrthoProduct, result: ProductResult, project: Project) -> str:
    """STAC item 1.0 with the projection extension, dated by the times that the images state: the time of making would
    make two equal sheets differ."""
    grid = product.grid
    assert grid.crs is not None, "sheets are cut from maps"
    left, bottom, right, top = grid.bounds
    clip = product.plan.clip
    outline = shapely.box(left, bottom, right, top) if not isinstance(clip, Regions) else clip.shapes[0][0]
    outline = shapely.segmentize(outline, max(right - left, top - bottom) / _POINTS)
    geometry, box = _in_degrees(outline, grid.crs, grid.bounds)
    known = []
    for name in product.images:
        with suppress(InputError):
            time = read_image_metadata(project.resolve(project.any_image(name).file)).time
            known += [] if time is None else [datetime.fromtimestamp(time, UTC).isoformat().replace("+00:00", "Z")]
    code = int(grid.crs.split(":")[1]) if grid.crs.upper().startswith("EPSG:") and grid.crs[5:].isdigit() else None
    properties = {
        # STAC requires an interval where there is no one time; a year 1 says that no image states any.
        "datetime": None,
        "start_datetime": min(known, default=_UNKNOWN),
        "end_datetime": max(known, default=_UNKNOWN),
        "gsd": grid.resolution,
        "proj:epsg": code,
        **({} if code else {"proj:wkt2": grid.crs}),
        "proj:bbox": [left, bottom, right, top],
        "proj:shape": [grid.height, grid.width],
        "proj:transform": [grid.resolution, 0.0, left, 0.0, -grid.resolution, top],
        "photoplan:images": list(product.images),
    }
    kind = "image/tiff; application=geotiff; profile=cloud-optimized"
    item = {
        "type": "Feature",
        "stac_version": "1.0.0",
        "stac_extensions": ["https://stac-extensions.github.io/projection/v1.1.0/schema.json"],
        "id": result.path.stem,
        "geometry": json.loads(shapely.to_geojson(shapely.set_precision(geometry, 1e-9))),
        "bbox": [round(value, 9) for value in box],
        "properties": properties,
        "links": [],
        "assets": {"data": {"href": f"./{result.path.name}", "type": kind, "roles": ["data"]}},
    }
    return json.dumps(item, indent=1, ensure_ascii=False) + "\n"


def _in_degrees(shape: Any, crs: str, bounds: tuple[float, float, float, float]) -> tuple[Any, list[float]]:
    """Longitudes and latitudes of a shape, cut at 180° if it crosses that, and its west, south, east and north.

    West is more than east in the bounds of a shape across 180° (RFC 7946, section 5.2).
    """
    first = float(crs_step(crs, "EPSG:4326", bounds)(np.array(bounds[:2]))[0])
    degrees = shapely.transform(shape, crs_step(crs, "EPSG:4326", bounds, first))
    west, south, east, north = (float(value) for value in degrees.bounds)
    parts = [
        shapely.transform(shapely.intersection(degrees, shapely.box(turn - 180.0, -90.0, turn + 180.0, 90.0)),
                          lambda XY, turn=turn: XY - [turn, 0.0])
        for turn in (-360.0, 0.0, 360.0)
        if west < turn + 180.0 and east > turn - 180.0
    ]  # fmt: skip
    west, east = (float(nearest_turn(value, 0.0, 360.0)) for value in (west, east))
    return shapely.union_all(parts), [west, south, east, north]


def _number(value: float) -> str:
    """A coordinate as a part of a name."""
    text = f"{value:.6f}".rstrip("0").rstrip(".")
    return ("m" + text[1:] if text.startswith("-") else text).replace(".", "p")
