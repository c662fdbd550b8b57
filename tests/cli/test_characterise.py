"""`photoplan characterise`: a simulated camera known from its files, outputs, refusals and exit codes."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.camera_model import Sensor, write_frame
from tools.command import Here
from tools.recorded import recorded

SENSOR = Sensor(
    shape=(64, 80),
    full_well=6000.0,
    dsnu=4.0,
    prnu=0.01,
    hot={(10, 20): 800.0, (40, 60): 500.0},
    dead=((30, 40),),
)
PHOTONS_PER_MS = 400.0
EXPOSURES = (2, 5, 8, 12, 16, 20, 24, 28, 34, 40, 50)
SERIES = """
[camera]
name = "simulated"
bits = 12

[[frames]]
kind = "flat"
files = "flat/flat_{exposure}ms_{photons}ph_*.tif"

[[frames]]
kind = "dark"
files = "dark/dark_{exposure}ms_*.tif"
name = "same exposures"

[[frames]]
kind = "dark"
files = "warm/dark_{exposure}ms_{temperature}C_*.tif"

[[frames]]
kind = "wedge"
files = "wedge/wedge_{density}_*.tif"
exposure_ms = 12.0
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Flat, dark and wedge frames of the sensor."""
    place = tmp_path_factory.mktemp("camera")
    noise = np.random.default_rng(0)
    for t in EXPOSURES:
        count = 6 if t == 16 else 2
        for k in range(count):
            photons = PHOTONS_PER_MS * t
            write_frame(place / f"flat/flat_{t}ms_{photons:g}ph_{k}.tif", SENSOR.frame(photons, t, noise))
            write_frame(place / f"dark/dark_{t}ms_{k}.tif", SENSOR.frame(0, t, noise))
    for celsius in (20, 35):
        for t in (200, 600, 1200):
            for k in range(4):
                name = f"warm/dark_{t}ms_{celsius}C_{k}.tif"
                write_frame(place / name, SENSOR.frame(0, t, noise, celsius))
    for density in (0.05, 0.2, 0.5, 0.9, 1.3):
        for k in range(2):
            photons = 8000 * 10**-density
            write_frame(place / f"wedge/wedge_{density}_{k}.tif", SENSOR.frame(photons, 12, noise))
    (place / "series.toml").write_text(SERIES, "utf-8")
    return place


@pytest.fixture
def run(capsys) -> Here:
    return Here(capsys)


@pytest.fixture(scope="module")
def told(folder, tmp_path_factory) -> dict:
    """Everything that the series allows, as JSON."""
    from photoplan.plain import json_text
    from photoplan.products.characterise.run import CharacteriseRequest, characterise

    return json.loads(json_text(characterise(CharacteriseRequest(folder / "series.toml"))))


def figures(told: dict, analysis: str) -> dict[str, dict]:
    found = next(a for a in told["analyses"] if a["name"] == analysis)
    assert found["state"] == "done", found
    return {f["name"] + ("@" + f["at"] if f.get("at") else ""): f for f in found["figures"]}


TRUTH = {
    ("photon_transfer", "gain_dn_e"): 0.4,
    ("photon_transfer", "read_noise_e"): 8.0,
    ("photon_transfer", "full_well_e"): 6000,
    ("dark_signal", "dark_current_dn_s@20 °C"): 0.4 * (20 + 1300 / (64 * 80)),
    ("dark_signal", "doubling_temperature_k"): 7.0,
    ("fixed_pattern", "dsnu_dn"): 1.6,
    # The dead pixel, 95 % darker, belongs to the pattern by the definition of the standard.
    ("fixed_pattern", "prnu_percent"): 100 * np.hypot(0.01, 0.95 / np.sqrt(64 * 80)),
    ("wedge", "gamma@12 ms"): 1.0,
    ("saturation", "saturation_dn"): 64 + 0.4 * 6000,
    ("emva1288", "quantum_efficiency_percent"): 50,
    ("emva1288", "gain_dn_e"): 0.4,
    ("emva1288", "temporal_dark_noise_e"): 8.0,
    ("emva1288", "dsnu_e"): 4.0,
    ("emva1288", "dark_current_e_s@20 °C"): 20 + 1300 / (64 * 80),
    ("emva1288", "doubling_temperature_k"): 7.0,
}


@pytest.mark.parametrize(("analysis", "name"), TRUTH)
def test_figure_of_the_simulated_camera(told, analysis, name):
    found, truth = figures(told, analysis)[name], TRUTH[analysis, name]
    sigma = found["sigma"]
    print(f"{analysis} {name}: {found['value']:.5g} ± {sigma} against {truth:g}")
    allowed = 4 * sigma if sigma else 0.005 * truth
    assert found["value"] == pytest.approx(truth, abs=max(allowed, 1e-9))
    assert found["value"] == pytest.approx(truth, rel=0.15)


def test_hot_and_dead_pixels_are_listed_with_their_places(told):
    found = next(a for a in told["analyses"] if a["name"] == "defects")
    rows = [dict(zip(found["tables"]["list"]["head"], row)) for row in found["tables"]["list"]["rows"]]
    hot = {(r["row"], r["column"]) for r in rows if r["kind"] == "hot" and r["setting"].startswith("dark")}
    dead = {(r["row"], r["column"]) for r in rows if r["kind"] == "dark"}
    assert hot == set(SENSOR.hot)
    assert dead == set(SENSOR.dead)


def test_linearity_ends_where_the_sensor_saturates(told):
    found = figures(told, "linearity")
    assert found["linearity_error_percent"]["value"] < 0.3
    assert found["response"]["value"] == pytest.approx(0.4 * 0.5 * PHOTONS_PER_MS, rel=0.01)


@pytest.mark.slow
@pytest.mark.drawn
def test_figures_of_the_report_are_drawn(folder, tmp_path, run):
    report = tmp_path / "r.html"
    assert run("characterise", folder / "series.toml", "--report", report).code == 0
    assert report.read_text("utf-8").count("data:image/png") > 10


def test_report_tables_and_json(folder, tmp_path, run):
    report, tables = tmp_path / "r.html", tmp_path / "csv"
    said = run("characterise", folder / "series.toml", "--report", report, "--csv", tables)
    assert said.code == 0
    assert str(tables / "figures.csv") in said.out and str(report) in said.out
    html = report.read_text("utf-8")
    for title in ("Photon transfer", "Dark signal", "Linearity", "Fixed pattern", "Defect elements", "EMVA 1288"):
        assert f"<h2>{title}" in html
    assert html.count("data:image/png") > 10 and "http" not in re.sub(r'http-equiv|base64,[^"]*', "", html)
    with (tables / "figures.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    gain = next(r for r in rows if r["analysis"] == "photon_transfer" and r["name"] == "gain_dn_e")
    assert float(gain["value"]) == pytest.approx(0.4, rel=0.02)
    assert (tables / "defects_list.csv").exists()
    recorded(tables / "figures.run.json", "characterise", folder / "series.toml")
    again = run("characterise", folder / "series.toml", "--report", report)
    assert again.code == 2 and "--overwrite" in again.err
    again = run("characterise", folder / "series.toml", "--csv", tables)
    assert again.code == 2 and "--overwrite" in again.err


def test_fault_13_outputs_that_are_inputs(folder, run):
    said = run("characterise", folder / "series.toml", "--report", folder / "series.toml", "--overwrite")
    assert said.code == 2 and "is the input" in said.err
    assert (folder / "series.toml").read_text("utf-8") == SERIES
    frame = folder / "flat/flat_2ms_800ph_0.tif"
    said = run("characterise", folder / "series.toml", "--report", frame, "--overwrite")
    assert said.code == 2 and "is the input" in said.err


def test_dry_run_reads_no_pixel_and_names_what_is_missing(folder, tmp_path, run):
    said = run("characterise", folder / "series.toml", "--dry-run", "--report", tmp_path / "r.html")
    assert said.code == 0
    assert "photon_transfer: possible" in said.out
    assert re.search(r"blooming: missing: 0 settings of scene frames", said.err)
    assert not (tmp_path / "r.html").exists()
    told = json.loads(run("characterise", folder / "series.toml", "--dry-run", "--json", "-q").out)
    states = {a["name"]: a["state"] for a in told["analyses"]}
    assert states["emva1288"] == "possible" and states["blooming"] == "missing"


def test_only_some(folder, run):
    said = run("characterise", folder / "series.toml", "--only", "wedge", "--only", "noise", "--json", "-q")
    assert said.code == 0 and said.err.startswith("the sensor is full"), "notes are no progress"
    assert [a["name"] for a in json.loads(said.out)["analyses"]] == ["noise", "wedge"]
    said = run("characterise", folder / "series.toml", "--only", "colour")
    assert said.code == 2 and "known are photon_transfer" in said.err
    said = run("characterise", folder / "series.toml", "--only", "blooming")
    assert said.code == 3 and "blooming needs 4" in said.err


def test_series_that_allows_nothing(folder, tmp_path, run):
    file = tmp_path / "s.toml"
    file.write_text(f'[[frames]]\nkind = "scene"\nfiles = "{folder}/flat/flat_2ms_800ph_0.tif"\n')
    said = run("characterise", file)
    assert said.code == 3 and "lacks what any analysis needs" in said.err
    said = run("characterise", tmp_path / "nothing.toml")
    assert said.code == 3 and "nothing.toml" in said.err


def test_fault_08_damaged_frame_is_named(folder, tmp_path, run):
    bad = tmp_path / "wedge_0.3_0.tif"
    whole = (folder / "wedge/wedge_0.5_0.tif").read_bytes()
    bad.write_bytes(whole[:-40])
    text = SERIES.replace('"flat/', f'"{folder}/flat/').replace('"dark/', f'"{folder}/dark/')
    text = text.replace('"warm/', f'"{folder}/warm/').replace('"wedge/wedge_', f'["{bad}", "{folder}/wedge/wedge_')
    (tmp_path / "s.toml").write_text(text.replace('_{density}_*.tif"', '_{density}_*.tif"]'))
    said = run("characterise", tmp_path / "s.toml", "--only", "linearity")
    assert said.code == 3
    assert "wedge_0.3_0.tif" in said.err and said.out == ""


def test_exposures_that_cannot_be_give_no_linearity(folder, tmp_path, run):
    table = tmp_path / "t.csv"
    wrong = dict(zip(EXPOSURES, EXPOSURES)) | {20: 5, 5: 20}
    lines = [
        f"flat_{t}ms_{PHOTONS_PER_MS * t:g}ph_{k},{wrong[t]}" for t in EXPOSURES for k in range(6 if t == 16 else 2)
    ]
    table.write_text("file,exposure_ms\n" + "\n".join(line.replace(",", ".tif,") for line in lines) + "\n")
    text = f'[camera]\nbits = 12\n[[frames]]\nkind = "flat"\nfiles = "{folder}/flat/*.tif"\ntable = "{table}"\n'
    (tmp_path / "s.toml").write_text(text)
    said = run("characterise", tmp_path / "s.toml", "--only", "linearity")
    assert said.code == 0
    assert "not known: linearity: the signal falls from" in said.out
    assert "DN/ms" not in said.out


def test_planes_of_a_bayer_sensor_are_measured_apart(tmp_path, run):
    noise = np.random.default_rng(4)
    colour = np.ones((48, 64))
    colour[::2, ::2], colour[1::2, 1::2] = 0.5, 0.4
    for t in (8, 16, 24, 32):
        for k in range(2):
            frame = Sensor(shape=(48, 64)).frame(400 * t * colour, t, noise)
            write_frame(tmp_path / f"f_{t}ms_{k}.tif", frame)
            write_frame(tmp_path / f"d_{t}ms_{k}.tif", Sensor(shape=(48, 64)).frame(0, t, noise))
    (tmp_path / "s.toml").write_text(
        '[camera]\nbits = 12\nbayer = "RGGB"\n[[frames]]\nkind = "flat"\nfiles = "f_{exposure}ms_*.tif"\n'
        '[[frames]]\nkind = "dark"\nfiles = "d_{exposure}ms_*.tif"\n'
    )
    said = run("characterise", tmp_path / "s.toml", "--json", "-q", "--only", "linearity", "--only", "photon_transfer")
    told = {a["name"]: a for a in json.loads(said.out)["analyses"]}
    response = {f["plane"]: f["value"] for f in told["linearity"]["figures"] if f["name"] == "response"}
    assert response == pytest.approx({"R": 40, "G1": 80, "G2": 80, "B": 32}, rel=0.02)
    gain = {f["plane"]: f["value"] for f in told["photon_transfer"]["figures"] if f["name"] == "gain_dn_e"}
    assert gain == pytest.approx(dict.fromkeys(("R", "G1", "G2", "B"), 0.4), rel=0.15)


def test_wedge_by_steps_in_one_image(tmp_path, run):
    noise = np.random.default_rng(5)
    densities = (0.1, 0.4, 0.7, 1.0)
    photons = np.repeat([8000 * 10**-d for d in densities], 20)[None, :] * np.ones((30, 1))
    for k in range(2):
        write_frame(tmp_path / f"w{k}.tif", Sensor(shape=(30, 80)).frame(photons, 5, noise))
    steps = ", ".join(f"{{ density = {d}, roi = [{20 * i + 2}, 2, 16, 26] }}" for i, d in enumerate(densities))
    (tmp_path / "s.toml").write_text(
        '[camera]\nbits = 12\nblack_level_dn = 64.0\n[[frames]]\nkind = "wedge"\nfiles = "w*.tif"\nillumination = 6.0\n'
        f"steps = [{steps}]\n"
    )
    told = json.loads(run("characterise", tmp_path / "s.toml", "--only", "wedge", "--json", "-q").out)
    found = figures(told, "wedge")
    assert found["gamma@illumination 6"]["value"] == pytest.approx(1.0, abs=0.02)


def test_blooming_from_files(tmp_path, run):
    noise = np.random.default_rng(6)
    for t in (2, 4, 8, 12, 16, 24):
        signal = np.full((60, 70), 0.5 * t)
        signal[25:35, 30:40] = 20.0 * t
        over = np.maximum(signal - 150, 0)
        signal = signal - over
        for d in range(1, 20):
            signal[25 - d] += 0.02 * np.exp(-d / 6) * over.sum(axis=0)
            signal[34 + d] += 0.02 * np.exp(-d / 6) * over.sum(axis=0)
        frame = np.clip(np.rint(10 + noise.poisson(signal * 4) / 4), 0, 255).astype(np.uint8)
        write_frame(tmp_path / f"s_{t}ms.tif", frame)
    (tmp_path / "s.toml").write_text(
        '[camera]\nblack_level_dn = 10.0\n[[frames]]\nkind = "scene"\nfiles = "s_{exposure}ms.tif"\n'
    )
    told = json.loads(run("characterise", tmp_path / "s.toml", "--only", "blooming", "--json", "-q").out)
    onset = figures(told, "blooming")["blooming_onset_dn"]
    assert onset["value"] == pytest.approx(150, abs=3 * onset["sigma"])


def test_fault_08_frame_whose_pixels_are_damaged_stops_its_analysis_only(folder, tmp_path, run):
    with rasterio.open(folder / "wedge/wedge_0.5_0.tif") as file:
        pixels = file.read(1)
    profile = {"driver": "GTiff", "count": 1, "height": 64, "width": 80, "dtype": "uint16", "compress": "deflate"}
    for density in (0.1, 0.4, 0.8):
        with rasterio.open(tmp_path / f"w_{density}.tif", "w", **profile) as file:
            file.write(pixels, 1)
    bad = tmp_path / "w_0.4.tif"
    content = bytearray(bad.read_bytes())
    for k in range(len(content) // 2, len(content) // 2 + 40):
        content[k] ^= 0x5A
    bad.write_bytes(content)
    (tmp_path / "s.toml").write_text(
        f'[camera]\nbits = 12\n[[frames]]\nkind = "wedge"\nfiles = "w_{{density}}.tif"\n'
        f'[[frames]]\nkind = "flat"\nfiles = "{folder}/flat/flat_{{exposure}}ms_*.tif"\n'
    )
    said = run("characterise", tmp_path / "s.toml", "--only", "wedge", "--only", "linearity")
    assert said.code == 4
    assert "wedge:" in said.err and "w_0.4.tif" in said.err and "damaged" in said.err
    assert "linearity error" in said.out and "gamma" not in said.out


def test_black_is_that_of_the_exposure_and_temperature(tmp_path):
    from photoplan.io.series import read_series
    from photoplan.products.characterise.data import SeriesData, black_of

    noise = np.random.default_rng(8)
    for kind, exposure, celsius, mean in (
        ("flat", 10, 20, 900),
        ("flat", 20, 20, 900),
        ("flat", 10, 30, 900),
        ("flat", 10, 40, 900),
        ("dark", 10, 20, 100),
        ("dark", 30, 20, 120),
        ("dark", 10, 30, 150),
    ):
        for k in range(2):
            pixels = np.rint(mean + 3 * noise.standard_normal((20, 20))).astype(np.uint16)
            write_frame(tmp_path / f"{kind}_{exposure}ms_{celsius}C_{k}.tif", pixels)
    text = "[camera]\nblack_level_dn = 7.0\n" + "".join(
        f'[[frames]]\nkind = "{kind}"\nfiles = "{kind}_{{exposure}}ms_{{temperature}}C_*.tif"\n'
        for kind in ("flat", "dark")
    )
    (tmp_path / "s.toml").write_text(text)
    data = SeriesData(read_series(tmp_path / "s.toml"))
    found = {}
    for setting in data.settings("flat"):
        black = black_of(data, setting, data.planes[0])
        found[setting.first.exposure_ms, setting.first.temperature_c] = black.mean
    assert found == pytest.approx({(10, 20): 100, (20, 20): 110, (10, 30): 150, (10, 40): 7}, abs=1)
