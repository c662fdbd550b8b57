"""How fast a tile is resampled, beside `cv2.remap` with ready-made maps. One thread, 512 × 512 tiles.

Ours is everything that a tile needs once its source window is packed: relief, homogeneous anchors, positions to 1e-5
pixel, gather, validity, planar output. `cv2.remap` only gathers, at given positions that it rounds to 1/32 pixel.
CPU time of the thread, alternating pairs, medians. Run: `python bench/kernel_rate.py [--json]`.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from photoplan.kernels.positions import positions
from photoplan.kernels.raster import interleave
from photoplan.kernels.rectify import rectify_tile

SIDE = 512
CASES = (("uint8", 3), ("uint8", 1), ("uint16", 1), ("float32", 1), ("uint16", 3), ("float32", 3))


def scene(scale: float = 1.0) -> tuple[tuple[Any, ...], np.ndarray, int]:
    """Anchors of one cell seen by a slightly turned and tilted camera, rough relief, and the window's side."""
    c, s = scale * np.cos(0.03), scale * np.sin(0.03)
    window = int(1.1 * scale * SIDE) + 16
    matrix = np.array([[c, -s, 0.4, 20.3 * scale], [s, c, -0.3, 8.2 * scale], [1e-6, -1e-6, 1e-4, 1.0]])
    edges = [(u, v, h, 1.0) for h in (0.0, 5.0) for v in (-0.5, SIDE - 0.5) for u in (-0.5, SIDE - 0.5)]
    corners = (np.array(edges) @ matrix.T)[None]
    rects, start = np.array([[0, 0, SIDE, SIDE]], np.int32), np.array([0, 1], np.int32)
    relief = np.random.default_rng(0).uniform(0, 5, (SIDE, SIDE)).astype(np.float32)
    heights, frame, field = np.array([[0.0, 5.0]]), np.zeros(5), np.empty((0, 0, 2), np.float32)
    return (rects, start, heights, corners, frame, field), relief, window


def seconds(action: Callable[[], object]) -> float:
    begin = time.thread_time()
    action()
    return time.thread_time() - begin


def pairs(ours: Callable[[], object], theirs: Callable[[], object], repeats: int) -> tuple[float, float, float]:
    """Median Mpx/s of both and median of the pairs' ratios."""
    ours(), theirs()
    times = [(seconds(ours), seconds(theirs)) for _ in range(repeats)]
    mega = SIDE * SIDE / 1e6
    a, b = (mega / statistics.median(each) for each in zip(*times))
    return a, b, statistics.median(t / o for o, t in times)


def kernel_rates(repeats: int = 31) -> dict[str, Any]:
    """Rates in Mpx/s of output per core.

    Returns
    -------
    dict
        For each case like "uint8 x 3": ours, cv2_remap, ratio, pack (reading order to kernel order, source Mpx/s);
        "positions": positions alone; "uint8 x 3 at scale 2": averaging (no counterpart in cv2.remap).
    """
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    anchors, relief, window = scene()
    xy = positions(anchors, relief)
    map_x, map_y = np.ascontiguousarray(xy[..., 0]), np.ascontiguousarray(xy[..., 1])
    rates: dict[str, Any] = {}
    for dtype, bands in CASES:
        source = (np.random.default_rng(1).random((bands, window, window)) * 250).astype(dtype)
        image, packed = np.ascontiguousarray(source.transpose(1, 2, 0)), interleave(source)
        out, valid = np.empty((bands, SIDE, SIDE), dtype), np.empty((SIDE, SIDE), bool)

        def ours(packed: Any = packed, out: Any = out, valid: Any = valid) -> None:
            rectify_tile(anchors, relief, packed, None, None, "bicubic", out, valid)

        def theirs(image: Any = image) -> object:
            return cv2.remap(image, map_x, map_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT)

        a, b, ratio = pairs(ours, theirs, repeats)
        assert valid.all()
        packing = statistics.median(seconds(lambda source=source: interleave(source)) for _ in range(repeats))
        rates[f"{dtype} x {bands}"] = {
            "ours": round(a, 1),
            "cv2_remap": round(b, 1),
            "ratio": round(ratio, 2),
            "pack": round(window**2 / 1e6 / max(packing, 1e-6), 0) if bands > 1 else None,
        }
    alone = statistics.median(seconds(lambda: positions(anchors, relief)) for _ in range(repeats))
    rates["positions"] = {"ours": round(SIDE * SIDE / 1e6 / alone, 1)}
    anchors, relief, window = scene(2.0)
    packed = interleave((np.random.default_rng(1).random((3, window, window)) * 250).astype(np.uint8))
    out, valid = np.empty((3, SIDE, SIDE), np.uint8), np.empty((SIDE, SIDE), bool)
    rectify_tile(anchors, relief, packed, None, None, "bicubic", out, valid)
    coarse = seconds(lambda: rectify_tile(anchors, relief, packed, None, None, "bicubic", out, valid))
    rates["uint8 x 3 at scale 2"] = {"ours": round(SIDE * SIDE / 1e6 / coarse, 1)}
    cv2.setNumThreads(threads)
    return rates


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    rates = kernel_rates()
    if parser.parse_args().json:
        print(json.dumps(rates))
        return
    print(f"Mpx/s of output per core, cubic{'ours':>20}{'cv2.remap':>12}{'ratio':>8}{'pack':>8}")
    for case, rate in rates.items():
        cells = "".join(
            f"{rate.get(key) or '':>{width}}"
            for key, width in (("ours", 20), ("cv2_remap", 12), ("ratio", 8), ("pack", 8))
        )
        print(f"{case:<30}{cells}")


if __name__ == "__main__":
    main()
