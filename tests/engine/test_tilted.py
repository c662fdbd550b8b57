"""Pixels that cover much more of a source along the view than across it: views over ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from tools.thinned import some

from photoplan.engine.execute import ArrayReader, Painted, Source, render
from photoplan.geometry.grid import Placement, Window
from photoplan.kernels.footprint import depth_tilt
from photoplan.plan.anchors import AnchorRule
from photoplan.plan.footprint import Tile, Tiles
from photoplan.plan.product import CompiledTile, ProductPlan, compile_tile
from photoplan.targets.map import Target

SIDE = 1600
HEIGHT = 40.0


@dataclass(frozen=True, eq=False)
class Picture:
    """What a camera would see that looks along `azimuth` and down; h is the depth along its axis."""

    azimuth: float = 30.0
    down: float = 12.0
    size: tuple[int, int] = (160, 120)
    focal: float = 160.0
    breaks = None

    @property
    def window(self) -> Window:
        return Window(0, 0, *self.size)

    @property
    def placement(self) -> Placement:
        raise AssertionError("nothing is written")

    def to_ground(self, uvh: ArrayLike) -> NDArray[np.float64]:
        uvh = np.asarray(uvh, float)
        (ca, sa), (cd, sd) = (
            (np.cos(angle), np.sin(angle)) for angle in (np.radians(self.azimuth), np.radians(self.down))
        )
        forward, right = np.array([sa * cd, ca * cd, -sd]), np.array([ca, -sa, 0.0])
        u, v = ((uvh[..., k] - (self.size[k] - 1) / 2) / self.focal for k in (0, 1))
        ray = forward + u[..., None] * right + v[..., None] * np.cross(forward, right)
        return np.array([0.0, 0.0, HEIGHT]) + uvh[..., 2:] * ray


class Plain:
    """The level ground, seen from above it."""

    def relief(self, target: Target, window: Window) -> NDArray[np.float32]:
        rows, cols = np.mgrid[window.row : window.stop[1], window.col : window.stop[0]].astype(float)
        fall = HEIGHT - target.to_ground(np.stack([cols, rows, np.ones_like(cols)], axis=-1))[..., 2]
        return np.where(fall > HEIGHT / 700, HEIGHT / np.maximum(fall, 1e-9), np.nan).astype(np.float32)


@dataclass(frozen=True)
class Map:
    """A raster with pixels of a metre around the origin."""

    size: tuple[int, int] = (SIDE, SIDE)
    field = None
    breaks = None

    def project_homogeneous(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        XYZ = np.asarray(XYZ, float)
        x, y = XYZ[..., 0] + (SIDE - 1) / 2, (SIDE - 1) / 2 - XYZ[..., 1]
        return np.stack([x, y, np.ones_like(x)], axis=-1)


def seen(
    pixels: NDArray, picture: Picture, kernel: str = "bilinear", window: Window | None = None, tilted: bool = True
) -> tuple[CompiledTile, Painted]:
    plan = ProductPlan(
        name="view",
        sources=("map",),
        target=picture,
        rule=AnchorRule.of(kernel, 0.02, tilted=tilted),
        tiles=Tiles.every(picture.window, 512),
    )
    tile = Tile(0, window or picture.window)
    compiled = compile_tile(plan, tile, {0: Map()}, Plain())
    return compiled, render(plan, tile, [Source(Map(), ArrayReader(pixels))], Plain(), kernel)


def chess(cell: int) -> NDArray[np.uint8]:
    rows, cols = np.mgrid[:SIDE, :SIDE] // cell
    return ((rows + cols) % 2 * 200 + 20).astype(np.uint8)[None]


def by_rays(pixels: NDArray, picture: Picture, side: int = 24) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Mean of what side × side rays of every pixel meet; whether all of them meet the map."""
    rows, cols = np.mgrid[: picture.size[1], : picture.size[0]].astype(float)
    total, met = np.zeros(rows.shape), np.ones(rows.shape, bool)
    for across, down in np.ndindex(side, side):
        uv = [cols + (across + 0.5) / side - 0.5, rows + (down + 0.5) / side - 0.5]
        ray = picture.to_ground(np.stack([*uv, np.ones_like(cols)], axis=-1)) - (0, 0, HEIGHT)
        depth = np.where(ray[..., 2] < -1e-3, HEIGHT / np.maximum(-ray[..., 2], 1e-3), np.nan)
        xy = Map().project_homogeneous(depth[..., None] * ray)[..., :2]
        with np.errstate(invalid="ignore"):
            inside = ((xy > -0.5) & (xy < SIDE - 0.5)).all(axis=-1)
        x, y = np.where(inside[..., None], np.rint(xy), 0).astype(int).transpose(2, 0, 1)
        total, met = total + pixels[0, y, x], met & inside
    return total / side**2, met


@pytest.mark.parametrize(
    "azimuth", [pytest.param(0.0, marks=pytest.mark.slow), 30.0, pytest.param(45.0, marks=pytest.mark.slow)]
)
def test_a_pixel_is_the_mean_of_what_it_covers(azimuth: float) -> None:
    picture, pixels = Picture(azimuth), chess(12)
    truth, met = by_rays(pixels, picture)
    _, painted = seen(pixels, picture)
    assert painted.valid is not None and painted.values is not None
    assert painted.valid[met].mean() > 0.98 and (met & painted.valid).sum() > 10_000
    error = (painted.values[0].astype(float) - truth)[met & painted.valid]
    plain = seen(pixels, picture, tilted=False)[1].values
    assert plain is not None
    wrong = (plain[0].astype(float) - truth)[met & painted.valid]
    # Bilinear kernels are a little wider than pixels; without the tilt most far pixels are wrong.
    assert np.sqrt(np.mean(error**2)) < 14 < 30 < np.sqrt(np.mean(wrong**2))
    assert abs(error.mean()) < 0.5


def test_a_chessboard_far_away_is_grey() -> None:
    picture, pixels = Picture(), chess(4)
    compiled, painted = seen(pixels, picture)
    assert painted.values is not None and painted.valid is not None
    far = painted.valid & (compiled.relief > 500)
    assert far.sum() > 100
    grey = painted.values[0][far].astype(float)
    plain = seen(pixels, picture, tilted=False)[1].values
    assert plain is not None and plain[0][far].astype(float).std() > 30
    assert abs(grey.mean() - 120) < 1 and grey.std() < 8
    assert painted.values[0][painted.valid & (compiled.relief < 80)].astype(float).std() > 70


def test_far_ground_is_read_reduced_and_near_ground_is_not() -> None:
    compiled, _ = seen(chess(12), Picture())
    levels = [layer.level for layer in compiled.layers]
    assert levels == sorted(set(levels)) and levels[0] == 0 and levels[-1] >= 1
    depths = [np.median(compiled.relief[layer.owner == 1]) for layer in compiled.layers if layer.owner is not None]
    assert depths == sorted(depths) and len(depths) == len(levels)
    # Each pixel is painted once, and no level reads what only another one needs.
    assert np.sum([layer.owner for layer in compiled.layers], axis=0).max() == 1
    assert max(layer.anchors.source_window.size for layer in compiled.layers[1:]) < SIDE**2 / 4


def test_parts_of_a_tile_are_the_tile() -> None:
    picture, pixels = Picture(), np.random.default_rng(3).integers(0, 255, (3, SIDE, SIDE)).astype(np.uint8)
    _, whole = seen(pixels, picture)
    assert whole.values is not None and whole.valid is not None
    for part in (Window(0, 0, 80, 120), Window(80, 30, 80, 50)):
        _, painted = seen(pixels, picture, window=part)
        rows, cols = part.slices(picture.window)
        assert painted.values is not None and painted.valid is not None
        assert (painted.valid == whole.valid[rows, cols]).mean() > 0.9999
        difference = painted.values.astype(int) - whole.values[:, rows, cols]
        assert np.abs(difference[:, painted.valid]).max() <= 1


@pytest.mark.parametrize("kernel", some(["bilinear", "bicubic", "lanczos3"], 1))
@pytest.mark.parametrize("dtype", some(["uint8", "uint16", "float32"], 0, 2))
def test_constant_sources_stay_constant_and_their_edge_is_not_dark(dtype: str, kernel: str) -> None:
    pixels = np.full((2, SIDE, SIDE), 173, dtype)
    _, painted = seen(pixels, Picture(), kernel)
    assert painted.values is not None and painted.valid is not None
    np.testing.assert_allclose(painted.values[:, painted.valid].astype(float), 173, rtol=2e-7)
    assert not painted.valid.all() and not painted.values[:, ~painted.valid].any()


def test_nearest_keeps_grey_values() -> None:
    classes = np.array([3, 50, 200], np.uint8)[np.random.default_rng(1).integers(0, 3, (1, SIDE, SIDE))]
    compiled, painted = seen(classes, Picture(), "nearest")
    assert painted.values is not None and painted.valid is not None and compiled.tilt is None
    assert set(np.unique(painted.values[0][painted.valid])) == {3, 50, 200}


def test_a_silhouette_belongs_to_neither_side() -> None:
    depth = np.fromfunction(lambda row, col: 100 + 2 * col - 3 * row, (6, 9)).astype(np.float32)
    depth[:, 5:] += 1000
    tilt = depth_tilt(depth, (1, 2, 0, 1))
    assert tilt.shape == (2, 3, 8) and (tilt[0] == 2).all() and (tilt[1] == -3).all()
    depth[2, 4] = np.nan
    tilt = depth_tilt(depth, (0, 0, 0, 0))
    assert np.isfinite(tilt).all() and tilt[0, 2, 3] == 2 and tilt[0, 2, 4] == 0
    assert (depth_tilt(np.full((1, 1), 5, np.float32), (0, 0, 0, 0)) == 0).all()
