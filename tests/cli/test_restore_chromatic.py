"""`photoplan restore --chromatic`: bands brought together before the filter."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.command import Here
from tools.formed import form_image

from photoplan.io.raster import write_whole_image
from photoplan.products.measured_filter import load_chromatic
from photoplan.quality.formation.model import ImageModel
from photoplan.quality.formation.optics import Gain, Lateral, Quantisation, Spread
from photoplan.quality.formation.scenes import PatternScene

CAMERA = ImageModel(
    Spread(gaussian=(0.8, 0.8)),
    lateral=(Lateral(1, (0.8, 0.0), 0.004), Lateral(3, (-0.6, 0.2), -0.003)),
    gain=Gain(200.0, 10.0, 2.0),
    quantisation=Quantisation(8),
)


@pytest.fixture
def photoplan(capsys: pytest.CaptureFixture[str]) -> Here:
    return Here(capsys)


@pytest.fixture
def chart(tmp_path: Path) -> Path:
    scene = PatternScene("discs", (150, 120), (24.0, 11.0), 4, bands=3)
    write_whole_image(tmp_path / "chart.tif", form_image(CAMERA, scene).values)
    (tmp_path / "one.txt").write_text("1\n")
    return tmp_path / "chart.tif"


def apart(path: Path) -> float:
    with rasterio.open(path) as file:
        bands = file.read().astype(float)[:, 15:-15, 15:-15]
    return float(np.sqrt(np.mean((bands[[0, 2]] - bands[1]) ** 2)))


def test_measured_then_from_the_file(photoplan: Here, chart: Path) -> None:
    folder = chart.parent
    words = ("restore", chart, "--filter", folder / "one.txt", "--no-quicklook", "--workers", 1)
    said = photoplan(*words, "--chromatic", "measure", "--output", folder / "a")
    assert said.code == 0, said.err
    assert "band 1 against 2: scale, shift +0.80" in said.err and "errors of prediction: none" in said.err
    first = folder / "a" / "chart_restored.tif"
    assert apart(first) < 3.0 < 10.0 < apart(chart)
    model = load_chromatic(folder / "a" / "chart_chromatic.toml")
    record = json.loads((folder / "a" / "chart_restored.run.json").read_text())
    assert record["chromatic"]["bands"][0]["count"] == model.bands[0].count >= 24
    said = photoplan(*words, "--chromatic", folder / "a" / "chart_chromatic.toml", "--output", folder / "b", "--json")
    assert said.code == 0, said.err
    with rasterio.open(first) as one, rasterio.open(folder / "b" / "chart_restored.tif") as two:
        # The file keeps nine digits of the coefficients.
        assert np.abs(one.read().astype(int) - two.read()).max() <= 1


def test_what_cannot_be_measured_is_said(photoplan: Here, chart: Path) -> None:
    folder = chart.parent
    write_whole_image(folder / "grey.tif", np.zeros((50, 50), np.uint8))
    words = ("restore", folder / "grey.tif", "--filter", folder / "one.txt", "--output", folder / "a")
    said = photoplan(*words, "--chromatic", "measure")
    assert said.code == 3 and "single band" in said.err
    said = photoplan(*words, "--chromatic", folder / "missing.toml")
    assert said.code == 3 and "missing.toml" in said.err
    (folder / "other.toml").write_text('format = "photoplan chromatic 1"\nimage_size = [9, 9]\nreference = 1\n')
    said = photoplan(*words, "--chromatic", folder / "other.toml")
    assert said.code == 3 and "9 × 9" in said.err
    assert not (folder / "a").exists() or not list((folder / "a").glob("*.tif"))


def test_a_measured_model_that_exists_is_kept(photoplan: Here, chart: Path) -> None:
    folder = chart.parent
    (folder / "a").mkdir()
    (folder / "a" / "chart_chromatic.toml").write_text("mine")
    said = photoplan(
        "restore", chart, "--filter", folder / "one.txt", "--chromatic", "measure", "--output", folder / "a"
    )
    assert said.code == 2 and "chart_chromatic.toml" in said.err
    assert (folder / "a" / "chart_chromatic.toml").read_text() == "mine"
