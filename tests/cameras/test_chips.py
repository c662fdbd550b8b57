"""Lines of two chips: one image whose columns have a step, seen, projected and rectified as if there were none."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import rasterio
from pyproj import Transformer
from scipy import ndimage
from tools.command import inside
from tools.line_strip import Strip, pattern
from tools.shaken_strip import ShakenStrip
from tools.thinned import some

from photoplan.cameras.base import project, tremor_told
from photoplan.cameras.pushbroom import ChippedLine
from photoplan.errors import InputError
from photoplan.io.camera.line import read_line

#: The second chip begins here, stands 0.12 mm (12 lines) ahead, is turned by 1 mrad, and overlaps by so many columns.
FIRST, AHEAD, TURN = 180, 0.12, 1e-3
HEIGHT = 100.0


def elements(strip: Strip, overlap: float) -> np.ndarray:
    """x, y (mm) of every element: y to the left, falling with the column."""
    column = np.arange(strip.columns, dtype=float)
    second = column >= FIRST
    y = ((strip.columns - 1) / 2 - column + overlap * second) * strip.pitch
    x = second * (AHEAD + TURN * (column - FIRST) * strip.pitch)
    return np.stack([x, y], axis=1)


def chips(strip: Strip, overlap: float) -> str:
    """The same as the entry of a strip."""
    half, p = (strip.columns - 1) / 2, strip.pitch
    return (
        f"chips = [\n  {{ columns = {FIRST}, y_mm = [{half * p}, {-p}] }},\n  {{ columns = {strip.columns - FIRST}, "
        f"x_mm = [{AHEAD}, {TURN * p}], y_mm = [{(half - FIRST + overlap) * p}, {-p}] }},\n]"
    )


def strip_file(folder: Path, strip: Strip, overlap: float, table: bool = False) -> Path:
    path = strip.strip_file(folder)
    entry = chips(strip, overlap)
    if table:
        np.savetxt(folder / "e.csv", elements(strip, overlap), "%.7f", ",", header="x,y", comments="")
        entry = f'table = "e.csv"\nchips = [{{ columns = {FIRST} }}, {{ columns = {strip.columns - FIRST} }}]'
    text = re.sub(r"y_mm = .*\n(\[detectors.forward\])", lambda m: f"{entry}\n{m[1]}", path.read_text(), count=1)
    path.write_text(text)
    return path


def seen(strip: Strip, overlap: float) -> np.ndarray:
    """Map X, Y (lines, columns, 2) on level ground of what each pixel sees, ray by ray."""
    t = (np.arange(strip.lines) - strip.lines / 2) * strip.line_time
    S, R = strip.pose(t)
    # Camera axes as drawn: x along the flight, y to the right, z down.
    x, y = elements(strip, overlap).T
    d = np.stack([x, -y, np.full_like(y, strip.focal)], axis=-1)
    d = np.einsum("nij,cj->nci", R, d / np.linalg.norm(d, axis=1, keepdims=True))
    back = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    r = np.full(d.shape[:2], strip.flying - HEIGHT)
    for _ in range(8):
        lon, lat, h = back.transform(*np.moveaxis(S[:, None] + r[..., None] * d, -1, 0))
        r = r + (h - HEIGHT)
    return np.stack(Transformer.from_crs("EPSG:4979", strip.crs, always_xy=True).transform(lon, lat)[:2], axis=-1)


def camera_of(folder: Path, strip: Strip, overlap: float) -> ChippedLine:
    camera = read_line(strip_file(folder, strip, overlap), "nadir").camera(strip.crs, "ellipsoidal")
    assert isinstance(camera, ChippedLine)
    return camera


def shaken(lines: int) -> ShakenStrip:
    return ShakenStrip(columns=400, lines=lines, vibration=(3.0, 0.4, 0.5), events=(20.0, 10.0, 6.0))


@pytest.mark.parametrize("overlap", some([0.0, 8.3], 1))
def test_rays_are_those_of_the_elements_and_project_brings_them_back(tmp_path: Path, overlap: float) -> None:
    strip = Strip(lines=120)
    camera = camera_of(tmp_path, strip, overlap)
    truth = seen(strip, overlap)
    xy = np.stack(np.meshgrid(np.arange(400.0), np.arange(0, 120.0, 7)), axis=-1)
    ground = camera.rays(xy, HEIGHT)[0]
    assert np.abs(ground[..., :2] - truth[::7]).max() < 1e-3 * strip.pixel
    back = project(camera, ground)
    # Where both see, which is shifted by as much as the flight rolls in 12 lines, the first counts: the same ground.
    alone = (xy[..., 0] < FIRST - 3.0) | (xy[..., 0] > FIRST + overlap + 5.0)
    assert np.abs(back - xy)[alone].max() < 2e-8
    assert np.abs(camera.rays(back, HEIGHT)[0] - ground).max() < 1e-8
    both = (xy[..., 0] >= FIRST) & (xy[..., 0] < FIRST + overlap - 5.0) & (xy[..., 1] > 30) & (xy[..., 1] < 90)
    assert (back[both][:, 0] < FIRST).all()
    assert camera.gaps[0] == pytest.approx(-overlap, abs=1e-6)
    # Twice in the overlap, once elsewhere.
    counts = np.bincount(camera.moments(ground.reshape(-1, 3)).point, minlength=both.size).reshape(both.shape)
    assert (counts[both] == 2).all() and (counts[(xy[..., 0] < 168) | (xy[..., 0] > 192)] == 1).all()
    J = camera.derivatives(ground)
    step = np.array([0.5, 0.0, 0.0])
    far = np.abs(xy[..., 0] - FIRST) > 16
    change = project(camera, ground + step) - project(camera, ground - step)
    assert np.abs(change - J[..., 0])[far].max() < 1e-5


def test_a_table_of_both_chips_is_what_their_polynomials_are(tmp_path: Path) -> None:
    strip = Strip(lines=60)
    exact = camera_of(tmp_path, strip, 1.5)
    stated = read_line(strip_file(tmp_path, strip, 1.5, table=True), "nadir")
    assert "2 chips" in stated.describe()["directions"]
    xy = np.stack(np.meshgrid(np.arange(400.0), [10.0, 30.0]), axis=-1)
    away = stated.camera(strip.crs, "ellipsoidal").rays(xy, HEIGHT)[0] - exact.rays(xy, HEIGHT)[0]
    assert np.abs(away).max() < 1e-3 * strip.pixel


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (("columns = 220", "columns = 219"), "chips of 399 columns in a line of 400"),
        ((", y_mm = [0.195", ", z_mm = [0.195"), "z_mm"),
        (("chips = [", "y_mm = [1.0]\nchips = ["), "are those of each chip"),
        (("y_mm = [0.195", "y_mm = [1.895"), "over half of chip 1"),
    ],
)
def test_chips_that_make_no_line_are_refused(tmp_path: Path, change: tuple[str, str], told: str) -> None:
    strip = Strip(lines=60)
    path = strip_file(tmp_path, strip, 0.0)
    text = path.read_text()
    assert change[0] in text
    path.write_text(text.replace(*change, 1))
    with pytest.raises(InputError, match=told):
        read_line(path, "nadir").camera(strip.crs, "ellipsoidal")


def test_it_is_told_how_strongly_they_shake(tmp_path: Path) -> None:
    strip = shaken(400)
    camera = read_line(strip_file(tmp_path, strip, 12.0), "nadir").camera(strip.crs, "ellipsoidal")
    assert (tremor_told(camera, HEIGHT) or "").startswith("a turbulent flight: lines lie up to ")


@pytest.mark.parametrize(
    ("overlap", "strip", "most"),
    [
        pytest.param(7.0, Strip(lines=70), 0.05, id="overlap"),
        pytest.param(-0.6, Strip(lines=400), 1.0, marks=pytest.mark.slow, id="gap"),
        pytest.param(12.0, shaken(400), 0.5, marks=pytest.mark.slow, id="shaken"),
    ],
)
def test_an_orthophoto_shows_no_step(tmp_path: Path, overlap: float, strip: Strip, most: float) -> None:
    """The picture goes on over the chips' border: 12 lines of step, a turn of a milliradian."""
    strip_file(tmp_path, strip, overlap)
    XY = seen(strip, overlap)
    profile = {"driver": "GTiff", "width": 400, "height": strip.lines, "count": 3, "dtype": "float32"}
    with rasterio.open(tmp_path / "strip.tif", "w", **profile) as file:
        file.write(np.stack([*(XY - strip.origin).transpose(2, 0, 1), pattern(XY)]).astype(np.float32))
    project_file = tmp_path / "project.toml"
    project_file.write_text(
        f'format = 1\ncrs = "{strip.crs}"\n[terrain]\nheight = {HEIGHT}\nheight_system = "ellipsoidal"\n'
        '[[images]]\nname = "strip"\nfile = "strip.tif"\nline = "strip.toml"\ndetectors = "nadir"\n'
    )
    assert inside("check", project_file).code == 0
    said = inside("ortho", project_file, "--resolution", 0.28, "--no-quicklook")
    assert said.code == 0, said.err
    with rasterio.open(tmp_path / "products/strip_ortho.tif") as file:
        values, T = file.read(masked=True).astype(float), file.transform
    valid = ~np.ma.getmaskarray(values).any(axis=0)
    v, u = np.mgrid[: valid.shape[0], : valid.shape[1]]
    X, Y = T @ np.stack([u + 0.5, v + 0.5])
    error = np.hypot(values[0] - (X - strip.origin[0]), values[1] - (Y - strip.origin[1])) / 0.28
    grey = np.abs(values[2] - pattern(np.stack([X, Y], axis=-1)))
    inner = ndimage.binary_erosion(ndimage.binary_closing(valid, iterations=3), iterations=9)
    # Of the ground that the chips' border passes.
    camera = read_line(tmp_path / "strip.toml", "nadir").camera(strip.crs, "ellipsoidal")
    at = project(camera, np.stack([X, Y, np.full_like(X, HEIGHT)], axis=-1))
    border = inner & (np.abs(at[..., 0] - FIRST) < 6 + overlap)
    missing = border & ~valid
    told = f"worst {error[inner & valid].max():.3f} px, at the border {error[border & valid].max():.3f} px"
    print(f"\n{told}, grey values {grey[border & valid].max():.2f}; {missing.sum()} of {border.sum()} not shown")
    assert border.sum() > 300
    assert missing.sum() == 0
    assert np.sqrt((error[inner & valid] ** 2).mean() / 2) < 0.05
    assert error[border & valid].max() < most
