"""Rational polynomials that satellites were delivered with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import RPCTransformer

from photoplan.io.camera.rpc.file import read_rpc


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
