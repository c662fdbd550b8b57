"""Metashape's Omega Phi Kappa text: written by hand after the layout of its export."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS, Transformer
from scipy.spatial.transform import Rotation
from tools.format_examples import assert_same, block_of, round_trip

from photoplan.errors import InputError
from photoplan.io.formats import orientation_format, read_orientation_block

HEADER = "# Cameras (2)\n# PhotoID, X, Y, Z, Omega, Phi, Kappa, r11, r12, r13, r21, r22, r23, r31, r32, r33\n"
POSES = {
    "IMG 1.JPG": (593656.5, 5089108.8, 909.4, 1.25, -2.5, 118.75),
    "b": (593700.0, 5089100.0, 910.0, -69.8, 11.2, -4.5),
}


def matrix(angles: tuple[float, ...]) -> np.ndarray:
    """Camera axes to ground axes: about X by ω, then Y by φ, then Z by κ, each about the moved axis."""
    return Rotation.from_euler("XYZ", angles, degrees=True).as_matrix()


def lines(turn: str = "plain", delimiter: str = "\t") -> str:
    flip = np.diag([1, -1, -1])
    out = ""
    for name, values in POSES.items():
        R = matrix(values[3:])
        R = {"plain": R, "transposed": R.T, "y down": R @ flip, "both": (R @ flip).T}[turn]
        out += delimiter.join([name, *(f"{v:.6f}" for v in values), *(f"{v:.16f}" for v in R.ravel())]) + "\n"
    return out


@pytest.mark.parametrize("turn", ["plain", "transposed", "y down", "both"])
@pytest.mark.parametrize("delimiter", ["\t", ", "])
def test_angles_and_system(tmp_path: Path, turn: str, delimiter: str) -> None:
    path = tmp_path / "opk.txt"
    wkt = CRS("EPSG:32632").to_wkt("WKT1_GDAL")
    path.write_text(f"# CoordinateSystem: {wkt}\r\n{HEADER}{lines(turn, delimiter)}")
    block = read_orientation_block(path)
    assert block.table.crs == "EPSG:32632"
    assert [i.name for i in block.table.images] == list(POSES)
    for k, values in enumerate(POSES.values()):
        np.testing.assert_array_equal(block.table.centers[k], values[:3])
        np.testing.assert_allclose(block.table.rotations[k], matrix(values[3:]), atol=1e-12)


def test_a_matrix_of_other_angles_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "opk.txt"
    path.write_text(HEADER + lines().replace("\t11.200000\t", "\t11.210000\t"))
    with pytest.raises(InputError, match=r"opk\.txt:4: image 'b': the matrix r11 … r33 is not that of ω, φ, κ"):
        read_orientation_block(path)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda t: t.replace("\t910.000000", ""), r"opk\.txt:4: 15 columns"),
        (lambda t: t.replace("910.000000", "x"), r"opk\.txt:4: image .*'x' is not a number"),
        (lambda t: t.replace("910.000000", "nan"), r"opk\.txt:4: image .*'nan' is not a number"),
        (lambda t: HEADER, "holds no image"),
        (lambda t: "# CoordinateSystem: PROJCS[\n" + t, r"opk\.txt:1: .*not a coordinate reference system"),
    ],
)
def test_fault_18_broken_lines(tmp_path: Path, change: object, says: str) -> None:
    path = tmp_path / "opk.txt"
    path.write_text(change(HEADER + lines()))  # type: ignore[operator]
    with pytest.raises(InputError, match=says):
        read_orientation_block(path, format="opk")


def test_geographic_positions_become_a_tangential_system(tmp_path: Path) -> None:
    """Each image's angles refer to east, north, up at its own place; 2 km apart these differ by 0.02°."""
    path = tmp_path / "opk.txt"
    places = [(8.2, 47.3, 900.0), (8.23, 47.31, 950.0)]
    text = f"# CoordinateSystem: {CRS('EPSG:4326').to_wkt('WKT1_GDAL')}\n{HEADER}"
    text += "".join(f"{k}\t{x!r}\t{y!r}\t{z!r}\t10.0\t-5.0\t30.0\n" for k, (x, y, z) in enumerate(places))
    path.write_text(text)
    table = read_orientation_block(path).table
    assert table.crs is None and table.origin is not None
    lat, lon, h = table.origin
    to_enu = Transformer.from_pipeline(
        f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lon_0={lon!r} +lat_0={lat!r} +h_0={h!r}"
    )
    for k, (x, y, z) in enumerate(places):
        np.testing.assert_allclose(table.centers[k], to_enu.transform(x, y, z), atol=1e-6)
        # A point 1 m along each of the camera's axes, by its own east, north, up.
        for axis in range(3):
            d = matrix((10.0, -5.0, 30.0))[:, axis]
            metres = np.array([111320.0 * np.cos(np.radians(y)), 111180.0, 1.0])
            there = to_enu.transform(*(np.array([x, y, z]) + 10 * d / metres))
            np.testing.assert_allclose(
                (np.array(there) - table.centers[k]) / 10, table.rotations[k][:, axis], atol=3e-3
            )
    spread = np.degrees(np.arccos((np.trace(table.rotations[0].T @ table.rotations[1]) - 1) / 2))
    assert 0.015 < spread < 0.035


@pytest.mark.parametrize("crs", ["EPSG:32632", None])
def test_round_trip(tmp_path: Path, crs: str | None) -> None:
    block = block_of({}, crs=crs)
    again = round_trip(block, tmp_path / "opk.txt", "opk")
    assert_same(block, again)
    assert again.table.crs == crs
    assert read_orientation_block(tmp_path / "opk.txt").table.crs == crs  # recognised by its header


def test_the_written_matrix_takes_the_camera_to_the_ground(tmp_path: Path) -> None:
    from photoplan.io.formats import write_orientation

    block = block_of({}, 1)
    write_orientation(block, tmp_path / "opk.txt", "opk")
    row = (tmp_path / "opk.txt").read_text().splitlines()[-1].split("\t")
    np.testing.assert_allclose(np.array(row[7:], float).reshape(3, 3), block.table.rotations[0], atol=1e-15)
    assert list(orientation_format("opk").losses(block)) == []
