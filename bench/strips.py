"""How fast a strip of a turbulent flight is rectified: 100 Mpx, planning of tiles and kernels, CPU time of one core.

    python bench/strips.py [--quick]

A line of 10,000 detectors, 50 Hz of 3 pixels in roll and two events of 40 pixels; hills of 20 m, bicubic, pixels of the
size of the image's. Rows of tiles follow each other as in a run, so that they share what a run would share.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from tools.shaken_strip import ShakenStrip

from photoplan.cameras.pushbroom import LineCamera
from photoplan.geometry.grid import MapGrid, Window
from photoplan.io.camera.line import read_line
from photoplan.kernels.raster import interleave
from photoplan.kernels.rectify import rectify_tile
from photoplan.plan.anchors import AnchorRule, compile_anchors
from photoplan.plan.ground import TileGround
from photoplan.targets.map import MapTarget

SIDE, HEIGHT = 10_000, 100.0
#: Millions of pixels a second that are asked for.
TARGET = 5.0
RULE = AnchorRule.of("bicubic", 0.02)


def strip_camera() -> LineCamera:
    """The nadir line of the strip."""
    strip = ShakenStrip(columns=SIDE, lines=SIDE)
    with tempfile.TemporaryDirectory() as folder:
        return read_line(strip.strip_file(Path(folder)), "nadir").camera(strip.crs, "ellipsoidal")


def rectified(camera: LineCamera, target: MapTarget, window: Window) -> tuple[float, float, int]:
    """CPU seconds of the plan and of the kernels of a tile, and its pixels that show something."""
    v, u = np.mgrid[: window.height, : window.width].astype(float)
    relief = HEIGHT + 20 * np.sin((u + window.col) / 300) * np.cos((v + window.row) / 200)
    relief = relief.astype(np.float32)
    begin = time.process_time()
    anchors = compile_anchors(camera, TileGround.of(target, window, relief), RULE)
    planned = time.process_time() - begin
    if anchors is None:
        return planned, 0.0, 0
    part = anchors.source_window
    pixels = np.random.default_rng(0).integers(0, 255, (1, part.height, part.width), np.uint8)
    edges = (-0.5 - part.col, -0.5 - part.row, SIDE - 0.5 - part.col, SIDE - 0.5 - part.row)
    out, valid = np.zeros((1, *relief.shape), np.uint8), np.zeros(relief.shape, bool)
    begin = time.process_time()
    rectify_tile(anchors.arrays, relief, interleave(pixels), None, edges, "bicubic", out, valid)
    return planned, time.process_time() - begin, int(valid.sum())


def report_strips(quick: bool) -> dict:
    """All rows, printed and as values."""
    print("\nStrip of a turbulent flight, 100 Mpx, plan and kernels, one core")
    camera, rows = strip_camera(), {}
    corners = camera.rays(np.array([(0, 0), (SIDE, SIDE), (0, SIDE), (SIDE, 0)]) - 0.5, HEIGHT)[0]
    low, high = corners[:, :2].min(axis=0), corners[:, :2].max(axis=0)
    pixel = float(np.sqrt(np.prod(high - low))) / SIDE
    size = np.ceil((high - low) / pixel).astype(int).tolist()
    grid = MapGrid(low[0], high[1], pixel, *size, camera.ground.crs)
    target = MapTarget(grid)
    for side in (512, 1024):
        tops, lefts = (range(0, n - side + 1, side) for n in (grid.height, grid.width))
        tops = tops[len(tops) // 2 :][: 2 if quick else None]
        # The first tile compiles kernels; it is not counted.
        rectified(camera, target, Window(lefts[0], tops[0], side, side))
        cost = [rectified(camera, target, Window(left, top, side, side)) for top in tops for left in lefts]
        plan, kernels, pixels = (sum(each) for each in zip(*cost))
        rate = pixels / 1e6 / (plan + kernels)
        rows[side] = {"plan_ns": plan / pixels * 1e9, "kernels_ns": kernels / pixels * 1e9, "rate": rate}
        print(
            f"  tiles of {side:4}: {pixels / 1e6:5.1f} Mpx, plan {plan / pixels * 1e9:4.0f}, kernels "
            f"{kernels / pixels * 1e9:4.0f} ns a pixel: {rate:.2f} Mpx/s; to reach {TARGET:g}: "
            f"{'reached' if rate >= TARGET else 'NOT REACHED'}"
        )
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two rows of tiles instead of half the strip")
    report_strips(parser.parse_args().quick)
    return 0


if __name__ == "__main__":
    sys.exit(main())
