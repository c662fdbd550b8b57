"""Real slanted edges against an established program's MTF50 under the same linearisation (README of the data).

The program (0.7.38) takes pixels up to 16 from the edge, as `EdgeSettings.reach` does; windows of 8 to 20 pixels move
MTF50 of these edges by up to 2 %, the whole region by up to 5 %, because the light is not even across the edge.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from photoplan.quality.curves import Linearisation, MtfCurve
from photoplan.quality.edges.response import EdgeSettings, measure_edge

EDGES = {
    "sfrmat3/h_edge_mono.tif": (0.2026, 0.2006),
    "splund/x2084_y0616_F2.png": (0.3345, 0.2980),
    "splund/x2088_y0616_F2_8.png": (0.5038, 0.4734),
}


def _bands(path):
    import rasterio

    with rasterio.open(path) as image:
        return image.read()


@pytest.mark.parametrize(("name", "reference"), EDGES.items())
@pytest.mark.parametrize("kind", ["srgb", "linear"])
def test_three_real_edges(shared, name, reference, kind):
    grey = _bands(shared / "data" / "slanted_edges" / name)[0]
    way = Linearisation(kind)
    edge = measure_edge(way.to_linear(grey), limits=way.limits(grey.dtype))
    expected = reference[kind == "linear"]
    print(f"{name} {kind}: MTF50 {edge.mtf50:.4f} ({100 * (edge.mtf50 / expected - 1):+.1f} %)")
    assert edge.mtf50 == pytest.approx(expected, rel=0.02)
    assert edge.mtf50_interval[0] <= expected <= edge.mtf50_interval[1]


@pytest.fixture(scope="module")
def chart():
    from pathlib import Path

    path = Path(__file__).resolve().parents[3] / "shared" / "data" / "slanted_edges" / "chart_photo" / "Test.jpg"
    if not path.is_file():
        pytest.skip("needs the folder `shared` with test data beside the checkout")
    red, green, blue = _bands(path).astype(float)
    grey = np.round(0.299 * red + 0.587 * green + 0.114 * blue).astype(np.uint8)
    return Linearisation("srgb").to_linear(grey)


def _stretch(light, start, end, half=28.0):
    """The edge between two places (column, row), measured in a strip beside it."""
    a, b = np.array(start), np.array(end)
    along = (b - a) / np.hypot(*(b - a))
    first = np.floor(np.minimum(a, b)).astype(int) - 32
    last = np.ceil(np.maximum(a, b)).astype(int) + 32
    part = light[first[1] : last[1], first[0] : last[0]]
    rows, columns = np.mgrid[first[1] : last[1], first[0] : last[0]]
    t = (columns - a[0]) * along[0] + (rows - a[1]) * along[1]
    n = (rows - a[1]) * along[0] - (columns - a[0]) * along[1]
    strip = (np.abs(n) < half) & (t >= 0.0) & (t < np.hypot(*(b - a)))
    return measure_edge(part, strip, origin=tuple(first), settings=EdgeSettings(curve=2), limits=(0.0, 255.0))


@pytest.mark.parametrize(
    ("at", "slope", "reference"),
    [
        pytest.param((1991.0, 385.0), (1.0, -0.099), 0.1978, marks=pytest.mark.slow),
        pytest.param((2198.0, 1809.0), (1.0, -0.109), 0.2684, marks=pytest.mark.slow),
    ],
)
def test_chart_photo_at_the_reference_places(chart, at, slope, reference):
    place, way = np.array(at), np.array(slope)
    edge = _stretch(chart, place - 60.0 * way, place + 60.0 * way)
    print(f"chart {at}: MTF50 {edge.mtf50:.4f} ({100 * (edge.mtf50 / reference - 1):+.1f} %)")
    assert edge.mtf50 == pytest.approx(reference, rel=0.02)


def _whole(chart, start, end):
    """Mean MTF of eight stretches of a long edge, on which sharpness changes."""
    a, b = np.array(start), np.array(end)
    places = [a + (b - a) * (0.04 + 0.92 * i / 8) for i in range(9)]
    curves = [_stretch(chart, p, q).mtf for p, q in pairwise(places)]
    mean = MtfCurve(curves[0].frequency, np.mean([curve.modulation for curve in curves], axis=0))
    return mean.mtf50, [curve.mtf50 for curve in curves]


@pytest.mark.slow
def test_chart_photo_left_edge_as_a_whole(chart):
    """Its sharpness falls from 0.27 at the upper end to 0.16 at the lower one: only the mean can be compared."""
    mean, parts = _whole(chart, (1362.0, 446.0), (1494.0, 1880.0))
    print(f"chart left edge: MTF50 {mean:.4f} ({100 * (mean / 0.2073 - 1):+.1f} %), along it {np.round(parts, 3)}")
    assert mean == pytest.approx(0.2073, rel=0.02)
    assert parts[0] > 0.24 and parts[-1] < 0.18


@pytest.mark.xfail(strict=True, reason="+5.8 %: steps of one pixel on this edge, see the docstring")
@pytest.mark.slow
def test_chart_photo_right_edge_as_a_whole(chart):
    """Not reached: its profile has steps one pixel apart and a veil of 8 pixels on the bright side.

    Single stretches differ by 25 %, the standard deviation of their mean is 3 %; at the reference's place 0.178 ± 0.010
    is found on 120 pixels.
    """
    mean, parts = _whole(chart, (2779.0, 306.0), (2960.0, 1706.0))
    print(f"chart right edge: MTF50 {mean:.4f} ({100 * (mean / 0.1931 - 1):+.1f} %), along it {np.round(parts, 3)}")
    assert mean == pytest.approx(0.1931, rel=0.02)
