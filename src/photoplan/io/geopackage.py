"""Vector products as GeoPackage, which appear under their name only when they are complete."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio.raw
import shapely
from numpy.typing import NDArray
from pyogrio.errors import DataSourceError

from photoplan.errors import UsageError
from photoplan.io.disk import disk_error, sync_file, sync_folder


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


def write_geopackage(path: Path, layers: Sequence[VectorLayer], crs: str) -> None:
    """Write layers as one GeoPackage, which appears complete or not at all and replaces an older one.

    Raises
    ------
    UsageError
        The folder cannot be written to.
    ResourceError
        The disk is full.
    """
    partial = path.with_name(f".{path.stem}.{os.getpid()}.partial.gpkg")
    try:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            partial.unlink(missing_ok=True)
            for layer in layers:
                pyogrio.raw.write(
                    os.fspath(partial),
                    geometry=shapely.to_wkb(np.array([*layer.shapes], object)),
                    field_data=list(layer.columns.values()),
                    fields=list(layer.columns),
                    layer=layer.name,
                    driver="GPKG",
                    geometry_type=layer.kind,
                    crs=crs,
                    append=partial.exists(),
                )
            sync_file(partial)
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
        sync_folder(path.parent)
    except DataSourceError as error:
        raise UsageError(f"{path}: cannot be written ({error}); choose a folder that can be written") from error
    except OSError as error:
        raise disk_error(path, error) from error
