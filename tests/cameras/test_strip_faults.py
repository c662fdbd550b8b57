"""Bad inputs of aerial strips: what must happen, by the numbers of the list of faults."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.command import inside
from tools.effort import at_most
from tools.line_strip import Strip
from tools.shaken_strip import ShakenStrip
from tools.thinned import some

from photoplan.errors import HeightSystemError, InputError
from photoplan.io.camera.line import read_line

LEVEL = '[terrain]\nheight = 300.0\nheight_system = "ellipsoidal"\n'


def written(strip: Strip, folder: Path, values: np.ndarray | None = None, entry: str = "", **profile: object) -> Path:
    """A strip, an image of it, and their project."""
    strip.strip_file(folder)
    values = np.full((1, strip.lines, strip.columns), 99, np.uint8) if values is None else values
    count, height, width = values.shape
    about = {"driver": "GTiff", "width": width, "height": height, "count": count, "dtype": values.dtype} | profile
    with rasterio.open(folder / "a.tif", "w", **about) as file:
        file.write(values)
    path = folder / "project.toml"
    image = f'[[images]]\nname = "a"\nfile = "a.tif"\nline = "strip.toml"\ndetectors = "nadir"\n{entry}'
    path.write_text(f'format = 1\ncrs = "{strip.crs}"\n{LEVEL}{image}')
    return path


def refused(*words: object) -> str:
    said = inside(*words)
    assert (said.code, said.out) == (3, ""), (said.code, said.out, said.err)
    return " ".join(said.err.split())


def edited(path: Path, before: str, after: str) -> None:
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after))


def product_of(project: Path) -> tuple[np.ndarray, np.ndarray, rasterio.Affine]:
    """Values, validity and transform of its orthophoto."""
    said = inside("ortho", project, "--resolution", 0.3, "--no-quicklook")
    assert said.code == 0, said.err
    with rasterio.open(said.out.split()[0]) as file:
        return file.read(), file.read_masks(1) > 0, file.transform


def test_fault_01_the_grid_of_the_records_heights_is_missing(tmp_path: Path) -> None:
    project = written(Strip(lines=60, columns=40), tmp_path)
    edited(tmp_path / "strip.toml", '"ellipsoidal"', '"EPSG:3855"')
    with pytest.raises(HeightSystemError, match="us_nga_egm08_25"):
        read_line(tmp_path / "strip.toml", "nadir")
    told = refused("check", project)
    assert "us_nga_egm08_25.tif" in told and "pyproj sync" in told


@pytest.mark.parametrize("name", ["flight.npy", "flight.csv"])
def test_fault_07_a_table_without_end_is_refused_by_its_size(tmp_path: Path, name: str) -> None:
    written(Strip(lines=60, columns=40), tmp_path)
    edited(tmp_path / "strip.toml", '"flight.csv"', f'"{name}"')
    with (tmp_path / name).open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (10**10, 7)})
    os.truncate(tmp_path / name, 56 * 10**10 + 128)
    with at_most(seconds=2.0), pytest.raises(InputError, match=name.replace(".", r"\.")):
        read_line(tmp_path / "strip.toml", "nadir")


@pytest.mark.parametrize("place", ["/vsicurl/http://example.org/a.csv", "https://example.org/a.csv", "/vsimem/a.npy"])
def test_fault_09_no_name_leads_out_to_the_network(tmp_path: Path, place: str) -> None:
    """Of the strip in a project, of the record and of a table in a strip."""
    project = written(Strip(lines=60, columns=40), tmp_path)
    edited(tmp_path / "strip.toml", '"flight.csv"', f'"{place}"')
    assert "No such file" in refused("check", project)
    edited(project, '"strip.toml"', f'"{place}"')
    assert place in refused("check", project)


def test_fault_09_a_virtual_raster_named_as_the_image_of_a_strip(tmp_path: Path) -> None:
    project = written(Strip(lines=60, columns=40), tmp_path)
    (tmp_path / "a.tif").write_text(
        '<VRTDataset rasterXSize="40" rasterYSize="60"><VRTRasterBand dataType="Byte" band="1"><SimpleSource>'
        "<SourceFilename>/etc/hostname</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>"
    )
    assert "a.tif" in refused("ortho", project, "--resolution", 0.3)


def test_fault_14_angles_of_another_unit_are_told(tmp_path: Path) -> None:
    """Degrees that are declared to be radians go round more than once."""
    project = written(Strip(lines=60, columns=40), tmp_path)
    table = np.loadtxt(tmp_path / "flight.csv", delimiter=",", skiprows=1)
    table[:, 6] += 90.0
    np.savetxt(tmp_path / "flight.csv", table, "%.9f", ",", header="time,x,y,z,omega,phi,kappa", comments="")
    edited(tmp_path / "strip.toml", "lever_arm", 'angle_unit = "rad"\nlever_arm')
    told = refused("check", project)
    assert "flight.csv" in told and "row" in told and "deg" in told


def test_fault_14_angles_that_turn_by_less_than_a_circle_in_another_unit_are_told(tmp_path: Path) -> None:
    """Lines then lie hundreds of pixels beside each other's course, which no flight does."""
    project = written(ShakenStrip(lines=40, columns=40, vibration=(1, 0.2, 0.1), events=(8, 2, 1)), tmp_path)
    assert "all plausible" in inside("check", project).out
    edited(tmp_path / "strip.toml", "lever_arm", 'angle_unit = "rad"\nlever_arm')
    said = inside("check", project)
    assert said.code == 3 and "pixels from the smooth course: are angles in another unit" in said.out


def test_fault_30_a_flight_whose_heights_are_in_feet_is_told(tmp_path: Path) -> None:
    project = written(Strip(lines=60, columns=40), tmp_path)
    table = np.loadtxt(tmp_path / "flight.csv", delimiter=",", skiprows=1)
    table[:, 3] *= 3.2808
    np.savetxt(tmp_path / "flight.csv", table, "%.9f", ",", header="time,x,y,z,omega,phi,kappa", comments="")
    assert "times as long one way as the other on the ground" in inside("check", project).out


@pytest.mark.parametrize(
    ("by", "told"),
    [
        (lambda t: t.replace("\n", "\r\n"), None),
        (lambda t: "\ufeff" + t, None),
        (lambda t: t.replace("time,x", "Time, X"), None),
        (lambda t: t.split("\n")[0] + "\n", "nothing but its first line"),
        (lambda t: "", "first line is ''"),
        (lambda t: "\n".join([*t.split("\n")[:4], "1,2,3", *t.split("\n")[5:]]), "4"),
        (lambda t: t.replace("\n", "\n1,5,1,1,1,1,1,1\n", 1), "row"),
        (lambda t: "\n".join([*t.split("\n")[:4], "nan,1,1,1,1,1,1", *t.split("\n")[5:]]), "row 4 holds a number"),
        (lambda t: t.replace(",", ";"), "first line is 'time;x"),
    ],
)
def test_fault_18_tables_of_flights(tmp_path: Path, by: object, told: str | None) -> None:
    path = Strip(lines=60, columns=40).strip_file(tmp_path)
    exact = read_line(path, "nadir").track.positions(np.zeros(1))
    file = tmp_path / "flight.csv"
    file.write_bytes(by(file.read_text()).encode())  # type: ignore[operator]
    if told is None:
        assert np.array_equal(read_line(path, "nadir").track.positions(np.zeros(1)), exact)
        return
    with pytest.raises(InputError, match=told):
        read_line(path, "nadir")


def test_fault_20_a_record_in_feet_or_degrees(tmp_path: Path) -> None:
    path = Strip(lines=60, columns=40).strip_file(tmp_path)
    text = path.read_text()
    for crs, told in (("EPSG:2263", "metre"), ("EPSG:4326", "geographic"), ("", "crs")):
        path.write_text(text.replace('"EPSG:32633"', f'"{crs}"'))
        with pytest.raises(InputError, match=told):
            read_line(path, "nadir")


def test_fault_22_nodata_leaves_no_dark_fringes(tmp_path: Path) -> None:
    """A patch of nodata in a bright strip of a turbulent flight: what is valid is as bright as all the rest."""
    strip = ShakenStrip(columns=80, lines=150, vibration=(2.0, 0.5, 0.0), events=(0.0, 0.0, 0.0))
    values = np.full((1, 150, 80), 200, np.uint8)
    values[0, 60:90, 20:50] = 0
    got, valid, _ = product_of(written(strip, tmp_path, values, nodata=0))
    assert (got[0][valid] == 200).all()
    assert (
        0.5 < valid.mean() < 0.95
        and not valid[valid.shape[0] // 2, valid.shape[1] // 2 - 5 : valid.shape[1] // 2].all()
    )


@pytest.mark.parametrize("shaken", some([False, True], 1))
def test_fault_23_lines_in_a_gap_of_the_record_are_not_made_up(tmp_path: Path, shaken: bool) -> None:
    """A fifth of the record is missing, another part at its end: these lines are told, and nothing of them is shown."""
    strip = ShakenStrip(
        columns=80, lines=200, vibration=(2.0, 0.3, 0.0) if shaken else (0.0, 0.0, 0.0), events=(0.0, 0.0, 0.0)
    )
    values = np.repeat(np.arange(200, dtype=np.uint8), 80).reshape(1, 200, 80)
    project = written(strip, tmp_path, values)
    table = np.loadtxt(tmp_path / "flight.csv", delimiter=",", skiprows=1)
    line = np.round((table[:, 0] - 500.0) / strip.line_time + strip.lines / 2)
    table = table[((line < 80) | (line > 119)) & (line < 180)]
    np.savetxt(tmp_path / "flight.csv", table, "%.12f", ",", header="time,x,y,z,omega,phi,kappa", comments="")
    camera = read_line(tmp_path / "strip.toml", "nadir")
    told = camera.describe()
    assert told["gaps"].startswith("of the record: lines 79 to 120 have no orientation")
    assert told["oriented lines"].startswith("0 to 179 only")
    xy = np.stack([np.full(200, 40.0), np.arange(200.0)], axis=1)
    known = np.isfinite(camera.camera(strip.crs, "ellipsoidal").rays(xy, 300.0)[0][:, 0])
    assert np.array_equal(np.flatnonzero(~known), np.r_[80:120, 180:200])
    got, valid, _ = product_of(project)
    seen = got[0][valid]
    assert not ((seen > 83) & (seen < 116)).any() and seen.max() <= 180
    assert (seen < 80).mean() > 0.3 and (seen > 119).mean() > 0.2


@pytest.mark.slow
def test_fault_24_sixteen_bits_and_floats_of_a_strip_keep_their_type(tmp_path: Path) -> None:
    strip = ShakenStrip(columns=60, lines=100, vibration=(1.0, 0.3, 0.0), events=(0.0, 0.0, 0.0))
    for dtype, value in (("uint16", 40_000), ("float32", -1234.5)):
        folder = tmp_path / dtype
        folder.mkdir()
        got, valid, _ = product_of(written(strip, folder, np.full((1, 100, 60), value, dtype)))
        assert got.dtype == dtype and np.allclose(got[0][valid], value, rtol=1e-6) and valid.mean() > 0.4


def test_fault_24_an_image_of_another_size_than_its_strip(tmp_path: Path) -> None:
    project = written(Strip(lines=60, columns=40), tmp_path, np.zeros((1, 59, 40), np.uint8))
    assert "40 × 59 pixels, but strip.toml states 40 × 60" in refused("check", project)


@pytest.mark.parametrize("what", ["shape", "object", "text", "cut"])
def test_fault_31_a_damaged_npy_is_named(tmp_path: Path, what: str) -> None:
    """It promises more than it holds, holds objects or text, or ends in its header."""
    project = written(Strip(lines=60, columns=40), tmp_path)
    edited(tmp_path / "strip.toml", '"flight.csv"', '"flight.npy"')
    file = tmp_path / "flight.npy"
    table = np.loadtxt(tmp_path / "flight.csv", delimiter=",", skiprows=1)
    if what == "object":
        np.save(file, np.array([[table]], object), allow_pickle=True)
    elif what == "text":
        np.save(file, table.astype("U20"))
    else:
        np.save(file, table)
        os.truncate(file, 60 if what == "cut" else file.stat().st_size - 500)
    assert "flight.npy" in refused("check", project)
