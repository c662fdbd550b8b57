"""gcp_list.txt of OpenDroneMap: its CRS line, its pixels, its points without names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from photoplan.errors import InputError
from photoplan.geometry.crs import same_crs
from photoplan.io.points import read_gcp_list

#: The layout that the documentation shows, with made-up numbers.
LIST = """EPSG:32616
544256.7 5320919.9 5 3044 2622 IMG_0525.jpg
544157.7 5320899.2 5.5 4193.5 1552 IMG_0585.jpg gcp02
544256.7 5320919.9 5 1606 2763 IMG_0526.jpg
544157.7 5320899.2 5.5 100 200 IMG_0526.JPG gcp02 extra
"""


def write(folder: Path, content: str, name: str = "gcp_list.txt") -> Path:
    path = folder / name
    path.write_bytes(content.encode())
    return path


def test_points_with_and_without_names(tmp_path: Path) -> None:
    gcps = read_gcp_list(write(tmp_path, LIST.replace("\n", "\r\n")))
    assert gcps.crs == "EPSG:32616"
    assert gcps.ground.names == ("gcp_1", "gcp02")
    np.testing.assert_array_equal(gcps.ground.XYZ, [[544256.7, 5320919.9, 5], [544157.7, 5320899.2, 5.5]])
    assert np.isnan(gcps.ground.sigma).all()
    assert not gcps.ground.check.any()
    assert gcps.points.images == ("IMG_0525.jpg", "IMG_0585.jpg", "IMG_0526.jpg")
    # Pixels are taken as they are: 0, 0 is the centre of the upper-left pixel, as OpenSfM computes.
    np.testing.assert_array_equal(gcps.points.xy, [[3044, 2622], [4193.5, 1552], [1606, 2763], [100, 200]])


@pytest.mark.parametrize(
    ("line", "crs"),
    [
        ("WGS84 UTM 16N", "EPSG:32616"),
        ("wgs84 utm 16S", "EPSG:32716"),
        ("+proj=utm +zone=16 +datum=WGS84 +units=m +no_defs", "+proj=utm +zone=16 +datum=WGS84 +units=m +no_defs"),
        ("EPSG:32616+5773", "EPSG:32616"),
    ],
)
def test_ways_to_state_the_crs(tmp_path: Path, line: str, crs: str) -> None:
    assert same_crs(read_gcp_list(write(tmp_path, LIST.replace("EPSG:32616", line))).crs, crs)


def test_points_are_brought_into_the_projects_crs(tmp_path: Path) -> None:
    """Zone 17 and back gives the point again; geographic ones are never taken for metres."""
    there = read_gcp_list(write(tmp_path, LIST), "EPSG:32617")
    assert there.crs == "EPSG:32617"
    places = dict(zip(there.ground.names, there.ground.XYZ))
    lines = [" ".join(f"{v:.4f}" for v in places["gcp02"]) + " 100 200 IMG_0526.JPG gcp02", ""]
    back = read_gcp_list(write(tmp_path, "\n".join(["EPSG:32617", *lines])), "EPSG:32616")
    given = read_gcp_list(write(tmp_path, LIST)).ground
    at = given.XYZ[given.names.index("gcp02")]
    np.testing.assert_allclose(back.ground.XYZ, [at], atol=2e-4)
    degrees = "EPSG:4326\n-93 0 198.6 10 20 a.jpg p\n"
    with pytest.raises(InputError, match="points are geographic"):
        read_gcp_list(write(tmp_path, degrees))
    XYZ = read_gcp_list(write(tmp_path, degrees), "EPSG:32615").ground.XYZ[0]
    np.testing.assert_allclose(XYZ, [500_000, 0, 198.6], atol=1e-6)


def test_no_height(tmp_path: Path) -> None:
    gcps = read_gcp_list(write(tmp_path, "EPSG:32616\n1 2 NaN 3 4 a.jpg p\n"))
    assert np.isnan(gcps.ground.XYZ[0, 2])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (LIST.split("\n", 1)[1], r"gcp_list\.txt:1: the first line is a measurement; it must state the CRS"),
        (LIST.replace("EPSG:32616", "somewhere"), r"gcp_list\.txt:1: 'somewhere' is not a coordinate reference"),
        (LIST.replace("EPSG:32616", "WGS84 UTM 61N"), r":1: UTM zone 61"),
        (LIST.replace("3044", "nan"), r":2: column = 'nan' is not a number"),
        (LIST.replace("544256.7", "544256,7", 1), r":2: X = '544256,7' is not a number; write decimals with a point"),
        (LIST.replace(" IMG_0525.jpg", ""), r":2: 5 words; X Y Z column row image are needed"),
        (LIST.replace("5.5 100", "5.6 100"), r":5: point 'gcp02' has other coordinates than in line 3"),
        (
            LIST + "544157.7 5320899.2 5.5 1 2 x/IMG_0585.jpg gcp02\n",
            r":6: point 'gcp02' is measured in image .* line 3",
        ),
        ("EPSG:32616\n", "holds a CRS and no measurement"),
        ("", "holds no line with data"),
    ],
)
def test_fault_18_is_named_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_gcp_list(write(tmp_path, text))
