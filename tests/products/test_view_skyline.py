"""The skyline: of a ridge whose line is known, against all pixels, and without sky."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyogrio
import pytest
import rasterio
from rasterio.transform import from_origin
from tools.command import inside

from photoplan.products.view.skyline import COLUMNS, skyline
from photoplan.requests.view import CameraRequest, SkylineRequest

CRS = "EPSG:32633"
STAND = CameraRequest(position=(500_000.0, 5_300_050.0), height=20.0, look_at=(500_000.0, 5_300_500.0), size=(90, 60))


@pytest.fixture
def ridge(tmp_path: Path) -> Path:
    """Level ground, and 400 m to the north a wall-like ridge that rises to the east; posts of 5 m."""
    x = np.mgrid[0:200, 0:200][1]
    heights = np.full((200, 200), 100.0)
    heights[:2, :] = 130.0 + 0.1 * (x[:2] * 5.0)
    path = tmp_path / "ridge.tif"
    place = {"crs": CRS, "transform": from_origin(499_500.0, 5_300_510.0, 5.0, 5.0)}
    shape = {"driver": "GTiff", "width": 200, "height": 200, "count": 1, "dtype": "float64"}
    with rasterio.open(path, "w", **shape, **place) as file:
        file.write(heights, 1)
    return path


def test_the_line_of_a_ridge(ridge: Path, tmp_path: Path) -> None:
    """Every point of it lies on the ridge's upper edge, 0.1 m a metre, to a thousandth of a pixel."""
    found = skyline(SkylineRequest(ridge, STAND, output=tmp_path / "s.csv"))
    x, y, E, N, H, distance, azimuth = found.points.T
    assert len(found.points) == 90 and set(found.surfaces) == {"terrain"}
    np.testing.assert_array_equal(x, np.arange(90))
    # Posts lie in the middle of their pixels: the first row of posts from 499,502.5 on, its southern neighbour 5 m on.
    np.testing.assert_allclose(H, 130.0 + 0.1 * (E - 499_502.5), atol=0.02)
    assert (np.abs(N - 5_300_502.5) < 0.2).all()
    np.testing.assert_allclose(
        distance, np.hypot(np.hypot(E - 500_000, N - 5_300_050), H - 120.0), rtol=1e-5
    )  # the earth is round
    np.testing.assert_allclose(azimuth, np.degrees(np.arctan2(E - 500_000, N - 5_300_050)) % 360, atol=1e-6)
    assert (np.diff(y) < 0).all()  # it rises to the right
    table = (tmp_path / "s.csv").read_text().split("\n")
    assert table[0] == ",".join([*COLUMNS, "surface"]) and len(table) == 92


def test_it_is_the_border_of_the_matrix(ridge: Path, tmp_path: Path) -> None:
    """By command: in every column the first pixel with ground lies less than a pixel below."""
    words = ("--from", 500_000, 5_300_050, "--height", 20, "--look-at", 500_000, 5_300_500, "--size", 90, 60)
    said = inside("view", "matrix", ridge, *words, "-o", tmp_path / "m.tif", "-q")
    assert said.code == 0, said.err
    said = inside("view", "skyline", ridge, *words, "-o", tmp_path / "s.gpkg")
    assert said.code == 0 and "90 of 90 columns" in said.out
    with rasterio.open(tmp_path / "m.tif") as file:
        seen = np.isfinite(file.read(3))
    meta, _, _, columns = pyogrio.raw.read(tmp_path / "s.gpkg")
    y = columns[meta["fields"].tolist().index("y")]
    first = seen.argmax(axis=0)
    assert ((first - y >= 0) & (first - y < 1)).all()


def test_without_sky_there_is_none(ridge: Path, tmp_path: Path) -> None:
    down = CameraRequest(
        position=(500_000.0, 5_300_000.0), height=200.0, look_at=(500_000.0, 5_300_001.0), size=(40, 30)
    )
    found = skyline(SkylineRequest(ridge, down, output=tmp_path / "none.csv"))
    assert len(found.points) == 0
    said = inside("view", "skyline", ridge, "--from", 0, 0, "--azimuth", 0, "-o", tmp_path / "none.csv")
    assert said.code == 2 and "exists already" in said.err
    said = inside("view", "skyline", "no.tif", "--from", 0, 0, "--azimuth", 0, "-o", tmp_path / "line.txt")
    assert said.code == 2 and ".gpkg" in said.err
