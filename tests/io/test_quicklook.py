"""Small pictures: right place, right colours, transparent where there is nothing."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import MapGrid
from photoplan.io.product import ProductFile, write_overview, write_quicklook


def product(
    path: Path, left: float, colour: tuple[int, ...], *, size: int = 800, dtype: str = "uint8", **more: Any
) -> Path:
    """One colour, its lower right quarter invalid."""
    grid = MapGrid(left, 1000, 1, size, size, more.pop("crs", "EPSG:32633"))
    with ProductFile(path, grid.placement, len(colour), np.dtype(dtype), run_key="k", tile=256, **more) as file:
        for index, w in enumerate(file.windows):
            y, x = np.mgrid[w.row : w.stop[1], w.col : w.stop[0]]
            pixels = np.empty((len(colour), *x.shape), dtype)
            pixels[:] = np.array(colour)[:, None, None]
            file.append(index, pixels, (x < size // 2) | (y < size // 2))
        file.complete()
    return path


def png(path: Path) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with rasterio.open(path) as file:
            assert (file.driver, file.count) == ("PNG", 4)
            return np.asarray(file.read())


@pytest.mark.parametrize("nodata", ["auto", "mask"])
def test_one_product(tmp_path: Path, nodata: Any) -> None:
    source = product(tmp_path / "a.tif", 0, (200, 100, 50), nodata=nodata)
    found = png(write_quicklook(source, tmp_path / "a.png", max_side=200))
    assert found.shape == (4, 200, 200)
    assert (found[:, :95].reshape(4, -1) == np.array([[200], [100], [50], [255]])).all()
    assert (found[3, 105:, 105:] == 0).all()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.png", "a.tif"]


@pytest.mark.parametrize(("dtype", "bands"), [("uint16", 1), ("float32", 2), ("int16", 5)])
def test_other_types_and_bands_are_shown(tmp_path: Path, dtype: str, bands: int) -> None:
    grid = MapGrid(0, 0, 1, 300, 300, "EPSG:32633")
    with ProductFile(tmp_path / "a.tif", grid.placement, bands, np.dtype(dtype), run_key="k") as file:
        ramp = np.broadcast_to(np.arange(300) * 30 + 100, (bands, 300, 300)).astype(dtype)
        file.append(0, ramp)
        file.complete()
    found = png(write_quicklook(tmp_path / "a.tif", tmp_path / "a.png"))
    assert found.shape == (4, 300, 300)
    assert (found[3] == 255).all()
    assert (np.diff(found[0, 0].astype(int)) >= 0).all()
    assert (found[0, 0, 0], found[0, 0, -1]) == (0, 255)


def test_many_products_lie_where_the_map_says(tmp_path: Path) -> None:
    """Two overlapping by half: the first lies on top, the second is seen where the first has nothing."""
    first = product(tmp_path / "a.tif", 0, (200, 0, 0), nodata="mask")
    second = product(tmp_path / "b.tif", 400, (0, 0, 200), nodata="mask")
    elsewhere = product(tmp_path / "c.tif", 0, (9, 9, 9), crs="EPSG:32634")
    path = write_overview([first, second, elsewhere], tmp_path / "all.png", max_side=240)
    assert path is not None
    found = png(path)
    assert found.shape == (4, 160, 240)
    # Map places (x, y from the top left, metres) and the colour there; a pixel is five metres.
    for x, y, colour in [
        (200, 200, (200, 0, 0, 255)),
        (600, 200, (200, 0, 0, 255)),
        (600, 600, (0, 0, 200, 255)),
        (1000, 200, (0, 0, 200, 255)),
        (1000, 600, (0, 0, 0, 0)),
    ]:
        assert tuple(found[:, y // 5, x // 5].tolist()) == colour


def test_small_products_make_a_small_picture(tmp_path: Path) -> None:
    """No finer than the finest of them."""
    products = [product(tmp_path / f"{left}.tif", left, (9, 9, 9), size=100) for left in (0, 50)]
    path = write_overview(products, tmp_path / "all.png")
    assert path is not None and png(path).shape == (4, 100, 150)


def test_nothing_and_nonsense(tmp_path: Path) -> None:
    assert write_overview([], tmp_path / "all.png") is None
    with pytest.raises(UsageError, match="16 to 20,000"):
        write_overview([], tmp_path / "all.png", max_side=5)
    with pytest.raises(InputError, match="no such file"):
        write_quicklook(tmp_path / "absent.tif", tmp_path / "a.png")
    (tmp_path / "file").touch()
    source = product(tmp_path / "a.tif", 0, (1, 2, 3), size=100)
    with pytest.raises(UsageError, match=r"file/a\.png: cannot be written"):
        write_quicklook(source, tmp_path / "file" / "a.png")
