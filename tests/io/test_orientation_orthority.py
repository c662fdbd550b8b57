"""The conventions of orthority's files, against positions that orthority itself computes.

The figures come from running orthority 0.7.0 (`oty frame`, bilinear, 4 m) on an image whose two bands hold column and
row: a pixel of its orthophoto then states the image position that it was taken from. It rounds positions to 1/32
pixel. Over all pixels of the three orthophotos (196,000) the largest difference from ours was 0.0157 px, the mean
difference below 0.0001 px.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from photoplan.cameras.base import project
from photoplan.cameras.frame import FrameCamera
from photoplan.geometry.pose import Pose
from photoplan.io.formats import read_cameras, read_orientation
from photoplan.io.project.model import Image, interior_of, lens_of

EXTERIOR = "filename,x,y,z,omega,phi,kappa\nimg.tif,500003,5400007,1300,2.0,-3.0,30.0\n"
COMMON = "im_size: [400, 300], sensor_size: [36.0, 27.0], cx: 0.0125, cy: -0.02"
INTERIOR = {
    "brown": "type: brown, focal_len: [35.0, 34.5], k1: -0.1, k2: 0.02, p1: 0.004, p2: -0.006, k3: 0.003",
    "fisheye": "type: fisheye, focal_len: 30.0, k1: -0.02, k2: 0.004",
    "opencv": "type: opencv, focal_len: 35.0, k1: -0.1, k2: 0.02, p1: 0.004, p2: -0.006, k3: 0.003, "
    "k4: 0.05, k5: 0.01, k6: -0.002",
}
#: X, Y of the ground at Z = 300, column, row.
POSITIONS = {
    "brown": [
        (499944, 5399620, 84.125000, 261.312500),
        (499884, 5400048, 147.687500, 106.531250),
        (500184, 5400492, 327.968750, 23.125000),
        (500024, 5399624, 112.312500, 274.906250),
        (500432, 5399788, 279.093750, 293.406250),
        (500148, 5400320, 286.906250, 69.093750),
        (500180, 5399848, 208.687500, 229.375000),
        (500676, 5400024, 394.875000, 258.250000),
    ],
    "fisheye": [
        (499748, 5399468, 38.000000, 245.218750),
        (499576, 5400040, 73.156250, 66.375000),
        (500524, 5400640, 396.781250, 63.781250),
        (499620, 5399472, 8.843750, 223.375000),
        (500280, 5399708, 213.281250, 268.125000),
        (500144, 5400392, 283.250000, 60.218750),
        (499864, 5399788, 108.906250, 182.218750),
        (500092, 5400008, 209.375000, 157.312500),
    ],
    "opencv": [
        (499740, 5399614, 15.968750, 224.375000),
        (500580, 5400050, 369.687500, 234.250000),
        (500216, 5400498, 337.281250, 27.156250),
        (499808, 5399618, 39.218750, 236.312500),
        (500176, 5399786, 195.375000, 250.312500),
        (500196, 5400322, 302.062500, 77.031250),
        (499720, 5399846, 52.750000, 142.625000),
        (500104, 5400022, 216.906250, 157.562500),
    ],
}


@pytest.mark.parametrize("kind", list(INTERIOR))
def test_positions_are_orthoritys(tmp_path: Path, kind: str) -> None:
    (tmp_path / "int.yaml").write_text(f"cam: {{{INTERIOR[kind]}, {COMMON}}}")
    (tmp_path / "ext.csv").write_text(EXTERIOR)
    description = read_cameras(tmp_path / "int.yaml").cameras["cam"]
    table = read_orientation(tmp_path / "ext.csv")
    image = Image(name="img", file="img.tif", camera="cam", center=(0, 0, 0), angles=(0, 0, 0))
    pose = Pose(table.centers[0], table.rotations[0])
    camera = FrameCamera(interior_of(description, image), lens_of(description), pose)
    X, Y, column, row = np.array(POSITIONS[kind]).T
    found = project(camera, np.column_stack([X, Y, np.full(len(X), 300.0)]))
    difference = found - np.column_stack([column, row])
    # Half of 1/32 pixel, and the float32 in which the image holds its positions.
    assert np.abs(difference).max() < 1 / 64 + 1e-4
