"""An orthophoto of 55 Mpx from rational polynomials: photoplan beside orthority and gdalwarp, whole processes.

    python bench/satellite.py [--repeat N]

A QuickBird crop, enlarged six times, over a real terrain raster; cubic, one band, uncompressed, no overviews, one
thread where a program lets itself be told. All take the edges of orthority's product, which cannot be told its own.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from prepare import DATA, WORK
from programs import Missing, install_orthority

HERE = Path(__file__).resolve().parent
FOLDER = WORK / "satellite"
FACTOR, RESOLUTION = 6, 1.0
CRS = "+proj=tmerc +lat_0=0 +lon_0=25 +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +type=crs"
#: Least ratio of CPU seconds, theirs / ours; most memory of ours, MiB.
TARGETS = {"orthority": 5.0, "gdalwarp exact": 5.0, "gdalwarp -et 0.125": 1.0}
MEMORY, MIB = 400, 2**20
_TILED = ["-co", "TILED=YES", "-co", "BLOCKXSIZE=512", "-co", "BLOCKYSIZE=512"]

Commands = dict[str, Callable[[Path, list[float]], tuple[list[object], str]]]
"""By name: from a folder and edges to a command and the name of its product."""


def prepare_image(data: Path) -> tuple[Path, Path]:
    """The enlarged image with its polynomials, and the terrain on a plain map: heights are taken as they are."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    image, terrain = FOLDER / "qb2.tif", FOLDER / "dem.tif"
    with rasterio.open(data / "rpc_qb2" / "qb2_basic1b.tif") as file:
        pixels, rpc = file.read(1), file.rpcs
    large = cv2.resize(pixels, None, fx=FACTOR, fy=FACTOR, interpolation=cv2.INTER_CUBIC)
    for axis in ("line", "samp"):
        setattr(rpc, f"{axis}_off", (getattr(rpc, f"{axis}_off") + 0.5) * FACTOR - 0.5)
        setattr(rpc, f"{axis}_scale", getattr(rpc, f"{axis}_scale") * FACTOR)
    form = {"driver": "GTiff", "count": 1, "tiled": True, "blockxsize": 512, "blockysize": 512}
    size = {"width": large.shape[1], "height": large.shape[0]}
    with rasterio.open(image, "w", dtype="uint8", rpcs=rpc, **form, **size) as file:
        file.write(large, 1)
    with rasterio.open(data / "dem.tif") as file:
        about = {"width": file.width, "height": file.height, "transform": file.transform, "nodata": np.nan}
        with rasterio.open(terrain, "w", dtype="float32", crs=CRS, **form, **about) as out:
            out.write(file.read(1), 1)
    return image, terrain


def commands(image: Path, terrain: Path) -> Commands:
    """Of all programs that are there; others are named."""
    project = FOLDER / "project.toml"
    ground = f'[terrain]\nfile = "{terrain}"\nheight_system = "ellipsoidal"\n'
    project.write_text(
        f'format = 1\ncrs = "{CRS}"\n{ground}[[images]]\nname = "qb2"\nfile = "{image}"\nrpc = "{image}"\n'
    )

    def ours(folder: Path, edges: list[float]) -> tuple[list[object], str]:
        call = [sys.executable, "-m", "photoplan.cli.main", "ortho", project, "--resolution", RESOLUTION]
        call += ["--kernel", "bicubic", "--compress", "none", "--no-overviews", "--no-quicklook", "--workers", 1]
        return [*call, "--output", folder, *(["--bounds", *edges] if edges else []), "-q"], "qb2_ortho.tif"

    def orthority(folder: Path, edges: list[float]) -> tuple[list[object], str]:
        call = [script, "rpc", "-r", RESOLUTION, "-ap", "-d", terrain, "-c", CRS, "-i", "cubic", "-di", "bilinear"]
        return [*call, "-nbo", "-nwm", *_TILED, "--out-dir", folder, image], "qb2_ORTHO.tif"

    def gdal(threshold: float) -> Callable[[Path, list[float]], tuple[list[object], str]]:
        def call(folder: Path, edges: list[float]) -> tuple[list[object], str]:
            words = ["gdalwarp", "-q", "-rpc", "-to", f"RPC_DEM={terrain}", "-to", "RPC_DEM_APPLY_VDATUM_SHIFT=NO"]
            words += ["-to", "RPC_DEMINTERPOLATION=bilinear", "-et", threshold, "-r", "cubic", "-dstnodata", 0]
            words += ["-t_srs", CRS, "-te", *edges, "-tr", RESOLUTION, RESOLUTION, *_TILED]
            return [*words, image, folder / "warped.tif"], "warped.tif"

        return call

    found: Commands = {}
    try:
        script = install_orthority()
        found["orthority"] = orthority
    except Missing as reason:
        print(f"  left out: {reason}")
    found["photoplan"] = ours
    if shutil.which("gdalwarp"):
        found |= {"gdalwarp -et 0.125": gdal(0.125), "gdalwarp exact": gdal(0.0)}
    else:
        print("  left out: gdalwarp is not found; on Debian it is in the package gdal-bin")
    return found


def measured(name: str, command: Callable, edges: list[float]) -> tuple[dict, Path]:
    """What a run into an empty folder costs, and its product."""
    folder = FOLDER / name.replace(" ", "_")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    words, product = command(folder, edges)
    call = [sys.executable, str(HERE / "measure.py"), *map(str, words)]
    cost = json.loads(subprocess.run(call, check=True, capture_output=True, text=True).stdout)
    if cost["code"] != 0:
        raise SystemExit(f"{name} ended with code {cost['code']}: {cost['stderr']}")
    return cost, folder / product


def values(path: Path, edges: list[float]) -> NDArray[np.int16]:
    """Pixels within edges; −1 where there are none."""
    with rasterio.open(path) as file:
        window = rasterio.windows.from_bounds(*edges, transform=file.transform).round_offsets().round_lengths()
        read = {"window": window, "boundless": True}
        return np.where(file.dataset_mask(**read) > 0, file.read(1, **read), -1).astype(np.int16)


def report_satellite(repeat: int) -> dict:
    """All rows, printed and as values; none, with the reason, where the data are absent."""
    print("\nOrthophoto from rational polynomials, whole processes")
    if not DATA.is_dir():
        print("  left out: the folder `shared` is not beside the checkout")
        return {}
    programs = commands(*prepare_image(DATA))
    # The first run of ours after a change compiles its kernels; it is not counted.
    edges = list(rasterio.open(measured("photoplan", programs["photoplan"], [])[1]).bounds)
    costs: dict[str, list[dict]] = {name: [] for name in programs}
    products: dict[str, Path] = {}
    for turn in range(repeat):
        for name, command in programs.items():
            if turn and name == "gdalwarp exact":
                continue
            cost, products[name] = measured(name, command, edges)
            costs[name].append(cost)
            if name == "orthority" and not turn:
                edges = list(rasterio.open(products[name]).bounds)
    ours = statistics.median(each["cpu"] for each in costs["photoplan"])
    mine, rows = values(products["photoplan"], edges), {}
    print(f"  {mine.shape[1]} × {mine.shape[0]} at {RESOLUTION:g} m ({mine.size / 1e6:.0f} Mpx)")
    for name, runs in costs.items():
        cpu, wall, memory = (statistics.median(run[key] for run in runs) for key in ("cpu", "wall", "memory"))
        rows[name] = {"cpu": cpu, "wall": wall, "memory": memory, "runs": len(runs)}
        told = f"  {name:20}{len(runs):3} runs {cpu:8.2f} CPU s {wall:8.2f} s {memory / MIB:6.0f} MiB"
        if name == "photoplan":
            print(f"{told}; to reach ≤ {MEMORY} MiB: {'reached' if memory / MIB <= MEMORY else 'NOT REACHED'}")
            continue
        other = values(products[name], edges)
        both = (mine >= 0) & (other >= 0)
        near = float((np.abs(mine[both] - other[both]) <= 2).mean())
        rows[name] |= {
            "ratio": cpu / ours,
            "within": near,
            "common": float(both.sum() / ((mine >= 0) | (other >= 0)).sum()),
        }
        reached = "reached" if cpu / ours >= TARGETS[name] else "NOT REACHED"
        print(f"{told}, {cpu / ours:.2f} times ours; to reach {TARGETS[name]:g}: {reached}; {near:.2%} within 2 levels")
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=3, metavar="N", help="runs of each program [3]")
    report_satellite(parser.parse_args().repeat)
    return 0


if __name__ == "__main__":
    sys.exit(main())
