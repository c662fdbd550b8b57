"""Heights from three lines of a turbulent flight, of a calm one, and of lines and frames together: rendered truth."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from products.test_surface import places
from tools.command import inside
from tools.facet_scene import Scene
from tools.shaken_strip import ShakenStrip
from tools.strip_scene import CALM, CENTRE, HEIGHT_OF_A_PIXEL, SHAKEN, with_others, write_strips

pytestmark = pytest.mark.slow
WIDE, LONG = 18.0, 25.0
BOUNDS = (CENTRE[0] - WIDE, CENTRE[1] - LONG, CENTRE[0] + WIDE, CENTRE[1] + LONG)
#: Events alone: what a line sees hardly moves while it is exposed.
SLOW = replace(SHAKEN, vibration=(0.0, 0.0, 0.0))


def judged(scene: Scene, project: Path, folder: Path, *how: object) -> tuple[float, float, float]:
    """Mean squares of the heights' errors, pixels of parallax of the outermost lines, and of the same by their standard
    deviations; mean error."""
    words = ["--resolution", 0.9, "--bounds", *BOUNDS, *(how or ("--no-search", "--reach", 6)), "--no-quicklook", "-q"]
    said = inside("surface", project, *words)
    assert said.code == 0, said.err
    heights, X, Y = places(folder / "surface.tif")
    sigma, *_ = places(folder / "surface_sigma.tif")
    assert np.isfinite(heights).all()
    off = heights - scene.heights(X, Y)
    errors = off / HEIGHT_OF_A_PIXEL
    return float(np.mean(errors**2)), float(np.mean((off / sigma) ** 2)), float(errors.mean())


@pytest.mark.parametrize(
    ("like", "snr", "relief", "rms", "told"),
    [
        # A roll by up to four pixels while a line is exposed blurs it along itself: no pixel of the model is so.
        (SHAKEN, 50, 1, 0.06, 1.4),
        (SHAKEN, 10, 1, 0.06, 1.4),
        (CALM, 50, 1, 0.015, 1.2),
        (CALM, 50, 4, 0.015, 1.2),
    ],
    ids=["turbulent", "turbulent, noise", "calm", "calm, strong relief"],
)
def test_three_lines(tmp_path: Path, like: ShakenStrip, snr: float, relief: float, rms: float, told: float) -> None:
    found = []
    for seed in range(3):
        folder = tmp_path / str(seed)
        folder.mkdir()
        scene = write_strips(folder, like, seed, snr, relief)
        found.append(judged(scene, scene.path, folder / "products"))
    squares, biases = np.mean(found, axis=0)[:2], np.array(found)[:, 2]
    both = np.sqrt(squares)
    print("rms", both[0], "normalised", both[1], "bias", biases)
    assert both[0] < rms and 0.8 < both[1] < told and np.abs(biases).max() < 0.03


def test_three_lines_of_which_nothing_is_known_but_the_terrain(tmp_path: Path) -> None:
    """With the usual reach, 32 px of parallax: from coarse to fine, as a search does not follow how a flight shakes."""
    scene = write_strips(tmp_path)
    square, normalised, bias = judged(scene, scene.path, tmp_path / "products", "--start", "terrain")
    print("rms", np.sqrt(square), "normalised", np.sqrt(normalised), "bias", bias)
    assert np.sqrt(square) < 0.06 and np.sqrt(normalised) < 1.4 and abs(bias) < 0.03


def test_lines_frames_films_and_polynomials_together(tmp_path: Path) -> None:
    """Two lines of a flight with events, a frame, a scan of film and a satellite's image, of the same scene."""
    scene = write_strips(tmp_path, SLOW)
    square, normalised, bias = judged(scene, with_others(scene), tmp_path / "products")
    print("rms", np.sqrt(square), "normalised", np.sqrt(normalised), "bias", bias)
    record = json.loads((tmp_path / "products/surface.run.json").read_text())["product"]
    print(record["sigma0"])
    assert set(record["sigma0"]) == {"forward", "nadir", "frame", "film", "satellite"}
    assert all(0.4 < value < 1 for value in record["sigma0"].values())
    assert np.sqrt(square) < 0.01 and 0.8 < np.sqrt(normalised) < 1.2 and abs(bias) < 0.01


@pytest.mark.parametrize("images", [("frame", "film", "satellite"), ("frame", "film")], ids=len)
def test_few_images_with_facets_coarser_than_pixels(tmp_path: Path, images: tuple[str, ...]) -> None:
    """Of 1.03 pixels; without what they do not hold of short waves 0.0167 and 0.0274 px, 1.94 and 2.08."""
    scene = write_strips(tmp_path, SLOW)
    words = ("--no-search", "--reach", 6, "--images", ",".join(images))
    square, normalised, bias = judged(scene, with_others(scene), tmp_path / "products", *words)
    print("rms", np.sqrt(square), "normalised", np.sqrt(normalised), "bias", bias)
    assert np.sqrt(square) < 0.015 and 0.8 < np.sqrt(normalised) < 1.3 and abs(bias) < 0.01
