"""A block of three small images over gentle hills, made in a moment: what whole runs are tested on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.transform import from_origin
from scipy.ndimage import gaussian_filter

from photoplan.products.init import InitRequest, init_project

SIZE = (200, 150)
"""Width and height of an image, pixels."""
FOCAL = 200.0
"""Camera constant, pixels."""
CRS = "EPSG:32633"
X0, Y0, Z0 = 500_300.0, 5_300_200.0, 400.0
"""First projection centre; the terrain lies at about 100 m, so a pixel is 1.5 m and a footprint 300 m × 225 m."""
BASE = 60.0
"""Distance of the projection centres, metres."""
NAMES = ("one", "two", "three")
ANGLES = ((0.8, -1.2, 3.0), (-0.5, 0.4, 95.0), (1.5, 0.9, -170.0))
"""ω, φ, κ in degrees."""
DEM_STEP = 10.0
YAML = (
    f"small:\n  type: pinhole\n  im_size: [{SIZE[0]}, {SIZE[1]}]\n  focal_len: {FOCAL:g}\n  sensor_size: [200, 150]\n"
)


@dataclass(frozen=True)
class Block:
    """Files of a block, all in one folder."""

    folder: Path

    @property
    def images(self) -> list[Path]:
        return [self.folder / "images" / f"{name}.tif" for name in NAMES]

    @property
    def terrain(self) -> Path:
        return self.folder / "dem.tif"

    @property
    def camera(self) -> Path:
        return self.folder / "camera.yaml"

    @property
    def orientation(self) -> Path:
        return self.folder / "orientation.csv"

    @property
    def project(self) -> Path:
        return self.folder / "project.toml"

    def init_options(self) -> list[str]:
        """Options of `photoplan init` behind the folder."""
        files = {"--camera": self.camera, "--orientation": self.orientation, "--terrain": self.terrain}
        options = ["--images", str(self.folder / "images" / "*.tif"), "--crs", CRS]
        return [*options, *(str(word) for pair in files.items() for word in pair)]


def texture(size: tuple[int, int] = SIZE, bands: int = 3, seed: int = 0) -> NDArray[np.uint8]:
    """Smooth noise (bands, height, width) between 20 and 235, so that no pixel is mistaken for nodata."""
    noise = np.random.default_rng(seed).normal(size=(bands, size[1], size[0]))
    smooth = gaussian_filter(noise, (0, 1.5, 1.5), mode="wrap")
    return np.clip(127.5 + smooth * 40 / smooth.std(), 20, 235).astype(np.uint8)


def hills(X: NDArray[np.float64], Y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Height of the terrain at map points, metres."""
    return 100 + 8 * np.sin((X - X0) / 70) * np.cos((Y - Y0) / 50)


def write_image(path: Path, pixels: NDArray[Any], **options: Any) -> Path:
    """A TIFF of (bands, height, width)."""
    bands, height, width = pixels.shape
    profile = {"driver": "GTiff", "width": width, "height": height, "count": bands, "dtype": pixels.dtype} | options
    with rasterio.open(path, "w", **profile) as file:
        file.write(pixels)
    return path


def write_terrain(path: Path, heights: NDArray[Any] | None = None, **options: Any) -> Path:
    """Heights of 640 m × 600 m around the block; rows from the north."""
    left, top, columns, rows = X0 - 260, Y0 + 300, 64, 60
    if heights is None:
        x = left + (np.arange(columns) + 0.5) * DEM_STEP
        y = top - (np.arange(rows) + 0.5) * DEM_STEP
        heights = hills(*np.meshgrid(x, y))
    place = {"crs": CRS, "transform": from_origin(left, top, DEM_STEP, DEM_STEP)}
    return write_image(path, heights[None].astype(np.float32), **(place | options))


def write_orientation(path: Path, unit: float = 1.0) -> Path:
    """The table of orientations; `unit` is the number that angles are multiplied with."""
    lines = ["name,x,y,z,omega,phi,kappa"]
    for i, (name, angles) in enumerate(zip(NAMES, ANGLES)):
        numbers = (X0 + i * BASE, Y0, Z0, *(a * unit for a in angles))
        lines.append(",".join([name, *(f"{n:.6f}" for n in numbers)]))
    path.write_text("\n".join(lines) + "\n")
    return path


def write_block(folder: Path, project: bool = True) -> Block:
    """All files of the block, and its project file if asked."""
    block = Block(folder)
    (folder / "images").mkdir(parents=True)
    for seed, path in enumerate(block.images):
        write_image(path, texture(seed=seed))
    write_terrain(block.terrain)
    block.camera.write_text(YAML)
    write_orientation(block.orientation)
    if project:
        make_project(block)
    return block


def make_project(block: Block, **changes: Any) -> Path:
    """Write `project.toml` of the block; its height systems are declared to be the same."""
    request = InitRequest(
        folder=block.folder,
        images=(str(block.folder / "images" / "*"),),
        camera=block.camera,
        orientation=block.orientation,
        terrain=str(block.terrain),
        crs=CRS,
        **{"height_system": "same", "overwrite": True} | changes,
    )
    return init_project(request).path
