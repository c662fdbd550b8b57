"""`photoplan restore` without a filter: measured in the images, kept, used again; and apertures of scanners."""

import json
import re

import numpy as np
import pytest
import rasterio
from tools.blurred_scenes import any_edges, taken
from tools.command import Here


@pytest.fixture
def photoplan(capsys):
    return Here(capsys)


@pytest.fixture(scope="module")
def image(tmp_path_factory):
    rng = np.random.default_rng(31)
    seen, _ = taken(any_edges(rng, 224), 0.5, rng)
    path = tmp_path_factory.mktemp("scene") / "scene.tif"
    with rasterio.open(path, "w", driver="GTiff", width=224, height=224, count=1, dtype="uint8") as file:
        file.write(np.clip(np.rint(seen), 0, 255).astype(np.uint8), 1)
    return path


@pytest.mark.slow
def test_a_measured_filter_is_printed_kept_and_gives_the_same_again(photoplan, image, tmp_path):
    first = photoplan("restore", image, "--output", tmp_path / "a", "--linearisation", "linear")
    assert first.code == 0
    assert "linearisation: linear (by default" not in first.err
    assert "spread function along rows 0.6" in first.err
    assert "condition: along rows: A/Z = 0.3" in first.err
    assert "rule: regularised: least expected error; noise " in first.err
    assert re.search(
        r"expected: error 0\.0\d+ as it is, 0\.0\d+ regularised, 0\.0\d+ exact \(rms in light, full", first.err
    )
    assert first.err.index("noise grows") < first.err.index("Mpx in")
    kept = tmp_path / "a" / "restoration_filter.toml"
    second = photoplan("restore", image, "--output", tmp_path / "b", "--filter", kept)
    assert second.code == 0
    one, other = ((tmp_path / name / "scene_restored.tif") for name in "ab")
    with rasterio.open(one) as a, rasterio.open(other) as b:
        assert np.array_equal(a.read(), b.read())


@pytest.mark.slow
def test_the_same_command_goes_on_and_another_filter_is_not_overwritten(photoplan, image, tmp_path):
    with rasterio.open(image) as whole:
        cut = whole.read(1)[:200, :200]
    image = tmp_path / "scene.tif"
    with rasterio.open(image, "w", driver="GTiff", width=200, height=200, count=1, dtype="uint8") as file:
        file.write(cut, 1)
    kept = tmp_path / "mine.toml"
    command = ["restore", image, "--output", tmp_path / "a", "--save-filter", kept]
    assert photoplan(*command).code == 0
    (tmp_path / "a" / "scene_restored.tif").unlink()
    (tmp_path / "a" / "scene_restored.run.json").unlink()
    (tmp_path / "a" / "scene_restored.png").unlink()
    assert photoplan(*command).code == 0
    kept.write_text(kept.read_text("utf-8").replace("measured at", "changed at"), "utf-8")
    (tmp_path / "a" / "scene_restored.tif").unlink()
    again = photoplan(*command)
    assert again.code == 2
    assert "exists" in again.err


@pytest.mark.slow
def test_dry_run_writes_nothing_and_says_what_is_taken_as_light_by_default(photoplan, image, tmp_path):
    said = photoplan("restore", image, "--output", tmp_path / "a", "--dry-run", "--json")
    assert said.code == 0 and "linearisation: linear (by default" in said.err
    plan = json.loads(said.out)
    assert plan["filter"]["noise_gain"] > 1.5
    assert plan["filter"]["facts"]["parts"][0]["method"] == "regularised"
    errors = plan["filter"]["facts"]["parts"][0]["expected_error"]
    assert errors["regularised"] < min(errors["none"], errors["exact"])
    assert not (tmp_path / "a").exists()


def test_apertures_of_scanners(photoplan, image, tmp_path):
    said = photoplan("restore", image, "--output", tmp_path / "a", "--aperture", "square", "--json")
    assert said.code == 0
    assert json.loads(said.out)["filter"]["size"] == [9, 9]
    assert photoplan("restore", image, "--output", tmp_path / "b", "--aperture", "round:1.2").code == 0
    refused = photoplan("restore", image, "--output", tmp_path / "c", "--aperture", "round:2")
    assert (refused.code, "amplify noise" in refused.err) == (3, True)
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["--aperture", "oval"], "square or round"),
        (["--aperture", "square:x"], "square or round"),
        (["--filter", "f.toml", "--method", "exact"], "--method"),
        (["--aperture", "square", "--cells", "3"], "--cells"),
        (["--filter", "f.toml", "--aperture", "square"], "exclude each other"),
        (["--size", "10"], "odd"),
    ],
)
def test_options_that_contradict_each_other(photoplan, image, tmp_path, options, word):
    said = photoplan("restore", image, "--output", tmp_path / "a", *options)
    assert said.code == 2
    assert word in said.err
    assert not (tmp_path / "a").exists()


def test_an_image_without_edges_gives_a_reason_and_no_filter(photoplan, tmp_path):
    path = tmp_path / "flat.tif"
    with rasterio.open(path, "w", driver="GTiff", width=200, height=200, count=1, dtype="uint8") as file:
        file.write(np.random.default_rng(1).normal(90, 3, (1, 200, 200)).astype(np.uint8))
    said = photoplan("restore", path, "--output", tmp_path / "a")
    assert said.code == 3
    assert "no edge" in said.err
    assert not (tmp_path / "a").exists()
