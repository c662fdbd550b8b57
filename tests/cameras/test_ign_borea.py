"""A real block of 805 UltraCam exposures: the strict model reproduces its image observations.

Of the 14,491 observations 14,407 are of points whose ground coordinates come with the block. Ground points carry
ellipsoidal heights; projection centres carry altitudes above the geoid and the linear alteration of a block that was
adjusted in map coordinates; angles refer to the map grid at each station.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from pyproj import Transformer
from tools.ign_block import unaltered_height

from photoplan.cameras.base import project
from photoplan.cameras.framed import oriented_camera
from photoplan.cameras.lenses import Interior, NoLens
from photoplan.geometry.local import LocalFrame
from photoplan.geometry.pose import Pose

CRS = "EPSG:2154"
#: PPA (13210, 8502) and focal length in pixels; the middle of 26460 × 17004 pixels is (13229.5, 8501.5).
INTERIOR = Interior.digital((26460, 17004), (30975.0, 30975.0), (13210.0 - 13229.5, 8502.0 - 8501.5))


@pytest.fixture
def folder(shared: Path) -> Path:
    return shared / "data" / "ign_borea"


def rows(path: Path, fields: int) -> list[list[str]]:
    return [f for f in (line.split() for line in path.read_text().splitlines()) if len(f) >= fields]


@lru_cache
def undulations(path: Path) -> tuple[np.ndarray, Any]:
    with rasterio.open(path) as raster:
        return raster.read(1).astype(float), ~raster.transform


def undulation(path: Path, XY: np.ndarray) -> float:
    """Geoid height, bilinear between the grid's pixel centres."""
    grid, to_pixel = undulations(path)
    lon, lat = Transformer.from_crs(CRS, "EPSG:4171", always_xy=True).transform(*XY)
    col, row = to_pixel.a * lon + to_pixel.c - 0.5, to_pixel.e * lat + to_pixel.f - 0.5
    j, i = int(col), int(row)
    u, v = col - j, row - i
    square = grid[i : i + 2, j : j + 2]
    return float(np.array([1 - v, v]) @ square @ np.array([1 - u, u]))


def residuals(folder: Path, curvature: str, altered: bool) -> np.ndarray:
    """Projected minus measured image coordinates of all observations, shape (n, 2), pixels."""
    ground = {f[0]: np.array(f[1:4], float) for f in rows(folder / "all_liaisons2_world.mes", 4)}
    seen: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for point, image, x, y in (f[:4] for f in rows(folder / "all_liaisons2.mes", 4)):
        if point in ground:
            seen.setdefault(image, []).append((ground[point], np.array([float(x), float(y)])))
    found = []
    for f in rows(folder / "23FD1305_alt_2.OPK", 8)[1:]:
        if f[0] not in seen:
            continue
        XYZ, xy = (np.array(column) for column in zip(*seen[f[0]]))
        center, angles = np.array(f[1:4], float), np.radians(np.array(f[4:7], float))
        center[2] += undulation(folder / "fr_ign_RAF20.tif", center[:2])
        if altered:
            scale = LocalFrame(CRS, (center[0], center[1])).scale(center[:2])
            center[2] = unaltered_height(center[2], XYZ[:, 2].mean(), scale)
        pose = Pose.from_angles(center, angles)
        camera = oriented_camera(INTERIOR, NoLens(), pose, crs=CRS, earth_curvature=curvature)
        found.append(project(camera, XYZ) - xy)
    return np.concatenate(found)


def test_strict_model_reproduces_the_whole_block(folder: Path) -> None:
    miss = residuals(folder, "strict", altered=True)
    distance = np.hypot(*miss.T)
    print(
        f"\nign_borea, strict: {len(miss)} observations, median {np.median(distance):.4f} px, rms per axis "
        f"{np.sqrt((miss**2).mean(axis=0)).round(3)} px, 95 % below {np.percentile(distance, 95):.2f} px"
    )
    assert len(miss) > 14_400
    assert np.median(distance) <= 0.18
    np.testing.assert_allclose(miss.mean(axis=0), 0.0, atol=0.02)


@pytest.mark.parametrize(("curvature", "altered"), [("strict", False), ("none", True)])
def test_half_of_the_model_is_visibly_wrong(folder: Path, curvature: str, altered: bool) -> None:
    """The alteration stands for the scale of the map: it goes with map coordinates, its undoing with strict ones."""
    assert np.median(np.hypot(*residuals(folder, curvature, altered).T)) > 1.0


def test_map_coordinates_with_their_alteration_come_close(folder: Path) -> None:
    """What the linear alteration is for; curvature within one image is left."""
    median = np.median(np.hypot(*residuals(folder, "none", altered=False).T))
    assert 0.18 < median < 0.25
