"""`photoplan characterise` of a sensor whose elements are full below the largest grey value that is written."""

from __future__ import annotations

import json
from typing import Any

import pytest
import rasterio
from tools.command import inside
from tools.formed import form_image

from photoplan.quality.formation.model import ImageModel
from photoplan.quality.formation.optics import (
    DarkCurrentPart,
    DefectPart,
    Exposure,
    Falloff,
    Gain,
    Quantisation,
    Readout,
    Spread,
    Well,
)
from photoplan.quality.formation.scenes import PatternScene

SIZE = (96, 80)
FULL_DN = 64 + 0.33 * 8000
SERIES = """
[camera]
bits = 12

[[frames]]
kind = "flat"
files = "flat_{exposure}ms_*.tif"

[[frames]]
kind = "dark"
files = "dark_{exposure}ms_*.tif"

[[frames]]
kind = "scene"
name = "lamp"
files = "lamp_{exposure}ms_*.tif"
"""


def camera(**parts: object) -> ImageModel:
    """100 electrons of light and 10 of dark current in a millisecond; 8000 fill an element."""
    usual: dict[str, object] = {
        "spread": Spread(gaussian=(0.6, 0.6)),
        "exposure": Exposure(light=100.0),
        "dark": DarkCurrentPart(rate=10.0),
        "well": Well(8000.0),
        "readout": Readout(shot_noise=True, noise=15.0),
        "gain": Gain(factor=0.33, offset=64.0),
        "quantisation": Quantisation(12),
    }
    return ImageModel(**{**usual, **parts})  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the command says of flat frames with fall-off, dark ones with a hot pixel, and a lamp that blooms."""
    folder = tmp_path_factory.mktemp("well")
    flat, black = (PatternScene("flat", SIZE, levels=(0.0, bright), oversampling=1) for bright in (1.0, 0.0))
    lamp = PatternScene("discs", SIZE, (400.0, 10.0), levels=(3.0, 0.003), oversampling=4)
    for kind, scene, model, exposures in (
        ("flat", flat, camera(falloff=Falloff(focal=200.0)), (10, 20, 40, 60, 75, 100, 140)),
        ("dark", black, camera(defects=(DefectPart(30, 20, "hot", 400.0),)), (5, 10, 15, 100, 400, 1000)),
        ("lamp", lamp, camera(), (4, 8, 12, 20, 26, 30, 40, 80)),
    ):
        for t in exposures:
            for k in range(2):
                image = form_image(model, scene, 100 * t + k, exposure=float(t)).values
                with rasterio.open(folder / f"{kind}_{t}ms_{k}.tif", "w", "GTiff", *SIZE, 1, dtype="uint16") as file:
                    file.write(image.reshape(SIZE[::-1]), 1)
    (folder / "series.toml").write_text(SERIES)
    said = inside("characterise", folder / "series.toml", "--json", "-q")
    assert said.code == 0, said.err
    found: dict[str, Any] = json.loads(said.out)
    return found


def analysis(report: dict[str, Any], name: str) -> dict[str, Any]:
    (found,) = [each for each in report["analyses"] if each["name"] == name]
    return found  # type: ignore[no-any-return]


def figure(report: dict[str, Any], where: str, name: str, at: str | None = None) -> dict[str, Any]:
    found = [f for f in analysis(report, where)["figures"] if f["name"] == name and at in (None, f.get("at", ""))]
    print(found[:1])
    return found[0]  # type: ignore[no-any-return]


def test_it_is_told(report: dict[str, Any]) -> None:
    (note,) = report["notes"]
    print(note)
    assert f"full at {FULL_DN:.4g} DN, below the largest grey value 4095" in note
    remark = figure(report, "saturation", "saturation_dn", "")["remark"]
    assert remark == "between 60 and 75 ms: the elements are full, below the largest grey value"


def test_fall_off_is_not_measured_on_full_elements(report: dict[str, Any]) -> None:
    """The brightest frames show none at all, those of 75 ms none in the middle."""
    want = 100 * (1 - (1 + (47.5**2 + 39.5**2) / 200.0**2) ** -2)
    assert figure(report, "fall_off", "corner_percent")["value"] == pytest.approx(want, abs=0.6)
    assert "flat 60 ms" in analysis(report, "fall_off")["notes"][0]


def test_dark_current_leaves_full_frames_out(report: dict[str, Any]) -> None:
    current = figure(report, "dark_signal", "dark_current_dn_s")
    want = 330 * (10 + 400 / (96 * 80))  # the hot pixel's charge runs over and is kept
    assert abs(current["value"] - want) < 4 * current["sigma"]
    assert "dark 1000 ms: saturated, not used" in analysis(report, "dark_signal")["notes"]


def test_the_hottest_pixel_is_the_one_that_is_full_first(report: dict[str, Any]) -> None:
    """At the longest exposure everything is full; along its column its charge runs over before."""
    hottest = figure(report, "defects", "hottest_dn_s")
    assert "column 30, row 20" in hottest["remark"]
    assert hottest["value"] == pytest.approx(0.33 * 410 * 1000, rel=0.05)


def test_noise_is_that_of_elements_that_are_not_full(report: dict[str, Any]) -> None:
    largest = figure(report, "noise", "largest_noise_dn")
    assert largest["value"] == pytest.approx(0.33 * (15**2 + 6600 * 0.93) ** 0.5, rel=0.05)


def test_blooming_begins_at_the_full_well(report: dict[str, Any]) -> None:
    onset = figure(report, "blooming", "blooming_onset_dn")
    light = 0.33 * 8000 * 300 / 310  # the rest of a full element is dark current
    assert abs(onset["value"] - light) < 3 * onset["sigma"] < 0.5 * light
    rows, columns = (figure(report, "blooming", f"blooming_{name}_px")["value"] for name in ("rows", "columns"))
    assert rows > 5 and columns <= 2  # along the columns


def test_a_saturated_spot_is_no_saturation_of_the_scene(report: dict[str, Any]) -> None:
    refused = analysis(report, "saturation")["refused"]
    print(refused)
    assert "of its samples are saturated" in refused["saturation lamp"]
