"""Heights per CPU second of `photoplan surface`, and its memory: four rendered 8-bit images, nine pixels of each for a
height, whole commands by growing size.

    python bench/surface_rate.py [HEIGHTS …]   (default: 100000 300000 1000000)

Images and pyramids grow with the size, tiles do not: time per height and memory should stay. Seconds on two cores are
half of the CPU seconds.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from prepare import CHECKOUT
from scipy.ndimage import gaussian_filter, map_coordinates

from photoplan.io.project.file import load_project
from photoplan.project.cameras import central_without_pixels

sys.path.insert(0, str(CHECKOUT / "tests"))
from tools.rendered_block import Flight, write_project
from tools.small_block import CRS, X0, Y0, write_image

#: Pixels on the ground, metres; pixels along a side of a height; flying height over base.
GSD, RATIO, STEEP = 0.5, 3, 3.0
#: Camera constant, pixels: of large images as wide as these, which else would see their borders at grazing angles.
GROUND, FOCAL = 100.0, 1000.0
SIZES = (100_000, 300_000, 1_000_000)


def hills(X, Y):
    """Heights, metres."""
    return GROUND + 6 * np.sin(X / 61) * np.cos(Y / 47) + 2 * np.sin(X / 23 + Y / 31)


def write_block(folder, side):
    """Four images over side × side heights, 60 % of them common to all; bounds of those."""
    focal = max(FOCAL, float(side * RATIO))
    flying = focal * GSD
    step = flying / STEEP / 3
    extent = side * RATIO * GSD
    # Images are turned by 3°.
    size = (int((1.12 * extent + 3 * step) / GSD) + 80, int((1.06 * extent + 0.16 * step) / GSD) + 80)
    flight = Flight((X0, Y0), GROUND + flying, (step, 0.0), (4, 1), size, focal, tilt=0.0)
    path = write_project(folder, CRS, f"height = {GROUND}", "", flight)
    (folder / "rendered").mkdir()
    rng = np.random.default_rng(0)
    # Twice as fine as the pixels; further out the same again.
    ground = 120 + 40 * _unit(gaussian_filter(rng.normal(size=(2048, 2048)).astype(np.float32), 2.0, mode="wrap"))
    for camera, name in _cameras(path):
        pixels = np.empty(size[::-1], np.uint8)
        for row in range(0, size[1], 200):
            rows = np.arange(row, min(row + 200, size[1]))
            xy = np.stack(np.meshgrid(np.arange(size[0]), rows), axis=-1).reshape(-1, 2).astype(float)
            origin, way = camera.rays(xy)
            z = np.full(len(xy), GROUND)
            for _ in range(4):
                XY = origin[:, :2] + ((z - origin[:, 2]) / way[:, 2])[:, None] * way[:, :2]
                z = hills(*XY.T)
            at = ((XY[:, ::-1] - (Y0, X0)) / (GSD / 2)).T
            grey = map_coordinates(ground, at, order=1, mode="grid-wrap") + rng.normal(0, 0.5, len(xy))
            pixels[rows] = np.clip(np.rint(grey), 1, 255).reshape(len(rows), -1)
        write_image(folder / "rendered" / f"{name}.tif", pixels[None])
    half = extent / 2
    return path, (X0 - half, Y0 - half, X0 + half, Y0 + half)


def _unit(values):
    return (values - values.mean()) / values.std()


def _cameras(path):
    project = load_project(path)
    return [(central_without_pixels(project, image.name), image.name) for image in project.images]


def main():
    for heights in [int(float(word)) for word in sys.argv[1:]] or SIZES:
        with tempfile.TemporaryDirectory() as folder:
            path, bounds = write_block(Path(folder), round(heights**0.5))
            words = ["--resolution", GSD * RATIO, "--bounds", *bounds, "--reach", 20, "--workers", 2]
            command = [sys.executable, "-m", "photoplan", "surface", path, *words, "--no-quicklook", "-q", "--json"]
            measure = [sys.executable, Path(__file__).with_name("measure.py"), *map(str, command)]
            found = json.loads(subprocess.run(measure, stdout=subprocess.PIPE, check=True).stdout)
            record = json.loads((Path(folder) / "products" / "surface.run.json").read_text())["product"]
        print(
            f"{heights:>9}: {found['cpu']:.1f} CPU s, {heights / found['cpu']:.0f} each, {found['wall']:.1f} "
            f"s, {found['memory'] / 2**20:.0f} MiB, {record['valid_share']:.1%} known, corrections "
            f"{record['corrections_px'][0]:.3f} px, sigma {record['sigma_px']:.4f} px",
            flush=True,
        )


if __name__ == "__main__":
    main()
