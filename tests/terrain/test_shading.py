"""Hillshade, slope, aspect and tints: planes and spheres, invariances, and GDAL's programs on the same heights."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from hypothesis import given
from hypothesis import strategies as st

from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import MapGrid, Window
from photoplan.surfaces.raster import RasterSurface
from photoplan.targets.map import MapTarget
from photoplan.terrain import shading

GRID = MapGrid(1000.0, 2000.0, 0.5, 60, 50, "EPSG:32633")


@dataclass(frozen=True)
class Formula:
    """A surface z = f(X, Y)."""

    f: Callable[[np.ndarray, np.ndarray], np.ndarray]

    def relief(self, target: Any, window: Window) -> np.ndarray:
        v, u = np.mgrid[window.row : window.stop[1], window.col : window.stop[0]]
        XY = target.grid.to_map(np.stack([u, v], axis=-1))
        return self.f(XY[..., 0], XY[..., 1]).astype(np.float32)

    def heights(self, XY: Any) -> np.ndarray:
        return self.f(XY[..., 0], XY[..., 1])

    def height_range(self, bounds: Any) -> tuple[float, float]:
        raise NotImplementedError


def plane(gx: float, gy: float) -> Formula:
    return Formula(lambda X, Y: gx * (X - 1000) + gy * (Y - 2000))


@pytest.mark.parametrize(("gx", "gy"), [(0.0, 0.5), (0.3, -0.2), (-1.0, 0.0), (-0.4, -0.4), (2.0, 1.0)])
def test_a_plane_has_its_slope_aspect_and_light(gx: float, gy: float) -> None:
    slopes = shading.surface_slopes(plane(gx, gy), GRID, GRID.window)
    np.testing.assert_allclose(slopes.gradient[0], gx, atol=3e-5)
    np.testing.assert_allclose(slopes.gradient[1], gy, atol=3e-5)
    np.testing.assert_allclose(shading.slope_degrees(slopes), np.degrees(np.arctan(np.hypot(gx, gy))), atol=2e-3)
    np.testing.assert_allclose(shading.slope_percent(slopes), 100 * np.hypot(gx, gy), atol=5e-3)
    falls = np.degrees(np.arctan2(-gx, -gy)) % 360
    off = (shading.aspect(slopes) - falls + 180) % 360 - 180
    assert np.abs(off).max() < 0.02
    light = shading.Lighting(azimuth=200, altitude=30)
    az, al = np.radians([200, 30])
    normal = np.array([-gx, -gy, 1]) / np.sqrt(gx**2 + gy**2 + 1)
    expected = max(0.0, float(normal @ [np.sin(az) * np.cos(al), np.cos(az) * np.cos(al), np.sin(al)]))
    np.testing.assert_allclose(shading.hillshade(slopes, light), expected, atol=5e-5)


def test_compass_directions_of_aspect() -> None:
    """A surface that falls to the north has aspect 0, to the east 90, to the south 180, to the west 270."""
    for (gx, gy), degrees in {(0, -1): 0, (-1, 0): 90, (0, 1): 180, (1, 0): 270}.items():
        slopes = shading.surface_slopes(plane(gx, gy), GRID, Window(3, 3, 4, 4))
        np.testing.assert_allclose(shading.aspect(slopes), degrees, atol=1e-3)


def test_flat_ground_has_no_aspect_and_the_sine_of_the_sun() -> None:
    slopes = shading.surface_slopes(Formula(lambda X, Y: 1234.56 + 0 * X), GRID, GRID.window)
    assert (shading.aspect(slopes) == shading.FLAT).all()
    for multi in (False, True):
        shade = shading.hillshade(slopes, shading.Lighting(altitude=40, multidirectional=multi))
        np.testing.assert_allclose(shade, np.sin(np.radians(40)), atol=1e-6)


def test_a_sphere_converges_with_the_square_of_the_pixel() -> None:
    """Height √(R² − r²): the light is (x, y, z) · sun / R."""

    def f(X: np.ndarray, Y: np.ndarray) -> np.ndarray:
        return np.sqrt(50.0**2 - X**2 - Y**2)

    worst = []
    light = shading.Lighting(azimuth=300, altitude=35)
    for n in (10, 20, 40):
        grid = MapGrid(-20, 20, 40 / n, n, n, "EPSG:32633")
        shade = shading.hillshade(shading.surface_slopes(Formula(f), grid, grid.window), light)
        v, u = np.mgrid[:n, :n]
        X, Y = np.moveaxis(grid.to_map(np.stack([u, v], axis=-1)), -1, 0)
        normal = np.stack([X, Y, f(X, Y)], axis=-1) / 50
        worst.append(np.abs(shade - normal @ shading.directions(light)[0]).max())
    assert worst[0] < 0.002
    # The outermost pixels, where it is worst, move outwards with n: a little less than 16.
    assert worst[0] / worst[2] > 12


def test_invariances() -> None:
    """Lifting the terrain changes nothing; turning terrain and sun turns the picture; exaggeration scales."""

    def f(X: np.ndarray, Y: np.ndarray) -> np.ndarray:
        return 3 * np.sin(X / 4) * np.cos(Y / 6) + 0.02 * X

    grid = MapGrid(-16, 16, 0.5, 64, 64, "EPSG:32633")

    def shade(surface: Formula, **light: Any) -> np.ndarray:
        return shading.hillshade(shading.surface_slopes(surface, grid, grid.window), shading.Lighting(**light))

    base = shade(Formula(f), azimuth=300)
    np.testing.assert_allclose(shade(Formula(lambda X, Y: f(X, Y) + 64), azimuth=300), base, atol=1e-4)
    turned = shade(Formula(lambda X, Y: f(-Y, X)), azimuth=30)
    np.testing.assert_allclose(np.rot90(turned, 1), base, atol=1e-5)
    np.testing.assert_allclose(
        shade(Formula(lambda X, Y: 2.5 * f(X, Y)), azimuth=300),
        shade(Formula(f), azimuth=300, exaggeration=2.5),
        atol=1e-4,
    )


def test_tiles_do_not_show() -> None:
    surface = Formula(lambda X, Y: np.sin(X) * np.cos(Y / 2))
    whole = shading.surface_slopes(surface, GRID, GRID.window).gradient
    for window in GRID.window.tiles(16):
        part = shading.surface_slopes(surface, GRID, window).gradient
        np.testing.assert_array_equal(part, whole[:, window.row : window.stop[1], window.col : window.stop[0]])


def test_a_breakline_shows_in_the_pixels_that_it_passes_only() -> None:
    """A roof with its ridge at X = 1010.1: one column of pixels is between, all others have their face's slope."""
    roof = Formula(lambda X, Y: -np.abs(X - 1010.1))
    gx = shading.surface_slopes(roof, GRID, GRID.window).gradient[0]
    edges = GRID.left + np.arange(GRID.width + 1) * 0.5
    inside = (edges[:-1] < 1010.1) & (edges[1:] > 1010.1)
    assert inside.sum() == 1
    np.testing.assert_allclose(gx[:, edges[1:] < 1010.1], 1, atol=1e-4)
    np.testing.assert_allclose(gx[:, edges[:-1] > 1010.1], -1, atol=1e-4)
    assert (np.abs(gx[:, inside]) < 1).all()


def test_the_border_of_the_surface_is_shaded_too() -> None:
    """A plane that ends inside pixels: its slope reaches as far as pixel centres have heights; NaN beyond."""
    surface = Formula(lambda X, Y: np.where((X + 0.3 * Y < 1612) & (X - 0.2 * Y > 604), 0.2 * X + 0.1 * Y, np.nan))
    slopes = shading.surface_slopes(surface, GRID, GRID.window)
    empty = np.isnan(slopes.heights)
    np.testing.assert_array_equal(np.isnan(slopes.gradient[0]), empty)
    np.testing.assert_allclose(slopes.gradient[0][~empty], 0.2, atol=2e-3)
    grey = shading.grey(shading.hillshade(slopes, shading.Lighting()))
    np.testing.assert_array_equal(grey == 0, empty)


def test_classes() -> None:
    values = np.array([[0, 4.999, 5, 9, 10, 80, np.nan]], np.float32)
    np.testing.assert_array_equal(shading.slope_classes(values, (5.0, 10.0)), [[1, 1, 2, 2, 3, 3, 0]])
    for wrong in ((), (5.0, 5.0), (5.0, np.nan)):
        with pytest.raises(UsageError):
            shading.slope_classes(values, wrong)


# -- tints -----------------------------------------------------------------------------------------------------------


def test_ramps_interpolate_or_class() -> None:
    text = "# sea\n0, 0 0 100\n100;100 200 0  # green\n\n50\t50 50 50\nnv 0 0 0\n"
    heights = np.array([[-5, 0, 25, 50, 99, 100, 500, np.nan]], np.float32)
    smooth = shading.parse_ramp(text, "a.txt")(heights)
    np.testing.assert_allclose(smooth[0, 0, :7], [0, 0, 25, 50, 99, 100, 100], atol=1e-4)
    assert np.isnan(smooth[:, 0, 7]).all()
    classed = shading.parse_ramp(text, "a.txt", classed=True)(heights)
    np.testing.assert_allclose(classed[1, 0, :7], [0, 0, 0, 50, 50, 200, 200])


@pytest.mark.parametrize(
    ("text", "message"),
    [("0 1 2\n", "line 1"), ("0 0 0 0\n5 a b c", "line 2"), ("0 0 0 300", "line 1"), ("# no\n", "no line"),
     ("1 0 0 0\n1 1 1 1", "two colours"), ("nan 0 0 0", "line 1")],
)  # fmt: skip
def test_fault_18_a_bad_ramp_names_its_line(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        shading.parse_ramp(text, "a.txt")


def test_built_in_ramps_span_their_range() -> None:
    ramp = shading.built_in_ramp("hypsometric", 100, 900)
    ends = np.array([[100, 900]], np.float32)
    np.testing.assert_allclose(ramp(ends)[:, 0, 0], shading.RAMPS["hypsometric"][0], atol=1e-3)
    np.testing.assert_allclose(ramp(ends)[:, 0, 1], shading.RAMPS["hypsometric"][-1], atol=1e-3)
    steps = shading.built_in_ramp("grey", 0, 10, 5)(np.array([[0, 1.9, 2, 9.9, 10]], np.float32))[0, 0]
    np.testing.assert_allclose(steps, [40, 40, 40 + 205 / 4, 245, 245], atol=1e-3)
    with pytest.raises(UsageError, match="hypsometric"):
        shading.built_in_ramp("nice", 0, 1)


def test_shading_keeps_the_colour_of_flat_ground() -> None:
    colours = np.full((3, 1, 4), 120, np.float32)
    shade = np.array([[0.5, 0.0, 1.0, np.nan]], np.float32)
    found = shading.shaded(colours, shade, 0.5, 1.0)[0, 0]
    np.testing.assert_allclose(found, [120, 0, 120 + 135 / 2, 120])


# -- GDAL's programs on the same heights ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def hills(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """A smooth terrain at posts of 1 m."""
    y, x = np.mgrid[:120, :150]
    heights = (20 * np.sin(x / 19) * np.cos(y / 23) + 0.1 * x).astype(np.float32)
    path = tmp_path_factory.mktemp("hills") / "hills.tif"
    transform = rasterio.transform.from_origin(500_000, 5_200_000, 1, 1)
    with rasterio.open(path, "w", driver="GTiff", width=150, height=120, count=1, dtype="float32",
                       crs="EPSG:32633", transform=transform) as file:  # fmt: skip
        file.write(heights, 1)
    return path, heights


@pytest.mark.parametrize(
    ("mode", "options", "tolerance"),
    [("hillshade", [], 2.0), ("hillshade", ["-multidirectional"], 3.0), ("slope", [], 0.6), ("aspect", [], 8.0)],
)
def test_gdaldem_agrees(
    hills: tuple[Path, np.ndarray], tmp_path: Path, mode: str, options: list[str], tolerance: float
) -> None:
    """Zevenbergen and Thorne's differences over two posts against ours over one pixel, on smooth terrain."""
    program = shutil.which("gdaldem")
    if program is None:
        pytest.skip("gdaldem is not installed")
    path, heights = hills
    subprocess.run([program, mode, path, tmp_path / "a.tif", "-alg", "ZevenbergenThorne", "-q", *options], check=True)
    with rasterio.open(tmp_path / "a.tif") as file:
        theirs = file.read(1).astype(float)

    surface = RasterSurface(Posts(heights), (500_000.5, 5_199_999.5), (1.0, 1.0))
    grid = MapGrid(500_000, 5_200_000, 1.0, 150, 120, "EPSG:32633")
    assert surface.relief(MapTarget(grid), grid.window)[7, 9] == heights[7, 9]
    slopes = shading.surface_slopes(surface, grid, grid.window)
    if mode == "hillshade":
        ours = shading.grey(shading.hillshade(slopes, shading.Lighting(multidirectional=bool(options)))).astype(float)
    elif mode == "slope":
        ours = shading.slope_degrees(slopes).astype(float)
    else:
        ours = shading.aspect(slopes).astype(float)
    steep = shading.slope_degrees(slopes) > 8
    inner = np.zeros(heights.shape, bool)
    inner[2:-2, 2:-2] = True
    off = ours - theirs
    if mode == "aspect":
        off, inner = (off + 180) % 360 - 180, inner & steep
    assert np.abs(off[inner]).max() < tolerance
    assert np.abs(off[inner]).mean() < tolerance / 6


@dataclass(frozen=True)
class Posts:
    heights: np.ndarray

    @property
    def size(self) -> tuple[int, int]:
        return self.heights.shape[1], self.heights.shape[0]

    def read(self, window: Window) -> np.ndarray:
        assert min(window.col, window.row, window.size - 1) >= 0
        assert window.stop[0] <= self.size[0] and window.stop[1] <= self.size[1]
        return self.heights[window.row : window.stop[1], window.col : window.stop[0]]


@given(
    st.floats(0.4, 7.0), st.floats(-3, 3), st.floats(-3, 3), st.integers(2, 9), st.integers(2, 9), st.booleans(),
    st.sampled_from([(1.0, 1.0), (2.0, 0.7)]), st.booleans(),
)  # fmt: skip
def test_rasters_of_planes_have_their_slope_up_to_the_border(
    resolution: float, gx: float, gy: float, columns: int, rows: int, void: bool, mesh: tuple[float, float], other: bool
) -> None:
    """The outer half cell, where heights go on level, and tiles of any size; also through another CRS."""
    y, x = np.mgrid[:rows, :columns]
    heights = (100 + gx * mesh[0] * x - gy * mesh[1] * y).astype(np.float32)
    if void and rows > 4 and columns > 4:
        heights[1, 2] = np.nan
    width, height = columns * mesh[0], rows * mesh[1]
    surface = RasterSurface(Posts(heights), (1000 + mesh[0] / 2, 2000 - mesh[1] / 2), mesh)
    if other:
        surface = replace(surface, to_grid_crs=lambda XY: XY + 0.0)
    grid = MapGrid.covering((1000, 2000 - height, 1000 + width, 2000), resolution, "EPSG:32633")
    slopes = shading.surface_slopes(surface, grid, grid.window)
    valid = np.isfinite(slopes.heights)
    found = slopes.gradient[:, valid]
    known = np.isfinite(found).all(axis=0)
    # A pixel that reaches beyond the terrain on both sides has nothing beside its middle.
    assert known.all() or void or resolution > 2 * min(width, height) / 3
    off = np.abs(found[:, known] - np.array([[gx], [gy]], np.float32))
    assert not known.any() or off.max() < 2e-4 / min(resolution, *mesh) + 1e-4
    for part in grid.window.tiles(13):
        again = shading.surface_slopes(surface, grid, part).gradient
        inside = np.s_[:, part.row : part.stop[1], part.col : part.stop[0]]
        np.testing.assert_allclose(again, slopes.gradient[inside], atol=2e-4 / resolution)


@pytest.mark.parametrize(
    "wrong", [{"altitude": 0}, {"altitude": 91}, {"azimuth": np.nan}, {"exaggeration": -1}, {"exaggeration": 1e300}]
)
def test_lights_that_cannot_be_meant_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(UsageError):
        shading.Lighting(**wrong)


def test_slopes_between_posts_that_are_far_apart_have_no_steps() -> None:
    """Posts of 5 m on a parabola, pixels of 0.5 m: its slope grows evenly, that of meshes in steps."""
    x = 1000.0 + 5.0 * np.arange(40)
    heights = np.tile(0.01 * (x - 1000) ** 2, (40, 1)).astype(np.float32)
    surface = RasterSurface(Posts(heights), (1000.0, 2000.0), (5.0, 5.0))
    window = Window(100, 100, 60, 4)
    grid = replace(GRID, width=300, height=300)
    found, steps = (f(surface, grid, window).gradient[0, 0] for f in (shading.even_slopes, shading.surface_slopes))
    want = 0.02 * (grid.to_map(np.stack([np.arange(100, 160), np.full(60, 100)], axis=1))[:, 0] - 1000)
    assert np.abs(found - want).max() < 0.006 < 0.04 < np.abs(steps - want).max()
