"""The edge of a road in the orthophoto: with the hybrid model where it is, with its grid alone not."""

import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import road_edge as road
from tools.thinned import some

from photoplan.cameras.base import project

PAGE = Path(__file__).resolve().parents[2] / "docs" / "experiments" / "road-edge.md"
run = cache(road.run)


@pytest.mark.parametrize("width", some([2.5, 5.0], 1))
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_edge_lies_within_a_fifth_of_a_pixel_with_the_hybrid_model(width, seed):
    outcome = run(width, seed)
    assert outcome.offsets["hybrid"].shape[1] > 150
    assert outcome.worst("hybrid") < 0.2
    assert outcome.worst("grid") > 1.0
    assert outcome.rms("grid") > 8 * outcome.rms("hybrid")


@pytest.mark.slow
def test_grid_alone_gets_worse_with_its_width_and_the_hybrid_model_does_not():
    outcomes = [run(width, 0) for width in (2.5, 5.0, 10.0)]
    grid = [o.rms("grid") for o in outcomes]
    assert grid[0] * 1.4 < grid[1] < grid[2] / 1.4
    assert max(o.worst("hybrid") for o in outcomes) < 0.2


@pytest.mark.slow
def test_figures_on_the_page():
    rows = re.findall(
        r"^\| ([\d.]+) m \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|$", PAGE.read_text("utf-8"), re.M
    )
    assert len(rows) == 3
    for width, *quoted in np.array(rows, float):
        o = run(width, 0)
        computed = [o.rms("hybrid"), o.worst("hybrid"), o.rms("grid"), o.worst("grid")]
        np.testing.assert_allclose(computed, quoted, rtol=0.05, atol=0.03)


def test_what_the_measurement_itself_leaves():
    assert run(5.0, 0).worst("truth") < 0.12


def test_photo_is_strict():
    view = road.camera()
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, 1, (500, 2)) * (np.array(view.size) - 1)
    XY = road.hit(view, xy)
    Z = road.terrain(*XY.T)
    np.testing.assert_allclose(project(view, np.column_stack([XY, Z])), xy, atol=1e-3)
    # Nothing stands between the camera and the place: along the ray, the terrain stays below it.
    for t in np.linspace(0.9, 0.9999, 100):
        between = view.center + t * (np.column_stack([XY, Z]) - view.center)
        assert (between[:, 2] > road.terrain(between[:, 0], between[:, 1])).all()


@pytest.mark.slow
def test_half_level_of_the_photo_lies_on_the_projected_edge():
    view = road.camera()
    image = road.photo(view)[0]
    angles = np.arange(*road.ANGLES, 0.01)
    XY = road.on_circle(angles, road.HALF_WIDTH)
    column, row = project(view, np.column_stack([XY, road.terrain(*XY.T)])).T
    from scipy.ndimage import map_coordinates

    grey = map_coordinates(image, [row, column], order=3)
    assert abs(grey.mean() - (road.DARK + road.BRIGHT) / 2) < 2
    assert np.abs(grey - (road.DARK + road.BRIGHT) / 2).max() < 8


@pytest.mark.parametrize("moved", [-0.7, 0.0, 0.35, 3.0])
def test_a_moved_edge_is_measured(moved):
    grid = road.ortho_grid()
    columns, rows = np.meshgrid(np.arange(grid.width), np.arange(grid.height))
    X, Y = np.moveaxis(grid.to_map(np.stack([columns, rows], axis=-1)), -1, 0)
    beyond = np.abs(road.off_axis(X, Y)) - road.HALF_WIDTH - moved * road.PIXEL
    blurred = road.DARK + (road.BRIGHT - road.DARK) / (1 + np.exp(-beyond / 0.12))
    for side in (1.0, -1.0):
        np.testing.assert_allclose(road.edge_offsets(blurred, side)[1], moved, atol=0.03)


def test_toes_lie_on_the_ground_and_on_the_embankment():
    for side in (1.0, -1.0):
        X, Y = road.toe(np.linspace(1.2, 1.9, 50), side).T
        beside = np.abs(road.off_axis(X, Y)) - road.HALF_WIDTH
        assert (beside > 1).all()
        np.testing.assert_allclose(road.ground(X, Y), road.carriageway(X, Y) - road.SLOPE * beside, atol=1e-6)
