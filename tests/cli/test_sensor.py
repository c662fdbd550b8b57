"""`photoplan sensor`: figures of both templates, comparison with stated values, files, wrong descriptions."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import pytest
from tools.command import Here
from tools.recorded import recorded

TEMPLATES = Path(__file__).resolve().parents[2] / "docs" / "templates"
VIDEO, FRAME = TEMPLATES / "sensor-video.toml", TEMPLATES / "sensor-frame.toml"


def figures(said):
    assert said.code == 0, said.err
    return {f["name"]: f for f in json.loads(said.out)["figures"]}


def test_figures_of_behrs_camera(photoplan: Here):
    said = photoplan("sensor", VIDEO, "--json")
    found = figures(said)
    wanted = {
        "viewing_lines": 560,
        "line_hz": 15625,
        "bandwidth_mhz": 6.51,
        "blanking_factor": 1.18,
        "bandwidth_kell_mhz": 5.15,
        "element_x_um": 22.9,
        "element_y_um": 13.6,
        "nyquist_element_x_lp_mm": 21.8,
        "nyquist_pixel_x_lp_mm": 29.1,
        "nyquist_pixel_y_lp_mm": 34.7,
        "resolution_x_lp": 256,
        "resolution_y_lp": 240,
        "jitter_px": 0.2,
        "jitter_grey": 20,
        "noise_shot_e": 1000,
        "noise_dark_e": 100,
        "noise_transfer_e": 200,
        "noise_amplifier_e": 200,
        "noise_sum_e": 1500,
    }
    for name, value in wanted.items():
        print(name, found[name]["value"], value)
        assert found[name]["value"] == pytest.approx(value, rel=4e-3), name
    # Where the text differs from its equations both are shown, and the difference is told.
    assert found["blanking_factor"]["stated"] == 1.15 and "1.15 is stated" in said.err
    assert found["noise_total_e"]["value"] == pytest.approx(1044, abs=0.5) and "1500 is stated" in said.err
    # Table 3.4 prints 36.8, of the rounded size 13.6 µm; the unrounded one gives 36.74.
    assert found["nyquist_element_y_lp_mm"]["value"] == pytest.approx(36.74, abs=0.01)


def test_figures_of_a_modern_camera(photoplan: Here):
    found = figures(photoplan("sensor", FRAME, "--json", "-q"))
    assert found["sensor_x_mm"]["value"] == pytest.approx(2448 * 3.45e-3)
    assert found["nyquist_element_x_lp_mm"]["value"] == pytest.approx(144.93, abs=0.01)
    assert found["dark_e"]["value"] == pytest.approx(3.0 * 2 ** (20 / 7) * 0.01)
    assert found["noise_quantisation_e"]["value"] == pytest.approx(10500 / 4096 / 12**0.5)
    assert found["noise_total_e"]["value"] == pytest.approx(102.5, abs=0.1)
    both = found["mtf_aperture_x_100"]["value"] * found["mtf_diffraction_x_100"]["value"]
    assert found["mtf_both_x_100"]["value"] == pytest.approx(both)


@pytest.mark.drawn
def test_plain_text_report_and_table(photoplan: Here, tmp_path: Path):
    pytest.importorskip("matplotlib")
    report, table = tmp_path / "sensor.html", tmp_path / "sensor.csv"
    said = photoplan("sensor", VIDEO, "--report", report, "--csv", table, "-q")
    assert said.code == 0 and said.err == ""
    assert re.search(r"bandwidth widened by blanking +1\.181 +Behr 1989, eq\. 3\.11  \(stated: 1\.15\)", said.out)
    assert said.out.splitlines()[-2:] == [str(report), str(table)]
    rows = list(csv.DictReader(table.open(encoding="utf-8")))
    assert {row["name"]: float(row["value"]) for row in rows}["jitter_px"] == pytest.approx(0.2)
    page = report.read_text("utf-8")
    assert page.count("data:image/png") == 3 and "stated elsewhere" in page
    assert recorded(tmp_path / "sensor.run.json", "sensor", VIDEO)["file"] == "sensor.csv"
    again = photoplan("sensor", VIDEO, "--report", report)
    assert again.code == 2 and "--overwrite" in again.err
    assert photoplan("sensor", VIDEO, "--report", report, "--overwrite", "-q").code == 0
    same = photoplan("sensor", VIDEO, "--report", tmp_path / "a", "--csv", tmp_path / "a")
    assert same.code == 2
    assert photoplan("sensor", VIDEO, "--csv", VIDEO, "--overwrite").code == 2
    dry = photoplan("sensor", VIDEO, "--csv", tmp_path / "dry.csv", "--dry-run", "-q")
    assert dry.code == 0 and not (tmp_path / "dry.csv").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "describes nothing"),
        ("[sensor]\nelements = [384, 485]\nsize = [1, 2]\n", r":3: sensor\.size: unknown entry"),
        ("[sensors]\n", r"unknown entry"),
        ("[sensor]\nelements = [384, 485]\n", "size_mm or element_um"),
        ("[sensor]\nelements = [0, 485]\nsize_mm = [8.8, 6.6]\n", r":2: sensor\.elements\[1\]: 0 given"),
        ("[sensor]\nelements = [10, 10]\nelement_um = [5.0, 5.0]\nsensitive_um = [6.0, 5.0]\n", "larger than the elem"),
        ("[video]\nlines = 625\nline_us = 64.0\nline_blanking_us = 64.0\n", "as long as line_us"),
        ("[noise]\nread_noise_e = 2.0\n", "signal_e or full_well_e"),
        ("[noise]\nsignal_e = 5e3\nfull_well_e = 4e3\n", "more than full_well_e"),
        ("[noise]\nsignal_e = 5e3\ndark_e = 1.0\ndark_share = 0.1\n", "keep one"),
        ("[noise]\nsignal_e = 5e3\ndark_current_e_per_s = 1.0\n", "go together"),
        ("[noise]\nsignal_e = inf\n", "inf given"),
        ("[noise]\nsignal_e = 1e300\n", "1e.300 given"),
        ("[image]\njitter_ns = 3.0\n", "sampling_mhz"),
        ("[image]\nbits = 40\n", "40 given"),
        ("[image]\nbits = 8\n[stated]\nquantization = 1.0\n", "no such figure"),
        ("[transfer]\ninefficiency = 2.0\ntransfers = 3\n", "2.0 given"),
        ("[optics]\nf_number = -1.0\n", "-1.0 given"),
        ("name = [", "not valid TOML"),
    ],
)
def test_wrong_descriptions_name_entry_and_line(photoplan: Here, tmp_path: Path, text: str, message: str):
    file = tmp_path / "wrong.toml"
    file.write_text(text)
    said = photoplan("sensor", file)
    assert said.code == 3 and said.out == ""
    assert re.search(message, said.err), said.err
    assert str(file) in said.err


def test_extreme_values_stay_finite(photoplan: Here, tmp_path: Path):
    file = tmp_path / "far.toml"
    file.write_text(
        "[noise]\nsignal_e = 1e15\ndark_current_e_per_s = 1e15\nexposure_s = 1e15\ntemperature_c = 300.0\n"
        "dark_reference_c = -273.15\ndark_doubling_c = 1.0\n[optics]\nf_number = 1e-15\nwavelength_nm = 1e-15\n"
    )
    text = photoplan("sensor", file, "--json").out
    assert json.loads(text) and "Infinity" not in text and "NaN" not in text


def test_missing_file(photoplan: Here, tmp_path: Path):
    said = photoplan("sensor", tmp_path / "none.toml")
    assert said.code == 3 and "none.toml" in said.err


def test_every_entry_is_on_the_reference_page():
    from photoplan.io.quality_files import SensorDescription

    schema = SensorDescription.model_json_schema()
    page = (TEMPLATES.parent / "reference" / "sensor.md").read_text("utf-8")
    tables = [name for name in schema["properties"] if name != "name"]
    assert all(f"[{name}]" in page for name in tables)
    entries = {entry for table in schema["$defs"].values() for entry in table["properties"]}
    assert len(entries) > 35 and not {entry for entry in entries if f"`{entry}`" not in page}
