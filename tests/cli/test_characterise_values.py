"""`photoplan characterise` of frames whose grey values have other steps than 1, and of several temperatures."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from tools.command import Here, inside

SIZE = (64, 48)
GAIN, READ, BLACK = 0.6, 4.0, 20.0
SERIES = """
[camera]
{camera}

[[frames]]
kind = "flat"
files = "flat_{{exposure}}ms_{{photons}}p_*.tif"
temperature_c = 20.0

[[frames]]
kind = "dark"
files = "dark_{{exposure}}ms_{{temperature}}C_*.tif"
"""
Values = Callable[[NDArray[np.float64]], NDArray[Any]]


def write_series(folder: Path, camera: str, values: Values, current: dict[float, float] | None = None) -> Path:
    """A sensor of 12 bits with 0.6 grey values for each of the electrons that 50 % of the photons make."""
    rng = np.random.default_rng(3)
    offset = rng.normal(0.0, 3.0, SIZE[::-1])
    offset[20, 30] += 400.0
    current = current or {20.0: 0.0}

    def write(name: str, electrons: float) -> None:
        seen = GAIN * (rng.poisson(electrons, offset.shape) + offset + rng.normal(0.0, READ, offset.shape)) + BLACK
        grey = values(np.clip(np.rint(seen), 0, 4095))
        with rasterio.open(folder / name, "w", "GTiff", *SIZE, 1, dtype=grey.dtype) as file:
            file.write(grey, 1)

    for t in (1, 2, 4, 8, 12, 16, 24, 32, 40, 60):
        for k in range(2):
            write(f"flat_{t}ms_{240 * t}p_{k}.tif", 120.0 * t + current[20.0] * t / 1000)
            for temperature, rate in current.items():
                write(f"dark_{t}ms_{temperature:g}C_{k}.tif", rate * t / 1000)
    path = folder / "series.toml"
    path.write_text(SERIES.format(camera=camera))
    return path


def figures(series: Path) -> tuple[dict[tuple[str, str], float], dict[str, Any]]:
    """Figures by analysis and name, and all that was said."""
    wanted = ("photon_transfer", "dark_signal", "saturation", "fixed_pattern", "defects", "emva1288", "fall_off")
    said = inside("characterise", series, "--json", "-q", *(word for name in wanted for word in ("--only", name)))
    assert said.code == 0, said.err
    report: dict[str, Any] = json.loads(said.out)
    found = {
        (part["name"], figure["name"]): figure["value"]
        for part in report["analyses"]
        for figure in part.get("figures", ())
        if part["name"] in ("photon_transfer", "dark_signal", "saturation", "fixed_pattern", "defects")
        or (part["name"], figure["name"]) == ("emva1288", "temporal_dark_noise_e")
    }
    return found, report


@pytest.fixture(scope="module")
def usual(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], float]:
    """Whole grey values from 0 to 4095."""
    folder = tmp_path_factory.mktemp("usual")
    found, _ = figures(write_series(folder, "bits = 12", lambda grey: grey.astype(np.uint16)))
    assert found["photon_transfer", "read_noise_e"] == pytest.approx(READ, rel=0.02)
    return found


@pytest.mark.parametrize(
    ("factor", "kind"), [(16.0, "uint16"), pytest.param(1 / 4095, "float32", marks=pytest.mark.slow)]
)
def test_the_unit_of_grey_values_changes_nothing_else(
    tmp_path: Path, usual: dict[tuple[str, str], float], factor: float, kind: str
) -> None:
    """12 bits in the upper ones of 16, and values from 0 to 1: rounding is that of their steps."""
    found, report = figures(write_series(tmp_path, "", lambda grey: (grey * factor).astype(kind)))
    if kind == "uint16":
        assert report["saturation_dn"] == 65520
        assert "steps of 16 DN" in report["notes"][0]
    assert found.keys() == usual.keys()
    for (analysis, name), value in usual.items():
        unit = 1 / factor if name == "conversion_e_dn" else factor if "_dn" in name else 1.0
        assert found[analysis, name] == pytest.approx(value * unit, rel=2e-5, abs=1e-6 * unit), (analysis, name)


def test_more_than_the_stated_bits_is_refused(tmp_path: Path) -> None:
    """Values in the upper bits of their type are no saturated ones."""
    series = write_series(tmp_path, "bits = 12", lambda grey: (grey * 16).astype(np.uint16))
    said = inside("characterise", series, "-q")
    assert said.code == 3
    assert "has the grey value" in said.err
    assert "camera.bits allow 4095" in said.err


def test_dark_frames_of_another_temperature_are_left_out(tmp_path: Path) -> None:
    """The sheet takes the dark frames of the flat frames' temperature, wherever they stand in the series."""
    current = {20.0: 100.0, 50.0: 20000.0}
    _, report = figures(write_series(tmp_path, "bits = 12", lambda grey: grey.astype(np.uint16), current))
    sheet = {f["name"]: f for f in next(p for p in report["analyses"] if p["name"] == "emva1288")["figures"]}
    for name, truth in (("gain_dn_e", GAIN), ("quantum_efficiency_percent", 50.0), ("temporal_dark_noise_e", READ)):
        assert abs(sheet[name]["value"] - truth) < 3.5 * sheet[name]["sigma"], name
    parts = {part["name"]: part for part in report["analyses"]}
    assert "20 °C subtracted" in parts["fall_off"]["notes"][0]
    assert parts["fixed_pattern"]["details"]["dsnu"]["setting"].endswith("20 °C")


@pytest.mark.parametrize("largest", [pytest.param(4095.0, marks=pytest.mark.slow), 1.0])
def test_times_with_decimals_in_names_and_values_up_to_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], largest: float
) -> None:
    """Frames every half second, so that `up_0.5.tif` comes after `up_0.tif`; the gain settles when it does."""
    rng = np.random.default_rng(2)
    for k in range(40):
        after = 0.5 * k - 5.0
        level = 2000.0 if after < 0 else 1700.0 - 200.0 * np.exp(-after / 3.0)
        grey = np.rint(level + rng.normal(0.0, 6.0, (40, 40)))
        with rasterio.open(tmp_path / f"up_{0.5 * k:g}.tif", "w", "GTiff", 40, 40, 1, dtype="float32") as file:
            file.write((grey * largest / 4095).astype(np.float32), 1)
        with rasterio.open(tmp_path / f"none_{0.5 * k:g}.tif", "w", "GTiff", 40, 40, 1, dtype="float32") as file:
            level = np.rint(np.random.default_rng(k).normal(2000.0, 6.0, (40, 40)))
            file.write((level * largest / 4095).astype(np.float32), 1)
    entry = '[[frames]]\nkind = "step"\nname = "{0}"\nfiles = "{0}_{{time_s}}.tif"\n'
    (tmp_path / "series.toml").write_text(entry.format("none") + entry.format("up"))
    said = Here(capsys)("characterise", tmp_path / "series.toml", "--json", "-q")
    assert said.code == 0, said.err
    part = next(part for part in json.loads(said.out)["analyses"] if part["name"] == "gain_control")
    # A transition that cannot be used is named, and the other one is.
    assert part["refused"]["transition none"].startswith("none: no step")
    found = {figure["name"]: figure for figure in part["figures"]}
    for name, truth in (("change_dn", 200 * largest / 4095), ("time_constant_s", 3.0)):
        assert abs(found[name]["value"] - truth) < 3.5 * found[name]["sigma"], name
    assert found["settled_s"]["value"] == pytest.approx(3 * np.log(200 / 0.5), abs=0.5)


def test_mask_of_drift_frames_counts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A stain in the middle changes; what lies around it does not."""
    rng = np.random.default_rng(2)
    mask = np.ones((40, 40), np.uint8)
    mask[18:22, 18:22] = 0
    for k in range(12):
        grey = 1000 + 5 * rng.standard_normal((40, 40)) + 100 * k * (mask == 0)
        with rasterio.open(tmp_path / f"drift_{10 * k}.tif", "w", "GTiff", 40, 40, 1, dtype="uint16") as file:
            file.write(np.rint(grey).astype(np.uint16), 1)
    with rasterio.open(tmp_path / "mask.tif", "w", "GTiff", 40, 40, 1, dtype="uint8") as file:
        file.write(mask, 1)
    entry = '[[frames]]\nkind = "drift"\nfiles = "drift_{time_s}.tif"\nmask = "mask.tif"\nvalues = { window = 20 }\n'
    (tmp_path / "series.toml").write_text(entry)
    said = Here(capsys)("characterise", tmp_path / "series.toml", "--only", "drift", "--json", "-q")
    assert said.code == 0, said.err
    found = {figure["name"]: figure["value"] for figure in json.loads(said.out)["analyses"][0]["figures"]}
    assert found["mean_dn"] == pytest.approx(1000, abs=0.3)
    assert found["pixel_noise_of_mean_dn"] == pytest.approx(5 / np.sqrt(400 - 16), rel=0.1)


@pytest.mark.parametrize(
    ("entry", "why"),
    [
        ('kind = "stage"\nmask = "mask.tif"', "a mask does not count for kind stage"),
        ('kind = "step"\nbrightest = 0.5', "brightest does not count for kind step"),
        ('kind = "wedge"\nmask = "m.tif"\nsteps = [{ density = 0.1, roi = [0, 0, 9, 9] }]', "does not count for steps"),
    ],
)
def test_masks_that_would_not_count_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], entry: str, why: str
) -> None:
    (tmp_path / "series.toml").write_text(f'[[frames]]\nfiles = "a_*.tif"\n{entry}\n')
    said = Here(capsys)("characterise", tmp_path / "series.toml")
    assert said.code == 3
    assert why in said.err


@pytest.mark.parametrize("dark", [True, False])
def test_saturation_where_dark_frames_state_no_exposure_or_are_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], dark: bool
) -> None:
    """A black level of 200 DN is no response; grey values stop at 4095, which is the largest."""
    rng = np.random.default_rng(7)
    kinds = [(f"flat_{t}ms_{k}.tif", 60.0 * t) for t in (2, 4, 8, 16, 24, 32, 40, 50, 75, 90) for k in range(2)]
    for name, signal in [*kinds, ("dark_0.tif", 0.0), ("dark_1.tif", 0.0)]:
        grey = 200 + 0.5 * rng.poisson(2 * signal, (40, 48)) + 3 * rng.standard_normal((40, 48))
        with rasterio.open(tmp_path / name, "w", "GTiff", 48, 40, 1, dtype="uint16") as file:
            file.write(np.clip(np.rint(grey), 0, 4095).astype(np.uint16), 1)
    series = '[camera]\nbits = 12\n[[frames]]\nkind = "flat"\nfiles = "flat_{exposure}ms_*.tif"\n'
    series += '[[frames]]\nkind = "dark"\nfiles = "dark_*.tif"\n' if dark else ""
    (tmp_path / "series.toml").write_text(series)
    said = Here(capsys)("characterise", tmp_path / "series.toml", "--only", "saturation", "--json", "-q")
    assert said.code == 0, said.err
    report = json.loads(said.out)
    assert report["notes"] == []
    found = {figure["name"]: figure for figure in report["analyses"][0]["figures"]}
    assert "between 50 and 75 ms: grey values stop" in found["saturation_dn"]["remark"]
    assert found["saturation_exposure"]["value"] == pytest.approx((4095 - 200) / 60, rel=0.01)
