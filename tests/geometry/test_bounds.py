"""Finite nonsense: angles, places and heights that no one means, judged by one implementation."""

from __future__ import annotations

from pathlib import Path

import pytest

from photoplan.errors import InputError, UsageError
from photoplan.geometry.bounds import area_fault, odd_angles, odd_place
from photoplan.geometry.grid import refuse_absurd
from photoplan.io.formats import read_orientation
from photoplan.io.points import read_ground_points, read_observed_positions
from photoplan.io.project.file import load_project

NAN = float("nan")


@pytest.mark.parametrize(
    ("angles", "unit", "fine"),
    [
        ((0.0, -359.9, 360.0), "deg", True),
        ((1e300, 0.0, 0.0), "deg", False),
        ((0.0, 500_000.0, 0.0), "gon", False),
        ((0.0, 0.0, 399.0), "gon", True),
        ((0.0, 0.0, 180.0), "rad", False),
    ],
)
def test_angles_are_full_circles_at_most(angles: tuple[float, ...], unit: str, fine: bool) -> None:
    said = odd_angles(angles, unit)
    assert (said is None) is fine
    if unit == "rad":
        assert said is not None and "is it in deg or gon?" in said


@pytest.mark.parametrize(
    ("place", "camera", "fine"),
    [
        ((5e5, 5e6, 1500.0), True, True),
        ((5e5, 5e6, 700_000.0), True, True),
        ((5e5, 5e6, 1e12), True, False),
        ((5e5, 5e6, 1e5), False, False),
        ((5e8, 5e9, 500.0), False, False),
        ((5e5, NAN, NAN), False, True),
    ],
)
def test_places_lie_on_the_earth(place: tuple[float, ...], camera: bool, fine: bool) -> None:
    assert (odd_place(place, camera=camera) is None) is fine


def test_places_lie_where_their_crs_is_used() -> None:
    assert area_fault("EPSG:32632", (500_000.0, 5_400_000.0, 0.0)) is None
    # A neighbouring zone's coordinates are in use; X and Y exchanged are not.
    assert area_fault("EPSG:32632", (1_100_000.0, 5_400_000.0, 0.0)) is None
    assert "are X and Y exchanged" in (area_fault("EPSG:32632", (5_400_000.0, 500_000.0, 0.0)) or "")
    assert "EPSG:2154" in (area_fault("EPSG:2154", (500_000.0, 500_000.0, 0.0)) or "")


def test_tables_and_projects_ask_the_same(tmp_path: Path) -> None:
    table = tmp_path / "ext.csv"
    table.write_text("name,x,y,z,omega,phi,kappa\na,500000,5400000,1500,0,500000,0\n")
    with pytest.raises(InputError, match="500000 is more than a full circle"):
        read_orientation(table)
    with pytest.raises(InputError, match="more than a full circle"):
        read_observed_positions(table)
    table.write_text("name,x,y,z,omega,phi,kappa\na,500000,5400000,1e12,0,0,0\n")
    with pytest.raises(InputError, match=r"image 'a': Z = 1e\+12 m; heights lie between"):
        read_observed_positions(table)
    # A table of orientations that states no CRS may be in any system; with one, heights are heights.
    read_orientation(table)
    (tmp_path / "ext.prj").write_text("EPSG:32632")
    with pytest.raises(InputError, match=r"image 'a': Z = 1e\+12 m; heights lie between"):
        read_orientation(table)
    (tmp_path / "ext.prj").unlink()
    table.write_text("name,x,y,z\nG,500000,5400000,450000\n")
    with pytest.raises(InputError, match=r"ground point 'G': Z = 450000 m"):
        read_ground_points(table)
    for center, angles, says in (("1, 2, 3", "0, 0, 5e5", "full circle"), ("1, 2, 1e12", "0, 0, 0", "Z = 1e")):
        (tmp_path / "project.toml").write_text(
            f"""crs = "EPSG:32632"
[orientation]
angle_unit = "gon"
[cameras.c]
type = "frame"
size = [100, 80]
focal_px = 90.0
[[images]]
name = "a"
file = "a.tif"
camera = "c"
center = [{center}]
angles = [{angles}]
"""
        )
        with pytest.raises(InputError, match=f"image 'a' .*{says}"):
            load_project(tmp_path / "project.toml")


def test_absurd_rasters_are_refused_with_their_size() -> None:
    refuse_absurd((100_000, 100_000), 512, "x: resolution 0.1 m")
    with pytest.raises(UsageError, match=r"resolution 1e-06 m gives 1e\+09 × 1e\+09 pixels in 3.81e\+12 tiles"):
        refuse_absurd((1_000_000_000, 1_000_000_000), 512, "x: resolution 1e-06 m")
