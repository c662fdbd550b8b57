"""Real buildings as scenes: Delft where it stands, and the houses of Zurich moved next to each other onto a slope."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
import shapely
from numpy.typing import NDArray
from rasterio.transform import from_origin

from photoplan.io.objects import read_objects
from photoplan.io.vector_layer import VectorLayer, write_geopackage
from tools.rendered_block import Flight, write_project

#: Sides of a lot that a house of Zurich gets, metres, and how many there are in a row.
_LOT, _ROW = 26.0, 7


@dataclass(frozen=True)
class City:
    """A project that is yet to be rendered, and the part of the map that is looked at."""

    path: Path
    bounds: tuple[float, float, float, float]


def _dem(path: Path, crs: str, middle: tuple[float, float], slope: tuple[float, float], height: float) -> None:
    """A plane of 800 m around a place."""
    step = np.arange(161) * 5.0 - 400.0
    Z = height + slope[0] * step[None] - slope[1] * step[:, None]
    place = {"crs": crs, "transform": from_origin(middle[0] - 402.5, middle[1] + 402.5, 5, 5)}
    with rasterio.open(path, "w", driver="GTiff", width=161, height=161, count=1, dtype="float32", **place) as file:
        file.write(Z.astype(np.float32), 1)


def delft(folder: Path, data: Path, part: float = 1.0) -> City:
    """163 blocks and bridges; `part`: of the sides of images and map."""
    middle = (84_950.0, 447_533.0)
    _dem(folder / "dem.tif", "EPSG:28992", middle, (0.0, 0.0), -0.35)
    file = data / "delft.json"
    flight = _flight(middle, 180.0, part)
    path = write_project(folder, "EPSG:28992", 'file = "dem.tif"', f'\n[[objects]]\nfile = "{file}"\n', flight)
    path.write_text(path.read_text().replace('"same"', '"EPSG:5709"'))
    return City(path, _around(middle, part))


def zurich(folder: Path, data: Path, part: float = 1.0) -> City:
    """Every building of a file in which they stand kilometres apart, on lots beside each other, on a slope of 8 %."""
    own = read_objects(data / "zurich_subset_lod2.json")
    middle, height = (2_684_000.0, 1_246_000.0), 420.0
    slope = (0.08, 0.03)
    _dem(folder / "dem.tif", "EPSG:2056", middle, slope, height)
    shapes, names = [], []
    for k, (corners, name) in enumerate(_buildings(own.corners, own.owner)):
        at = (np.array([k % _ROW, k // _ROW]) - (_ROW - 1) / 2) * _LOT
        low, high = corners[..., :2].min(axis=(0, 1)), corners[..., :2].max(axis=(0, 1))
        if (high - low).max() > 1.6 * _LOT:
            continue
        foot = height + at @ slope - 1.5
        moved = corners - (*(low + high) / 2, corners[..., 2].min()) + (middle[0] + at[0], middle[1] + at[1], foot)
        for one in np.unique(name):
            shapes.append(shapely.MultiPolygon([shapely.Polygon(t) for t in moved[name == one]]))
            names.append(f"building {k} {one}")
    columns = {"name": np.array(names, object)}
    write_geopackage(folder / "houses.gpkg", [VectorLayer("houses", "MultiPolygon Z", shapes, columns)], "EPSG:2056")
    objects = '\n[[objects]]\nfile = "houses.gpkg"\nheight_system = "same"\n'
    flight = _flight(middle, height + 180, part)
    return City(write_project(folder, "EPSG:2056", 'file = "dem.tif"', objects, flight), _around(middle, part))


def _flight(middle: tuple[float, float], height: float, part: float) -> Flight:
    size = round(1200 * part), round(900 * part)
    return Flight(middle, height, (60.0 * part, 60.0 * part), (3, 2), size, 900.0)


def _around(middle: tuple[float, float], part: float) -> tuple[float, float, float, float]:
    x, y = middle
    return (x - 100 * part, y - 85 * part, x + 100 * part, y + 85 * part)


def _buildings(
    corners: NDArray[np.float64], owner: NDArray[np.int32]
) -> list[tuple[NDArray[np.float64], NDArray[np.int32]]]:
    """Triangles of buildings and the part each belongs to: parts that stand within 20 m of each other."""
    middles = {k: corners[owner == k].mean(axis=(0, 1))[:2] for k in np.unique(owner)}
    left, found = set(middles), []
    while left:
        group, todo = set(), [min(left)]
        while todo:
            k = todo.pop()
            group.add(k)
            left.discard(k)
            todo += [j for j in left - set(todo) if np.hypot(*(middles[j] - middles[k])) < 20]
        chosen = np.isin(owner, list(group))
        found.append((corners[chosen], owner[chosen]))
    return found
