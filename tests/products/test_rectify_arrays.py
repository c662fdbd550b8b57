"""The whole chain as one function: arrays and files in, a raster out; any target, any projection."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from tools.other_geometry import Cylinder, Wall, like_a_satellite
from tools.twin import TwinSource, twin_compose

import photoplan
from photoplan.cameras import NoLens, OpenCV
from photoplan.errors import InputError, UsageError

SIZE = (300, 220)
GRID = photoplan.MapGrid.covering((-20, -15, 20, 15), 0.5, "EPSG:32633")


def camera(lens: Any = None, **pose: Any) -> Any:
    """A nearly vertical image 100 m above the origin."""
    interior = photoplan.Interior.digital(SIZE, (400.0, 400.0))
    at = {"center": (1.0, -2.0, 100.0), "angles": (0.03, -0.02, 0.4)} | pose
    return photoplan.FrameCamera(interior, NoLens() if lens is None else lens, photoplan.Pose.from_angles(*at.values()))


def smooth(bands: int = 1, size: tuple[int, int] = SIZE, seed: int = 0) -> NDArray[np.float32]:
    """Grey values whose steepest slope is known."""
    rng = np.random.default_rng(seed)
    return gaussian_filter(rng.normal(0, 300, (bands, size[1], size[0])), (0, 3, 3)).astype(np.float32)


def as_the_twin(raster: Any, sources: list[TwinSource], target: Any, surface: Any, owner: Any = None) -> None:
    want, good = twin_compose(target, target.window, surface, sources, owner, "bicubic")
    both = raster.valid & good
    assert both.mean() > 0.3 and np.mean(raster.valid != good) < 0.01
    slope = max(float(np.abs(np.gradient(s.image, axis=(1, 2))).max()) for s in sources)
    assert np.abs(raster.values - want)[:, both].max() <= 0.02 * slope + 1e-3
    assert raster.residual <= 0.02


def test_an_array_becomes_an_orthophoto() -> None:
    image, cam = smooth(3), camera(OpenCV(k1=-0.1))
    got = photoplan.rectify(image, cam, GRID, 2.0, workers=2, tile=32)
    as_the_twin(got, [TwinSource(image, None, cam)], photoplan.MapTarget(GRID), photoplan.LevelSurface(2.0))
    assert (got.placement.bounds, got.placement.crs) == (GRID.bounds, "EPSG:32633")
    whole = photoplan.rectify(image, cam, GRID, 2.0)
    # Tiles have cells of their own, each within the tolerance.
    both = got.valid & whole.valid
    slope = np.abs(np.gradient(image, axis=(1, 2))).max()
    assert np.abs(got.values - whole.values)[:, both].max() <= 0.04 * slope and np.mean(got.valid != whole.valid) < 0.01


def test_a_wall_a_cylinder_and_rational_polynomials_need_nothing_new() -> None:
    image, flat = smooth(), photoplan.LevelSurface(0.3)
    level = photoplan.Pose.from_angles((0.0, -30.0, 5.0), (np.pi / 2, 0.0, 0.0))
    before = photoplan.FrameCamera(photoplan.Interior.digital(SIZE, (400.0, 400.0)), NoLens(), level)
    wall = Wall((-4.0, 0.0, 8.0), (1.0, 0.0, 0.0), 0.1, (70, 40))
    as_the_twin(photoplan.rectify(image, before, wall, flat), [TwinSource(image, None, before)], wall, flat)
    column = Cylinder((0.0, 0.0), 8.0, 5.0, 0.1, (314, 24))
    got = photoplan.rectify(image, before, column, flat)
    as_the_twin(got, [TwinSource(image, None, before)], column, flat)
    space = like_a_satellite(SIZE)
    ground = photoplan.LevelSurface(110.0)
    grid = photoplan.MapGrid.covering((-20, -12, 20, 12), 0.5, "EPSG:32633")
    got = photoplan.rectify(image, space, grid, ground)
    as_the_twin(got, [TwinSource(image, None, space)], photoplan.MapTarget(grid), ground)


def test_several_sources_are_composed_by_their_owners() -> None:
    cameras = [camera(), camera(angles=(-0.05, 0.04, 2.0))]
    images = [smooth(seed=1), smooth(seed=2)]
    owner = np.ones((GRID.height, GRID.width), int)
    owner[:, 30:] = 2
    owner[:5] = 0
    got = photoplan.rectify(images, cameras, GRID, 0.0, owner=owner)
    twins = [TwinSource(i, None, c) for i, c in zip(images, cameras)]
    as_the_twin(got, twins, photoplan.MapTarget(GRID), photoplan.LevelSurface(0.0), owner)
    assert got.owner is not None and set(np.unique(got.owner[got.valid])) == {1, 2} and not got.valid[:5].any()


def test_whatever_holds_pixels_is_a_source(tmp_path: Path) -> None:
    image = (128 + np.clip(smooth(3), -100, 100)).astype(np.uint8)
    profile = {"driver": "GTiff", "width": SIZE[0], "height": SIZE[1], "count": 3, "dtype": "uint8", "nodata": 255}
    with rasterio.open(tmp_path / "a.tif", "w", **profile) as file:
        file.write(image)
    want = photoplan.rectify(image, camera(), GRID, 0.0)
    masked = np.ma.masked_equal(image, 255)
    with rasterio.open(tmp_path / "a.tif") as file, rasterio.MemoryFile((tmp_path / "a.tif").read_bytes()) as memory:
        for source in (tmp_path / "a.tif", str(tmp_path / "a.tif"), file, memory.open(), masked):
            got = photoplan.rectify(source, camera(), GRID, 0.0)
            np.testing.assert_array_equal(got.values, want.values)
    single = photoplan.rectify(image[0], camera(), GRID, 0.0)
    np.testing.assert_array_equal(single.values[0], want.values[0])
    floats = smooth()
    floats[0, 100:130, 140:170] = np.nan
    holed = photoplan.rectify(floats, camera(), GRID, 0.0)
    assert np.isfinite(holed.values).all() and 0 < np.count_nonzero(want.valid & ~holed.valid) < 400


def test_a_raster_is_saved_and_goes_to_xarray(tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray", reason="xarray is not installed")
    got = photoplan.rectify(smooth(2), camera(), GRID, 0.0)
    path = got.save(tmp_path / "a.tif")
    with rasterio.open(path) as file:
        assert file.bounds == GRID.bounds and file.crs.to_epsg() == 32633
        values = file.read(masked=True)
        np.testing.assert_array_equal(values.filled(0)[:, got.valid], got.values[:, got.valid])
        np.testing.assert_array_equal(~values.mask.all(axis=0), got.valid)
    with pytest.raises(UsageError, match="exists already"):
        got.save(path)
    array = got.to_xarray()
    assert isinstance(array, xarray.DataArray) and array.dims == ("band", "y", "x")
    X, Y = GRID.to_map((7, 3))
    assert (float(array.x[7]), float(array.y[3])) == (X, Y)
    np.testing.assert_array_equal(np.isfinite(array[0]), got.valid)
    assert array.spatial_ref.attrs["crs_wkt"].startswith("PROJCRS")


def test_heights_come_from_a_file(tmp_path: Path) -> None:
    profile = {"driver": "GTiff", "width": 40, "height": 40, "count": 1, "dtype": "float32", "crs": "EPSG:32633"}
    profile |= {"transform": rasterio.Affine(2, 0, -40, 0, -2, 40)}
    with rasterio.open(tmp_path / "dtm.tif", "w", **profile) as file:
        file.write(np.full((1, 40, 40), 3.0, np.float32))
    want = photoplan.rectify(smooth(), camera(), GRID, 3.0)
    got = photoplan.rectify(smooth(), camera(), GRID, tmp_path / "dtm.tif")
    np.testing.assert_allclose(got.values, want.values, atol=1e-3)


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    image = smooth()
    for arguments, message in (
        ((image[:, :-1], camera(), GRID, 0.0), "source 1 has 300 × 219 pixels, its camera has 300 × 220"),
        (([image], [camera(), camera()], GRID, 0.0), "1 sources and 2 cameras"),
        (
            ([image, image.astype(np.uint8)], [camera(), camera()], GRID, 0.0),
            "source 2 has 1 bands of uint8",
        ),
        (([image, image], [camera(), camera()], GRID, 0.0), "say which of them paints"),
        ((image.astype(np.int64), camera(), GRID, 0.0), "type int64"),
        ((7, camera(), GRID, 0.0), "source: int 7"),
    ):
        with pytest.raises(UsageError, match=message):
            photoplan.rectify(*arguments)
    with pytest.raises(UsageError, match="kernel 'cubic'; allowed are"):
        photoplan.rectify(image, camera(), GRID, 0.0, kernel="cubic")
    with pytest.raises(UsageError, match="whole numbers from 0 to 1"):
        photoplan.rectify([image], [camera()], GRID, 0.0, owner=np.full((GRID.height, GRID.width), 2))
    with pytest.raises(InputError, match=r"none\.tif"):
        photoplan.rectify(tmp_path / "none.tif", camera(), GRID, 0.0)


def test_every_public_name_is_there_and_hides_no_module() -> None:
    import importlib
    import pkgutil

    names = ("cameras", "matching", "orientation", "quality", "radiometry", "surfaces", "targets", "terrain")
    packages = [photoplan, *(getattr(photoplan, name) for name in names)]
    verbs = {"plan_surface", "make_surface", "plan_view", "find_ties", "register", "balance_project", "make_seams"}
    assert verbs <= set(dir(photoplan))
    for package in packages:
        modules = {m.name for m in pkgutil.iter_modules(package.__path__)}
        assert set(dir(package)) >= set(package.__all__)
        for name in package.__all__:
            found = getattr(package, name)
            assert name not in modules or found is importlib.import_module(f"{package.__name__}.{name}"), name
            assert getattr(found, "__doc__", None) or name.startswith("__"), name
