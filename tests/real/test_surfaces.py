"""Surfaces from real images against heights that others have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from PIL import Image
from pyproj import Transformer
from real.test_rpc_ties import brought_together
from scipy import ndimage
from tools.command import inside
from tools.real_projects import dmc_project

from photoplan.geometry.frames import WallFrame
from photoplan.geometry.pose import angles_from_rotation

pytest.importorskip("cv2")
pytestmark = pytest.mark.slow


def nmad(values: NDArray[np.float64]) -> float:
    """1.4826 times the median distance from the median."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def at_posts(path: Path, other: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Heights of a raster at the pixels of another one, bilinear, NaN where one of four is missing; and the latter."""
    with rasterio.open(path) as file, rasterio.open(other) as theirs:
        z, to_map, Z = (
            file.read(1).astype(float),
            file.transform,
            theirs.read(1, masked=True).astype(float).filled(np.nan),
        )
        row, col = np.nonzero(np.isfinite(Z))
        X, Y = theirs.transform @ (col + 0.5, row + 0.5)
        if file.crs != theirs.crs:
            X, Y = Transformer.from_crs(theirs.crs, file.crs, always_xy=True).transform(X, Y)
    u, v = (np.asarray(a) - 0.5 for a in ~to_map @ (np.asarray(X), np.asarray(Y)))
    i, j = np.floor(u).astype(int), np.floor(v).astype(int)
    inside = (i >= 0) & (j >= 0) & (i < z.shape[1] - 1) & (j < z.shape[0] - 1)
    i, j, u, v, row, col = (a[inside] for a in (i, j, u, v, row, col))
    a, b = u - i, v - j
    found = (z[j, i] * (1 - a) + z[j, i + 1] * a) * (1 - b) + (z[j + 1, i] * (1 - a) + z[j + 1, i + 1] * a) * b
    return found, Z[row, col]


def test_a_triplet_of_satellite_images(shared: Path, tmp_path: Path) -> None:
    """From level ground at 170 m, with a reach of 100 m, over a quarry of 175 m of relief."""
    project = brought_together(shared, tmp_path)
    said = inside("surface", project, "--resolution", 1.5, "--reach", 100, "--no-quicklook")
    assert said.code == 0, said.err
    theirs = shared / "data/pleiades_triplet_s2p/s2p_dsm.tif"
    found, Z = at_posts(tmp_path / "products/surface.tif", theirs)
    sigma, _ = at_posts(tmp_path / "products/surface_sigma.tif", theirs)
    off = found - Z
    known, sure = np.isfinite(off), sigma <= 0.5
    print(
        "known",
        known.mean(),
        "NMAD",
        nmad(off[known]),
        "sure",
        sure.mean(),
        nmad(off[sure]),
        "median",
        np.median(off[sure]),
    )
    assert known.mean() > 0.99 and abs(np.median(off[known])) < 0.15
    assert nmad(off[known]) < 0.62 and nmad(off[sure]) < 0.55
    assert (np.abs(off[known]) < 2).mean() > 0.96


def test_four_aerial_frames(shared: Path, tmp_path: Path) -> None:
    """Pixels of 6 m against posts of 24 m, within which ravines are cut 20 m deep."""
    project = dmc_project(shared, tmp_path)
    said = inside("surface", project, "--resolution", 24, "--no-quicklook")
    assert said.code == 0, said.err
    found, Z = at_posts(tmp_path / "products/surface.tif", shared / "data/ngi_dmc/dem.tif")
    off = (found - Z)[np.isfinite(found)]
    print(
        "known",
        np.isfinite(found).mean(),
        "NMAD",
        nmad(off),
        "median",
        np.median(off),
        "far",
        (np.abs(off) > 20).mean(),
    )
    assert abs(np.median(off)) < 1 and nmad(off) < 4
    assert (np.abs(off) > 20).mean() < 0.2


@pytest.mark.xfail(
    strict=True, reason="rms of heights that claim 8 mm: about 40 mm, 12 are allowed: missed, see docs/status.md"
)
def test_a_facade_from_three_photographs(shared: Path, tmp_path: Path) -> None:
    """The fountain of Lausanne, over its wall, searched from a level start."""
    data = shared / "data/epfl_fountain"
    reference = np.loadtxt(data / "reference_points.txt")
    moved = np.array([500_000.0, 5_200_000.0, 100.0]) - np.median(reference[:, :3], axis=0)
    text = 'format = 1\ncrs = "EPSG:32633"\n[terrain]\nheight = 100.0\nheight_system = "same"\n'
    text += '[orientation]\nheight_system = "same"\n'
    ways = []
    for name in ("0004", "0005", "0006"):
        values = [float(word) for word in (data / f"{name}.jpg.camera").read_text().split()]
        K, R, C = (np.array(values[a:b]) for a, b in ((0, 9), (12, 21), (21, 24)))
        pixels = np.asarray(Image.open(data / f"{name}.jpg")).transpose(2, 0, 1)
        form = {"driver": "GTiff", "count": 3, "dtype": "uint8", "width": pixels.shape[2], "height": pixels.shape[1]}
        with rasterio.open(tmp_path / f"{name}.tif", "w", **form) as file:
            file.write(pixels)
        G = R.reshape(3, 3) @ np.diag([1, -1, -1])
        ways.append(G[:, 2])
        text += f'[cameras.c{name}]\ntype = "frame"\nsize = [1536, 1024]\nfocal_px = [{K[0] / 2}, {K[4] / 2}]\n'
        text += f"principal_point_px = {[float(c + 0.5) / 2 - 0.5 for c in (K[2], K[5])]}\n"
        text += f'[[images]]\nname = "{name}"\nfile = "{name}.tif"\ncamera = "c{name}"\n'
        text += f"center = {(C + moved).tolist()}\nangles = {np.degrees(angles_from_rotation(G)).tolist()}\n"
    (tmp_path / "project.toml").write_text(text)
    # The wall faces the photographers.
    x, y, _ = np.mean(ways, axis=0)
    azimuth = round(float(np.degrees(np.arctan2(x, y))), 3)
    frame = WallFrame.facing((500_000.0, 5_200_000.0, 100.0), azimuth)
    bounds = (-3.6, -2.7, 4.4, 2.4)
    target = f"wall:500000,5200000,100,{azimuth}"
    words = ["--resolution", 0.02, "--reach", 1.8, "--bounds", *bounds, "--no-quicklook"]
    said = inside("surface", tmp_path / "project.toml", "--target", target, *words)
    assert said.code == 0, said.err
    points = frame.inverse(reference[:, :3] + moved)
    seen = (reference[:, 5] < 0.004) & (points[:, :2] > bounds[:2]).all(axis=1)
    seen &= (points[:, :2] < bounds[2:]).all(axis=1)
    found = []
    for kind in ("", "_sigma"):
        with rasterio.open(tmp_path / f"products/surface{kind}.tif") as file:
            values = file.read(1).astype(float)
            col, row = np.asarray(~file.transform @ points[seen, :2].T) - 0.5
        found.append(ndimage.map_coordinates(values, [row, col], order=1, mode="nearest"))
    off = found[0] - points[seen, 2]
    known = np.isfinite(off)
    print("points", seen.sum(), "known", known.mean(), "NMAD", nmad(off[known]))
    for sigma, share, rms, far in ((0.008, 0.45, 0.012, 0.03), (0.012, 0.7, 0.018, 0.05), (0.02, 0.8, 0.025, 0.1)):
        sure = found[1] < sigma
        own, beyond = np.sqrt(np.mean(off[sure] ** 2)), (np.abs(off[sure]) > 0.02).mean()
        print("sigma", sigma, "claimed", sure.mean(), "rms", own, "off by 20 mm", beyond)
        assert sure.mean() > share and own < rms and beyond < far
    assert known.mean() > 0.9 and nmad(off[known]) < 0.008
