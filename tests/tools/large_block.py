"""A block of aerial images over a large terrain raster: what planning, not resampling, has to master."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from rasterio.windows import Window

CRS = "EPSG:32633"
LEFT, TOP = 400_000.0, 5_400_000.0
FOCAL_MM, PIXEL_MM, SIZE = 100.0, 0.004, (26_460, 17_004)

PROJECT = """format = 1
crs = "{crs}"

[terrain]
file = "terrain.tif"
height_system = "same"

[orientation]
height_system = "same"

[cameras.large]
type = "frame"
size = [{width}, {height}]
camera_constant_mm = {c}
pixel_size_um = {pixel}
"""
IMAGE = """
[[images]]
name = "{k:04d}"
file = "{k:04d}.tif"
camera = "large"
center = {center}
angles = {angles}
"""


def relief(X: np.ndarray, Y: np.ndarray) -> np.ndarray:
    """Mountains of 600 m over 9 km, and hills down to 40 m across."""
    x, y = X - LEFT, TOP - Y
    smooth = 700 + 350 * np.sin(x / 2900) * np.cos(y / 2300) + 120 * np.sin((x + 2 * y) / 1300)
    return smooth + 12 * np.sin(x / 31 + y / 97) * np.cos(y / 23) + 25 * np.sin(x / 211) * np.sin(y / 173)


def write_terrain(path: Path, side: int, mesh: float, block: int = 512) -> None:
    """A tiled, compressed GeoTIFF of side × side posts; heights in centimetres with 0.3 m of noise."""
    profile = {
        "driver": "GTiff", "width": side, "height": side, "count": 1, "dtype": "float32", "crs": CRS, "tiled": True,
        "blockxsize": block, "blockysize": block, "compress": "deflate", "predictor": 3, "zlevel": 1, "bigtiff": "yes",
        "transform": Affine(mesh, 0, LEFT - mesh / 2, 0, -mesh, TOP + mesh / 2),
    }  # fmt: skip
    rng = np.random.default_rng(5)
    noise = rng.normal(0, 0.3, (block, side + block))
    with rasterio.open(path, "w", **profile) as file:
        for row in range(0, side, block):
            height = min(block, side - row)
            X, Y = np.meshgrid(LEFT + np.arange(side) * mesh, TOP - (row + np.arange(height)) * mesh)
            start = int(rng.integers(0, block))
            rough = relief(X, Y) + noise[:height, start : start + side]
            file.write(np.round(rough, 2).astype(np.float32), 1, window=Window(0, row, side, height))


def write_image(path: Path) -> None:
    """A sparse TIFF of the camera's size: none of its blocks is written."""
    profile = {"driver": "GTiff", "width": SIZE[0], "height": SIZE[1], "count": 3, "dtype": "uint8"}
    with rasterio.open(path, "w", tiled=True, blockxsize=512, blockysize=512, sparse_ok=True, **profile):
        pass


def write_block(folder: Path, images: int, side: int = 20_000, mesh: float = 2.0, above: float = 2500.0) -> Path:
    """Terrain, images in strips with angles of up to 3°, and `photoplan init`'s inputs; returns the project file.

    Parameters
    ----------
    folder : Path
        Exists.
    images : int
        Spread evenly over the terrain, in strips along X.
    side, mesh : int, float
        Posts along a side of the terrain, and their distance in metres.
    above : float
        Height of the projection centres above the middle height of the terrain, metres.
    """
    terrain = folder / "terrain.tif"
    if not terrain.exists():
        write_terrain(terrain, side, mesh)
    image = folder / "image.tif"
    write_image(image)
    rng = np.random.default_rng(7)
    strips = int(np.sqrt(images))
    each = -(-images // strips)
    text = [PROJECT.format(crs=CRS, width=SIZE[0], height=SIZE[1], c=FOCAL_MM, pixel=PIXEL_MM * 1000)]
    extent = side * mesh
    for k in range(images):
        strip, place = divmod(k, each)
        X = LEFT + extent * (0.03 + 0.94 * (place + 0.5) / each) + rng.normal(0, 20)
        Y = TOP - extent * (0.03 + 0.94 * (strip + 0.5) / strips) + rng.normal(0, 20)
        tilts = rng.uniform(-3, 3, 2)
        center = [round(float(v), 3) for v in (X, Y, 700 + above)]
        angles = [round(float(v), 5) for v in (*tilts, (0.0 if strip % 2 else 180.0) + rng.normal(0, 2))]
        text.append(IMAGE.format(k=k, center=center, angles=angles))
    path = folder / "project.toml"
    path.write_text("".join(text))
    for k in range(images):
        (folder / f"{k:04d}.tif").write_bytes(image.read_bytes())
    return path
