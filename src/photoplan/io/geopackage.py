"""Vector products as GeoPackage, which appear under their name only when they are complete."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio.raw
import shapely
from numpy.typing import NDArray

from photoplan.cameras.observed import ImagePoints
from photoplan.io.disk import disk_error, library_error, make_parents
from photoplan.io.gdal import FIXED_DATE
from photoplan.io.naming import give_name, scratch
from photoplan.io.tables import write_table


@dataclass(frozen=True, eq=False)
class VectorLayer:
    """A layer of one geometry type."""

    name: str
    kind: str
    """Geometry type: `Polygon`, `MultiPolygon`, `LineString Z`, `Point Z` …"""
    shapes: Sequence[Any]
    """Shapely geometries, (n,), metres."""
    columns: Mapping[str, NDArray[Any]]
    """Values of each field, (n,)."""


def write_vector(path: Path, **layer: Any) -> None:
    """Write a layer as `pyogrio.raw.write`, without the time of writing."""
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": FIXED_DATE})
    pyogrio.raw.write(os.fspath(path), **layer)


def write_geopackage(path: Path, layers: Sequence[VectorLayer], crs: str | None) -> None:
    """Write layers as one GeoPackage, which appears complete or not at all and replaces an older one.

    Without a `crs` they lie in a plane of their own, such as that of an image.
    """
    try:
        make_parents(path.parent)
        with scratch(path.parent) as folder:
            partial = folder / path.name
            warnings.filterwarnings("ignore", "'crs' was not provided")
            for layer in layers:
                write_vector(
                    partial,
                    geometry=shapely.to_wkb(np.array([*layer.shapes], object)),
                    field_data=list(layer.columns.values()),
                    fields=list(layer.columns),
                    layer=layer.name,
                    driver="GPKG",
                    geometry_type=layer.kind,
                    crs=crs,
                    append=partial.exists(),
                )
            give_name(partial, path)
    except OSError as error:
        raise disk_error(path, error) from error
    except RuntimeError as error:
        raise library_error(path, error) from error


@dataclass(frozen=True, eq=False)
class PointLayer:
    """A layer of points in space."""

    name: str
    XYZ: NDArray[np.float64]
    """(n, 3), metres."""
    columns: Mapping[str, NDArray[Any]]
    """Values of each field, (n,)."""


def write_point_layers(path: Path, layers: Sequence[PointLayer], crs: str) -> None:
    """Write layers of points as one GeoPackage, which appears complete or not at all and replaces an older one.

    Layers without points are left out.
    """
    vectors = [
        VectorLayer(item.name, "Point Z", shapely.points(item.XYZ), item.columns) for item in layers if len(item.XYZ)
    ]
    write_geopackage(path, vectors, crs)


def write_residuals(
    path: Path,
    points: ImagePoints,
    residuals: NDArray[np.float64],
    normalised: NDArray[np.float64],
    redundancies: NDArray[np.float64],
    rejected: NDArray[np.bool_],
) -> None:
    """Write measurements with their residuals as a table that `photoplan adjust` reads again as image points."""
    pairs = ("residual", "normalised", "redundancy")
    names = [f"{name}_{axis}" for name in pairs for axis in "xy"]
    rows = []
    used: NDArray[np.bool_] = np.asarray(np.isfinite(residuals).all(axis=1))
    for k in range(len(points)):
        numbers = [*(f"{v:.10g}" for v in points.xy[k]), *(f"{v:.6g}" for v in points.sigma[k])]
        for values in (residuals[k], normalised[k], redundancies[k]):
            numbers += ["" if not np.isfinite(v) else f"{v:.4f}" for v in values]
        state = "rejected" if rejected[k] else "yes" if used[k] else "no"
        rows.append([points.points[points.point[k]], points.images[points.image[k]], *numbers, state])
    write_table(path, ["point", "image", "x", "y", "sigma_x", "sigma_y", *names, "used"], rows)
