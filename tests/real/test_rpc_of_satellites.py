"""Rational polynomials that satellites were delivered with."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import RPCTransformer
from scipy.ndimage import map_coordinates, spline_filter

from photoplan.cameras.base import project
from photoplan.cameras.fiducials import Affine2D
from photoplan.cameras.rpc import RpcCamera, fitted_functions
from photoplan.geometry.local import GeodeticGround
from photoplan.io.camera.satellite import read_rpc


def test_pleiades_polynomials_are_those_of_its_location_grid(shared: Path) -> None:
    """The producer fitted them to 0.0004 px; a pixel more would be a count from 0 (DIMAP counts from 1)."""
    folder = shared / "data/pleiades_line_model"
    rpc = read_rpc(next(folder.glob("PHRDIMAP*.XML"))).functions
    with rasterio.open(next(folder.glob("GRID*.tif"))) as grid:
        lon, lat = grid.read((3, 4)).astype(float)
        height = float(grid.tags()["ALTITUDE_B2"])
    i, j = np.mgrid[0:65, 0:65]
    # In the file's count 0.5 is the centre of the first pixel.
    nodes = np.stack([624.984375 * j, 597.609375 * i], axis=-1)
    miss = rpc(np.stack([lon, lat, np.full(lon.shape, height)], axis=-1)) - nodes
    assert np.abs(miss.mean(axis=(0, 1))).max() < 0.001
    assert miss.std(axis=(0, 1)).max() < 0.001


def test_tags_of_real_images_give_gdals_positions(shared: Path) -> None:
    images = [
        *sorted((shared / "data/pleiades_triplet_s2p").glob("img_*.tif")),
        shared / "data/ngi_dmc/rpc_qb2/qb2_basic1b.tif",
    ]
    normal = np.random.default_rng(4).uniform(-1, 1, (300, 3))
    for image in images:
        rpc = read_rpc(image).functions
        at = normal * rpc.ground_scale + rpc.ground_offset
        with rasterio.open(image) as file, RPCTransformer(file.rpcs) as gdal:
            rows, cols = gdal.rowcol(*at.T, op=lambda v: v)
        assert np.abs(rpc(at) + 0.5 - np.column_stack([cols, rows])).max() < 1e-6, image.name
        back = rpc.inverse(rpc(at), at[:, 2])
        assert np.abs(rpc(back) - rpc(at)).max() < 1e-8


def offsets(images: list[np.ndarray], cameras: list[RpcCamera], patches: np.ndarray) -> np.ndarray:
    """By how much the second image shows ground elsewhere than the first one and the polynomials say, (n, 2) pixels.

    Patches of the ground (n, m, 3), without heights in places, are correlated; NaN where they are not alike.
    """
    reach, found = 4, np.full((len(patches), 2), np.nan)
    smooth = [spline_filter(image.astype(float)) for image in images]
    for n, XYZ in enumerate(patches):
        at = [project(camera, XYZ[np.isfinite(XYZ[:, 2])]) for camera in cameras]
        a = map_coordinates(smooth[0], at[0].T[::-1], prefilter=False)
        a = (a - a.mean()) / (a.std() + 1e-9)
        score = np.empty((2 * reach + 1, 2 * reach + 1))
        for i, j in np.ndindex(score.shape):
            b = map_coordinates(smooth[1], (at[1] + (j - reach, i - reach)).T[::-1], prefilter=False)
            score[i, j] = (a * (b - b.mean())).mean() / (b.std() + 1e-9)
        i, j = np.unravel_index(score.argmax(), score.shape)
        if score.max() > 0.85 and 0 < i < 2 * reach and 0 < j < 2 * reach:
            along = [score[i, j - 1 : j + 2], score[i - 1 : i + 2, j]]
            found[n] = [k - reach + (s[0] - s[2]) / (2 * (s[0] - 2 * s[1] + s[2])) for k, s in zip((j, i), along)]
    return found


def spread(values: np.ndarray) -> np.ndarray:
    """Normalised median deviation of each column."""
    return 1.4826 * np.nanmedian(np.abs(values - np.nanmedian(values, axis=0)), axis=0)


@pytest.mark.slow
@pytest.mark.parametrize("second", [2, 3])
def test_one_shift_brings_the_images_of_a_triplet_together(shared: Path, second: int) -> None:
    """README of the data: medians of about 1 px, spread 0.14 and 0.25 px, by other polynomials and another matching."""
    folder = shared / "data/pleiades_triplet_s2p"
    ground = GeodeticGround("EPSG:32631")
    images, cameras = [], []
    for number in (1, second):
        path = folder / f"img_0{number}.tif"
        with rasterio.open(path) as file:
            images.append(file.read(1))
        cameras.append(RpcCamera(read_rpc(path).functions, ground, (1024, 1024)))
    with rasterio.open(folder / "s2p_dsm.tif") as file:
        Z, T = file.read(1), file.transform
    half = 15
    window = np.lib.stride_tricks.sliding_window_view(Z, (2 * half + 1, 2 * half + 1))[::24, ::24]
    row, col = np.nonzero(np.isfinite(window).mean(axis=(2, 3)) > 0.9)
    u, v = np.meshgrid(np.arange(2 * half + 1) + 0.5, np.arange(2 * half + 1) + 0.5)
    X, Y = T * (24 * col[:, None] + u.ravel(), 24 * row[:, None] + v.ravel())
    XYZ = np.stack([X, Y, window[row, col].reshape(len(row), -1)], axis=-1)
    middle = np.nanmean(XYZ, axis=1)
    inside = np.all([((p > 30) & (p < 994)).all(axis=1) for p in (project(c, middle) for c in cameras)], axis=0)
    shift = np.zeros(2)
    for _ in range(3):
        # A parabola through three correlations is a little off between pixels: the last round measures near none.
        cameras[1] = replace(cameras[1], correction=Affine2D(1, 0, shift[0], 0, 1, shift[1]))
        left = offsets(images, cameras, XYZ[inside])
        shift += np.nanmedian(left, axis=0)
    assert 0.3 < np.hypot(*shift) < 2.0
    assert np.abs(np.nanmedian(left, axis=0)).max() <= 0.02
    assert (spread(left) <= (0.14, 0.25)).all()
    assert np.isfinite(left[:, 0]).sum() > 100


def test_quickbird_and_its_control(shared: Path) -> None:
    """Five field points: the polynomials alone are wrong by 3.6 pixels, with one shift by a tenth."""
    folder = shared / "data/ngi_dmc/rpc_qb2"
    points = json.loads((folder / "gcps.geojson").read_text())["features"]
    xy = np.array([p["properties"]["ji"] for p in points])
    at = np.array([p["geometry"]["coordinates"] for p in points])
    miss = xy - read_rpc(folder / "qb2_basic1b.tif").functions(at)
    assert np.hypot(*miss.mean(axis=0)) == pytest.approx(3.64, abs=0.05)
    assert np.abs(miss - miss.mean(axis=0)).max() < 0.15


def test_polynomials_fitted_to_the_location_grid_of_pleiades(shared: Path) -> None:
    """All its heights, −30 to 4900 m; every second node is kept for the check."""
    folder = shared / "data/pleiades_line_model"
    with rasterio.open(next(folder.glob("GRID*.tif"))) as grid:
        bands, tags = grid.read().astype(float), grid.tags()
    heights = np.array([float(tags[f"ALTITUDE_B{k}"]) for k in range(0, len(bands), 2)])
    H = np.broadcast_to(heights[:, None, None], (len(heights), 65, 65))
    at = np.stack([bands[::2], bands[1::2], H], axis=-1)
    i, j = np.mgrid[0:65, 0:65]
    xy = np.broadcast_to(np.stack([624.984375 * j, 597.609375 * i], axis=-1), (*H.shape, 2))
    kept = np.broadcast_to((i + j) % 2 == 1, H.shape)
    found = fitted_functions(at[~kept], xy[~kept])
    miss = found(at[kept]) - xy[kept]
    assert miss.std(axis=0).max() <= 0.001
