"""`photoplan simulate`: files in, files out, and what it refuses."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.command import Here
from tools.formed import form_image, form_series

from photoplan.io.raster import write_whole_image
from photoplan.products.simulate import entry_of, model_of, read_model
from photoplan.quality.formation.model import ImageModel
from photoplan.quality.formation.scenes import PatternScene

MODEL = """
seed = 3
[spread]
gaussian = 0.6
[exposure]
light = 5000.0
[readout]
shot_noise = true
noise = 10.0
[gain]
factor = 0.04
offset = 5.0
[quantisation]
bits = 8
"""


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "model.toml"
    path.write_text(MODEL)
    return path


@pytest.fixture
def photoplan(capsys: pytest.CaptureFixture[str]) -> Here:
    return Here(capsys)


def pixels(path: Path) -> np.ndarray:
    with rasterio.open(path) as file:
        return file.read()


def test_frames_are_those_of_the_library(photoplan: Here, model: Path, tmp_path: Path) -> None:
    output = tmp_path / "edge.tif"
    said = photoplan("simulate", "edge:7", "--model", model, "--size", 60, 40, "--frames", 2, "--exposure", 1,
                     "--exposure", 0.5, "--output", output, "--json")  # fmt: skip
    assert said.code == 0, said.err
    report = json.loads(said.out)
    paths = [Path(image["path"]) for image in report["images"]]
    assert [path.name for path in paths] == ["edge_0001.tif", "edge_0002.tif"]
    value = read_model(model)
    for frame, (path, exposure) in enumerate(zip(paths, (1.0, 0.5))):
        expected = form_image(value, PatternScene("edge", (60, 40), (7.0,)), frame, exposure).values
        assert np.array_equal(pixels(path)[0], expected)
        assert report["images"][frame]["exposure"] == exposure
    record = json.loads((tmp_path / "edge.run.json").read_text())
    assert record["settings"]["model"]["spread"]["gaussian"] == [0.6, 0.6]
    assert report["model_mtf50"]["x"] == pytest.approx(0.2807, abs=1e-4)


def test_a_series_is_that_of_the_library(photoplan: Here, model: Path, tmp_path: Path) -> None:
    """Jitter of its own for each frame, and automatic gain that runs through them."""
    with model.open("a") as file:
        file.write("[jitter]\nsigma = 0.5\n[automatic_gain]\ntarget = 60.0\nleast = 0.1\nmost = 9.0\nframes = 2.0\n")
    output = tmp_path / "s.tif"
    said = photoplan(
        "simulate", "edge:7", "--model", model, "--size", 60, 40, "--frames", 4, "--output", output, "--json"
    )
    assert said.code == 0, said.err
    value, scene = read_model(model), PatternScene("edge", (60, 40), (7.0,))
    images = json.loads(said.out)["images"]
    for image, formed in zip(images, form_series(value, [scene] * 4), strict=True):
        assert np.array_equal(pixels(Path(image["path"]))[0], formed.values)
        assert image["automatic_gain"] == formed.gain
    assert len({image["automatic_gain"] for image in images}) == 4


def test_an_image_file_is_a_scene(photoplan: Here, tmp_path: Path) -> None:
    """Without a model the pixels are the means of the file's; any number of bands, beyond one tile."""
    scene = np.random.default_rng(1).integers(0, 255, (3, 48, 3000)).astype(np.uint8)
    write_whole_image(tmp_path / "scene.tif", scene)
    said = photoplan("simulate", tmp_path / "scene.tif", "--oversampling", 4, "--output", tmp_path / "out.tif", "-q")
    assert (said.code, said.out, said.err) == (0, f"{tmp_path / 'out.tif'}\n", "")
    assert np.allclose(pixels(tmp_path / "out.tif"), scene.reshape(3, 12, 4, 750, 4).mean((2, 4)), atol=1e-4)
    said = photoplan("simulate", tmp_path / "scene.tif", "--dtype", "uint8", "--output", tmp_path / "same.tif", "-q")
    assert said.code == 0 and np.array_equal(pixels(tmp_path / "same.tif"), scene)


def test_blur_of_a_file_has_no_seams_between_tiles(photoplan: Here, tmp_path: Path) -> None:
    scene = np.random.default_rng(2).random((1, 20, 3000)).astype(np.float32)
    write_whole_image(tmp_path / "scene.tif", scene)
    (tmp_path / "m.toml").write_text("[spread]\ngaussian = 2.0\n")
    photoplan("simulate", tmp_path / "scene.tif", "--model", tmp_path / "m.toml", "--output", tmp_path / "out.tif")
    from scipy import ndimage

    rows = np.pad(scene[0].astype(float), 40, mode="edge")
    whole = form_image(read_model(tmp_path / "m.toml"), rows).values[40:-40, 40:-40]
    assert np.abs(pixels(tmp_path / "out.tif")[0] - whole).max() < 1e-5
    # A sampled Gaussian is close to it too.
    assert np.abs(ndimage.gaussian_filter(rows, np.sqrt(4 + 1 / 6))[40:-40, 40:-40] - whole).max() < 2e-3


def test_bands_of_lateral_colour(photoplan: Here, tmp_path: Path) -> None:
    (tmp_path / "m.toml").write_text("[[lateral]]\nband = 3\nshift = [1.0, 0.0]\n")
    said = photoplan("simulate", "edge:0", "--model", tmp_path / "m.toml", "--size", 40, 9, "--output",
                     tmp_path / "out.tif")  # fmt: skip
    assert said.code == 0, said.err
    bands = pixels(tmp_path / "out.tif")
    assert bands.shape == (3, 9, 40)
    assert np.allclose((40 - bands.sum(2)).mean(1), [20.0, 20.0, 21.0], atol=1e-3)


def test_lateral_colour_of_a_band_that_the_scene_lacks(photoplan: Here, tmp_path: Path) -> None:
    (tmp_path / "m.toml").write_text("[[lateral]]\nband = 1\n[[lateral]]\nband = 3\nshift = [1.0, 0.0]\n")
    write_whole_image(tmp_path / "grey.tif", np.ones((1, 9, 9), np.uint8))
    said = photoplan("simulate", tmp_path / "grey.tif", "--model", tmp_path / "m.toml", "--output", tmp_path / "a.tif")
    assert said.code == 3 and "m.toml: [[lateral]] describes band 3" in said.err and "grey.tif has 1 band;" in said.err
    assert not (tmp_path / "a.tif").exists()


@pytest.mark.parametrize("dry", [(), ("--dry-run",)])
def test_a_file_without_any_value_is_refused(dry: tuple[str, ...], photoplan: Here, tmp_path: Path) -> None:
    values = np.full((1, 1100, 1100), np.nan, np.float32)
    write_whole_image(tmp_path / "empty.tif", values)
    words = ("--output", tmp_path / "a.tif", *dry)
    said = photoplan("simulate", tmp_path / "empty.tif", *words)
    assert said.code == 3 and "empty.tif: not one pixel has a value" in said.err, said
    assert not (tmp_path / "a.tif").exists()
    values[0, 1099, 1099] = 1.0
    write_whole_image(tmp_path / "one.tif", values)
    assert photoplan("simulate", tmp_path / "one.tif", *words).code == 0


def test_dry_run_writes_nothing(photoplan: Here, model: Path, tmp_path: Path) -> None:
    said = photoplan("simulate", "flat", "--model", model, "--output", tmp_path / "a.tif", "--dry-run")
    assert said.code == 0 and said.out.strip() == str(tmp_path / "a.tif")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["model.toml"]


def test_an_output_that_exists_is_refused(photoplan: Here, model: Path, tmp_path: Path) -> None:
    words = ("simulate", "flat", "--model", model, "--size", 9, 9, "--output", tmp_path / "a.tif")
    assert photoplan(*words).code == 0
    said = photoplan(*words)
    assert said.code == 2 and "--overwrite" in said.err
    assert photoplan(*words, "--overwrite").code == 0


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (("edge:x",), 2, "numbers"),
        (("edg:5",), 2, "patterns are"),
        (("missing.tif",), 3, "no such file"),
        (("star:7.5",), 3, "whole number"),
        (("flat", "--frames", "0"), 2, "frames"),
        (("flat", "--frames", "3", "--exposure", "1", "--exposure", "2"), 2, "2 exposures for 3 frames"),
        (("flat", "--size", "90000", "90000"), 3, "at most 40,000,000"),
        (("flat", "--output", "a.jpg"), 2, "TIFF"),
        (("flat", "--output", "nowhere/a.tif"), 2, "folder does not exist"),
        (("flat", "--seed", "-4"), 2, "seed"),
    ],
)
def test_wrong_use(
    words: tuple[str, ...], code: int, message: str, photoplan: Here, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    said = photoplan("simulate", *words)
    assert said.code == code and message in said.err, said
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[spred]\ngaussian = 1.0\n", "model.toml:1: spred: unknown entry"),
        ("\n[spread]\ngauss = 1.0\n", "model.toml:3: spread.gauss: unknown entry"),
        ("[spread]\ngaussian = 'wide'\n", "model.toml:2"),
        ("[spread]\ngaussian = -1.0\n", "model.toml: spread: gaussian (x) = -1; allowed is 0 to 50"),
        ("[spread]\ngaussian = nan\n", "model.toml:2"),
        ("[well]\n", "well.capacity: is missing"),
        ("[quantisation]\nbits = 40\n", "bits"),
        ("[[defects]]\ncolumn = 999\nrow = 0\nkind = 'dead'\n", "defect in column 999"),
        ("[[lateral]]\nband = 1\n[[lateral]]\nband = 1\n", "twice"),
        ("seed = 1\nseed = 2\n", "not valid TOML"),
        ("[quantisation]\nbits = 12\n", "uint8 files for grey values of 12 bits"),
    ],
)
def test_faults_of_a_model(text: str, message: str, photoplan: Here, tmp_path: Path) -> None:
    model = tmp_path / "model.toml"
    model.write_text(text)
    said = photoplan("simulate", "flat", "--model", model, "--size", 9, 9, "--dtype", "uint8", "--output",
                     tmp_path / "a.tif")  # fmt: skip
    assert said.code in (2, 3) and message in said.err, said
    assert not (tmp_path / "a.tif").exists()


def test_every_entry_is_explained() -> None:
    page = (Path(__file__).parents[2] / "docs" / "reference" / "simulate.md").read_text("utf-8")
    schema = entry_of(ImageModel).model_json_schema()
    tables = schema["$defs"]
    entries = {entry for each in tables.values() for entry in each["properties"]}
    assert not {e for e in entries | {"seed"} if f"`{e}`" not in page}
    assert {name for name in schema["properties"] if name != "seed"} == set(re.findall(r"\*\*`\[+(\w+)\]+`\*\*", page))


def test_the_model_on_the_page_works() -> None:
    page = (Path(__file__).parents[2] / "docs" / "reference" / "simulate.md").read_text("utf-8")
    text = re.findall(r"^```toml\n(.*?)^```", page, re.M | re.S)[0]
    import tomllib

    assert model_of(entry_of(ImageModel).model_validate(tomllib.loads(text)), "page") != ImageModel()
