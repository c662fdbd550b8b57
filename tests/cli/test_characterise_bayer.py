"""`photoplan characterise` of a Bayer pattern: lengths, places and frequencies are those of the whole image."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.command import Here
from tools.thinned import some

SERIES = """
[camera]
bits = 12
{bayer}

[[frames]]
kind = "flat"
files = "flat_*.tif"
values = {{ artificial = "none", principal_point = "estimated" }}

[[frames]]
kind = "dark"
files = "dark_*.tif"

[[frames]]
kind = "scene"
files = "lamp_{{exposure}}ms.tif"
"""


@pytest.mark.parametrize("bayer", some(['bayer = "RGGB"', ""], 0))
def test_pixels_are_those_of_the_image(tmp_path: Path, capsys: pytest.CaptureFixture[str], bayer: str) -> None:
    """Fall-off with a stain, stripes in the dark, and a lamp whose column is lit for 20 pixels up and down."""
    rng = np.random.default_rng(1)
    y, x = np.mgrid[:160, :200]
    flat = 3000.0 * np.cos(np.arctan(np.hypot(x - 114.5, y - 69.5) / 150)) ** 4
    flat *= np.where(np.hypot(x - 150, y - 120) < 6, 0.8, 1.0)
    dark = 40.0 + 6.0 * np.sin(2 * np.pi * x / 20)
    colours = np.array([[0.5, 1.0], [1.0, 0.7]])[y % 2, x % 2] if bayer else np.ones_like(flat)

    def write(name: str, values: np.ndarray) -> None:
        whole = np.clip(np.rint(values + 3.0 * rng.standard_normal(values.shape)), 0, 4095).astype(np.uint16)
        with rasterio.open(tmp_path / name, "w", "GTiff", 200, 160, 1, dtype="uint16") as file:
            file.write(whole, 1)

    for k in range(4):
        write(f"flat_{k}.tif", dark + colours * flat)
        write(f"dark_{k}.tif", dark)
    lamp = np.maximum(np.abs(x - 100), np.abs(y - 80)) <= 12
    lifted = (np.abs(x - 100) <= 10) & (np.abs(y - 80) <= 32)
    for t in (1, 2, 3, 4, 6, 8, 12):
        write(f"lamp_{t}ms.tif", dark + np.where(lamp, 600.0 * t, 0.0) + (300.0 * (t - 6) if t > 6 else 0.0) * lifted)
    (tmp_path / "s.toml").write_text(SERIES.format(bayer=bayer))
    only = ("--only", "fall_off", "--only", "fixed_pattern", "--only", "blooming")
    said = Here(capsys)("characterise", tmp_path / "s.toml", *only, "--csv", tmp_path / "csv", "--json", "-q")
    assert said.code == 0, said.err
    figures = [f for part in json.loads(said.out)["analyses"] for f in part.get("figures", ())]
    truths = {"camera_constant_px": 150.0, "principal_point_x_px": 114.5, "principal_point_y_px": 69.5}
    seen = [f for f in figures if f["name"] in truths]
    assert len(seen) == (12 if bayer else 3)
    for f in seen:
        assert abs(f["value"] - truths[f["name"]]) < 4.5 * f["sigma"], f
    peaks = [f["remark"] for f in figures if f["name"] == "excess_dark_rows"]
    assert set(peaks) == {"peak at 0.05 cycles/px"}
    extents = [f["value"] for f in figures if f["name"] == "blooming_rows_px"]
    assert extents and all(18 <= extent <= 22 for extent in extents)
    with (tmp_path / "csv" / "fall_off_dirt.csv").open() as file:
        places = [(float(row["x"]), float(row["y"]), float(row["width"])) for row in csv.DictReader(file)]
    assert all(np.hypot(px - 150, py - 120) < 3 and 10 <= width <= 14 for px, py, width in places)
    with (tmp_path / "csv" / "fixed_pattern_spectrograms.csv").open() as file:
        highest = max(float(row["frequency_cycles_px"]) for row in csv.DictReader(file))
    assert highest == (0.25 if bayer else 0.5)
