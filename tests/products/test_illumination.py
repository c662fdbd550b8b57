"""Light on slopes and haze: a rendered mountain becomes as even as its ground, shadows stay."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from rasterio.transform import from_origin
from scipy.ndimage import gaussian_filter, map_coordinates
from tools.command import Here
from tools.small_block import write_image

from photoplan.errors import GeometryError
from photoplan.radiometry.illumination import LitGround, estimate_light

SUN = (135.0, 38.0)
SIZE, PIXEL = 180, 10.0
DIRECT, SKY, HAZE, PER_100 = np.array([120.0, 110, 80]), np.array([25.0, 30, 40]), 14.0, -1.5


@dataclass(frozen=True)
class Mountain:
    """A rendered picture of known light."""

    picture: Path
    terrain: Path
    cos_i: NDArray[np.float64]
    shadow: NDArray[np.bool_]


def cast(heights: NDArray[np.float64], toward: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Where heights stand in the sun's way, by steps of half a pixel along the ray."""
    row, col = np.mgrid[: heights.shape[0], : heights.shape[1]].astype(float)
    dark = np.zeros(heights.shape, bool)
    level = np.hypot(*toward[:2])
    for away in np.arange(1.0, 100.0, 0.5):
        at = [row - away * toward[1] / level, col + away * toward[0] / level]
        above = map_coordinates(heights, at, order=1, mode="constant", cval=-1e9)
        dark |= above > heights + away * PIXEL * toward[2] / level + 0.05
    return dark


def render(folder: Path, haze: bool) -> Mountain:
    """Matt ground of changing colour under sun and sky; heights at the centres of pixels."""
    rng = np.random.default_rng(4)
    parts = sum(s**1.3 * gaussian_filter(rng.normal(size=(SIZE, SIZE)), s) for s in (4, 9, 25))
    heights = 900 + 130 * parts / parts.std()
    gy, gx = np.gradient(heights, PIXEL)
    normal = np.stack([-gx, gy, np.ones_like(gx)]) / np.sqrt(1 + gx**2 + gy**2)
    azimuth, altitude = np.radians(SUN)
    toward = np.array([np.cos(altitude) * np.sin(azimuth), np.cos(altitude) * np.cos(azimuth), np.sin(altitude)])
    cos_i = np.tensordot(toward, normal, 1)
    shadow = cast(heights, toward)
    colour = 1 + 0.12 * gaussian_filter(rng.normal(size=(SIZE, SIZE)), 1.5) / 0.19 + rng.normal(0, 0.03, (SIZE, SIZE))
    light = DIRECT[:, None, None] * np.where(shadow, 0, np.maximum(cos_i, 0))
    grey = np.clip(colour, 0.0, 2) * (light + SKY[:, None, None] * (1 + normal[2]) / 2)
    if haze:
        grey = grey + HAZE + PER_100 * (heights - heights.mean()) / 100
    place = {"crs": "EPSG:32633", "transform": from_origin(500_000, 5_300_000, PIXEL, PIXEL)}
    picture = write_image(folder / "ortho.tif", np.clip(np.rint(grey), 1, 255).astype(np.uint8), **place)
    terrain = write_image(folder / "dtm.tif", heights[None].astype(np.float32), **place)
    return Mountain(picture, terrain, cos_i, shadow)


def read(path: Path) -> NDArray[np.float64]:
    with rasterio.open(path) as file:
        return np.asarray(file.read().astype(float))


def correlation(grey: NDArray[np.float64], mountain: Mountain, light: NDArray[np.float64] | None = None) -> float:
    """Largest correlation of a band with the light, where the sun shines."""
    lit = ~mountain.shadow & (mountain.cos_i > 0.05)
    light = mountain.cos_i if light is None else light
    return max(abs(float(np.corrcoef(band[lit], light[lit])[0, 1])) for band in grey)


@pytest.mark.drawn
@pytest.mark.parametrize("correct", ["c", pytest.param("cosine", marks=pytest.mark.slow)])
def test_slopes_lose_their_light_and_shadows_stay(
    correct: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Correlation with cos i from above 0.6 to below 0.05; what lies in shadow keeps every grey value."""
    photoplan, mountain, out = Here(capsys), render(tmp_path, haze=False), tmp_path / "even.tif"
    words = ("illumination", mountain.picture, "--terrain", mountain.terrain, "--sun", *SUN, "--correct", correct)
    said = photoplan(*words, "-o", out)
    assert said.code == 0, said.err
    assert (tmp_path / "even.png").exists() and "correlation with cos i" in said.out
    before, after = read(mountain.picture), read(out)
    assert correlation(before, mountain) > 0.6
    assert correlation(after, mountain) < 0.05
    # Shadows of this program and of the test differ by a pixel at their borders.
    inner = gaussian_filter((mountain.shadow | (mountain.cos_i <= 0)).astype(float), 1.5) > 0.97
    assert inner.mean() > 0.02
    np.testing.assert_array_equal(after[:, inner], before[:, inner])
    record = json.loads((tmp_path / "even.run.json").read_text())
    assert record["settings"]["correct"] == [correct]
    if correct == "cosine":
        for band, direct, sky in zip(record["settings"]["bands"], DIRECT, SKY):
            assert abs(band["slope"] - direct) < 3.5 * band["sigmas"][0] + 1
            assert abs(band["sky"] - sky) < 3.5 * band["sigmas"][1] + 1
            assert 0 < band["sigmas"][0] < 6
    again = photoplan(*words, "-o", out)
    assert again.code == 2 and "exists already" in again.err


def test_haze_falls_with_height(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photoplan, mountain = Here(capsys), render(tmp_path, haze=True)
    words = ("illumination", mountain.picture, "--terrain", mountain.terrain, "--sun", *SUN, "-o", tmp_path / "a.tif")
    said = photoplan(*words, "--correct", "haze-by-height,c", "--no-picture")
    assert said.code == 0, said.err
    assert correlation(read(tmp_path / "a.tif"), mountain) < 0.05
    dry = photoplan(*words, "--correct", "haze-by-height", "--dry-run", "--json")
    for band in json.loads(dry.out)["bands"]:
        # The darkest ground is in shadow, and not black: the sky lights it.
        assert band["haze_by_height"] == pytest.approx(PER_100, abs=0.8)
        assert HAZE < band["haze"] < HAZE + 30
    assert json.loads(dry.out)["path"] is None


def test_what_cannot_be_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photoplan, mountain = Here(capsys), render(tmp_path, haze=False)
    words = ("illumination", mountain.picture, "--terrain", mountain.terrain, "-o", tmp_path / "a.tif")
    for more, code, told in [
        (("--sun", SUN[0] + 180, SUN[1]), 3, "not brighter on slopes towards the sun"),
        (("--sun", SUN[0], 95), 2, "altitude 95"),
        (("--sun", *SUN, "--correct", "c,cosine"), 2, "two models of one thing"),
        (("--sun", *SUN, "--correct", "clouds"), 2, "corrections clouds; name some of cosine, c"),
    ]:
        said = photoplan(*words, *more)
        assert said.code == code and told in said.err, said.err
    bare = write_image(tmp_path / "bare.tif", np.full((1, 20, 20), 9, np.uint8))
    said = photoplan("illumination", bare, "--terrain", mountain.terrain, "--sun", *SUN, "-o", tmp_path / "a.tif")
    assert said.code == 3 and "no georeference" in said.err
    assert not (tmp_path / "a.tif").exists()


def test_small_pictures_have_standard_deviations(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of 64 pixels a side all were one part, and without it nothing was left: an IndexError."""
    photoplan, mountain = Here(capsys), render(tmp_path, haze=True)
    small = tmp_path / "small.tif"
    with rasterio.open(mountain.picture) as file:
        write_image(small, file.read(window=((0, 64), (0, 64))), crs=file.crs, transform=file.transform)
    words = ("illumination", small, "--terrain", mountain.terrain, "--sun", *SUN, "-o", tmp_path / "a.tif", "--dry-run")
    said = photoplan(*words, "--correct", "c,haze-by-height", "--json")
    assert said.code == 0, said.err
    assert all(band["sigmas"][0] > 0 and band["sigmas"][3] > 0 for band in json.loads(said.out)["bands"]), said.out


def test_fault_16_pixels_of_one_part_alone_are_refused() -> None:
    n = 600
    ground = LitGround(np.linspace(0.2, 1, n), np.ones(n), np.linspace(0.0, 100, n), np.zeros(n, bool))
    with pytest.raises(GeometryError, match="without one part of the picture 0 pixels"):
        estimate_light(np.ones((1, n)), ground, np.zeros(n, int), ["haze-by-height"], 0.7)


def test_slopes_have_no_steps_at_coarse_posts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Even ground on hills, posts six pixels apart: less than 1 % of the light is left (2.4 % by plain slopes)."""
    side, pixel, apart = 240, 2.0, 6
    place = {"crs": "EPSG:32633", "transform": from_origin(500_000, 5_300_000, pixel, pixel)}

    def hills(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(900 + 12 * np.sin(x / 30) + 9 * np.cos(y / 25))

    y, x = (np.mgrid[:side, :side] + 0.5) * pixel
    gx, gy = 12 / 30 * np.cos(x / 30), 9 / 25 * np.sin(y / 25)
    azimuth, altitude = np.radians(SUN)
    toward = np.array([np.cos(altitude) * np.sin(azimuth), np.cos(altitude) * np.cos(azimuth), np.sin(altitude)])
    cos_i = (toward[2] - toward[0] * gx - toward[1] * gy) / np.sqrt(1 + gx**2 + gy**2)
    grey = np.rint(100 * (60 + 120 * np.maximum(cos_i, 0))).astype(np.uint16)[None]
    picture = write_image(tmp_path / "ortho.tif", grey, **place)
    step = apart * pixel
    posts = (np.mgrid[: side // apart + 2, : side // apart + 2] - 0.5) * step
    coarse = {"crs": "EPSG:32633", "transform": from_origin(500_000 - step, 5_300_000 + step, step, step)}
    terrain = write_image(tmp_path / "dtm.tif", hills(posts[1], posts[0])[None].astype(np.float32), **coarse)
    out = tmp_path / "even.tif"
    said = Here(capsys)("illumination", picture, "--terrain", terrain, "--sun", *SUN, "-o", out, "--no-picture")
    assert said.code == 0, said.err
    inner = read(out)[0, 2 * apart : -2 * apart, 2 * apart : -2 * apart]
    left = float(inner.std() / inner.mean())
    print(f"light left on slopes: {100 * left:.2f} %")
    assert left < 0.01
