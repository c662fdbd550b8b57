"""What takes minutes: real tiles against the twin with every kernel, and the memory of a large product."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.command import peak_of
from tools.real_projects import drone_project
from tools.twin import strict_positions, strict_scales, twin_resample

from photoplan.engine.execute import Source, render
from photoplan.geometry.grid import Window
from photoplan.io.project.file import load_project
from photoplan.plan.footprint import Tile
from photoplan.products.init import InitRequest, init_project
from photoplan.products.orthophoto.plan import plan_orthophotos
from photoplan.project.scene import open_scene

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def project(block: Path, tmp_path_factory: pytest.TempPathFactory):
    return load_project(drone_project(block, tmp_path_factory.mktemp("brighton")))


@pytest.mark.parametrize("kernel", ["nearest", "bilinear", "bicubic", "bicubic-1", "lanczos3"])
@pytest.mark.parametrize("resolution", [0.03, 0.1])
def test_a_real_tile_is_what_the_twin_says(project, kernel: str, resolution: float) -> None:
    """Trees, a lens, a real surface model: positions within the tolerance, grey values as that allows."""
    plan = plan_orthophotos(project, ["DJI_0032"], resolution=resolution, kernel=kernel)
    product, scene = plan.products[0].plan, open_scene(project, "DJI_0032")
    middle = Window(product.size[0] // 2 - 60, product.size[1] // 2 - 60, 120, 120)
    got = render(product, Tile(0, middle), [Source(scene.camera, scene.reader)], scene.surface, kernel)
    xy, uvh = strict_positions(product.target, middle, scene.camera, scene.surface)
    image, usable = scene.reader.read(Window(0, 0, *scene.reader.size))
    want, good = twin_resample(image, usable, xy, kernel, strict_scales(product.target, scene.camera, uvh))
    assert got.residual <= 0.02 and got.valid is not None and got.values is not None
    assert np.count_nonzero(got.valid != good) <= 2
    miss = np.abs(got.values.astype(float) - np.clip(want, 0, 255))[:, got.valid & good]
    if kernel == "nearest":
        # A position within the tolerance of a border between two pixels may take either.
        assert np.mean(miss > 0) < 0.05
    else:
        # 0.02 px on the steepest edges of this image (some 100 grey values a pixel), and the rounding.
        assert np.percentile(miss, 99.9) <= 1.5 and miss.max() <= 4.0


def test_memory_of_a_product_of_109_mpx_stays_below_400_mib(shared: Path, tmp_path: Path) -> None:
    data = shared / "data" / "ngi_dmc"
    name = "3324c_2015_1004_05_0182_RGB"
    with rasterio.open(data / "images" / f"{name}.tif") as frame:
        pixels = frame.read().repeat(12, axis=1).repeat(12, axis=2)
    profile = {"driver": "GTiff", "count": 3, "dtype": "uint8", "tiled": True, "blockxsize": 512, "blockysize": 512}
    with rasterio.open(tmp_path / f"{name}.tif", "w", width=7680, height=13824, **profile) as large:
        large.write(pixels)
    del pixels
    text = (data / "eo" / "ngi_int_param.yaml").read_text().replace("[640, 1152]", "[7680, 13824]")
    (tmp_path / "camera.yaml").write_text(text)
    request = InitRequest(
        tmp_path / "project",
        (str(tmp_path / f"{name}.tif"),),
        tmp_path / "camera.yaml",
        data / "eo" / "ngi_xyz_opk.csv",
        str(data / "dem.tif"),
        height_system="same",
    )
    words = ["ortho", init_project(request).path, "--resolution", "0.5", "--workers", 1]
    words += ["--compress", "none", "--no-overviews"]  # as `make bench` measures it
    for _ in range(2):  # the first run may compile
        said, peak = peak_of(*words, "--json", "--no-quicklook", "--overwrite")
        assert said.code == 0, said
    assert json.loads(said.out)["products"][0]["valid_share"] > 0.85  # a frame with relief in its upright rectangle
    assert peak < 400 * 2**20
