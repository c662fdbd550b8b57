"""Mosaics beside OTB: four aerial frames, from their orthophotos by OTB's Mosaic, from the images by photoplan.

    python bench/otb.py [--quick] [--json FILE]

OTB gets orthophotos that photoplan has made, finds one gain for each image and band, and feathers over four pixels.
Ours balances, finds seams by content and feathers over the same width; the orthophotos are a part of it. Whole
processes, one run, as many threads as each takes. How much images differ in overlaps is measured on pixels of 20 m.
"""

from __future__ import annotations

import argparse
import importlib
import json
import re
import shlex
import shutil
import sys
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from orientation import measure, photoplan
from prepare import CHECKOUT, DATA, WORK

from photoplan.geometry.grid import MapGrid

sys.path.insert(0, str(CHECKOUT / "tests"))

#: Ground pixels of the mosaic; of the comparison of overlaps, metres; width of the feather, pixels.
RESOLUTIONS, COARSE, FEATHER = (5.0, 2.0), 20.0, 4
MIB = 2**20


def overlaps(files: list[Path], gains: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean over the pairs of images of their rms differences, (bands,); `gains` (images, bands) are applied."""
    found = []
    for path, gain in zip(files, gains):
        with rasterio.open(path) as file:
            step = round(COARSE / file.res[0])
            grid = MapGrid.covering(tuple(file.bounds), COARSE, str(file.crs))
            values = np.full((file.count, grid.height * step, grid.width * step), np.nan)
            top, left = (round(v / file.res[0]) for v in (grid.top - file.bounds.top, file.bounds.left - grid.left))
            seen = np.where(file.dataset_mask() > 0, file.read().astype(float) * gain[:, None, None], np.nan)
            values[:, top : top + file.height, left : left + file.width] = np.minimum(seen, 255)
            small = values.reshape(file.count, grid.height, step, grid.width, step).mean(axis=(2, 4))
            found.append((round(-grid.top / COARSE), round(grid.left / COARSE), small))
    top, left = (min(each[k] for each in found) for k in (0, 1))
    bottom, right = (max(each[k] + each[2].shape[k + 1] for each in found) for k in (0, 1))
    whole = np.full((len(found), 3, bottom - top, right - left), np.nan)
    for k, (row, col, values) in enumerate(found):
        whole[k, :, row - top :, col - left :][:, : values.shape[1], : values.shape[2]] = values
    pairs = [np.nanmean((whole[i] - whole[j]) ** 2, axis=(1, 2)) for i in range(len(whole)) for j in range(i)]
    return np.sqrt(pairs).mean(axis=0)


def orthophotos(project: Path, resolution: float, out: Path) -> tuple[dict, list[Path]]:
    """What they cost, and their files."""
    words = ["--resolution", resolution, "--hidden", "nodata", "--no-quicklook", "--no-overviews", "--compress", "none"]
    cost = measure(*photoplan("ortho", project, *words, "--overwrite", "-q", "--output", out))
    return cost, sorted(out.glob("*_ortho.tif"))


def theirs(script: str, files: list[Path], resolution: float, folder: Path) -> tuple[dict, NDArray[np.float64]]:
    """What OTB's mosaic costs, and its gains (images, bands)."""
    words = [script, "-il", *files, "-comp.feather", "slim", "-comp.feather.slim.length", FEATHER * resolution]
    words += ["-harmo.method", "band", "-nodata", 0, "-tmpdir", folder, "-out", folder / "otb.tif", "uint8"]
    log = folder / "otb.log"
    cost = measure("sh", "-c", f"{shlex.join(map(str, words))} > {shlex.quote(str(log))} 2>&1")
    lines = re.findall(r"Gains\s*:([ 0-9.e+-]+)", log.read_text())
    return cost, np.array([line.split() for line in lines], float).T


def ours(project: Path, resolution: float, folder: Path) -> dict[str, dict]:
    """What each of the commands costs."""
    width = FEATHER * resolution
    seams = folder / "seams.gpkg"
    mosaic = ["--resolution", resolution, "--seams", seams, "--feather", width, "--compress", "none", "--no-overviews"]
    return {
        "balance": measure(*photoplan("balance", project, "--no-picture", "-q")),
        "seams": measure(*photoplan("seams", project, "--no-picture", "-q", "-o", seams)),
        "mosaic": measure(*photoplan("mosaic", project, *mosaic, "--no-quicklook", "-q", "--output", folder)),
    }


def report_otb(quick: bool) -> list[dict]:
    """All rows, printed and as values; none, with the reason, where OTB or the frames are absent."""
    print("\nMosaics beside OTB: four DMC frames, balanced and feathered over four pixels, one run")
    script = shutil.which("otbcli_Mosaic")
    if script is None or not DATA.is_dir():
        print("  left out: " + ("the folder `shared` is not beside the checkout" if script else
              "otbcli_Mosaic is not found; on Debian it is in the package otb-bin"))  # fmt: skip
        return []
    dmc_project = importlib.import_module("tools.real_projects").dmc_project
    rows = []
    for resolution in RESOLUTIONS[: 1 if quick else None]:
        folder = WORK / "otb" / f"{resolution:g}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        project = dmc_project(CHECKOUT.parent / "shared", folder)
        ortho, files = orthophotos(project, resolution, folder / "raw")
        raw = overlaps(files, np.ones((len(files), 3)))
        cost, gains = theirs(script, files, resolution, folder)
        mine = ours(project, resolution, folder)
        even = overlaps(orthophotos(project, resolution, folder / "even")[1], np.ones((len(files), 3)))
        rms = {"raw": raw, "otb": overlaps(files, gains), "photoplan": even}
        whole = {what: sum(each[what] for each in mine.values()) for what in ("cpu", "wall")}
        whole["memory"] = max(each["memory"] for each in mine.values())
        told = {name: ", ".join(f"{v:.1f}" for v in each) for name, each in rms.items()}
        rows.append({"resolution": resolution, "ortho": ortho, "otb": cost, **mine, "rms": told})
        print(f"  {resolution:g} m, overlaps before: {told['raw']} grey values")
        for name, each in (("otb", cost), ("photoplan", whole)):
            spent = f"{each['cpu']:6.1f} CPU s, {each['wall']:6.1f} s, {each['memory'] / MIB:5.0f} MiB"
            print(f"    {name:9} {spent}, overlaps {told[name]}")
        parts = ", ".join(f"{name} {each['cpu']:.1f}" for name, each in mine.items())
        print(f"    of ours: {parts} CPU s; the orthophotos that OTB begins with: {ortho['cpu']:.1f} CPU s")
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="the coarse mosaic alone")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    options = parser.parse_args()
    found = report_otb(options.quick)
    if options.json:
        options.json.write_text(json.dumps(found, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
