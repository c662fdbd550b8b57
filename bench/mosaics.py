"""Mosaics and visibility: processor time per pixel from 20 to 500 images, and what it costs to know what is hidden.

    python bench/mosaics.py [--quick] [--json FILE]

Images are noise of 400 × 300 pixels with forward and side overlap of 70 and 47 %, tiles of 256, one worker. The product
lies between the outer projection centres; few images leave fewer to choose from even there, so times are told per pixel
and image to choose from, too.
Planning and executing are timed in one process; visibility by whole processes in turn.
"""

from __future__ import annotations

import argparse
import importlib
import json
import shutil
import statistics
import sys
import time
from pathlib import Path

import numpy as np
import rasterio
import shapely
from orientation import measure, photoplan
from prepare import CHECKOUT, WORK
from rasterio.transform import from_origin

from photoplan import load_project, plan_mosaic
from photoplan.io.vector_layer import VectorLayer, write_geopackage
from photoplan.products.orthophoto.execution import Run, execute
from photoplan.project import scene

sys.path.insert(0, str(CHECKOUT / "tests"))

CRS, LEFT, TOP, GROUND = "EPSG:32633", 500_000.0, 5_300_000.0, 100.0
SIZE, FOCAL, GSD = (400, 300), 400.0, 0.5
#: Of the projection centres along and across the strips, pixels.
BASE, STRIP = 120, 160
#: Most by which the time per pixel may grow, and with visibility.
MOST_GROWTH, MOST_COST = 1.3, 2.0

_PROJECT = """format = 1
crs = "{crs}"
[terrain]
file = "terrain.tif"
height_system = "same"
[orientation]
height_system = "same"
[cameras.small]
type = "frame"
size = [{width}, {height}]
focal_px = {focal}
"""
_IMAGE = (
    '\n[[images]]\nname = "{k:04d}"\nfile = "{k:04d}.tif"\ncamera = "small"\ncenter = {center}\nangles = {angles}\n'
)


def write_block(folder: Path, images: int, size: tuple[int, int] = SIZE) -> Path:
    """Images in as many strips as make a square block, over hills; returns the project file."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    rng = np.random.default_rng(3)
    strips = max(1, round((images * BASE / STRIP) ** 0.5))
    each = -(-images // strips)
    text = [_PROJECT.format(crs=CRS, width=size[0], height=size[1], focal=FOCAL)]
    for k in range(images):
        strip, place = divmod(k, each)
        center = [LEFT + GSD * (BASE * place + 200), TOP - GSD * (STRIP * strip + 150), GROUND + FOCAL * GSD]
        text.append(_IMAGE.format(k=k, center=center, angles=rng.uniform(-2, 2, 3).round(3).tolist()))
        pixels = rng.integers(1, 255, (3, size[1], size[0]), np.uint8)
        profile = {"driver": "GTiff", "width": size[0], "height": size[1], "count": 3, "dtype": "uint8"}
        with rasterio.open(folder / f"{k:04d}.tif", "w", **profile) as file:
            file.write(pixels)
    write_terrain(folder / "terrain.tif", (BASE * each + size[0]) * GSD, (STRIP * strips + size[1]) * GSD)
    (folder / "project.toml").write_text("".join(text))
    return folder / "project.toml"


def write_terrain(path: Path, width: float, height: float, margin: float = 100.0, mesh: float = 2.0) -> None:
    """Hills, with trees of some metres."""
    v, u = np.mgrid[: int((height + 2 * margin) / mesh), : int((width + 2 * margin) / mesh)] * mesh
    trees = np.random.default_rng(4).uniform(0, 1, u.shape) < 0.01
    heights = GROUND + 4 * np.sin(u / 90) * np.cos(v / 70) + 6 * trees
    profile = {"driver": "GTiff", "width": u.shape[1], "height": u.shape[0], "count": 1, "dtype": "float32", "crs": CRS}
    with rasterio.open(
        path, "w", tiled=True, transform=from_origin(LEFT - margin, TOP + margin, mesh, mesh), **profile
    ) as f:
        f.write(heights.astype(np.float32), 1)


def mosaic_once(project: Path) -> dict[str, float]:
    """Processor seconds of planning and of executing, pixels that are painted, images to choose from at each."""
    scene._open.cache_clear()
    opened = load_project(project)
    X, Y = np.array([image.center[:2] for image in opened.images]).T
    bounds = (float(X.min()), float(Y.min()), float(X.max()) + GSD, float(Y.max()) + GSD)
    start = time.process_time()
    plan = plan_mosaic(opened, resolution=GSD, tile=256, bounds=bounds)
    planned = time.process_time()
    shutil.rmtree(project.parent / "products", ignore_errors=True)
    (made,) = execute(plan, project.parent / "products", Run(quicklook=False))
    done = time.process_time()
    grid = plan.products[0].grid
    pixels = made.valid_share * grid.width * grid.height
    choices = sum(len(tile.sources) * tile.pixels for tile in plan.products[0].plan.tiles)
    return {"plan": planned - start, "execute": done - planned, "pixels": pixels, "choices": choices}


def report_growth(quick: bool) -> list[dict]:
    """A row for each number of images."""
    rows = []
    counts = (6, 20) if quick else (20, 100, 500)
    mosaic_once(write_block(WORK / "mosaics" / "first", 4))
    for images in counts:
        project = write_block(WORK / "mosaics" / str(images), images)
        cost = min((mosaic_once(project) for _ in range(5 if images < 100 else 1)), key=lambda each: each["execute"])
        rows.append({"images": images, **cost})
        per = {name: 1e9 * cost[name] / cost["pixels"] for name in ("plan", "execute")}
        print(
            f"  {images:4d} images, {cost['pixels'] / 1e6:5.1f} Mpx: {per['execute']:5.0f} ns a pixel, with planning "
            f"{per['execute'] + per['plan']:5.0f} ns; {cost['choices'] / cost['pixels']:.1f} images to choose from"
        )
    for name, unit in (("pixel", "pixels"), ("pixel and image to choose from", "choices")):
        first, last = ((r["execute"] / r[unit], (r["plan"] + r["execute"]) / r[unit]) for r in (rows[0], rows[-1]))
        print(
            f"  per {name}: {last[0] / first[0]:.2f} × (with planning {last[1] / first[1]:.2f} ×; asked: at most "
            f"{MOST_GROWTH})"
        )
    return rows


def report_visibility(quick: bool) -> dict[str, float]:
    """Whole processes: an image over hills with trees, then the same with 400 houses."""
    houses = importlib.import_module("tools.town").houses
    size = (800, 600) if quick else (4000, 3000)
    project = write_block(WORK / "mosaics" / "one", 1, size)
    text = project.read_text().replace(f"focal_px = {FOCAL}", f"focal_px = {10 * FOCAL}")
    project.write_text(text.replace(f"{GROUND + FOCAL * GSD}]", f"{GROUND + 10 * FOCAL * GSD / 2}]"))
    write_terrain(project.with_name("terrain.tif"), size[0] * GSD, size[1] * GSD, 600.0)
    town = houses(400, 1, 1200.0, lambda xy: GROUND + 8)
    shift = np.array([LEFT - 400, TOP - 700, 0])
    polygons = [shapely.Polygon(ring + shift) for house in town for (ring,) in house.polygons]
    names = np.array([f"face {k}" for k in range(len(polygons))], object)
    write_geopackage(project.with_name("town.gpkg"), [VectorLayer("town", "Polygon Z", polygons, {"name": names})], CRS)
    over = project.with_name("town.toml")
    over.write_text(project.read_text() + '\n[[objects]]\nfile = "town.gpkg"\nheight_system = "same"\n')
    kinds = {
        "ground": (project, "--hidden", "show"),
        "ground, visibility": (project, "--hidden", "nodata"),
        "objects": (over, "--true", "--hidden", "show"),
        "objects, visibility": (over, "--true", "--hidden", "nodata"),
    }
    out = WORK / "mosaics" / "products"
    common = [
        "--resolution",
        GSD / 2,
        "--workers",
        1,
        "--no-quicklook",
        "--no-overviews",
        "--overwrite",
        "--output",
        out,
    ]
    costs: dict[str, list[float]] = {name: [] for name in kinds}
    for _ in range(1 if quick else 3):
        for name, words in kinds.items():
            costs[name].append(measure(*photoplan("ortho", *words, *common, "--force"))["cpu"])
    cpu = {name: statistics.median(each) for name, each in costs.items()}
    print("  one image, CPU s: " + ", ".join(f"{name} {value:.2f}" for name, value in cpu.items()))
    for name in ("ground", "objects"):
        print(f"  {name}: with visibility {cpu[f'{name}, visibility'] / cpu[name]:.2f} × (asked: at most {MOST_COST})")
    print(f"  objects with visibility: {cpu['objects, visibility'] / cpu['ground']:.2f} × the ordinary orthophoto")
    return cpu


def report_mosaics(quick: bool) -> dict:
    """All rows, printed and as values."""
    print("\nMosaics: processor time per painted pixel")
    return {"growth": report_growth(quick), "visibility": report_visibility(quick)}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few and small images")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    options = parser.parse_args()
    found = report_mosaics(options.quick)
    if options.json:
        options.json.write_text(json.dumps(found, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
