"""`photoplan adjust` finds what the polynomials of satellites are off by."""

from __future__ import annotations

import json
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer

from photoplan.products.adjust.run import AdjustRequest, adjust_project


def test_quickbird_by_its_control(shared: Path, tmp_path: Path) -> None:
    """3.64 px off alike; after one shift the five field points fit to 0.13 px (README of the data)."""
    folder = shared / "data/ngi_dmc/rpc_qb2"
    shutil.copy(folder / "qb2_basic1b.tif", tmp_path)
    to_map = Transformer.from_crs(4326, 32735, always_xy=True)
    control, points = ["name,x,y,z"], ["point,image,x,y"]
    for found in json.loads((folder / "gcps.geojson").read_text())["features"]:
        name, (lon, lat, h) = found["properties"]["id"], found["geometry"]["coordinates"]
        x, y = to_map.transform(lon, lat)
        control.append(f"{name},{x:.4f},{y:.4f},{h:.4f}")
        points.append("{},qb2,{:.4f},{:.4f}".format(name, *found["properties"]["ji"]))
    (tmp_path / "control.csv").write_text("\n".join(control))
    (tmp_path / "points.csv").write_text("\n".join(points))
    project = tmp_path / "project.toml"
    project.write_text(
        'format = 1\ncrs = "EPSG:32735"\n[observations]\nimage_points = ["points.csv"]\ncontrol = ["control.csv"]\n'
        'sigma_image = 0.2\nsigma_control = [0.02, 0.02]\n[[images]]\nname = "qb2"\nfile = "qb2_basic1b.tif"\n'
        'rpc = "tags"\n'
    )
    report = adjust_project(AdjustRequest(project))
    entry = tomllib.loads(project.read_text())["images"][0]
    assert np.hypot(*entry["shift"]) == pytest.approx(3.64, abs=0.05)
    assert np.sqrt(entry["covariance"][0]) < 0.1
    image = report.corrections[0]
    assert image.measurements == 5 and np.hypot(*image.mean) < 0.01
    assert report.data["gross_errors"] == []
    lines = (tmp_path / "adjustment/image_points.csv").read_text().splitlines()
    head = lines[0].split(",")
    left = np.array([[float(row.split(",")[head.index(k)]) for k in ("residual_x", "residual_y")] for row in lines[1:]])
    assert round(np.abs(left).max(), 2) <= 0.13
