"""List the kernels that commands compile: `src/photoplan/kernels/signatures.txt`, written anew by commands run cold.

    python bench/signatures.py

Commands run on the included block, each with an empty cache. Takes some minutes; run it after a kernel or its arguments
have changed. `tests/kernels/test_precompile.py` (slow) fails if the list lacks a kernel of `ortho`.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from importlib.resources import files
from pathlib import Path

import numpy as np
import rasterio

BLOCK = Path(str(files("photoplan"))) / "demo_block"
LIST = Path(str(files("photoplan"))) / "kernels" / "signatures.txt"
HEAD = """\
# Kernels that commands compile: seconds | commands | kernel | types of its arguments. Written by bench/signatures.py.
# PIXEL, LANES and TAPS stand for the type of the image's pixels, 1 or 4 bands side by side, and taps of the kernel.
"""
#: Kernels of the pixels of images, by the number of axes from which on bytes are pixels and not a mask.
PIXELS = {
    "resample.gather_runs": 3,
    "resample.border_runs": 3,
    "resample.average_runs": 3,
    "footprint.average_along_runs": 3,
    "raster._interleave_bands": 3,
    "raster.fill_block": 0,
}
RECORD = """
import json, sys, time
from photoplan.cli import main
main.start()
from numba.core import event
from photoplan.kernels import precompile

class Listener(event.Listener):
    running = []
    def on_start(self, event):
        self.running.append((event.data["dispatcher"].py_func, time.thread_time()))
    def on_end(self, event):
        function, began = self.running.pop()
        if not self.running and function.__module__.startswith("photoplan.kernels."):
            kernel = function.__module__.removeprefix("photoplan.kernels.") + "." + function.__name__
            types = ", ".join(precompile.text_of(each) for each in event.data["args"])
            print(json.dumps([kernel, types, time.thread_time() - began]), file=out)

precompile.signatures = lambda: ()
with open(sys.argv[1], "w") as out:
    event.register("numba:compile", Listener())
    code = main.run(sys.argv[2:])
sys.exit(code)
"""


def commands(folder: Path) -> list[tuple[str, list[object]]]:
    """Commands and their words; those with one name add up."""
    project, some = folder / "project.toml", ("--images", "DJI_001*")
    return [
        ("check", ["check", project]),
        *(("ortho", ["ortho", project, *some, "--resolution", r, "--overwrite"]) for r in (0.1, 0.04)),
        *(("mosaic", ["mosaic", project, *some, "--resolution", r, "--overwrite"]) for r in (0.1, 0.04)),
        ("surface", ["surface", project, "--resolution", 0.3, "--bounds", 576708, 5188146, 576722, 5188158]),
        ("view", ["view", project, "--camera", "DJI_0027", "-o", folder / "image.png"]),
        ("view", ["view", project, "--from", 576715, 5188140, "--altitude", 330, "--look-at", 576715, 5188170, "-o",
                  folder / "view.png"]),
        ("terrain build", ["terrain", "build", folder / "points.csv", "--crs", "EPSG:32615", "-o", folder / "m.gpkg"]),
        ("terrain contours", ["terrain", "contours", folder / "m.gpkg", "--interval", 0.5, "-o", folder / "c.gpkg"]),
        ("terrain shade", ["terrain", "shade", folder / "m.gpkg", "-o", folder / "shade.tif"]),
        ("tie", ["tie", project]),
        ("adjust", ["adjust", project, "--datum", "orientations"]),
    ]  # fmt: skip


def make_inputs(folder: Path) -> None:
    """The project, and points of its terrain as a table."""
    words = ["--images", BLOCK / "images" / "*.jpg", "--camera", BLOCK / "int.yaml", "--orientation", BLOCK / "ext.csv"]
    words += ["--terrain", BLOCK / "dsm.tif", "--height-system", "same", "-q"]
    subprocess.run([sys.executable, "-m", "photoplan", "init", str(folder), *map(str, words)], check=True)
    with rasterio.open(BLOCK / "dsm.tif") as file:
        heights, placement = file.read(1), file.transform
    rows, columns = (np.random.default_rng(0).integers(0, n, 3000) for n in heights.shape)
    lines = ["x,y,z"]
    for row, column in zip(rows, columns):
        if heights[row, column] > -1000:
            x, y = placement.c + placement.a * (column + 0.5), placement.f + placement.e * (row + 0.5)
            lines.append(f"{x:.3f},{y:.3f},{heights[row, column]:.3f}")
    (folder / "points.csv").write_text("\n".join(lines))


def general(kernel: str, types: str) -> str:
    """Types with placeholders for those of the image."""
    if kernel not in PIXELS:
        return types
    axes = PIXELS[kernel]
    pixels = r"\buint8\b(?!\[)" if not axes else ""
    types = re.sub(r"\buint8\[([^\]]*)\]", lambda m: m[0] if m[1].count(",") + 1 < axes else f"PIXEL[{m[1]}]", types)
    types = re.sub(pixels, "PIXEL", types) if pixels else types
    tags = "Tuple((UniTuple(int64, TAPS), UniTuple(int64, LANES)))"
    types = types.replace("UniTuple(UniTuple(int64, 4), 2)", tags)
    return types.replace("UniTuple(int64, 4)", "UniTuple(int64, LANES)")


def main() -> None:
    """Run all commands and write the list."""
    found: dict[tuple[str, str], tuple[float, list[str]]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_inputs(folder)
        for command, words in commands(folder):
            cache = folder / "cache"
            shutil.rmtree(cache, ignore_errors=True)
            call = [sys.executable, "-c", RECORD, folder / "list", *words, "-q"]
            done = subprocess.run([str(word) for word in call], env={**os.environ, "NUMBA_CACHE_DIR": str(cache)})
            if done.returncode:
                sys.exit(f"{command} ended with {done.returncode}")
            rows = [json.loads(line) for line in (folder / "list").read_text().splitlines()]
            print(f"{command}: {len(rows)} kernels, {sum(row[2] for row in rows):.1f} CPU s")
            for kernel, types, seconds in rows:
                before, names = found.get((kernel, general(kernel, types)), (seconds, []))
                found[kernel, general(kernel, types)] = min(before, seconds), [*names, *{command}.difference(names)]
    lines = [f"{s:.1f} | {', '.join(names)} | {kernel} | {types}" for (kernel, types), (s, names) in found.items()]
    order = sorted(lines, key=lambda line: (line.split("|")[2], line.split("|")[3]))
    LIST.write_text(HEAD + "\n".join(order) + "\n", "utf-8")


if __name__ == "__main__":
    main()
