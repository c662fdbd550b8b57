"""`photoplan dtm visible` from files to maps."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import rasterio
from tools.dem_file import X0, Y0, write_dem


@pytest.fixture
def walled(tmp_path):
    """Flat ground with a wall at x = 60 and a hole."""

    def height(x, y):
        return np.where((x > 80) & (y > 60), np.nan, 500.0 + 3.0 * (x == 60))

    return write_dem(tmp_path / "walled.tif", height, (121, 101))


def pixels(path):
    with rasterio.open(path) as file:
        return file.read(), file


def test_one_observer(walled, tmp_path, photoplan):
    out = tmp_path / "seen.tif"
    said = photoplan("dtm", "visible", walled, "--from", X0 + 20, Y0 + 50, "--height-observer", 10, "-o", out, "--json")
    assert said.code == 0, said.err
    bands, file = pixels(out)
    assert bands.shape == (1, 101, 121) and file.nodata == 255
    # The line over the wall comes down to the ground at 20 + 40 · 10 / 7 = 77.14.
    assert (bands[0, :, :61] == 1).all() and (bands[0, 50, 61:78] == 0).all() and (bands[0, 50, 78:] == 1).all()
    assert (bands[0, :39, 81:] == 255).all()
    facts = json.loads(said.out)
    row = facts["observers"][0]
    assert row["eye_height"] == pytest.approx(510) and row["area_without_model"] == pytest.approx(40 * 40, abs=1)
    assert row["visible_area"] == (bands == 1).sum() and row["area"] == (bands != 255).sum()
    assert facts["horizon"] == pytest.approx(math.sqrt(20 * facts["earth_radius"] / 0.87), rel=1e-6)


def test_several_observers_are_counted(walled, tmp_path, photoplan):
    table = tmp_path / "posts.csv"
    table.write_text(f"name;X;Y;h\nwest;{X0 + 20};{Y0 + 20};1.5\neast;{X0 + 100};{Y0 + 20};\n")
    out = tmp_path / "count.tif"
    said = photoplan("dtm", "visible", walled, "--observers", table, "--radius", 60, "-o", out)
    assert said.code == 0 and "observer east" in said.out, said
    count, west, east = pixels(out)[0]
    assert (west[80, :60] == 1).all() and (west[80, 62:] == 0).all() and (count[:19, 81:] == 255).all()
    assert (east[80, 62:] == 1).all() and (east[80, 41:60] == 0).all()
    np.testing.assert_array_equal(count[count != 255], (west + east)[count != 255])
    assert count[80, 60] == 2 and (count == 2).sum() == 65, "the top of the wall alone"


def test_minimum_height(walled, tmp_path, photoplan):
    out = tmp_path / "need.tif"
    words = ("--from", X0 + 20, Y0 + 50, "--minimum-height", "--no-curvature", "--height-observer", 1)
    said = photoplan("dtm", "visible", walled, *words, "-o", out)
    assert said.code == 0, said.err
    need = pixels(out)[0][0]
    assert need[50, 100] == pytest.approx(1 + 2 * 80 / 40, abs=1e-4)
    assert np.isnan(need[:39, 81:]).all()


def test_wrong_use(walled, tmp_path, photoplan):
    out = tmp_path / "out.tif"
    here = ("--from", X0 + 20, Y0 + 50)
    for words, code, text in [
        (("-o", out), 2, "--from"),
        ((*here, "-o", walled), 2, "input"),
        ((*here, "-o", walled, "--overwrite"), 2, "input"),
        (("--from", X0 - 20, Y0, "-o", out), 3, "outside"),
        (("--from", X0 + 100, Y0 + 90, "-o", out), 3, "no height"),
        ((*here, "-o", out, "--memory", "10KB"), 5, "--memory"),
        ((*here, "-o", out, "--height-observer", "-1"), 2, "zero or more"),
        (("--observers", tmp_path / "none.csv", "-o", out), 3, "none.csv"),
    ]:
        said = photoplan("dtm", "visible", walled, *words)
        assert said.code == code and text in said.err, (words, said)
        assert not out.exists()


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("x,y\n", "no point"),
        ("a,b\n1,2\n", "no column called"),
        ("x,y\n1,2\n3\n", ":3:"),
        ("x;y\n1;2\n3;nan\n", ":3:"),
        ("x;y\n400020,5;450050\n", "with a point"),
        ("\ufeffx,y\r\n1,2,3\r\n", ":2:"),
        ("", "no line"),
    ],
)
def test_fault_18_tables_of_observers(walled, tmp_path, photoplan, content, text):
    table = tmp_path / "posts.csv"
    table.write_text(content, newline="")
    said = photoplan("dtm", "visible", walled, "--observers", table, "-o", tmp_path / "out.tif")
    assert said.code == 3 and text in said.err and "posts.csv" in said.err
