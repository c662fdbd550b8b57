"""Mosaics in sheets: squares of the map whose lines do not depend on the flight, each a product of its own."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from photoplan.errors import UsageError
from photoplan.geometry.crs import crs_step
from photoplan.geometry.grid import MapGrid
from photoplan.io.names import safe_stem
from photoplan.io.naming import write_atomically
from photoplan.io.virtual import write_virtual
from photoplan.products.orthophoto.finished import ProductResult
from photoplan.products.orthophoto.plan import OrthoPlan, OrthoProduct

#: Sheets of one run at most.
_MOST = 10_000
#: Points along a side of a sheet's outline in degrees: lines of a map are bent there.
_POINTS = 8


def sheets_of(grid: MapGrid, size: float) -> list[tuple[str, MapGrid]]:
    """Squares between multiples of a size that touch a grid, from north to south, with the end of their names: the
    coordinates of their south-west corner.

    Raises
    ------
    UsageError
        The size is no multiple of the pixels, or gives too many sheets.
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
            found.append((f"_{_number(bounds[0])}_{_number(bounds[1])}", sheet))
    return found


def sheet_index(plan: OrthoPlan, folder: Path) -> list[Path]:
    """The file that shows all sheets as one; none where there are no sheets."""
    choice = plan.settings.choice
    return [] if choice is None or choice.sheets is None else [folder / f"{safe_stem(choice.name)}.vrt"]


def write_index(plan: OrthoPlan, path: Path, results: Sequence[ProductResult]) -> None:
    """A STAC item beside each sheet that is there, and a VRT of them all."""
    products = {product.plan.name: product for product in plan.products}
    for result in results:
        item = _item(products[result.path.stem], result)
        write_atomically(result.path.with_suffix(".stac.json"), item.encode())
    if results:
        write_virtual(path, [result.path for result in results])


def _item(product: OrthoProduct, result: ProductResult) -> str:
    """STAC item 1.0 with the projection extension; dated by when the sheet was made: a project does not know when its
    images were taken."""
    grid = product.grid
    left, bottom, right, top = grid.bounds
    along = np.linspace(0, 1, _POINTS, endpoint=False)
    corners = np.array([(left, bottom), (right, bottom), (right, top), (left, top)])
    ring = np.concatenate([a + along[:, None] * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0))])
    degrees = np.round(crs_step(grid.crs, "EPSG:4326", grid.bounds)(ring), 9)
    record = json.loads(result.path.with_suffix(".run.json").read_text(encoding="utf-8"))
    code = int(grid.crs.split(":")[1]) if grid.crs.upper().startswith("EPSG:") and grid.crs[5:].isdigit() else None
    properties = {
        "datetime": record["run"]["finished"],
        "created": record["run"]["finished"],
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
        "geometry": {"type": "Polygon", "coordinates": [[*degrees.tolist(), degrees[0].tolist()]]},
        "bbox": [*degrees.min(axis=0).tolist(), *degrees.max(axis=0).tolist()],
        "properties": properties,
        "links": [],
        "assets": {"data": {"href": f"./{result.path.name}", "type": kind, "roles": ["data"]}},
    }
    return json.dumps(item, indent=1, ensure_ascii=False) + "\n"


def _number(value: float) -> str:
    """A coordinate as a part of a name."""
    text = f"{value:.6f}".rstrip("0").rstrip(".")
    return ("m" + text[1:] if text.startswith("-") else text).replace(".", "p")
