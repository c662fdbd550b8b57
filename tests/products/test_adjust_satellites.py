"""`photoplan adjust` with satellites and strips: what it finds is written so that every product uses it."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tools.command import inside
from tools.line_strip import Strip
from tools.rpc_files import as_text
from tools.rpc_images import CRS, SIZE, camera
from tools.shaken_strip import ShakenStrip

from photoplan.cameras.base import Camera, project
from photoplan.cameras.fiducials import Affine2D
from photoplan.cameras.pushbroom import LineCamera
from photoplan.cameras.pushbroom import measured as measured_of
from photoplan.io.camera.line import read_line
from photoplan.io.project.file import load_project
from photoplan.io.project.model import StatedTerrain
from photoplan.products.adjust.run import AdjustRequest, adjust_project
from photoplan.project.cameras import camera_without_pixels

#: From the polynomials to the true positions of the second and third satellite image.
TRUE = (Affine2D(1, 0, 0, 0, 1, 0), Affine2D(1, 0, 1.5, 0, 1, -2.25), Affine2D(1, 2e-4, -0.5, 0, 1 - 1e-4, 3.0))


def measured(folder: Path, cameras: dict[str, Camera], places: np.ndarray, noise: float = 0.1) -> None:
    """Files of image points and control: the first eight places."""
    rng = np.random.default_rng(3)
    rows = ["point,image,x,y"]
    for name, each in cameras.items():
        xy = project(each, places)
        inside = np.isfinite(xy).all(axis=1) & ((xy >= 0) & (xy < np.array(each.size) - 0.5)).all(axis=1)
        for k in np.flatnonzero(inside):
            x, y = xy[k] + rng.normal(0.0, noise, 2)
            rows.append(f"P{k},{name},{x:.4f},{y:.4f}")
    (folder / "points.csv").write_text("\n".join(rows) + "\n")
    control = [f"P{k},{x:.4f},{y:.4f},{z:.4f}" for k, (x, y, z) in enumerate(places[:8].tolist())]
    (folder / "control.csv").write_text("\n".join(["name,x,y,z", *control]) + "\n")


def head(crs: str, curvature: str = "none", adjustment: str = "") -> str:
    return (
        f'format = 1\ncrs = "{crs}"\n[orientation]\nheight_system = "ellipsoidal"\nearth_curvature = "{curvature}"\n'
        '[observations]\nimage_points = ["points.csv"]\ncontrol = ["control.csv"]\nsigma_image = 0.1\n'
        f"sigma_control = [0.02, 0.02]\n{adjustment}\n"
    )


def satellites(folder: Path, curvature: str, form: str) -> tuple[Path, dict[str, Camera]]:
    text, cameras = head(CRS, curvature, f'[adjustment]\nrpc = {{ correction = "{form}" }}'), {}
    for k, true in enumerate(TRUE):
        one = camera(seed=k)
        coefficients = one.functions.coefficients.copy()
        coefficients[2, 3] += 0.05 * (k - 1)
        functions = replace(one.functions, coefficients=coefficients)
        (folder / f"sat{k}_RPC.TXT").write_text(as_text(functions))
        cameras[f"sat{k}"] = replace(one, functions=functions, correction=true)
        text += f'[[images]]\nname = "sat{k}"\nfile = "sat{k}.tif"\nsize = {list(SIZE)}\nrpc = "sat{k}_RPC.TXT"\n'
    (folder / "project.toml").write_text(text)
    rng = np.random.default_rng(1)
    around = [(u, v) for u in (-0.95, 0.95) for v in (-0.95, -0.3, 0.3, 0.95)]
    uv = np.concatenate([around, rng.uniform(-1, 1, (60, 2))])
    places = np.column_stack([(602_000.0, 5_339_000.0) + uv * (6_800.0, 10_200.0), rng.uniform(50, 500, len(uv))])
    measured(folder, cameras, places)
    return folder / "project.toml", cameras


def difference(path: Path, cameras: dict[str, Camera]) -> float:
    """Largest difference in the image between what the project's cameras see and the truth, pixels."""
    opened, worst = load_project(path), 0.0
    opened = opened.model_copy(update={"terrain": StatedTerrain(height=200.0, height_system="ellipsoidal")})
    for name, true in cameras.items():
        middle = (np.array(true.size) - 1.0) / 2.0
        xy = middle + np.array([(0, 0), (0.9, 0.9), (-0.9, 0.9), (0.9, -0.9), (-0.9, -0.9)]) * middle
        at = true.rays(xy, 200.0)[0]
        worst = max(worst, float(np.abs(project(camera_without_pixels(opened, name), at) - xy).max()))
    return worst


@pytest.mark.parametrize("curvature", [pytest.param("none", marks=pytest.mark.slow), "strict"])
def test_affine_corrections_of_polynomials_are_found_and_used(tmp_path: Path, curvature: str) -> None:
    path, cameras = satellites(tmp_path, curvature, "affine")
    assert difference(path, cameras) > 2.0
    said = inside("adjust", str(path))
    assert said.code == 0, said.err
    assert difference(path, cameras) < 0.15
    entry = tomllib.loads(path.read_text())["images"][1]
    Q = np.zeros((6, 6))
    Q[np.tril_indices(6)] = entry["covariance"]
    assert np.abs(np.array(entry["shift"]) - (1.5, -2.25)).max() < 5 * np.sqrt(np.diag(Q)[:2].max())
    path.write_text(path.read_text() + '\n[terrain]\nheight = 200.0\nheight_system = "ellipsoidal"\n')
    assert "polynomials are corrected by" in inside("check", path).out
    # Another run begins there and stays there.
    assert inside("adjust", str(path), "--overwrite").code == 0
    again = tomllib.loads(path.read_text())["images"][1]
    assert np.abs(np.array(again["shift"]) - entry["shift"]).max() < 1e-3


def test_fault_30_control_in_another_datum_is_refused(tmp_path: Path) -> None:
    path, _ = satellites(tmp_path, "none", "shift")
    lines = (tmp_path / "control.csv").read_text().splitlines()
    moved = [lines[0], *(f"{n},{float(x) + 700},{y},{z}" for n, x, y, z in (line.split(",") for line in lines[1:]))]
    (tmp_path / "control.csv").write_text("\n".join(moved))
    before = path.read_text()
    said = inside("adjust", str(path))
    assert (said.code, path.read_text()) == (3, before), said.err
    assert "times what is known of it beforehand" in said.err


def test_fault_14_axes_of_control_exchanged_are_refused(tmp_path: Path) -> None:
    path, _ = satellites(tmp_path, "none", "shift")
    lines = (tmp_path / "control.csv").read_text().splitlines()
    moved = [lines[0], *(f"{n},{y},{x},{z}" for n, x, y, z in (line.split(",") for line in lines[1:]))]
    (tmp_path / "control.csv").write_text("\n".join(moved))
    said = inside("adjust", str(path))
    assert said.code == 3 and "are X and Y exchanged" in said.err


def flown(
    folder: Path, entries: str = "", count: int = 120, strip: Strip | None = None
) -> tuple[Path, dict[str, Camera]]:
    """Nadir and forward line of a flight whose file has a wrong boresight and a late clock; the true cameras."""
    strip = strip or Strip(lines=9000, waves=0.002)
    path = strip.strip_file(folder)
    cameras: dict[str, Camera] = {n: read_line(path, n).camera(strip.crs, "ellipsoidal") for n in ("nadir", "forward")}
    text = path.read_text().replace("time_offset = -0.0", "time_offset = 0.004\nboresight = [0.03, -0.02, 0.05]")
    path.write_text(text.replace("time_offset = 0.0\n", "time_offset = 0.004\nboresight = [0.03, -0.02, 0.05]\n"))
    assert "0.004" in path.read_text()
    adjustment = "[adjustment]\nstrips = { boresight = 0.1, time_offset = 0.01" + entries + " }"
    project_text = head(strip.crs, adjustment=adjustment)
    for name in cameras:
        project_text += f'[[images]]\nname = "{name}"\nfile = "{name}.tif"\nsize = [400, 9000]\n'
        project_text += f'line = "strip.toml"\ndetectors = "{name}"\n'
    (folder / "project.toml").write_text(project_text)
    rng = np.random.default_rng(4)
    at = cameras["nadir"].rays(rng.uniform((5, 5), (395, 8995), (count, 2)), 100.0)[0]
    measured(folder, cameras, at + np.column_stack([np.zeros((count, 2)), rng.uniform(-60, 60, count)]), 0.05)
    return folder / "project.toml", cameras


@pytest.mark.slow
def test_boresight_and_clock_of_a_strip_are_found_and_used(tmp_path: Path) -> None:
    path, cameras = flown(tmp_path, count=60)
    assert difference(path, cameras) > 3.0
    report = adjust_project(AdjustRequest(path))
    assert difference(path, cameras) < 0.1
    found = {p.name: p.value for p in report.corrections[0].parameters}
    # Against the axes of the camera: what the file states is turned back.
    assert found["boresight x"] == pytest.approx(-0.03, abs=2e-3)
    assert found["boresight z"] == pytest.approx(-0.05, abs=5e-3)
    assert (tmp_path / "adjustment/nadir.correction.toml").exists()
    path.write_text(path.read_text() + '\n[terrain]\nheight = 100.0\nheight_system = "ellipsoidal"\n')
    checked = inside("check", path)
    assert checked.code == 0 and "trajectory is corrected by adjustment/forward.correction.toml" in checked.out
    adjust_project(AdjustRequest(path, overwrite=True))
    assert difference(path, cameras) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("splines", ["", ", knots = 4.0, attitude = 0.01, position = 0.1, smooth_attitude = 0.005"])
def test_a_late_clock_of_a_turbulent_strip_is_found(tmp_path: Path, splines: str) -> None:
    """50 Hz of 2 px, of which 4 ms are 72°, two events of 10 px: without the moment that is meant no step helped."""
    strip = ShakenStrip(lines=9000, waves=0.002, vibration=(2.0, 0.8, 0.5), events=(10.0, 6.0, 4.0))
    path, cameras = flown(tmp_path, splines, count=60, strip=strip)
    report = adjust_project(AdjustRequest(path))
    found = {p.name: (p.value, p.sigma) for p in report.corrections[0].parameters}
    assert found["time offset"][0] == pytest.approx(-0.004, abs=5e-5)
    opened = load_project(path).model_copy(update={"terrain": StatedTerrain(height=200.0, height_system="ellipsoidal")})
    for name, true in cameras.items():
        assert isinstance(true, LineCamera)
        xy = np.random.default_rng(1).uniform((2, 100), (397, 8900), (2000, 2))
        at, used = true.rays(xy, 200.0)[0], camera_without_pixels(opened, name)
        assert isinstance(used, LineCamera)
        left = measured_of(used, true.calm(), at, xy).miss
        print(f"\n{name}: {np.sqrt((left**2).mean(axis=0)).round(3)} px rms at the moments of the rows")
        assert np.sqrt((left**2).mean()) < (0.3 if splines else 0.06)


def test_splines_of_a_strip_are_written_and_read(tmp_path: Path) -> None:
    path, cameras = flown(tmp_path, ", knots = 4.0, attitude = 0.01, position = 0.1, smooth_attitude = 0.005", 60)
    report = adjust_project(AdjustRequest(path))
    assert difference(path, cameras) < 0.15
    times, values = report.corrections[0].over_time or (np.empty(0), np.empty(0))
    assert len(times) == len(values) > 4
    # Angles as they are drawn: a flight to the east, rolled and pitched by waves of 0.23 degrees.
    seconds, angles = report.corrections[0].angles or (np.empty(0), np.empty((0, 3)))
    assert len(seconds) == len(angles) > 100 and (np.diff(seconds) > 0).all()
    assert 0.1 < np.degrees(np.abs(angles[:, :2])).max() < 0.4 and np.degrees(np.abs(angles[:, 2])).max() < 0.4
    assert load_project(path).any_image("forward").geometry_files(lambda name: tmp_path / name)[-1].exists()


def test_fault_18_broken_corrections_are_refused_by_name(tmp_path: Path) -> None:
    path, _ = flown(tmp_path)
    path.write_text(path.read_text().replace('detectors = "nadir"\n', 'detectors = "nadir"\ncorrection = "c.toml"\n'))
    for verb, entry in (("adjust", "time_offset_s = nan"), ("adjust", "boresight_deg = [0.0, 40.0, 0.0]")):
        (tmp_path / "c.toml").write_text(f'format = "photoplan line correction 1"\n{entry}\n')
        said = inside(verb, str(path))
        assert said.code == 3 and "c.toml" in said.err and entry.split()[0] in said.err


@pytest.mark.slow
def test_fault_23_points_on_lines_without_orientation_are_named(tmp_path: Path) -> None:
    path, _ = flown(tmp_path, count=40)
    table = (tmp_path / "flight.csv").read_text().splitlines()
    # The last third of the record is lost: lines from about 7000 on.
    (tmp_path / "flight.csv").write_text("\n".join(table[: len(table) * 72 // 100]))
    rows = (tmp_path / "points.csv").read_text().splitlines()
    late = [row for row in rows[1:] if float(row.split(",")[3]) > 7900]
    said = inside("adjust", path, "--dry-run")
    assert said.code == 0 and late, said.err
    assert "has no ray" in said.err and "such measurements take no part" in said.err
    name, image = late[0].split(",")[:2]
    assert not any(f"gross error: point '{name}' in image '{image}'" in line for line in said.err.splitlines())
