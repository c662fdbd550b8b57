"""The photo of a chart: its four slanted edges found by themselves, as sharp as mtf_mapper measures them."""

from __future__ import annotations

import json
from math import hypot
from pathlib import Path

import pytest
import rasterio
from rasterio.windows import Window
from tools.command import Here

pytestmark = pytest.mark.slow

#: mtf_mapper 0.7.38, sRGB (README of `slanted_edges`): column, row, MTF50.
REFERENCE = ((1991, 385, 0.1978), (2864, 935, 0.1931), (2198, 1809, 0.2684), (1404, 871, 0.2073))

ORIGIN = (1300, 250)


@pytest.fixture
def photoplan(capsys: pytest.CaptureFixture[str]) -> Here:
    """The command, called inside this process."""
    return Here(capsys)


@pytest.fixture(scope="module")
def chart(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The part of the photo around the square."""
    path = tmp_path_factory.mktemp("chart") / "chart.tif"
    with rasterio.open(shared / "data" / "slanted_edges" / "chart_photo" / "Test.jpg") as file:
        pixels = file.read(window=Window(*ORIGIN, 1750, 1700))
    size = {"width": 1750, "height": 1700, "count": 3, "dtype": "uint8"}
    with rasterio.open(path, "w", driver="GTiff", photometric="RGB", **size) as file:
        file.write(pixels)
    return path


def sides(photoplan: Here, chart: Path, half: int) -> list[tuple[float, float]]:
    """For each side: how far the reference's place is from the nearest part, and the mean MTF50 weighted by length."""
    words = ("--linearisation", "srgb", "--least-length", 60, "--half-width", half, "--grid", 1, "--json", "-q")
    said = photoplan("mtf", chart, *words)
    assert said.code == 0, said.err
    found = []
    for col, row, reference in REFERENCE:
        near, weights, total = 1e9, 0.0, 0.0
        for edge in json.loads(said.out)["images"][0]["edges"]:
            (x0, y0), (x1, y1) = [(x + ORIGIN[0], y + ORIGIN[1]) for x, y in edge["ends"]]
            length = hypot(x1 - x0, y1 - y0)
            off = abs((col - x0) * (y1 - y0) - (row - y0) * (x1 - x0)) / length
            t = ((col - x0) * (x1 - x0) + (row - y0) * (y1 - y0)) / length
            if off < 12.0:
                near = min(near, hypot(off, max(0.0, -t, t - length)))
                weights, total = weights + length, total + length * edge["mtf50"]
        assert weights > 250
        print(
            f"window {half}: ({col}, {row}) {near:.1f} px off, {weights:.0f} px measured, MTF50 {total / weights:.4f}, "
            f"reference {reference}: {100 * (total / weights / reference - 1):+.1f} %"
        )
        found.append((near, total / weights))
    return found


def test_the_four_edges_of_the_chart_photo(chart: Path, photoplan: Here) -> None:
    """Each side of the square is some 1400 pixels long, and its sharpness changes by a third along it.

    Its straight parts are measured; their mean weighted by length is the side's figure. With the usual window of 20
    pixels to both sides all four are found at their places; with 11 pixels less of the bent right side is measured.
    """
    wide = sides(photoplan, chart, 20)
    assert max(near for near, _ in wide) < 3.0
    for found in (wide, sides(photoplan, chart, 11)):
        for (_, mtf50), (_, _, reference) in zip(found, REFERENCE):
            assert mtf50 == pytest.approx(reference, rel=0.02)
