"""`photoplan ortho --accuracy` and `mosaic --accuracy`: a raster of standard deviations beside the product."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.command import Here, edit
from tools.small_block import NAMES, X0, Y0, write_block

from photoplan.io.project.file import load_project

SIGMAS = "sigma_center = [0.1, 0.2, 0.3]\nsigma_angles = [0.01, 0.02, 0.03]"
TERRAIN = 0.6
ONE = ("--images", "one", "--resolution", 3, "--accuracy", "--no-quicklook")


@pytest.fixture
def stated(tmp_path: Path) -> Path:
    """A project that states all its errors."""
    project = write_block(tmp_path).project
    edit(project, "[terrain]", f"[terrain]\nsigma = {TERRAIN}")
    for name in NAMES:
        edit(project, f'name = "{name}"', f'name = "{name}"\n{SIGMAS}')
    return project


def pixels_of(path: Path) -> np.ndarray:
    with rasterio.open(path) as file:
        return file.read()


def test_accuracy_of_an_orthophoto(photoplan: Here, stated: Path) -> None:
    said = photoplan("ortho", stated, *ONE, "--tile", 128)
    assert said.code == 0, said.err
    folder = stated.parent / "products"
    names = ("sigma_x", "sigma_y", "sigma_z", "semi_major", "semi_minor", "azimuth")
    with rasterio.open(folder / "one_ortho_accuracy.tif") as file, rasterio.open(folder / "one_ortho.tif") as product:
        assert file.descriptions == names and file.units == ("m", "m", "m", "m", "m", "degree")
        assert file.transform == product.transform
        found, painted = file.read(), product.dataset_mask() > 0
        row, col = file.index(X0, Y0)
        x, y = file.xy(*np.nonzero(painted))
    known = np.isfinite(found).all(axis=0)
    assert (known == painted).all() and known.sum() > 1000
    # The terrain is gentle: its error shows with the tangent of the ray.
    tangent = np.hypot(np.subtract(x, X0), np.subtract(y, Y0)) / 300
    far = tangent > 0.4
    radial = np.hypot(*found[:2])
    assert 0.25 < radial[row, col] < 0.4 and (radial[known][far] > 0.55 * TERRAIN * tangent[far]).all()
    assert np.hypot(*found[3:5])[known] == pytest.approx(radial[known], rel=1e-5)
    record = json.loads((folder / "one_ortho.run.json").read_text())["product"]["accuracy_m"]
    assert record["median"] == pytest.approx(np.median(radial[known]), rel=0.03)
    assert record["p95"] == pytest.approx(np.quantile(radial[known], 0.95), rel=0.03)
    assert f"median {record['median']:.3g} m" in said.err and "one_ortho_accuracy.tif" in said.err


def test_a_mosaic_has_the_errors_of_who_paints(photoplan: Here, stated: Path) -> None:
    text = stated.read_text()
    at = text.index('name = "three"')
    worse = text[at:].replace("sigma_center = [0.1, 0.2, 0.3]", "sigma_center = [9.0, 9.0, 9.0]", 1)
    stated.write_text(text[:at] + worse)
    said = photoplan("mosaic", stated, "--resolution", 3, "--accuracy", "--sources", "--no-quicklook")
    assert said.code == 0, said.err
    folder = stated.parent / "products"
    found, (sources,) = pixels_of(folder / "mosaic_accuracy.tif"), pixels_of(folder / "mosaic_sources.tif")
    names = [image.name for image in load_project(stated).images]
    bad = sources == names.index("three") + 1
    good = (sources > 0) & ~bad
    assert bad.sum() > 100 and good.sum() > 100
    assert (found[0][bad] > 8).all() and (found[0][good] < 1).all()


def test_other_tiles_say_the_same(photoplan: Here, stated: Path, tmp_path: Path) -> None:
    """To the hundredth to which figures between nodes are good."""
    rasters = []
    for side in (128, 256):
        folder = tmp_path / f"made{side}"
        said = photoplan("ortho", stated, *ONE, "--output", folder, "--tile", side)
        assert said.code == 0, said.err
        rasters.append(pixels_of(folder / "one_ortho_accuracy.tif"))
    np.testing.assert_allclose(rasters[0][:4], rasters[1][:4], rtol=0.01)


def test_another_accuracy_is_another_product(photoplan: Here, stated: Path) -> None:
    keys = []
    record = stated.parent / "products" / "one_ortho.run.json"
    for words in (ONE, ONE, tuple(word for word in ONE if word != "--accuracy")):
        assert photoplan("ortho", stated, *words, "--overwrite").code == 0
        keys.append(json.loads(record.read_text())["key"])
        stated.write_text(stated.read_text().replace(f"sigma = {TERRAIN}", "sigma = 1.2"))
    assert len(set(keys)) == 3


def test_what_is_not_known_is_refused_before_any_work(photoplan: Here, tmp_path: Path) -> None:
    project = write_block(tmp_path).project
    said = photoplan("ortho", project, "--accuracy")
    assert said.code == 3 and "state sigma = METRES in [terrain]" in said.err
    edit(project, "[terrain]", "[terrain]\nsigma = 0.5")
    said = photoplan("ortho", project, "--accuracy")
    assert said.code == 3 and "nothing is known of the accuracy of its orientation" in said.err
    edit(project, 'name = "one"', 'name = "one"\nsigma_center = [1e300, 0.1, 0.1]\nsigma_angles = [0.01, 0.01, 0.01]')
    said = photoplan("ortho", project, *ONE)
    assert said.code == 3 and "sigma_center[1]: 1e+300" in said.err
    edit(project, "sigma = 0.5", "sigma = 1e300")
    said = photoplan("ortho", project, *ONE)
    assert said.code == 3 and "1e+300" in said.err
    assert not (tmp_path / "products").exists()


@pytest.mark.drawn
def test_it_is_drawn(photoplan: Here, stated: Path) -> None:
    pytest.importorskip("matplotlib")
    said = photoplan("ortho", stated, *ONE[:-1])
    assert said.code == 0, said.err
    picture = stated.parent / "products" / "one_ortho_accuracy.png"
    assert picture.read_bytes().startswith(b"\x89PNG") and str(picture) in said.err
