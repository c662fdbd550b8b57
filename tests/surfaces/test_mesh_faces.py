"""Triangles of a hybrid model: continuous over all edges, exact along lines, two heights at walls."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from tools.hybrid_models import line, model, plain_unit, random_lines, rough
from tools.thinned import examples

from photoplan.errors import GeometryError, InputError
from photoplan.surfaces.hybrid import HybridSurface
from photoplan.surfaces.mesh import build_faces, on_grid, thin
from photoplan.surfaces.units import UnitLayout

LAYOUT = UnitLayout(500_000.3, 5_300_000.7, 12.34, 2, 2)


def tilted(X, Y):
    return 250 + 0.25 * (X - 500_000) - 0.5 * (Y - 5_300_000)


def area(surface: HybridSurface) -> tuple[float, float]:
    """Area of all triangles, and of the meshes that have some; no triangle may be turned over."""
    covered = meshes = 0.0
    for unit in surface.source.units.values():
        if unit.faces is None:
            continue
        a, b, c = np.moveaxis(unit.faces.vertices[unit.faces.corners][..., :2], 1, 0)
        twice = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
        assert (twice >= 0).all()
        covered += twice.sum() / 2
        meshes += (np.diff(unit.faces.start) > 0).sum() * unit.width**2
    return covered, meshes


def edge_points(surface: HybridSurface, rng: np.random.Generator, away: float = 3e-9) -> tuple[np.ndarray, np.ndarray]:
    """Points on both sides of all mesh edges, 3 nm from them, inside the model."""
    xmin, ymin, xmax, ymax = surface.source.layout.bounds
    one, two = [], []
    for unit in surface.source.units.values():
        n = unit.meshes
        t, k = rng.uniform(0, n, (n + 1) * 30), np.repeat(np.arange(n + 1), 30)
        for col, row, step in ((k, t, (away, 0)), (t, k, (0, away))):
            XY = np.stack([unit.left + col * unit.width, unit.top - row * unit.width], axis=1)
            one.append(XY - step)
            two.append(XY + step)
    a, b = np.concatenate(one), np.concatenate(two)
    inside = ((a > [xmin + 1e-6, ymin + 1e-6]) & (b < [xmax - 1e-6, ymax - 1e-6])).all(axis=1)
    return a[inside], b[inside]


@settings(max_examples=examples(15, 40), deadline=None)
@given(seed=st.integers(0, 100_000))
def test_the_surface_is_continuous_and_exact_along_lines(seed: int) -> None:
    rng = np.random.default_rng(seed)
    posts = np.stack(np.meshgrid(*[np.arange(9) * LAYOUT.side / 4] * 2), axis=-1).reshape(-1, 2)
    posts = [LAYOUT.left, LAYOUT.top] + posts * [1, -1]
    lines = random_lines(rng, LAYOUT, 6, walls=seed % 2 == 1, on_posts=posts)
    surface, cut = model(LAYOUT, rng.choice([1, 2, 3, 4, 8], (2, 2)), lines)
    a, b = edge_points(surface, rng)
    gap = np.abs(surface.heights(a) - surface.heights(b))
    assert gap.max() < 5e-5  # float32 posts above each unit's datum, and 6 nm of the steepest triangle
    # Farther away the points are in two units beyond doubt: the difference is a slope, which halves with the distance,
    # but for single points that have a wall between them.
    a, b = edge_points(surface, rng, 2e-5)
    far = np.abs(surface.heights(a) - surface.heights(b))
    near = np.abs(surface.heights(0.75 * a + 0.25 * b) - surface.heights(0.25 * a + 0.75 * b))
    assert ((far > 0.02) & (near > 0.6 * far)).mean() < 0.004
    covered, meshes = area(surface)
    assert covered == pytest.approx(meshes, rel=1e-9)
    xmin, ymin, xmax, ymax = LAYOUT.bounds
    walls = {tuple(v) for each in cut if each.right is not None for v in each.xyz[:, :2]}
    for each in cut:
        if any(tuple(v) in walls for v in each.xyz[:, :2]):
            continue
        t = rng.uniform(0, 1, (len(each.xyz) - 1, 10, 1))
        on = (each.xyz[:-1, None] + t * (each.xyz[1:, None] - each.xyz[:-1, None])).reshape(-1, 3)
        on = on[((on[:, :2] > [xmin, ymin]) & (on[:, :2] < [xmax, ymax])).all(axis=1)]
        np.testing.assert_allclose(surface.heights(on[:, :2]), on[:, 2], atol=1e-6)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 100_000))
def test_a_line_on_the_grid_is_the_same_line(seed: int) -> None:
    rng = np.random.default_rng(seed)
    [one] = random_lines(rng, LAYOUT, 1, walls=True)
    meshes = rng.choice([0, 1, 3, 5, 8], (2, 2))
    cut = on_grid(one, LAYOUT, meshes)
    again = on_grid(cut, LAYOUT, meshes)
    np.testing.assert_array_equal(again.xyz, cut.xyz)
    given_ = cut.xyz[~cut.on_grid]
    np.testing.assert_allclose(given_, one.xyz, atol=1e-5)
    path = shapely.LineString(one.xyz[:, :2])
    along = shapely.line_locate_point(path, shapely.points(cut.xyz[:, :2]))
    assert (np.diff(along) > 0).all() and shapely.distance(path, shapely.points(cut.xyz[:, :2])).max() < 1e-5
    length = np.append(0, np.cumsum(np.hypot(*np.diff(one.xyz[:, :2], axis=0).T)))
    np.testing.assert_allclose(cut.xyz[:, 2], np.interp(along, length, one.xyz[:, 2]), atol=1e-6)
    # No piece crosses a grid line of the unit that it is in.
    x = np.stack([cut.xyz[:, 0] - LAYOUT.left, LAYOUT.top - cut.xyz[:, 1]], axis=1) / LAYOUT.side
    unit = np.floor((x[1:] + x[:-1]) / 2)
    inside = ((unit >= 0) & (unit < 2)).all(axis=1)
    count = np.ones(len(unit))
    count[inside] = np.maximum(meshes[unit[inside, 1].astype(int), unit[inside, 0].astype(int)], 1)
    low, high = np.sort(np.stack([(x[1:] - unit) * count[:, None], (x[:-1] - unit) * count[:, None]]), axis=0)
    assert (np.floor(low + 1e-7) + 1 >= high - 1e-7).all()


def test_a_line_along_the_border_of_units_gets_the_posts_of_both() -> None:
    layout = UnitLayout(0, 0, 12.0, 2, 1)
    cut = on_grid(line([(12, 1, 5.0), (12, -13, 5.0)]), layout, np.array([[2, 3]]))
    np.testing.assert_allclose(cut.xyz[:, 1], [1, 0, -4, -6, -8, -12, -13])


def test_vertices_next_to_a_grid_line_are_moved_onto_it() -> None:
    layout = UnitLayout(0, 0, 10.0, 1, 1)
    cut = on_grid(line([(2 + 8e-7, -2 - 7e-7, 1.0), (5, -4.0000009, 1.0), (9.5, -9.5, 1)]), layout, np.array([[10]]))
    assert (cut.xyz[0, :2] == [2, -2]).all() and (5, -4) in {tuple(v) for v in cut.xyz[:, :2]}
    unit = plain_unit(layout, 0, 0, 10, rough)
    faces = build_faces(unit, [cut])
    assert faces is not None
    a, b, c = np.moveaxis(faces.vertices[faces.corners], 1, 0)
    assert min(np.linalg.norm(p - q, axis=1).min() for p, q in ((a, b), (b, c), (c, a))) > 0.05


def test_a_unit_without_lines_beside_equal_or_coarser_ones_needs_no_triangles() -> None:
    layout = UnitLayout(0, 0, 8.0, 2, 1)
    fine, coarse = plain_unit(layout, 0, 0, 8, rough), plain_unit(layout, 1, 0, 4, rough)
    assert build_faces(fine, [], {"east": coarse, "west": fine}) is None
    faces = build_faces(coarse, [], {"west": fine})
    assert faces is not None
    assert np.flatnonzero(np.diff(faces.start)).tolist() == [0, 4, 8, 12]
    assert len(faces.corners) == 4 * 3


def test_both_sides_of_a_wall_and_one_height_at_its_free_end() -> None:
    layout = UnitLayout(0, 0, 10.0, 2, 1)
    # It ends inside a unit, and on the border between two, where only one of them sees the wall.
    for last in (7.3, 10.0):
        wall = line([(-1, -5.5, 254.0), (3.2, -4.5, 254.0), (last, -5.7, 253.0)], [251.0, 251.0, 250.0])
        surface, cut = model(layout, 5, [wall], lambda X, Y: 252.0 + 0 * X)
        assert surface.heights([(last, -5.7)]) == pytest.approx(251.5)
        mid = (cut[0].xyz[1:-1, :2] + cut[0].xyz[2:, :2]) / 2
        step = np.array([0, 1e-5])
        assert (surface.heights(mid[:-1] + step) > 253).all() and (surface.heights(mid[:-1] - step) < 252).all()
        a, b = edge_points(surface, np.random.default_rng(0))
        assert np.abs(surface.heights(a) - surface.heights(b)).max() < 1e-4


def test_where_walls_meet_each_sector_has_its_height() -> None:
    layout = UnitLayout(0, 0, 10.0, 1, 1)
    M = (5.0, -5.0)
    # Three terraces round one point: 260 in the north-west, 255 in the north-east, 250 in the south.
    walls = [
        line([(0, -5, 260.0), (*M, 260.0)], [250.0, 250.0]),
        line([(*M, 255.0), (10, -5, 255.0)], [250.0, 250.0]),
        line([(*M, 260.0), (5, 0, 260.0)], [255.0, 255.0]),
    ]
    surface, _ = model(layout, 4, walls, lambda X, Y: np.where(Y < -5, 250.0, np.where(X < 5, 260.0, 255.0)))
    around = np.array([(-1, 1), (-1e-3, 1e-3), (1, 1), (1e-3, 1e-3), (1, -1), (-1e-3, -1e-3), (0, -1)])
    np.testing.assert_allclose(surface.heights(M + around), [260, 260, 255, 255, 250, 250, 250], atol=1e-6)


def test_posts_on_a_line_take_its_height_for_all_meshes_around() -> None:
    layout = UnitLayout(0, 0, 8.0, 2, 2)
    surface, _ = model(layout, 4, [line([(6, -6, 260.0), (8, -8, 260.0)])], lambda X, Y: 250.0 + 0 * X)
    around = np.array([(dx, dy) for dx in (-1e-6, 1e-6) for dy in (-1e-6, 1e-6)])
    for post in ((6, -6), (8, -8)):
        np.testing.assert_allclose(surface.heights(post + around), 260, atol=1e-4)


def test_outside_the_domain_and_in_holes_there_are_no_triangles() -> None:
    layout = UnitLayout(0, 0, 10.0, 2, 2)
    outer = np.array([(1.5, -1.2), (1.8, -18), (17.7, -18.4), (18.2, -2), (9, -4.5), (1.5, -1.2)])
    hole = np.array([(8, -8), (8, -12), (12.0, -12), (12, -8), (8, -8)])  # along grid lines
    domain = shapely.Polygon(outer, [hole])
    borders = [
        line(np.column_stack([ring, tilted(*ring.T)]), kind=kind) for ring, kind in ((outer, "border"), (hole, "hole"))
    ]

    def bounded(X, Y):
        return np.where(shapely.distance(domain, shapely.points(X, Y)) == 0, tilted(X, Y), np.nan)

    surface, _ = model(layout, 5, borders, bounded, domain)
    XY = np.random.default_rng(1).uniform((0, -20), (20, 0), (4000, 2))
    XY = XY[shapely.distance(domain.boundary, shapely.points(XY)) > 1e-6]
    inside = shapely.contains_xy(domain, XY)
    np.testing.assert_array_equal(np.isfinite(surface.heights(XY)), inside)
    np.testing.assert_allclose(surface.heights(XY[inside]), tilted(*XY[inside].T), atol=1e-4)


def test_a_hole_of_just_one_mesh_is_a_hole() -> None:
    layout = UnitLayout(0, 0, 10.0, 1, 1)
    ring = np.array([(4, -4), (4, -6), (6.0, -6), (6, -4), (4, -4)])
    hole = line(np.column_stack([ring, tilted(*ring.T)]), kind="hole")
    surface, _ = model(layout, 5, [hole], tilted, shapely.Polygon([(0, 0), (10, 0), (10, -10), (0, -10)], [ring]))
    assert np.isnan(surface.heights([(5, -5)])) and np.isfinite(surface.heights([(3.9, -5), (5, -6.1)])).all()


def test_lines_that_cross_or_lack_intersections_are_named() -> None:
    layout = UnitLayout(0, 0, 10.0, 1, 1)
    unit = plain_unit(layout, 0, 0, 1, rough)
    a, b = line([(1, -1, 5.0), (9, -9, 5.0)], name="kerb 7"), line([(1, -9, 5.0), (9, -1, 5.0)], name="kerb 9")
    with pytest.raises(GeometryError, match=r"unit X 0\.0 … 10\.0.*kerb 7 and kerb 9 meet at 5\.0, -5\.0"):
        build_faces(unit, [a, b])
    fine = plain_unit(layout, 0, 0, 4, rough)
    with pytest.raises(InputError, match="ditch: the line crosses the grid"):
        build_faces(fine, [dataclasses.replace(a, name="ditch")])
    with pytest.raises(InputError, match="side 'above'"):
        build_faces(fine, [], {"above": unit})
    with pytest.raises(InputError, match="2 rows, 2 columns"):
        on_grid(a, LAYOUT, np.ones((1, 2), np.int64))


def test_thin_keeps_a_plane_with_one_mesh_and_a_ridge_with_all() -> None:
    layout = UnitLayout(0, 0, 16.0, 1, 1)
    assert thin(plain_unit(layout, 0, 0, 16, tilted), 1e-4).meshes == 1
    roof = plain_unit(layout, 0, 0, 16, lambda X, Y: 250 - np.abs(X - 5.0))
    assert thin(roof, 0.01).meshes == 16
    bowl = plain_unit(layout, 0, 0, 16, lambda X, Y: 250 + 0.02 * (X - 3) ** 2)
    for tolerance in (0.01, 0.05, 0.3, 2.0):
        coarse = thin(bowl, tolerance)
        # The sagitta of the parabola over a mesh: 0.02 (w/2)².
        assert 0.02 * (coarse.width / 2) ** 2 <= tolerance + 1e-6 < 0.02 * coarse.width**2 or coarse.meshes == 1


def test_thin_neither_loses_nor_adds_area() -> None:
    layout = UnitLayout(0, 0, 16.0, 1, 1)
    half = plain_unit(layout, 0, 0, 16, lambda X, Y: np.where(X <= 8, 250.0, np.nan))
    assert thin(half, 1).meshes == 2
    dent = plain_unit(layout, 0, 0, 16, lambda X, Y: np.where(X <= 9, 250.0, np.nan))
    assert thin(dent, 1).meshes == 16
    pin = plain_unit(layout, 0, 0, 16, lambda X, Y: 250.0 + 0 * X)
    pin.heights[5, 5] = np.nan
    assert thin(pin, 1).meshes == 16
    with pytest.raises(InputError, match="tolerance -1"):
        thin(pin, -1)
