"""Behr table 5.6, figs. 5.15 and 5.16; Ecker fig. 4.23; and the same meshes with homogeneous anchors."""

import anchor_interpolation as experiment
import numpy as np
import pytest

from photoplan.cameras.base import project
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.lenses import Interior, NoLens
from photoplan.geometry.grid import MapGrid, Window
from photoplan.geometry.pose import Pose
from photoplan.plan.anchors import AnchorRule, compile_anchors
from photoplan.plan.ground import TileGround
from photoplan.targets.map import MapTarget

CENTRES = experiment.SAMPLINGS[experiment.PIXEL_CENTRES]


def test_behr_table_5_6_is_reproduced_to_the_printed_digit():
    computed = experiment.table_5_6(distance=1300.0)
    assert {side: round(value) for side, value in computed.items()} == experiment.TABLE_5_6


def test_behr_limits_of_figures_5_15_and_5_16_in_the_text():
    # "up to 30 µm" in the mean and "up to 40 µm" at most are round figures: to ten micrometres.
    mean, largest = experiment.deviation_by_distance(np.array([1300.0]), 45.0)
    assert round(mean[0], -1) == 30
    assert round(largest[0], -1) == 40


def test_deviation_grows_with_distance_and_slope():
    distances = np.linspace(0, 1500, 7)
    curves = np.array([experiment.deviation_by_distance(distances, slope)[0] for slope in (15.0, 30.0, 45.0)])
    assert (np.diff(curves, axis=1) > 0).all()
    assert (np.diff(curves, axis=0) > 0).all()


def test_largest_deviation_is_in_the_middle_of_the_mesh():
    e = experiment.classical_deviation(experiment.Mesh(1300.0, 50.0, 45.0), CENTRES)
    assert np.unravel_index(e.argmax(), e.shape)[1] == 5


def test_only_meshes_that_rise_from_their_near_edge_print_the_table():
    found = experiment.setups_that_print_table_5_6(np.arange(1280.0, 1311.0, 10.0))
    assert found == [(experiment.PIXEL_CENTRES, True, 0.0, 1290.0, 1300.0)]


def test_law_is_quadratic_in_the_side():
    e = [experiment.classical_deviation(experiment.Mesh(1300.0, s, 45.0), CENTRES).mean() for s in (2.0, 1.0, 0.5)]
    np.testing.assert_allclose([e[0] / e[1], e[1] / e[2]], 4.0, rtol=2e-3)


def test_ecker_figure_4_23():
    printed = 1e3 * experiment.ecker_displacement(experiment.ECKER_MESH, 100.0)
    assert round(float(printed)) == experiment.ECKER_PRINTED


@pytest.mark.parametrize("percent", [10.0, 50.0, 100.0])
def test_ecker_displacement_has_a_closed_form(percent):
    s = np.linspace(0.1, 5, 9)
    closed = percent / 100 * s**2 / (4 * experiment.ECKER_CAMERA_CONSTANT)
    np.testing.assert_allclose(experiment.ecker_displacement(s, percent), closed, rtol=1e-9)


@pytest.mark.parametrize("roughness", [0.0, 10.0])
@pytest.mark.parametrize("side", [*experiment.TABLE_5_6, 400.0])
@pytest.mark.parametrize("slope", [15.0, 30.0, 45.0])
def test_homogeneous_anchors_are_exact_on_the_same_meshes(side, slope, roughness):
    relief = np.random.default_rng(7).uniform(-roughness, roughness, (11, 11))
    for distance in (0.0, 500.0, 1300.0, 1500.0):
        e = experiment.homogeneous_deviation(experiment.Mesh(distance, side, slope), CENTRES, relief)
        assert e.max() / experiment.PIXEL < 1e-11


def camera():
    """The experiment's camera as the package has it, pixels of 15 µm."""
    interior = Interior.metric((16_000, 16_000), 1e3 * experiment.CAMERA_CONSTANT, 1e3 * experiment.PIXEL)
    return FrameCamera(interior, NoLens(), Pose(np.array([0.0, 0.0, experiment.FLYING_HEIGHT]), np.eye(3)))


def test_the_packages_camera_is_the_experiments():
    XYZ = experiment.Mesh(1300.0, 50.0, 45.0).ground(*np.meshgrid(CENTRES, CENTRES))
    expected = experiment.image(XYZ) / experiment.PIXEL * (1, -1) + 7_999.5
    np.testing.assert_allclose(project(camera(), XYZ), expected, atol=1e-9)


@pytest.mark.parametrize("slope", [0.0, 45.0])
def test_the_package_needs_one_cell_for_behrs_steepest_mesh(slope):
    window = Window(0, 0, 512, 512)
    grid = MapGrid(left=1000.0, top=100.0, resolution=0.2, width=512, height=512, crs="EPSG:25832")
    relief = np.tan(np.radians(slope)) * np.broadcast_to(0.2 * np.arange(512), (512, 512))
    anchors = compile_anchors(
        camera(), TileGround.of(MapTarget(grid), window, relief.astype(np.float32)), AnchorRule(0.02, 2)
    )
    assert len(anchors.rects) == len(anchors.corners) == 1
    assert anchors.residual < 2e-11
