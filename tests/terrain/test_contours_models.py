"""Contours of hybrid models: random lines and walls, units of different widths, against the surface itself."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import shapely
import shapely.affinity
from tools.hybrid_models import model, random_lines

from photoplan.surfaces.units import UnitLayout
from photoplan.terrain.contours import ContourLine, ContourOptions, Labeller, decimals_of, trace_contours, unit_parts

LAYOUT = UnitLayout(512_000.0, 5_200_060.0, 20.0, 3, 3)
WIDTHS = np.array([[4, 8, 4], [8, 16, 8], [4, 4, 8]])


def hybrid(seed: int, walls: bool) -> tuple[Any, list[Any]]:
    rng = np.random.default_rng(seed)
    return model(LAYOUT, WIDTHS, random_lines(rng, LAYOUT, 6, walls))


def traced(surface: Any, lines: Any = None, **options: Any) -> list[ContourLine]:
    near = None if lines is None else (lambda bounds: lines)
    options = {"interval": 0.25, "base": 0.013} | options
    return list(trace_contours(unit_parts(surface.source, None, near), ContourOptions(**options)))


@pytest.mark.parametrize("seed", range(3))
def test_vertices_lie_on_the_surface_and_ends_at_borders_and_walls(seed: int) -> None:
    surface, lines = hybrid(seed, walls=True)
    walls = shapely.union_all([shapely.LineString(each.xyz[:, :2]) for each in lines if each.right is not None])
    assert not walls.is_empty
    edge = shapely.box(*LAYOUT.bounds).exterior
    checked = 0
    for line in traced(surface):
        points = shapely.points(line.xy)
        away = shapely.distance(points, walls) > 1e-4
        z = surface.heights(line.xy[away])
        assert np.abs(z - line.height).max(initial=0) < 2e-5
        checked += int(away.sum())
        if not line.closed:
            ends = points[[0, -1]]
            assert (np.minimum(shapely.distance(ends, edge), shapely.distance(ends, walls)) < 1e-6).all()
    assert checked > 3000


@pytest.mark.parametrize("options", [{}, {"smooth": True, "band": 0.45}, {"smooth": True, "simplify": True}])
def test_lines_of_a_model_never_cross(options: dict[str, Any]) -> None:
    surface, lines = hybrid(5, walls=False)
    shapes = [shapely.LineString(line.xy) for line in traced(surface, lines, **options)]
    assert all(shape.is_simple for shape in shapes)
    left, right = shapely.STRtree(shapes).query(shapes, predicate="intersects")
    assert (left == right).all()


def test_smoothing_leaves_vertices_on_breaklines_where_they_are() -> None:
    surface, lines = hybrid(7, walls=False)
    break_ = shapely.union_all([shapely.LineString(each.xyz[:, :2]) for each in lines])

    def on_lines(found: list[ContourLine]) -> set[Any]:
        xy = np.concatenate([line.xy for line in found])
        near = xy[shapely.distance(shapely.points(xy), break_) < 1e-7]
        return {tuple(p) for p in np.round(near, 6).tolist()}

    raw, smooth = on_lines(traced(surface)), on_lines(traced(surface, lines, smooth=True))
    assert len(raw) > 15
    assert raw == smooth
    assert on_lines(traced(surface, smooth=True)) != raw  # without the lines they move


# -- labels ------------------------------------------------------------------------------------------------------------


def ring(radius: float, height: float = 120.0, clockwise: bool = True, n: int = 400) -> ContourLine:
    at = np.linspace(0, 2 * np.pi, n + 1)
    xy = radius * np.column_stack([np.sin(at), np.cos(at) if clockwise else -np.cos(at)])
    xy[-1] = xy[0]
    return ContourLine(height, xy, True)


@pytest.mark.parametrize("clockwise", [True, False])
def test_labels_lie_on_the_line_along_it_with_their_top_uphill(clockwise: bool) -> None:
    line = ring(100.0, clockwise=clockwise)
    labels = Labeller(4.0, 90.0, 1).place(line)
    assert line.depression is not clockwise
    assert 5 <= len(labels) <= 7
    for label in labels:
        assert label.text == "120.0"
        assert np.hypot(label.X, label.Y) == pytest.approx(100, abs=0.6)
        up = np.radians(label.angle + 90)
        inward = -(label.X * np.cos(up) + label.Y * np.sin(up)) / 100
        assert (inward if clockwise else -inward) > 0.99


def test_labels_keep_apart_and_off_crooked_parts() -> None:
    labeller = Labeller(4.0, 60.0, 0)
    found = [label for radius in np.arange(20.0, 200.0, 3.0) for label in labeller.place(ring(radius, radius))]
    boxes = []
    for label in found:
        width = 4.0 * 0.62 * len(label.text)
        box = shapely.affinity.rotate(shapely.box(-width / 2, -2, width / 2, 2), label.angle)
        boxes.append(shapely.affinity.translate(box, label.X, label.Y))
    assert len(found) > 100
    left, right = shapely.STRtree(boxes).query(boxes, predicate="intersects")
    assert (left == right).all()
    zigzag = np.column_stack([np.arange(200.0) * 2, np.arange(200) % 2 * 6.0])
    straight = np.column_stack([400 + np.arange(20.0) * 2, np.full(20, 3.0)])
    places = Labeller(4.0, 1000.0, 0).place(ContourLine(10.0, np.concatenate([zigzag, straight]), True))
    assert [label.X > 400 for label in places] == [True]
    assert Labeller(4.0, 1000.0, 0).place(ContourLine(10.0, zigzag, True)) == []
    assert Labeller(4.0, 50.0, 0).place(ring(1.0)) == []
    # Twelve metres of text on a circle of 10 m would leave it by 1.8 m; of 30 m, by 0.6 m.
    assert Labeller(4.0, 1000.0, 0).place(ring(10.0, 1200.0)) == []
    assert len(Labeller(4.0, 1000.0, 0).place(ring(30.0, 1200.0))) == 1


@pytest.mark.parametrize(
    ("interval", "base", "decimals"), [(1, 0, 0), (2.5, 0, 1), (0.25, 0.1, 2), (10, 0.125, 3), (1 / 3, 0, 6)]
)
def test_decimals_tell_contours_apart(interval: float, base: float, decimals: int) -> None:
    assert decimals_of(interval, base) == decimals
