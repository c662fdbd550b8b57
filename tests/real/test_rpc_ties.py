"""Tie points between real satellite images bring them together."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import rasterio
import shapely
from real.test_rpc_of_satellites import offsets, spread

from photoplan.cameras.base import project
from photoplan.io.project.file import load_project
from photoplan.products.adjust.run import AdjustRequest, adjust_project
from photoplan.products.tie import TieRequest, find_ties
from photoplan.project.cameras import camera_without_pixels

pytest.importorskip("cv2")
NAMES = ("img_01", "img_02", "img_03")


def brought_together(shared: Path, folder: Path) -> Path:
    """Project of the triplet after `tie` and `adjust`, with heights of another program's surface at the tie points as
    height control."""
    data = shared / "data/pleiades_triplet_s2p"
    text = 'format = 1\ncrs = "EPSG:32631"\n[terrain]\nheight = 170.0\nheight_system = "ellipsoidal"\n[observations]\n'
    for name in NAMES:
        shutil.copy(data / f"{name}.tif", folder)
        text += f'[[images]]\nname = "{name}"\nfile = "{name}.tif"\nrpc = "tags"\n'
    path = folder / "project.toml"
    path.write_text(text)
    report = find_ties(TieRequest(path))
    assert report.points > 400 and report.sigma < 0.1
    first = adjust_project(AdjustRequest(path))
    assert first.rms_pixels < 0.05
    (folder / "rejected.txt").write_text(str(first.rejected))
    assert "position of the block in Z" in first.data["determined_by_priors_alone"]
    with rasterio.open(data / "s2p_dsm.tif") as file:
        Z, T = file.read(1), file.transform
    _, _, shapes, (names, *_) = pyogrio.raw.read(folder / "adjustment/points.gpkg", layer="points")
    at = shapely.get_coordinates(shapely.from_wkb(shapes))
    col, row = (np.floor(v).astype(int) for v in ~T * at.T)
    inside = (col >= 0) & (col < Z.shape[1]) & (row >= 0) & (row < Z.shape[0])
    known = [(names[k], float(Z[row[k], col[k]])) for k in np.flatnonzero(inside) if np.isfinite(Z[row[k], col[k]])]
    (folder / "heights.csv").write_text("name,x,y,z\n" + "".join(f"{n},,,{z:.3f}\n" for n, z in known))
    stated = '[observations]\ncontrol = ["heights.csv"]\nsigma_control = [1.0, 0.5]'
    path.write_text(path.read_text().replace("[observations]", stated, 1))
    second = adjust_project(AdjustRequest(path, overwrite=True))
    assert "position of the block in Z" not in second.data["determined_by_priors_alone"]
    return path


@pytest.fixture(scope="module")
def triplet(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return brought_together(shared, tmp_path_factory.mktemp("triplet"))


@pytest.mark.slow
@pytest.mark.xfail(strict=True, reason="10 of 564 points: missed by one, see docs/status.md")
def test_fewer_than_ten_measurements_of_a_triplet_are_rejected(triplet: Path) -> None:
    assert int((triplet.parent / "rejected.txt").read_text()) < 10


@pytest.mark.slow
def test_tie_points_of_a_triplet_bring_it_together(shared: Path, triplet: Path) -> None:
    """README of the data: a shift of each image has to bring the medians to zero, with a spread of 0.14 and 0.25 px."""
    folder = shared / "data/pleiades_triplet_s2p"
    path = triplet
    with rasterio.open(folder / "s2p_dsm.tif") as file:
        Z, T = file.read(1), file.transform
    opened = load_project(path)
    cameras = [camera_without_pixels(opened, name) for name in NAMES]
    images = []
    for name in NAMES:
        with rasterio.open(folder / f"{name}.tif") as file:
            images.append(file.read(1))
    XYZ = nodes(Z, T)
    for k in (1, 2):
        pair = [cameras[0], cameras[k]]
        middle = np.nanmean(XYZ, axis=1)
        good = np.all([((p > 30) & (p < 994)).all(axis=1) for p in (project(c, middle) for c in pair)], axis=0)
        left = offsets([images[0], images[k]], pair, XYZ[good])  # type: ignore[arg-type]
        assert np.isfinite(left[:, 0]).sum() > 100
        assert np.abs(np.nanmedian(left, axis=0)).max() <= 0.02
        assert (spread(left) <= (0.14, 0.25)).all()


def nodes(Z: np.ndarray, T: rasterio.Affine, half: int = 15) -> np.ndarray:
    """Patches of the surface (n, m, 3), NaN where it has no height."""
    window = np.lib.stride_tricks.sliding_window_view(Z, (2 * half + 1, 2 * half + 1))[::24, ::24]
    row, col = np.nonzero(np.isfinite(window).mean(axis=(2, 3)) > 0.9)
    u, v = np.meshgrid(np.arange(2 * half + 1) + 0.5, np.arange(2 * half + 1) + 0.5)
    X, Y = T * (24 * col[:, None] + u.ravel(), 24 * row[:, None] + v.ravel())
    return np.stack([X, Y, window[row, col].reshape(len(row), -1)], axis=-1)
