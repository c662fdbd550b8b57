"""Surfaces from real images against heights that others have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from pyproj import Transformer
from real.test_rpc_ties import brought_together
from tools.command import inside
from tools.real_projects import dmc_project

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
