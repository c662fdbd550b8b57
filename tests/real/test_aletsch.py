"""The Aletsch glacier of about 1895: a photograph of unknown camera, oriented by eleven points."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from photoplan.cli.table import VERBS
from photoplan.io.project.file import load_project

command = VERBS["resect"].command("resect")

PROJECT = """crs = "EPSG:21781"

[orientation]
height_system = "same"
earth_curvature = "{curvature}"
refraction = true

[observations]
image_points = ["points.csv"]
control = ["control.csv"]
sigma_image = 5.0
sigma_control = [0.0, 0.0]

[cameras.photo]
size = [1024, 763]
focal_px = 5000.0

[[images]]
name = "07861v"
file = "07861v.jpg"
camera = "photo"
"""


@pytest.fixture
def facts(shared: Path) -> dict:
    return json.loads((shared / "data" / "aletsch_photo_dem" / "resection.json").read_text())


def prepared(facts: dict, folder: Path, curvature: str) -> Path:
    table = np.array(facts["gcps_uvXYZ"])
    rows = [f"g{k},07861v,{u!r},{v!r}" for k, (u, v) in enumerate(table[:, :2].tolist())]
    (folder / "points.csv").write_text("point,image,x,y\n" + "\n".join(rows) + "\n")
    rows = [f"g{k},{X!r},{Y!r},{Z!r}" for k, (X, Y, Z) in enumerate(table[:, 2:].tolist())]
    (folder / "control.csv").write_text("name,x,y,z\n" + "\n".join(rows) + "\n")
    path = folder / "project.toml"
    path.write_text(PROJECT.format(curvature=curvature))
    return path


def test_eleven_points_without_start_values(facts: dict, tmp_path: Path) -> None:
    path = prepared(facts, tmp_path, "strict")
    # The stated camera constant is five times the true one and must not matter.
    result = CliRunner().invoke(command, [str(path), "--unknown-camera-constant", "--json"])
    assert result.exit_code == 0, result.output
    image = json.loads(result.stdout)["images"][0]
    residuals = np.array([p["residual_px"] for p in image["points"]])
    assert len(residuals) == 11 and not any(p["rejected"] for p in image["points"])
    rms = float(np.sqrt((residuals**2).mean()))
    assert rms <= 6.0
    assert abs(rms - 5.46) < 0.02, "the figure of an independent solution"
    center = np.array(load_project(path).images[0].center)
    # That solution lies well inside the standard deviations, and so does the summit it was taken from.
    assert (np.abs(center - facts["C"]) < 0.2 * np.array(image["sigma_center"])).all()
    assert abs(image["camera"]["c"]["value"] - facts["f_px"]) < 5.0
    assert (np.array(image["sigma_center"]) > 10.0).all()


@pytest.mark.slow
def test_points_above_the_camera_need_strict_curvature(facts: dict, tmp_path: Path) -> None:
    path = prepared(facts, tmp_path, "correction")
    result = CliRunner().invoke(command, [str(path), "--unknown-camera-constant"])
    assert "not defined for points above the camera; ask for strict" in str(result.exception)
    plain = CliRunner().invoke(
        VERBS["resect"].command("resect"), [str(prepared(facts, tmp_path, "none")), "--unknown-camera-constant"]
    )
    assert plain.exit_code == 0, plain.output
