"""A real exposure series: Flea3 colour camera, seven exposures in seven wavelengths, dark frames with black cut off."""

from __future__ import annotations

import json

import pytest
import rasterio
from tools.command import Here

#: Of the data's description: brightest 20 % of a Bayer plane at 500 nm, DN/ms at 25, 50, 100 and 250 ms.
RESPONSE = {25: 0.757, 50: 0.760, 100: 0.769, 250: 0.752}
#: The hot pixel in row 200, column 109, at the seven exposures.
HOT = [1, 2, 5, 13, 26, 90, 176]


@pytest.fixture(scope="module")
def found(shared, tmp_path_factory):
    folder = tmp_path_factory.mktemp("flea3")
    data = shared / "data" / "flea3_exposure_series"
    text = f"""
[camera]
name = "Flea3 FL3-GE-50S5C"
bits = 8
bayer = "RGGB"

[[frames]]
kind = "scene"
files = "{data}/disks/d1_disks32cmV2_{{wavelength}}nm_{{exposure}}ms_{{time:%Y-%m-%d-%H%M%S}}-0004.tif"
brightest = 0.2
brightest_exposure_ms = 100.0

[[frames]]
kind = "dark"
files = "{data}/dark_frames/d1_dark_{{exposure}}ms_*.tif"
"""
    (folder / "s.toml").write_text(text)
    return folder


@pytest.fixture
def analyses(found, capsys):
    def run(*names):
        said = Here(capsys)("characterise", found / "s.toml", "--json", *(w for n in names for w in ("--only", n)))
        assert said.code == 0, said
        return {a["name"]: a for a in json.loads(said.out)["analyses"]}

    return run


def test_response_at_500_nm_and_saturation(analyses):
    result = analyses("linearity", "saturation")
    figures = [f for f in result["linearity"]["figures"] if f["name"] == "response_at" and f.get("plane") == "R"]
    measured = {f["at"]: f["value"] for f in figures}
    for exposure, stated in RESPONSE.items():
        value = measured[f"500 nm {exposure} ms"]
        off = 100 * (value / stated - 1)
        print(f"500 nm {exposure} ms: {value:.4f} DN/ms against {stated} ({off:+.2f} %, wanted 1 %)")
        assert value == pytest.approx(stated, rel=0.01)
    at = {(f.get("plane"), f["at"]): f for f in result["saturation"]["figures"] if f["name"] == "saturation_dn"}
    assert at["R", "500 nm"]["value"] == pytest.approx(255, abs=0.5)
    assert "between 250 and 500 ms" in at["R", "500 nm"]["remark"]
    exposure = next(f for f in result["saturation"]["figures"] if (f.get("plane"), f["at"]) == ("R", "500 nm")
                    and f["name"] == "saturation_exposure")  # fmt: skip
    assert exposure["value"] == pytest.approx(255 / 0.7595, rel=0.02)


@pytest.mark.slow
def test_no_response_where_black_is_cut_off(analyses):
    result = analyses("linearity")["linearity"]
    known = {f["at"] for f in result["figures"] if f["name"] == "response_at" and f.get("plane") == "R"}
    # At 700 nm and 25 ms the mean is 0.3 DN: most pixels are zero.
    assert "700 nm 25 ms" not in known and "500 nm 25 ms" in known
    assert "zero" in result["refused"]["signal over exposure R 700 nm 25 ms"]


def test_hot_pixel_is_found_unaided(analyses, shared):
    result = analyses("defects")["defects"]
    growth = result["tables"]["hot_growth_G1"]
    column, row, *values = growth["rows"][0][1:-1]
    print(f"hottest pixel of all planes: row {row}, column {column}: {values} (stated {HOT})")
    assert (row, column) == (200, 109)
    assert values == pytest.approx(HOT, abs=1.5)  # means of two frames; the description's are of one
    hottest = [f for f in result["figures"] if f["name"] == "hottest_dn_s"]
    assert max(hottest, key=lambda f: f["value"])["remark"] == "column 109, row 200"
    file = next((shared / "data" / "flea3_exposure_series" / "dark_frames").glob("d1_dark_3916ms_*-0003.tif"))
    with rasterio.open(file) as data:
        assert data.read(1)[200, 109] in (HOT[-1], 173, 174, 175)


@pytest.mark.slow
def test_what_clipped_black_hides_is_refused(analyses):
    result = analyses("dark_signal", "fixed_pattern", "noise")
    assert not result["dark_signal"]["figures"]
    why = result["dark_signal"]["refused"]["dark current R"]
    assert "black is cut off: 99.8 %" in why
    assert "black is cut off" in result["fixed_pattern"]["refused"]["DSNU R"]
    assert not result["noise"]["figures"]


def test_what_the_series_lacks_is_said(found, capsys):
    said = Here(capsys)("characterise", found / "s.toml", "--only", "photon_transfer")
    assert said.code == 3
    assert "two flat frames or more" in said.err
    said = Here(capsys)("characterise", found / "s.toml", "--dry-run")
    assert said.code == 0
    assert "linearity: possible" in said.out
    assert "photon_transfer: missing" in said.err
