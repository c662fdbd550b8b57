"""Tables of observed positions and attitudes; faults 14 and 18 with the line that is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from photoplan.errors import InputError
from photoplan.geometry.pose import rotation_from_angles
from photoplan.io.orientation.block import TableFormat
from photoplan.io.points import read_observed_positions

POSITIONS = "name,x,y,z\na.tif,1,2,3\nb.tif,4,5,6\n"
FULL = (
    "name,x,y,z,omega,phi,kappa,sigma_xy,sigma_z,sigma_angle,strip,time\n"
    "a,1,2,3,1,-2,100,0.1,0.2,0.01,s1,10.5\nb,4,5,6,0,0,0,0.1,0.2,,s2,12\n"
)


def write(folder: Path, content: str, name: str = "gnss.csv") -> Path:
    path = folder / name
    path.write_text(content)
    return path


def test_positions_alone(tmp_path: Path) -> None:
    table = read_observed_positions(write(tmp_path, POSITIONS))
    assert table.images == ("a.tif", "b.tif")
    assert table.R_ground_camera is None
    assert table.attitudes(0.1) is None
    with pytest.raises(InputError, match=r"image 'a.tif': the accuracy of observed positions is not stated; give"):
        table.positions()
    observed = table.positions((0.1, 0.2))
    np.testing.assert_array_equal(observed.sigma, [[0.1, 0.1, 0.2]] * 2)
    assert observed.strip == ("all", "all")
    np.testing.assert_array_equal(observed.time, [0, 1])


@pytest.mark.parametrize(("unit", "full"), [("deg", 360), ("gon", 400)])
def test_everything_that_a_table_can_state(tmp_path: Path, unit: str, full: float) -> None:
    table = read_observed_positions(write(tmp_path, FULL), TableFormat(angle_unit=unit, rotation="pok"))
    assert table.R_ground_camera is not None
    angles = np.array([-2, 1, 100]) * 2 * np.pi / full
    np.testing.assert_allclose(table.R_ground_camera[0], rotation_from_angles(angles, "pok"), atol=1e-15)
    observed = table.positions()
    np.testing.assert_array_equal(observed.sigma, [[0.1, 0.1, 0.2]] * 2)
    assert observed.strip == ("s1", "s2")
    np.testing.assert_array_equal(observed.time, [10.5, 12])
    one, both = table.attitudes(), table.attitudes(0.5)
    assert one is not None
    assert one.images == ("a",)
    np.testing.assert_allclose(one.sigma, [[0.01 * 2 * np.pi / full] * 3])
    assert both is not None
    assert both.images == ("a", "b")
    np.testing.assert_allclose(both.sigma[1], 0.5)


def test_moments_as_dates(tmp_path: Path) -> None:
    text = "name,x,y,z,time\na,1,2,3,2020-05-01T10:00:00Z\nb,4,5,6,2020-05-01T10:00:02.5+00:00\n"
    assert np.diff(read_observed_positions(write(tmp_path, text)).time) == 2.5
    with pytest.raises(InputError, match=r"gnss\.csv:3: time 'later'; seconds or ISO 8601"):
        read_observed_positions(write(tmp_path, text.replace("2020-05-01T10:00:02.5+00:00", "later")))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (POSITIONS.replace("5", "nan"), r"gnss\.csv:3: y = 'nan' is not a number"),
        (POSITIONS.replace("b.tif", "x/a.jpg"), r":3: image 'x/a.jpg' is given in line 2 already"),
        (POSITIONS.replace("z\n", "z,omega\n").replace("3\n", "3,0\n").replace("6\n", "6,0\n"), "omega alone; omega"),
        (FULL.replace("100", "400.5"), r":2: angle k = 400.5 is more than a full circle in deg; state the unit"),
        (FULL.replace("0.01", "0"), r":2: sigma_angle = 0; it must be positive"),
        (FULL.replace("0.2,0.01", "-1,0.01"), r":2: sigma_z = -1; it must be positive"),
        ("name,x,y,z\n", "holds a header and no line with data"),
    ],
)
def test_fault_18_is_named_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_observed_positions(write(tmp_path, text))


def test_crs_beside_the_table(tmp_path: Path) -> None:
    path = write(tmp_path, POSITIONS)
    (tmp_path / "gnss.prj").write_text("EPSG:25832")
    assert read_observed_positions(path, crs="EPSG:25832").images
    with pytest.raises(InputError, match=r"gnss\.csv: positions in EPSG:25832, the project is in EPSG:2154"):
        read_observed_positions(path, crs="EPSG:2154")


def test_an_orientation_of_another_format(tmp_path: Path) -> None:
    text = 'crs = "EPSG:25832"\n[[images]]\nname = "a"\ncenter = [1.0, 2.0, 3.0]\nangles = [0.5, 0.0, 90.0]\n'
    table = read_observed_positions(write(tmp_path, text, "orientation.toml"), crs="EPSG:25832")
    assert table.images == ("a",)
    assert table.R_ground_camera is not None
    with pytest.raises(InputError, match="positions in EPSG:25832, the project is in EPSG:2154"):
        read_observed_positions(tmp_path / "orientation.toml", crs="EPSG:2154")
