"""A band that is tagged as alpha is a mask or a colour band by its values, unless the project states it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp
from scipy.ndimage import gaussian_filter
from tools.command import inside

from photoplan.geometry.grid import Window
from photoplan.io.raster import RasterReader

H, W = 200, 300
RNG = np.random.default_rng(4)
HARD = np.full((H, W), 255.0)
HARD[:, :90] = 0.0
TURNED = np.where(np.add.outer(np.arange(H), 0.4 * np.arange(W)) > 90, 255.0, 0.0)
PICTURE = 90 + 40 * gaussian_filter(RNG.normal(size=(H, W)), 4) * 8 + RNG.normal(0, 3, (H, W))
WATER = np.where(PICTURE < 60, 0.0, PICTURE)
MASKS = {
    "opaque": np.full((H, W), 255.0),
    "hard": HARD,
    "of a warp": np.clip(gaussian_filter(TURNED, 1.5), 0, 255),
    "half transparent": np.full((H, W), 128.0),
    "of two levels": np.where(HARD > 0, 128.0, 255.0),
    "nothing": np.zeros((H, W)),
    "a few soft pixels": np.where(RNG.random((H, W)) < 0.1, RNG.uniform(1, 254, (H, W)), 255.0),
}
PICTURES = {
    "near infrared": PICTURE,
    "dark": np.clip(PICTURE - 60, 0, 255),
    "with water": WATER,
    "speckled": np.where(RNG.random((H, W)) < 0.3, 0.0, PICTURE),
    "partly saturated": np.where(PICTURE > 120, 255.0, PICTURE),
}


def image(path: Path, alpha: np.ndarray, colours: int = 3, dtype: str = "uint8") -> Path:
    factor = {"uint8": 1.0, "uint16": 257.0, "float32": 1 / 255}[dtype]
    bands = np.stack([*RNG.uniform(20, 200, (colours, H, W)), alpha]) * factor
    bands = bands.astype(dtype) if dtype == "float32" else np.clip(bands, 0, None).round().astype(dtype)
    with rasterio.open(path, "w", driver="GTiff", width=W, height=H, count=colours + 1, dtype=dtype) as file:
        tags = [ColorInterp.red, ColorInterp.green, ColorInterp.blue] if colours == 3 else [ColorInterp.gray]
        file.colorinterp = [*tags, ColorInterp.alpha]
        file.write(bands)
    return path


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize("colours", [1, 3])
@pytest.mark.parametrize("kind", [*MASKS, *PICTURES])
def test_values_decide(tmp_path: Path, kind: str, colours: int, dtype: str) -> None:
    alpha = MASKS.get(kind, PICTURES.get(kind))
    assert alpha is not None
    reader = RasterReader(image(tmp_path / "a.tif", alpha, colours, dtype))
    assert reader.bands == colours + (kind in PICTURES)
    assert any("tagged as alpha but holds a picture" in text for text in reader.info.warnings) == (kind in PICTURES)
    pixels, valid = reader.read(Window(0, 0, W, H))
    assert len(pixels) == reader.bands
    if kind in PICTURES:
        assert valid is None
    else:
        with rasterio.open(tmp_path / "a.tif") as file:
            stored = file.read(colours + 1)
        assert np.array_equal(np.ones((H, W), bool) if valid is None else valid, stored > 0)


def test_what_is_stated_holds(tmp_path: Path) -> None:
    picture, mask = image(tmp_path / "p.tif", PICTURE), image(tmp_path / "m.tif", HARD)
    assert RasterReader(picture, alpha=True).bands == 3
    assert RasterReader(mask, alpha=False).bands == 4
    assert RasterReader(picture, alpha=False).info.warnings == ()


def test_an_orthophoto_keeps_the_near_infrared(tmp_path: Path, shared: Path) -> None:
    folder = tmp_path / "p"
    folder.mkdir()
    for file in (shared / "cases/13_rgbn_as_alpha").iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    done = inside("ortho", str(folder / "project.toml"), "--resolution", "2", "-o", str(tmp_path / "out"))
    assert done.code == 0
    assert "band 4 is tagged as alpha but holds a picture" in done.err
    with rasterio.open(tmp_path / "out" / "img_ortho.tif") as product:
        assert product.count == 4
        assert product.colorinterp[3] == ColorInterp.undefined
    text = (folder / "project.toml").read_text()
    (folder / "project.toml").write_text(text.replace('file = "img.tif"', 'file = "img.tif"\nalpha = true'))
    assert inside("ortho", str(folder / "project.toml"), "--resolution", "2", "-o", str(tmp_path / "as_mask")).code == 0
    with rasterio.open(tmp_path / "as_mask" / "img_ortho.tif") as product:
        assert product.count == 3
