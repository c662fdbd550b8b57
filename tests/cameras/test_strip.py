"""Aerial strips: a record of the flight, several lines of detectors; pixels drawn ray by ray by other means."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from scipy import ndimage
from tools.command import inside, unfinished_numbers
from tools.line_strip import Strip, pattern

from photoplan.cameras.base import project
from photoplan.errors import InputError
from photoplan.io.camera.line import line_files, read_line
from photoplan.io.project.file import load_project
from photoplan.project.scene import input_files


@pytest.mark.parametrize(("name", "ahead"), [("nadir", 0.0), ("forward", 46.6)])
@pytest.mark.parametrize(
    ("lever", "late"), [pytest.param((0.0, 0.0, 0.0), 0.0, marks=pytest.mark.slow), ((1.2, -0.4, 2.0), 0.35)]
)
def test_pixels_see_what_was_drawn(
    tmp_path: Path, name: str, ahead: float, lever: tuple[float, float, float], late: float
) -> None:
    """A lens, a line that looks 25° ahead, an antenna two metres away, a clock that is late; grid north is 1° off."""
    strip = Strip(lines=120)
    camera = read_line(strip.strip_file(tmp_path, lever, late), name).camera(strip.crs, "ellipsoidal")
    XY = strip.seen(300.0, ahead)
    found = project(camera, np.concatenate([XY, np.full((*XY.shape[:2], 1), 300.0)], axis=-1))
    y, x = np.mgrid[: strip.lines, : strip.columns]
    assert np.abs(found - np.stack([x, y], axis=-1)).max() < 1e-3


def test_boresight_turns_the_camera(tmp_path: Path) -> None:
    """A tenth of a degree about the line of flight moves columns by 0.1° in units of a pixel."""
    strip = Strip(lines=60)
    path = strip.strip_file(tmp_path)
    ground = np.array([[*strip.seen(300.0)[30, 200], 300.0]])
    before = project(read_line(path, "nadir").camera(strip.crs, "ellipsoidal"), ground)
    path.write_text(path.read_text().replace("lever_arm", "boresight = [0.1, 0.0, 0.0]\nlever_arm"))
    after = project(read_line(path, "nadir").camera(strip.crs, "ellipsoidal"), ground)
    assert abs(after - before)[0, 0] == pytest.approx(np.radians(0.1) * strip.focal / strip.pitch, rel=0.01)
    assert abs(after - before)[0, 1] < 0.3


def test_two_lines_of_one_flight_show_the_same_ground(tmp_path: Path) -> None:
    """Orthophotos of the nadir and the forward line, by command: the grey value of each place in both."""
    strip = Strip(lines=160)
    strip.strip_file(tmp_path)
    entries = []
    for name, ahead in (("nadir", 0.0), ("forward", 46.6)):
        with rasterio.open(
            tmp_path / f"{name}.tif", "w", driver="GTiff", width=400, height=160, count=1, dtype="float32"
        ) as file:
            file.write(pattern(strip.seen(300.0, ahead)).astype(np.float32), 1)
        entries.append(f'[[images]]\nname = "{name}"\nfile = "{name}.tif"\nline = "strip.toml"\ndetectors = "{name}"\n')
    toml = tmp_path / "project.toml"
    height = '[terrain]\nheight = 300.0\nheight_system = "ellipsoidal"\n'
    toml.write_text(f'format = 1\ncrs = "{strip.crs}"\n{height}{"".join(entries)}')
    assert tmp_path / "flight.csv" in input_files(load_project(toml))
    assert "nadir, forward" in inside("info", tmp_path / "strip.toml").out
    said = inside("ortho", toml, "--resolution", 0.3, "--no-quicklook")
    assert said.code == 0, said.err
    for path in said.out.split():
        with rasterio.open(path) as product:
            values, valid, T = product.read(1), product.read_masks(1) > 0, product.transform
        row, column = np.mgrid[: values.shape[0], : values.shape[1]] + 0.5
        whole = ndimage.binary_erosion(valid, iterations=2)
        error = (values - pattern(np.stack([T.c + T.a * column, T.f + T.e * row], axis=-1)))[whole]
        pixel = 0.3 * float(np.hypot(40 / 4, 40 / 5)) / np.sqrt(2)
        print(f"\n{Path(path).name}: rms {error.std() / pixel:.4f} px, worst {np.abs(error).max() / pixel:.3f} px")
        assert valid.mean() > 0.7 and error.std() / pixel < 0.03 and np.abs(error).max() / pixel < 0.3


@pytest.mark.parametrize(
    ("what", "by", "told"),
    [
        ("flight.csv", lambda t: t.replace("time,x", "t,x"), "the first line is"),
        ("flight.csv", lambda t: t.replace("\n", "\nnan,1,1,1,1,1,1\n", 1), "finite"),
        ("flight.csv", lambda t: "\n".join([*t.split("\n")[:5], t.split("\n")[2], ""]), "is not after that of"),
        ("flight.csv", lambda t: t.replace(".", "x", 9), "cannot be read"),
        (
            "flight.csv",
            lambda t: t.replace(",5340000.", ",53400000.", 1),
            "flight.csv: from record 1 to 2, .* usual speed",
        ),
        ("flight.csv", lambda t: t.replace(",3000.", ",3000000.", 1), "flight.csv: row 1: Z = 3e.06 m"),
        ("flight.csv", lambda t: t.replace(",600", ",600000000", 1), "flight.csv: row .*: X = .* lies on no map"),
        ("flight.csv", lambda t: t.replace(",0.", ",9000.", 1), "flight.csv: row .*: angle .* more than a full circle"),
        ("strip.toml", lambda t: t.replace("EPSG:32633", "EPSG:4326"), "is geographic"),
        ("strip.toml", lambda t: t.replace("first = ", "first = 9"), "no line of the image is oriented"),
        ("strip.toml", lambda t: t.replace("focal_mm = 100.0", "focal_mm = -100.0"), "focal_mm"),
        ("strip.toml", lambda t: t.replace("focal_mm = 100.0", "focal_mm = 1e300"), r"focal_mm: 1e\+300"),
        ("strip.toml", lambda t: t.replace("line = ", "line = 1e-300 # "), "lines of 1e-300 s"),
        ("strip.toml", lambda t: t.replace("lever_arm = [0.0", "lever_arm = [5e3"), "lever_arm"),
        ("strip.toml", lambda t: t.replace("first = ", "first = 1e300 # "), "clock.first"),
        ("strip.toml", lambda t: t.replace('"flight.csv"', '"other.csv"'), "other.csv"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, what: str, by: object, told: str) -> None:
    path = Strip(lines=60).strip_file(tmp_path)
    file = tmp_path / what
    file.write_text(by(file.read_text()))  # type: ignore[operator]
    with pytest.raises(InputError, match=told):
        read_line(path, "nadir")


def test_detectors_are_chosen_by_name(tmp_path: Path) -> None:
    path = Strip(lines=60).strip_file(tmp_path)
    with pytest.raises(InputError, match=r"several lines of detectors \(nadir, forward\)"):
        read_line(path)
    with pytest.raises(InputError, match="no line of detectors 'back'; there are nadir, forward"):
        read_line(path, "back")


@pytest.mark.parametrize(
    ("record", "told"),
    [
        (np.zeros((5, 7), complex), "complex128: real numbers are needed"),
        (np.zeros(5, [("a", "f8")]), "real numbers are needed"),
        (b"\x93NUMPY\x01\x00\x06\x00{'a(9\n", "flight.npy: cannot be read"),
        (np.zeros((5, 7))[:, :6], "needed are 7 numbers in each row"),
    ],
)
def test_fault_31_damaged_arrays_are_named(tmp_path: Path, record: np.ndarray | bytes, told: str) -> None:
    path = Strip(lines=60).strip_file(tmp_path)
    path.write_text(path.read_text().replace("flight.csv", "flight.npy"))
    if isinstance(record, bytes):
        (tmp_path / "flight.npy").write_bytes(record)
    else:
        np.save(tmp_path / "flight.npy", record)
    with pytest.raises(InputError, match=told):
        read_line(path, "nadir")


@pytest.mark.parametrize("suffix", [".csv", ".npy"])
def test_a_table_of_elements_is_what_its_polynomial_is(tmp_path: Path, suffix: str) -> None:
    """Positions of every element, measured to 0.01 columns, instead of the polynomial from which they come."""
    strip = Strip(lines=60)
    path = strip.strip_file(tmp_path)
    column = np.arange(strip.columns, dtype=float)
    y = ((strip.columns - 1) / 2 - column) * strip.pitch
    table = np.stack([np.zeros_like(y), y - 2e-5 * y**3], axis=1)
    table += np.random.default_rng(1).normal(0.0, 0.002 * strip.pitch, table.shape)
    write_table(tmp_path / f"nadir{suffix}", table)
    exact = read_line(path, "nadir").camera(strip.crs, "ellipsoidal")
    name, rest = path.read_text().split("[detectors.forward]")
    head = name.split("y_mm = ")[0]
    path.write_text(f'{head}table = "nadir{suffix}"\n[detectors.forward]{rest}')
    stated = read_line(path, "nadir")
    told = stated.describe()["directions"]
    assert "columns beside a smooth curve" in told
    assert stated.beside is not None and 0.003 < stated.beside < 0.02
    xy = np.stack(np.meshgrid(np.linspace(0, 399, 40), [10.0, 30.0]), axis=-1)
    away = stated.camera(strip.crs, "ellipsoidal").rays(xy, 300.0)[0] - exact.rays(xy, 300.0)[0]
    print(f"\n{suffix}: {np.abs(away).max() / strip.pixel:.4f} px beside the exact line")
    assert np.abs(away).max() < 0.005 * strip.pixel
    assert tmp_path / f"nadir{suffix}" in line_files(path)

    for change, message in (
        (lambda t: t[:-1], "399 rows; needed are x and y of 400 elements"),
        (lambda t: np.where(np.arange(400)[:, None] == 17, np.nan, t), "row 18 holds a number that is not finite"),
        (lambda t: t + 0.3 * strip.pitch * (np.arange(400)[:, None] == 17), "element 18 lies 0.4"),
        (
            lambda t: t + 3.0 * strip.pitch * (np.arange(400)[:, None] >= 200),
            "several chips in one line, state `chips`",
        ),
    ):
        write_table(tmp_path / f"nadir{suffix}", change(table))
        with pytest.raises(InputError, match=message):
            read_line(path, "nadir")


def write_table(path: Path, table: np.ndarray) -> None:
    if path.suffix == ".npy":
        np.save(path, table)
    else:
        np.savetxt(path, table, "%.8f", ",", header="x,y", comments="")


def test_detectors_are_a_table_or_polynomials(tmp_path: Path) -> None:
    path = Strip(lines=60).strip_file(tmp_path)
    path.write_text(path.read_text().replace("[detectors.forward]\n", '[detectors.forward]\ntable = "a.csv"\n'))
    with pytest.raises(InputError, match="state one of both"):
        read_line(path, "forward")


def test_fault_30_check_of_what_sees_nothing_prints_no_nan(tmp_path: Path) -> None:
    toml = Strip(lines=60, columns=40).write(tmp_path, 200.0)
    toml.write_text(toml.read_text().replace("height = 200.0", "height = 9000.0"))
    said = inside("check", toml)
    assert (
        said.code == 3 and "FAULT: sees nothing of the terrain\n" in said.out and "no sensible resolution" in said.out
    )
    assert not unfinished_numbers(said.out + said.err), said
    toml.write_text(toml.read_text().replace("height = 9000.0", "height = 9e9"))
    said = inside("check", toml)
    assert said.code == 3 and "terrain.height: Z = 9e+09 m" in said.err
