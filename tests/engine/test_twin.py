"""The engine against its slow exact twin."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from tools.arrays import noise, product
from tools.function_surface import FunctionSurface
from tools.kinds import FEW, KINDS
from tools.pinhole import Pinhole
from tools.thinned import examples, some
from tools.twin import TwinSource, twin_compose

from photoplan.engine.execute import ArrayReader, Source, render
from photoplan.errors import UsageError
from photoplan.geometry.grid import MapGrid, Window
from photoplan.geometry.pose import Pose
from photoplan.plan.footprint import Tile
from photoplan.plan.product import ProductPlan, compile_tile
from photoplan.plan.sources import GivenOwners, Share
from photoplan.surfaces.base import LevelSurface

Kinds = list[list[str]]
SMOOTH, SMOOTH_FEW = ([[name, dtype] for name, dtype in kinds if name != "nearest"] for kinds in (KINDS, FEW))
SIZE = (90, 70)


def camera(kappa: float, tilt: float = 0.05, k1: float = 0.0) -> Pinhole:
    """A small camera 100 m above level ground: a pixel is about 1 m there, and no position is on a round number."""
    return Pinhole(Pose.from_angles((0.123, 0.377, 100), (tilt, -tilt / 2, kappa)), 101.3, SIZE, k1)


def both(cam: Pinhole, resolution: float, kernel: str, reader: ArrayReader, half: int = 16):  # type: ignore[no-untyped-def]
    grid = MapGrid.covering(
        (-half * resolution, -half * resolution, half * resolution, half * resolution), resolution, "EPSG:32615"
    )
    return composed(product(grid, reduces=kernel != "nearest"), Tile(0, grid.window), [cam], [reader], kernel)


def composed(plan: ProductPlan, tile: Tile, cameras: list[Pinhole], readers: list[ArrayReader], kernel: str):  # type: ignore[no-untyped-def]
    """A tile by the engine and by the twin."""
    surface = LevelSurface(0.0)
    got = render(plan, tile, [Source(*pair) for pair in zip(cameras, readers)], surface, kernel)
    compiled = compile_tile(plan, tile, dict(enumerate(cameras)), surface)
    levels = {layer.source: layer.level for layer in compiled.layers}
    twins = [TwinSource(r.image, r.valid, c, levels.get(i, 0)) for i, (c, r) in enumerate(zip(cameras, readers))]
    want, good = twin_compose(plan.target, tile.window, surface, twins, compiled.owner, kernel)
    return got, want, good


def compare(got, want, good, dtype: str, slack: float) -> None:  # type: ignore[no-untyped-def]
    if dtype != "float32":
        limits = np.iinfo(dtype)
        want = np.clip(want, limits.min, limits.max)
    valid = np.zeros(good.shape, bool) if got.valid is None else got.valid
    # Positions differ by up to 1e-4 px: on the very edge of validity the two may decide differently, seldom.
    assert np.count_nonzero(valid != good) <= 3
    common = valid & good
    if got.values is not None:
        assert np.abs(got.values.astype(float) - want)[:, common].max(initial=0) <= slack
        assert (got.values[:, ~valid] == 0).all()


@pytest.mark.parametrize("kinds", some([SMOOTH_FEW, SMOOTH], 0), ids=["few", "all"])
@settings(max_examples=examples(9, 25), deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(
    kappa=st.floats(-3.1, 3.1),
    tilt=st.floats(-0.15, 0.15),
    kind=st.integers(0, 999),
    bands=st.sampled_from([1, 2, 3, 4, 5]),
    resolution=st.sampled_from([0.5, 0.9, 1.2, 2.0, 5.0]),
    holes=st.booleans(),
    seed=st.integers(0, 5),
)
def test_every_pixel_as_the_twin_says(
    kinds: Kinds, kappa: float, tilt: float, kind: int, bands: int, resolution: float, holes: bool, seed: int
) -> None:
    kernel, dtype = kinds[kind % len(kinds)]
    image = noise(bands, SIZE[1], SIZE[0], dtype, seed)
    valid = np.random.default_rng(seed).random((SIZE[1], SIZE[0])) > 0.1 if holes else None
    got, want, good = both(camera(kappa, tilt), resolution, kernel, ArrayReader(image, valid))
    # Rounding, plus what a position error of 1e-3 px makes of full-range noise.
    spread = 4.0 if dtype == "float32" else float(np.iinfo(dtype).max) - np.iinfo(dtype).min
    compare(got, want, good, dtype, 0.501 * (dtype != "float32") + 4e-3 * spread)


@pytest.mark.parametrize("kappa", [0.0, 0.7, 2.9])
def test_nearest_takes_the_same_pixel(kappa: float) -> None:
    got, want, good = both(camera(kappa), 0.8, "nearest", ArrayReader(noise(3, SIZE[1], SIZE[0], "float32")))
    # At a border between two pixels either is the nearest.
    assert np.mean((got.values != want).any(axis=0) & got.valid & good) < 1e-3


@pytest.mark.parametrize("resolution", [0.5, 3.0])
def test_distorted_lens_stays_within_its_tolerance(resolution: float) -> None:
    """A ramp in x turns a position into a grey value: the image of the engine's own position error."""
    ramp = np.broadcast_to(np.arange(SIZE[0], dtype=np.float32), (SIZE[1], SIZE[0]))[None].copy()
    got, want, good = both(camera(0.4, k1=-0.2), resolution, "bicubic", ArrayReader(ramp), half=12)
    assert got.residual <= 0.02
    common = got.valid & good
    assert common.sum() > 200
    assert np.abs(got.values[0] - want[0])[common].max() <= 0.02


def test_a_tile_with_too_large_a_source_is_cut_and_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    reader = ArrayReader(noise(3, 600, 800, "uint8"))
    cam = Pinhole(Pose.from_angles((0, 0, 100), (0.02, 0.01, 0.3)), 400.0, (800, 600))
    grid = MapGrid.covering((-80, -60, 80, 60), 0.4, "EPSG:32615")
    whole = render(product(grid), Tile(0, grid.window), [Source(cam, reader)], LevelSurface(0.0), "bicubic")
    monkeypatch.setattr("photoplan.engine.execute.MOST_SOURCE_BYTES", 100_000)
    parts = render(product(grid), Tile(0, grid.window), [Source(cam, reader)], LevelSurface(0.0), "bicubic")
    assert whole.valid is not None and parts.valid is not None and parts.values is not None
    assert np.count_nonzero(whole.valid != parts.valid) <= 3
    assert np.abs(whole.values.astype(int) - parts.values.astype(int)).max() <= 1


def test_a_window_beside_the_image_holds_nothing() -> None:
    reader = ArrayReader(noise(1, SIZE[1], SIZE[0], "uint8"))
    grid = MapGrid.covering((1000, 1000, 1100, 1100), 1.0, "EPSG:32615")
    nothing = render(
        product(grid), Tile(0, Window(0, 0, 64, 64)), [Source(camera(0.0), reader)], LevelSurface(0.0), "bicubic"
    )
    assert nothing.values is None and nothing.valid is None


@pytest.mark.parametrize("kinds", some([SMOOTH_FEW, SMOOTH], 0), ids=["few", "all"])
@settings(max_examples=examples(5, 15), deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(
    count=st.integers(2, 8),
    kind=st.integers(0, 999),
    bands=st.sampled_from([1, 3]),
    resolution=st.sampled_from([0.7, 1.2, 4.5]),
    holes=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_many_sources_compose_as_the_twin_says(
    kinds: Kinds, count: int, kind: int, bands: int, resolution: float, holes: bool, seed: int
) -> None:
    kernel, dtype = kinds[kind % len(kinds)]
    rng = np.random.default_rng(seed)
    half = 16
    side = half * resolution
    grid = MapGrid.covering((-side, -side, side, side), resolution, "EPSG:32615")
    cameras, readers = [], []
    for k in range(count):
        pose = Pose.from_angles((*rng.uniform(-20, 20, 2), 100), (*rng.uniform(-0.2, 0.2, 2), rng.uniform(-3, 3)))
        cameras.append(Pinhole(pose, 101.3, SIZE))
        valid = rng.random((SIZE[1], SIZE[0])) > 0.1 if holes else None
        readers.append(ArrayReader(noise(bands, SIZE[1], SIZE[0], dtype, seed + k), valid))
    # Compact regions, single pixels among them, and pixels that nobody may paint.
    nearest = rng.uniform(0, 2 * half, (count + 1, 2))
    v, u = np.mgrid[: 2 * half, : 2 * half]
    owner = np.argmin((u[..., None] - nearest[:, 0]) ** 2 + (v[..., None] - nearest[:, 1]) ** 2, axis=-1)
    loose = rng.random(owner.shape) < 0.05
    owner[loose] = rng.integers(0, count + 1, int(loose.sum()))
    names = tuple(f"image {k}" for k in range(count))
    plan = product(grid, names=names, owners=GivenOwners(owner.astype(np.uint16)))
    got, want, good = composed(plan, Tile(0, grid.window, tuple(range(count))), cameras, readers, kernel)
    spread = 4.0 if dtype == "float32" else float(np.iinfo(dtype).max) - np.iinfo(dtype).min
    compare(got, want, good, dtype, 0.501 * (dtype != "float32") + 4e-3 * spread)
    if got.valid is not None:
        np.testing.assert_array_equal(got.owner, np.where(got.valid, owner, 0))


def test_a_tile_of_one_owner_is_that_of_its_source_byte_by_byte() -> None:
    """Owners cut runs, and a cut changes no bit of what is left."""
    cameras = [camera(0.3), camera(1.9)]
    readers = [ArrayReader(noise(3, SIZE[1], SIZE[0], "uint8", k)) for k in range(2)]
    sources = [Source(*pair) for pair in zip(cameras, readers)]
    grid = MapGrid.covering((-25, -25, 25, 25), 0.8, "EPSG:32615")
    tile, surface = Tile(0, grid.window, (0, 1)), FunctionSurface(lambda X, Y: 3 * np.sin(X / 3) + np.cos(Y / 2))
    alone = [render(product(grid), Tile(0, grid.window), [source], surface, "lanczos3") for source in sources]
    rng = np.random.default_rng(1)
    owner = rng.integers(0, 3, (grid.height, grid.width)).astype(np.uint16)
    both = render(product(grid, names=("a", "b"), owners=GivenOwners(owner)), tile, sources, surface, "lanczos3")
    for number, single in enumerate(alone, 1):
        mine = owner == number
        np.testing.assert_array_equal(both.valid[mine], single.valid[mine])
        np.testing.assert_array_equal(both.values[:, mine], single.values[:, mine])
    assert not both.valid[owner == 0].any() and not both.values[:, owner == 0].any()


def test_owners_of_another_size_are_refused() -> None:
    grid = MapGrid.covering((-25, -25, 25, 25), 0.8, "EPSG:32615")
    owners = GivenOwners(np.ones((3, 3), np.uint16))
    with pytest.raises(UsageError, match=r"owners of shape \(3, 3\)"):
        compile_tile(product(grid, owners=owners), Tile(0, grid.window), {0: camera(0.3)}, LevelSurface(0.0))
    with pytest.raises(UsageError, match="say which of them paints"):
        product(grid, names=("a", "b"))


def test_owners_are_chosen_among_the_sources_of_the_tile_and_nobody_else_is_opened() -> None:
    """A rule (visibility, best image) gets the cameras that can paint in the tile, and what may hide its pixels."""
    asked: list[tuple[Any, ...]] = []

    class LastCamera:
        def share(self, ground: Any, cameras: Any, surface: Any) -> Share:
            asked.append((ground.window, dict(cameras), surface))
            if 3 not in cameras:
                return Share(np.zeros(ground.relief.shape, np.uint16))
            return Share(np.full(ground.relief.shape, max(cameras) + 1, np.uint16))

    grid, surface = MapGrid.covering((-25, -25, 25, 25), 0.8, "EPSG:32615"), LevelSurface(0.0)
    one, two = (Source(camera(k), ArrayReader(noise(1, SIZE[1], SIZE[0], "uint8", int(k)))) for k in (0.0, 1.0))
    table: list[Any] = [None, one, None, two]
    plan = product(grid, names=("a", "b", "c", "d"), owners=LastCamera())
    got = render(plan, Tile(0, grid.window, (1, 3)), table, surface, "bilinear")
    assert asked[0] == (grid.window, {1: one.camera, 3: two.camera}, surface)
    # Once more for pixels in which the one that was chosen has nothing.
    assert asked[1:] == [(grid.window, {1: one.camera}, surface)]
    alone = render(product(grid), Tile(0, grid.window), [two], surface, "bilinear")
    np.testing.assert_array_equal(got.values, alone.values)
    np.testing.assert_array_equal(got.owner, 4 * alone.valid)


def test_where_a_source_has_nothing_to_use_the_next_one_paints() -> None:
    """Masks and nodata are known when pixels are read, after owners were chosen."""

    class First:
        def share(self, ground: Any, cameras: Any, surface: Any) -> Share:
            hidden = np.zeros(ground.relief.shape, bool)
            hidden[:, :4] = 0 not in cameras
            owner = np.full(ground.relief.shape, min(cameras) + 1, np.uint16)
            return Share(np.where(hidden, 0, owner).astype(np.uint16), hidden)

    grid, surface = MapGrid.covering((-10, -10, 10, 10), 0.8, "EPSG:32615"), LevelSurface(0.0)
    masks = [np.ones((SIZE[1], SIZE[0]), bool) for _ in range(3)]
    masks[0][:, : SIZE[0] // 2] = masks[1][: SIZE[1] // 2] = False
    table = [
        Source(camera(0.0), ArrayReader(np.full((1, SIZE[1], SIZE[0]), 50 * (k + 1), np.uint8), mask))
        for k, mask in enumerate(masks)
    ]
    plan = product(grid, names=("a", "b", "c"), owners=First())
    got = render(plan, Tile(0, grid.window, (0, 1, 2)), table, surface, "bilinear")
    assert got.values is not None and got.valid is not None and got.owner is not None and got.hidden is not None
    np.testing.assert_array_equal(got.values[0], 50 * got.owner)
    assert set(np.unique(got.owner)) == {0, 1, 2, 3} and got.bare == 0
    # Only what the others do not see stays empty, and is told as hidden.
    np.testing.assert_array_equal(got.valid, ~got.hidden)
    assert (got.owner[:, -4:] == 1).all() and not got.hidden[:, 4:].any()
