"""Four oblique drone images over a rough surface model, by photoplan and orthority: cells, CPU seconds.

    python bench/oblique.py [--repeat N]

The scene is made here: a surface model of 0.5 m posts with buildings, shrubs and crowns of trees, and images of 1.2 Mpx
(and one of 26 Mpx) that look 40 to 45° beside the nadir through a lens with distortion. Their grey values are noise, as
they do not matter. Uncompressed, no overviews, one thread, whole processes.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from prepare import WORK
from programs import ORTHORITY, Missing, install_orthority
from rasterio.transform import from_origin

from photoplan.products.init import InitRequest, init_project

HERE = Path(__file__).resolve().parent
CRS = "EPSG:32632"
CORNER, POST = (500_000.0, 5_400_600.0), 0.5
LENS = {"k1": -0.11, "k2": 0.03, "p1": 0.0007, "p2": -0.0004, "k3": 0.0}


@dataclass(frozen=True)
class Block:
    """Images of one size."""

    name: str
    size: tuple[int, int]
    count: int
    side: float
    """Of the surface model, metres; flown in proportion to it."""
    resolutions: dict[float, float]
    """Ground pixel of the products, metres: most CPU seconds of ours, as a part of orthority's."""

    @property
    def folder(self) -> Path:
        return WORK / "oblique" / self.name

    @property
    def project(self) -> Path:
        return self.folder / "project" / "project.toml"

    @property
    def images(self) -> list[Path]:
        return [self.folder / f"img{k}.tif" for k in range(self.count)]


BLOCKS = (
    Block("1.2 Mpx", (1280, 960), 4, 600.0, {0.25: 1.0, 0.1: 0.7}),
    Block("26 Mpx", (6240, 4160), 1, 1500.0, {0.1: 0.7}),
)


def surface(side: float, seed: int = 3) -> np.ndarray:
    """Heights of the posts: hills, shrubs, buildings with flat roofs, crowns of trees."""
    rng = np.random.default_rng(seed)
    n = int(side / POST)
    y, x = np.mgrid[:n, :n] * POST
    heights = 250 + 6 * np.sin(x / 70) * np.cos(y / 90) + rng.normal(0, 0.05, (n, n))
    shrubs = np.sin(x / 23 + 2 * np.sin(y / 41)) > 0
    heights += np.where(shrubs, rng.uniform(0, 4, (n, n)), 0)
    trees = int(800 * (side / 600.0) ** 2)
    for _ in range(trees // 20):
        col, row, width, depth = *rng.integers(0, n - 60, 2), *rng.integers(16, 60, 2)
        heights[row : row + depth, col : col + width] = heights[row, col] + rng.uniform(4, 18)
    for cx, cy, radius in zip(*rng.uniform(0, side, (2, trees)), rng.uniform(1.5, 5, trees)):
        part = np.s_[
            max(0, int((cy - radius) / POST)) : int((cy + radius) / POST) + 1,
            max(0, int((cx - radius) / POST)) : int((cx + radius) / POST) + 1,
        ]
        crown = 1.0 - ((x[part] - cx) ** 2 + (y[part] - cy) ** 2) / radius**2
        heights[part] += np.where(crown > 0, 2.0 * radius * np.sqrt(np.maximum(crown, 0)), 0.0)
    return heights.astype(np.float32)


def prepare(block: Block) -> None:
    """Write the block, once; its project each time, as the form may have changed."""
    block.folder.mkdir(parents=True, exist_ok=True)
    terrain = block.folder / "dsm.tif"
    if not terrain.exists():
        write(terrain, surface(block.side)[None], crs=CRS, transform=from_origin(*CORNER, POST, POST))
    width, height = block.size
    lines = ["filename,x,y,z,omega,phi,kappa"]
    far = block.side / 600.0
    looks = ((0.0, -95.0, 42.0, 0.0), (-90.0, 10.0, 3.0, -43.0), (5.0, 90.0, -40.0, 2.0), (100.0, 0.0, -2.0, 45.0))
    for image, (dx, dy, omega, phi), kappa in zip(block.images, looks, (0, 95, 175, -88)):
        X, Y = CORNER[0] + block.side / 2 + dx * far, CORNER[1] - block.side / 2 + dy * far
        lines.append(f"{image.stem},{X},{Y},{250 + 120 * far},{omega},{phi},{kappa}")
        if not image.exists():
            write(image, np.random.default_rng(len(lines)).integers(0, 255, (3, height, width), dtype=np.uint8))
    (block.folder / "ext.csv").write_text("\n".join(lines) + "\n")
    (block.folder / "ext.prj").write_text(CRS)
    sensor = f"im_size: [{width}, {height}], focal_len: 28.0, sensor_size: [36.0, {36.0 * height / width}]"
    terms = ", ".join(f"{name}: {value}" for name, value in LENS.items())
    (block.folder / "int.yaml").write_text(f"cam: {{type: brown, {sensor}, cx: 0.001, cy: -0.002, {terms}}}\n")
    init_project(
        InitRequest(
            folder=block.project.parent,
            images=tuple(map(str, block.images)),
            camera=block.folder / "int.yaml",
            orientation=block.folder / "ext.csv",
            terrain=str(terrain),
            height_system="same",
            overwrite=True,
        )
    )


def write(path: Path, bands: np.ndarray, **tags: object) -> None:
    count, height, width = bands.shape
    form = {"tiled": True, "blockxsize": 512, "blockysize": 512, "interleave": "pixel"}
    with rasterio.open(
        path, "w", driver="GTiff", width=width, height=height, count=count, dtype=bands.dtype, **form, **tags
    ) as data:
        data.write(bands)


def ours(block: Block, resolution: float, folder: Path) -> list[object]:
    call = [Path(sys.executable).with_name("photoplan"), "ortho", block.project, "--resolution", resolution]
    call += ["--kernel", "bicubic", "--compress", "none", "--no-overviews", "--no-quicklook", "--workers", 1]
    return [*call, "--output", folder, "--json"]


def theirs(block: Block, resolution: float, folder: Path) -> list[object]:
    call = [ORTHORITY / "bin" / "oty", "frame", "-r", resolution, "-ip", block.folder / "int.yaml"]
    call += ["-ep", block.folder / "ext.csv", "-d", block.folder / "dsm.tif", "-c", block.folder / "ext.prj"]
    call += ["-i", "cubic", "-di", "bilinear", "-nbo", "-nwm", "-co", "TILED=YES"]
    return [*call, "--out-dir", folder, *block.images]


def measure(call: list[object], folder: Path) -> dict:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    command = [sys.executable, HERE / "measure.py", *map(str, call)]
    cost = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    if cost["code"] != 0:
        raise RuntimeError(f"{call[0]} ended with code {cost['code']}: {cost['stderr']}")
    return cost


def megapixels(folder: Path) -> float:
    total = 0
    for path in folder.glob("*.tif"):
        with rasterio.open(path) as data:
            total += data.width * data.height
    return total / 1e6


def cells(folder: Path) -> tuple[int, int]:
    """Boxes of anchors, and tiles, of all products."""
    records = [json.loads(path.read_text())["product"] for path in folder.glob("*.run.json")]
    return sum(r["cells"] for r in records), sum(r["tiles"] for r in records)


def report_oblique(repeat: int) -> list[dict]:
    """Rows of the table; orthority's are left out where it is not there."""
    programs = {"photoplan": ours}
    try:
        install_orthority()
        programs["orthority -di bilinear"] = theirs
    except Missing as reason:
        print(f"left out: {reason}")
    print("\nOblique drone images over a rough surface model, cubic, three bands")
    rows = []
    for block in BLOCKS:
        prepare(block)
        for resolution, target in block.resolutions.items():
            folders = {name: block.folder / "products" / name.split()[0] for name in programs}
            measure(ours(block, resolution, folders["photoplan"]), folders["photoplan"])
            costs: dict[str, list[float]] = {name: [] for name in programs}
            for _ in range(repeat):
                for name, call in programs.items():
                    costs[name].append(measure(call(block, resolution, folders[name]), folders[name])["cpu"])
            cpu = {name: statistics.median(each) for name, each in costs.items()}
            size = {name: megapixels(folders[name]) for name in programs}
            row = {"block": block.name, "resolution": resolution, "cpu": cpu, "megapixels": size}
            row["cells"], row["tiles"] = cells(folders["photoplan"])
            rows.append(row)
            print(
                f"  {block.count} × {block.name} at {resolution:g} m: {row['cells']} cells in {row['tiles']} tiles",
                end="",
            )
            print("".join(f"; {name} {c:.2f} CPU s ({size[name]:.1f} Mpx)" for name, c in cpu.items()), end="")
            share = cpu["photoplan"] / cpu.get("orthority -di bilinear", float("nan"))
            print(
                f"; ours / theirs {share:.2f}, to reach ≤ {target:g}: {'reached' if share <= target else 'NOT REACHED'}"
            )
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeat", type=int, default=3, metavar="N", help="runs of each program [3]")
    report_oblique(parser.parse_args().repeat)
