"""Edges in images of any size: tiles make no difference, edges are chosen spread over the field."""

from __future__ import annotations

from math import hypot
from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.edge_scenes import blocks, noisy

from photoplan.geometry.grid import Window
from photoplan.products.mtf import edges as mtf_search
from photoplan.products.mtf.edges import LightImage, join_lines, parted, search_edges, select_spread, tiles_of
from photoplan.quality.curves import Linearisation
from photoplan.quality.edges.find import EdgeRegion, EdgeRules, StraightEdge


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> LightImage:
    path = tmp_path_factory.mktemp("scene") / "blocks.tif"
    pixels = noisy(blocks((660, 440), 12.0, 0.8, 3), 50, 4, "uint16")
    with rasterio.open(path, "w", driver="GTiff", width=660, height=440, count=1, dtype="uint16") as file:
        file.write(pixels, 1)
    return LightImage.open(path, Linearisation())


def search(image: LightImage) -> list[EdgeRegion]:
    return search_edges(image, 0, Window(0, 0, *image.size), EdgeRules()).regions


@pytest.fixture(scope="module")
def whole(image: LightImage) -> list[EdgeRegion]:
    return search(image)


def test_tiles_make_no_difference(image: LightImage, whole: list[EdgeRegion], monkeypatch: pytest.MonkeyPatch) -> None:
    """The same edges in one tile and in sixty-odd, which cut most of them: joined again, to a tenth of a pixel."""
    monkeypatch.setattr(mtf_search, "TILE", 90)
    assert len(tiles_of(Window(0, 0, *image.size))) == 40
    tiled = search(image)
    assert len(whole) == 96
    assert abs(len(tiled) - 96) <= 2
    near = 0
    for edge in tiled:
        other = min(whole, key=lambda w: hypot(w.line.x - edge.line.x, w.line.y - edge.line.y))
        off = (edge.line.x - other.line.x) * other.line.ty - (edge.line.y - other.line.y) * other.line.tx
        near += abs(off) < 0.1 and edge.line.tx * other.line.tx + edge.line.ty * other.line.ty > 0.9999
    print(f"{near} of {len(tiled)} edges as in one tile")
    assert near >= 0.97 * len(tiled)


def test_only_the_area_is_used(image: LightImage) -> None:
    area = Window(100, 80, 240, 200)
    regions = search_edges(image, 0, area, EdgeRules()).regions
    assert 8 <= len(regions) <= 30
    for region in regions:
        for x, y in region.line.ends:
            assert 99 <= x <= 341 and 79 <= y <= 281


def test_edges_are_spread(image: LightImage, whole: list[EdgeRegion]) -> None:
    """Twelve of 96 edges: both directions, and more cells of the field than the twelve best lie in."""
    chosen = select_spread(whole, image.size, 12)
    cells = {(int(6 * r.line.x / 660), int(6 * r.line.y / 440)) for r in chosen}
    assert len(chosen) == 12
    assert len(cells) >= 6
    assert {abs(r.line.tx) > abs(r.line.ty) for r in chosen} == {True, False}
    assert len(select_spread(whole, image.size, 1000)) == len(whole)


def test_lines_are_joined_where_they_go_on() -> None:
    pieces = [StraightEdge.between((x, 0.1 * x), (x + 90, 0.1 * (x + 90)), 1.0) for x in (0, 91, 182)]
    apart = StraightEdge.between((0, 30), (90, 39), 1.0)
    back = StraightEdge.between((370, 37), (280, 28), 1.0)
    joined = join_lines([pieces[1], apart, pieces[2], back, pieces[0]])
    assert len(joined) == 3
    assert joined[0].length == pytest.approx(hypot(272, 27.2), rel=1e-6)


def test_parts_are_edges_of_their_own() -> None:
    line = StraightEdge.between((0, 0), (300, 0), 1.0)
    parts = parted(EdgeRegion(line, 10, 1.0, 50.0, True, gaps=((40.0, 60.0),), of=7), 3)
    assert [p.line.length for p in parts] == pytest.approx([100] * 3)
    assert [p.line.x for p in parts] == pytest.approx([50, 150, 250])
    assert parts[0].gaps == ()
    masks = [p.mask((0, 0, 301, 5)) for p in parts]
    whole = EdgeRegion(line, 10, 1.0, 50.0, True, gaps=((40.0, 60.0),)).mask((0, 0, 301, 5))
    assert (np.logical_or.reduce(masks) == whole).all()
    assert {p.of for p in parts} == {7}


def test_path_of_the_image(image: LightImage, tmp_path: Path) -> None:
    assert image.channels(None) == (0,)
    assert image.channels("1") == (1,)
    assert image.channel_name(0) == "band 1"
