"""Views of a country with strict curvature: places by polynomials of the direction, and what that costs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio

from photoplan.geometry.grid import Window
from photoplan.products.view.camera import open_view_ground, view_camera
from photoplan.products.view.make import seen_surface
from photoplan.requests.view import CameraRequest
from photoplan.targets.view import ViewTarget

CRS = "EPSG:31287"


@pytest.fixture(scope="module")
def country(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Hills over 300 km × 200 km of Austria, posts every 500 m."""
    path = tmp_path_factory.mktemp("country") / "country.tif"
    x, y = np.meshgrid(np.arange(600) * 0.5, np.arange(400) * 0.5)
    heights = 900 + 500 * np.sin(x / 9.0) * np.cos(y / 7.0) + 200 * np.sin(x / 2.1 + y / 3.3)
    with rasterio.open(path, "w", driver="GTiff", width=600, height=400, count=1, dtype="float32", crs=CRS,
                       transform=rasterio.Affine(500, 0, 280_000, 0, -500, 500_000)) as file:  # fmt: skip
        file.write(heights.astype(np.float32), 1)
    return path


@pytest.mark.parametrize("azimuth", [80.0, 300.0])
def test_pixels_show_what_projects_onto_them(country: Path, monkeypatch: pytest.MonkeyPatch, azimuth: float) -> None:
    """Asked: to 0.02 pixels; exact rays, few at a time, see the same. A ray costs less than one map point."""
    ground = open_view_ground(country, None, None)
    request = CameraRequest(
        position=(430_000.0, 400_000.0),
        height=2500.0,
        azimuth=azimuth,
        pitch=-2.0,
        size=(1200, 800),
        curvature="strict",
    )
    target = view_camera(request, ground).target
    surface = seen_surface(ground, np.inf, 0.01)
    strict, count = ViewTarget._strict, [0]

    def counted(self: ViewTarget, unit: np.ndarray, along: np.ndarray) -> np.ndarray:
        count[0] += len(unit) * len(along)
        return strict(self, unit, along)

    monkeypatch.setattr(ViewTarget, "_strict", counted)
    window = Window(500, 330, 256, 160)
    seen = surface.look(target, window)
    points = count[0] / (window.width * window.height)
    there = seen.owner >= 0
    assert 0.4 < there.mean() < 1.0
    back = target.to_view(seen.XYZ[there])
    off = np.abs(back[:, :2] - seen.uvh[there][:, :2]).max()
    some = np.flatnonzero(there.ravel())[::97]
    few = surface.at(target, seen.uvh.reshape(-1, 3)[some, :2])
    apart = np.linalg.norm(few.XYZ - seen.XYZ.reshape(-1, 3)[some], axis=1) / few.uvh[:, 2]
    print(f"\n{azimuth:g}°: {off:.4f} px, {points:.2f} map points a ray, exact rays {np.median(apart):.1e} apart")
    assert off < 0.02
    assert np.median(apart) < 1e-5 and (apart < 1e-3).mean() > 0.99
    assert points < 1.0
