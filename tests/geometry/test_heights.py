"""Height systems: declared (fault 2), joined exactly or not at all (fault 1)."""

from __future__ import annotations

import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pyproj import network

from photoplan.errors import HeightSystemError
from photoplan.geometry.heights import check_height_system, declared_pair, height_label, height_step

POINT = np.array([[576661.8, 5188164.8, 207.2]])


@pytest.fixture(autouse=True)
def no_network():
    before = network.is_network_enabled()
    network.set_network_enabled(False)
    yield
    network.set_network_enabled(before)


@pytest.mark.parametrize(
    ("name", "canonical"),
    [
        ("ellipsoidal", "ellipsoidal"),
        ("Same", "same"),
        ("EPSG:5773", "EPSG:5773"),
        ("epsg:5773", "EPSG:5773"),
        ("EPSG:32615+5703", "EPSG:5703"),
        ("EPSG:4979", "ellipsoidal"),
    ],
)
def test_names_of_height_systems(name: str, canonical: str) -> None:
    assert check_height_system(name) == canonical


@pytest.mark.parametrize("name", ["sea level", "EPSG:32615", "EPSG:4326", "", "EPSG:4978"])
def test_other_names_are_refused_with_the_allowed_ones(name: str) -> None:
    with pytest.raises(HeightSystemError, match="ellipsoidal, EPSG:nnnn"):
        check_height_system(name, "terrain")


@pytest.mark.parametrize("pair", [(None, None), ("EPSG:5773", None), (None, "same")])
def test_fault_02_undeclared_heights_are_refused_and_the_message_says_what_to_declare(pair) -> None:
    with pytest.raises(HeightSystemError) as error:
        declared_pair(*pair)
    text = str(error.value)
    assert "not stated" in text
    assert "`height_system` same" in text
    assert "EPSG:nnnn" in text
    assert error.value.exit_code == 3


def test_same_takes_the_name_of_the_other() -> None:
    assert declared_pair("same", "same") == ("same", "same")
    assert declared_pair("same", "EPSG:5773") == ("EPSG:5773", "EPSG:5773")
    assert declared_pair("ellipsoidal", "same") == ("ellipsoidal", "ellipsoidal")
    assert declared_pair("epsg:5773", "Ellipsoidal") == ("EPSG:5773", "ellipsoidal")


@pytest.mark.parametrize("name", ["same", "ellipsoidal", "EPSG:5773"])
def test_equal_systems_leave_heights_alone(name: str) -> None:
    step = height_step(name, name, "EPSG:32615")
    assert step(POINT) == [207.2]
    assert step.operation == "none"


@pytest.mark.parametrize(
    ("source", "target", "grid"),
    [
        ("EPSG:3855", "ellipsoidal", "us_nga_egm08_25.tif"),
        ("ellipsoidal", "EPSG:3855", "us_nga_egm08_25.tif"),
        ("EPSG:5773", "ellipsoidal", "us_nga_egm96_15.tif"),
        ("EPSG:5773", "EPSG:3855", "us_nga_egm"),
        ("EPSG:5703", "ellipsoidal", "us_noaa_"),
    ],
)
def test_fault_01_missing_grid_is_named_and_heights_are_never_passed_on(source: str, target: str, grid: str) -> None:
    with pytest.raises(HeightSystemError) as error:
        height_step(source, target, "EPSG:32615")(POINT)
    text = str(error.value)
    assert grid in text
    assert "pyproj sync --file" in text
    assert error.value.exit_code == 3


def test_systems_of_different_zero_points_without_any_operation_are_refused() -> None:
    # Lowest astronomical tide here has no operation to an Australian height.
    with pytest.raises(HeightSystemError, match="cannot be turned into"):
        height_step("EPSG:5711", "EPSG:5703", "EPSG:32615")


def test_feet_become_metres() -> None:
    step = height_step("EPSG:6360", "EPSG:5703", "EPSG:32615")
    np.testing.assert_allclose(step(POINT), 207.2 * 1200 / 3937, rtol=1e-12)
    assert np.isnan(step([[576661.8, 5188164.8, np.nan]])).all()
    again = pickle.loads(pickle.dumps(step))
    assert again(POINT) == step(POINT)
    assert "ftUS" in step.operation


RAF20 = """
import sys, numpy as np, pyproj
pyproj.datadir.append_data_dir(sys.argv[1])
pyproj.network.set_network_enabled(False)
from photoplan.geometry.heights import height_step
step = height_step("EPSG:5720", "ellipsoidal", "EPSG:9794")
back = height_step("ellipsoidal", "EPSG:5720", "EPSG:9794")
P = np.array([[833143.85, 6298117.693, 1769.986]])
h = step(P)
print(h[0], back(np.column_stack([P[:, :2], h]))[0], "|".join(step.grids), step.accuracy)
try:
    step(np.array([[3e6, 8e6, 100.0]]))
except Exception as error:
    print(type(error).__name__)
"""


def test_a_grid_that_is_there_is_used_and_its_end_is_noticed(shared: Path) -> None:
    """The block of ign_borea: altitude by the grid RAF20, value read from the grid file itself."""
    import rasterio

    folder = shared / "data" / "ign_borea"
    run = subprocess.run([sys.executable, "-c", RAF20, str(folder)], capture_output=True, text=True, timeout=60)
    assert run.returncode == 0, run.stderr
    first, second = run.stdout.strip().splitlines()
    high, back, grids, _ = first.split()
    from pyproj import Transformer

    lon, lat = Transformer.from_crs("EPSG:9794", "EPSG:9782", always_xy=True).transform(833143.85, 6298117.693)
    with rasterio.open(folder / "fr_ign_RAF20.tif") as grid:
        to_map = grid.transform
        col, row = (lon - to_map.c) / to_map.a, (lat - to_map.f) / to_map.e
        c, r = int(col - 0.5), int(row - 0.5)
        fx, fy = col - 0.5 - c, row - 0.5 - r
        a = grid.read(1)[r : r + 2, c : c + 2]
    undulation = (a[0, 0] * (1 - fx) + a[0, 1] * fx) * (1 - fy) + (a[1, 0] * (1 - fx) + a[1, 1] * fx) * fy
    assert abs(float(high) - 1769.986 - undulation) < 1e-3
    assert 40 < undulation < 60
    assert abs(float(back) - 1769.986) < 1e-6
    assert "RAF20" in grids
    assert second == "HeightSystemError"


def test_labels() -> None:
    assert height_label(None) == "not stated"
    assert height_label("EPSG:5773") == "EGM96 height (EPSG:5773)"
