"""Small terrain files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import rasterio
import shapely

CRS = "EPSG:31287+5778"
"""Austria Lambert with heights above the Adriatic."""
X0, Y0 = 400_000.0, 450_000.0


def write_dem(path: Path, function, size: tuple[int, int], mesh: float = 1.0, crs: str | None = CRS) -> Path:
    """A GeoTIFF of function(x, y) at posts x = 0, 1 … east of X0, y = 0, 1 … north of Y0 (times the mesh)."""
    columns, rows = size
    x, y = np.meshgrid(np.arange(columns) * mesh, np.arange(rows)[::-1] * mesh)
    z = np.asarray(function(x, y), np.float32) + np.zeros((rows, columns), np.float32)
    transform = rasterio.transform.from_origin(X0 - mesh / 2, Y0 + (rows - 0.5) * mesh, mesh, mesh)
    with rasterio.open(
        path, "w", driver="GTiff", width=columns, height=rows, count=1, dtype="float32", nodata=-9999, crs=crs,
        transform=transform,
    ) as file:  # fmt: skip
        file.write(np.where(np.isnan(z), -9999, z).astype(np.float32), 1)
    return path


def write_geojson(path: Path, shapes: dict[str, shapely.Geometry], crs: str | None = "EPSG:31287") -> Path:
    """Shapes relative to X0, Y0, with their names."""
    features = [
        {
            "type": "Feature",
            "properties": {"name": name},
            "geometry": json.loads(shapely.to_geojson(shapely.transform(shape, lambda xy: xy + np.array([X0, Y0])))),
        }
        for name, shape in shapes.items()
    ]
    content: dict = {"type": "FeatureCollection", "features": features}
    if crs is not None:
        content["crs"] = {"type": "name", "properties": {"name": crs}}
    path.write_text(json.dumps(content))
    return path
