"""Control proposed for aerial images of 6 m pixels in mountains from orthophotos of 5 m, with spoilt orientations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tools.proposed import residuals, spoilt
from tools.real_projects import dmc_project

from photoplan.io.points import read_ground_points
from photoplan.products.control import ControlRequest, propose_control


@pytest.mark.parametrize(
    ("orthos", "limit"),
    [
        ([f"ngi_rgb_byte_{k}.tif" for k in (1, 2, 3, 4)], 1.0),
        pytest.param(["sentinel2_b432_byte.tif"], 1.5, marks=pytest.mark.slow),
    ],
    ids=["of the same flight", "of a satellite, 10 m"],
)
@pytest.mark.slow
def test_control_fits_the_true_orientation_to_a_pixel(
    shared: Path, tmp_path: Path, orthos: list[str], limit: float
) -> None:
    data = shared / "data" / "ngi_dmc"
    true = dmc_project(shared, tmp_path)
    near = tmp_path / "near.toml"
    near.write_text(true.read_text())
    spoilt(near, 10.0, 0.2)
    files = tuple(data / "ref" / name for name in orthos)
    found = propose_control(ControlRequest(near, files, height_sigma=3.0, search=60.0))
    error = residuals(true, tmp_path / "control.csv")
    print(f"{len(error)} points, rms {np.sqrt((error**2).mean()):.2f} px")
    assert len(error) >= 100 and min(len(i.points) for i in found.images) >= 20
    assert np.sqrt((error**2).mean()) <= limit  # measured: 0.40 and 0.73
    ground = read_ground_points(tmp_path / "control.csv")
    # Slopes carry the error of the place into the height.
    assert (ground.sigma[:, 2] > 3.0).all() and ground.sigma[:, 2].max() > 4.0
