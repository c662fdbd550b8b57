"""How fast an image is filtered, beside `cv2.filter2D`. One thread, 11 × 11 weights, 8 bit in and out.

    python bench/filter.py [--json FILE]

Ours is everything that `photoplan restore` does with pixels in memory: tiles of 512 × 512 with their margins, borders
that continue ramps, conversion, convolution, rounding, counting what is clipped. CPU time of the thread, alternating
pairs, medians.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from photoplan.geometry.grid import Window
from photoplan.quality.restoration.restorer import FilterKernel, RestorationFilter, Restorer

SIDE, TILE = 2048, 512
#: Our rate by that of `cv2.filter2D`, at least, for 8 bit.
TARGET = 1.0
#: Quarters from the middle of the filters printed by Kölbl (2006): figs. 4 (ADS40) and 6 (DMC).
ADS40 = (
    (3.011, -0.298, 0.017, 0.030, -0.030, -0.006),
    (-0.298, -0.169, 0.020, 0.020, -0.027, -0.006),
    (0.017, 0.020, 0.028, -0.007, -0.019, -0.004),
    (0.030, 0.020, -0.007, -0.024, -0.006, -0.001),
    (-0.030, -0.027, -0.019, -0.006, -0.002, 0.000),
    (-0.006, -0.006, -0.004, -0.001, 0.000, 0.000),
)
DMC = (
    (5.105, -0.597, -0.090, 0.064, -0.005, -0.004),
    (-0.597, -0.389, -0.053, 0.053, -0.005, -0.004),
    (-0.090, -0.053, 0.037, 0.022, -0.004, -0.002),
    (0.064, 0.053, 0.022, -0.004, -0.004, -0.001),
    (-0.005, -0.005, -0.004, -0.004, -0.001, 0.000),
    (-0.004, -0.004, -0.002, -0.001, 0.000, 0.000),
)


def whole(quarter: tuple[tuple[float, ...], ...]) -> np.ndarray:
    """A symmetric filter from its quarter."""
    return np.array(quarter)[np.ix_(*[np.abs(np.arange(-5, 6))] * 2)]


def general() -> np.ndarray:
    """A filter without any symmetry."""
    values = np.random.default_rng(0).normal(size=(11, 11)) * 0.03
    values[5, 5] += 2.0 - values.sum()
    return values


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


def filtered(restorer: Restorer, image: np.ndarray, out: np.ndarray) -> None:
    """A whole image by tiles."""
    size = restorer.size
    for window in Window(0, 0, *size).tiles(TILE):
        gaps = not restorer.margin.fits(window, size)
        at = restorer.margin.around(window, size, gaps)
        part = image[:, at.row : at.stop[1], at.col : at.stop[0]]
        made = restorer.restore(window, part, at, None).values
        out[:, window.row : window.stop[1], window.col : window.stop[0]] = made


def filter_rates(repeats: int = 15) -> list[dict]:
    """Rates in Mpx/s per core, for each filter and type."""
    import cv2  # noqa: PLC0415

    cv2.setNumThreads(1)
    rows = []
    noise = np.random.default_rng(1).normal(120, 25, (1, SIDE, SIDE)).clip(0, 255)
    for name, values in (
        ("ADS40 (Kölbl fig. 4)", whole(ADS40)),
        ("DMC (Kölbl fig. 6)", whole(DMC)),
        ("general", general()),
    ):
        for dtype in ("uint8", "uint16", "float32"):
            image = noise.astype(dtype)
            out = np.empty_like(image)
            used = RestorationFilter((FilterKernel(values),))
            restorer = Restorer(used, (SIDE, SIDE), 1, image.dtype, image.dtype)
            # cv2.filter2D correlates; a convolution takes the kernel turned round.
            turned = np.ascontiguousarray(values[::-1, ::-1]).astype(np.float32)

            def ours(restorer: Restorer = restorer, image: np.ndarray = image, out: np.ndarray = out) -> None:
                filtered(restorer, image, out)

            def theirs(image: np.ndarray = image, turned: np.ndarray = turned) -> np.ndarray:
                return cv2.filter2D(image[0], -1, turned)

            a, b, ratio = pairs(ours, theirs, repeats)
            inner = np.s_[8:-8, 8:-8]
            apart = np.abs(out[0][inner].astype(float) - theirs()[inner].astype(float)).max()
            rows.append(
                {"filter": name, "dtype": dtype, "ours": a, "cv2_filter2D": b, "ratio": ratio, "apart": float(apart)}
            )
    return rows


def report_filter(quick: bool = False) -> list[dict] | None:
    """All rows, printed and as values; None if OpenCV is missing."""
    try:
        rows = filter_rates(7 if quick else 15)
    except ImportError as error:
        print(f"left out: rates of filters ({error})")
        return None
    print(f"\nFilter of 11 × 11 weights, one core, Mpx/s; to reach with uint8: ratio {TARGET:g}")
    print(f"  {'':24}{'type':>9}{'photoplan':>11}{'cv2.filter2D':>14}{'ratio':>8}{'apart':>9}")
    for row in rows:
        print(
            f"  {row['filter']:24}{row['dtype']:>9}{row['ours']:11.0f}{row['cv2_filter2D']:14.0f}{row['ratio']:8.2f}"
            f"{row['apart']:9.2g}",
            end="",
        )
        print(f"   {'reached' if row['ratio'] >= TARGET else 'NOT REACHED'}" if row["dtype"] == "uint8" else "")
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    options = parser.parse_args()
    rows = report_filter()
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
