"""What the file of a surface says of itself: over what its heights are."""

from __future__ import annotations

from pathlib import Path

from photoplan.io.gdal import open_raster

TARGET = "PHOTOPLAN_TARGET"
"""The tag that holds it."""


def target_of(path: Path, driver: str) -> str | None:
    """What the heights of a raster lie over, where that is no map; None: a map, or the file says nothing."""
    with open_raster(path, driver) as dataset:
        target: str = dataset.tags().get(TARGET, "map")
    return None if target == "map" else target
