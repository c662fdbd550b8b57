"""Accuracy of orthophotos and budgets of strips, from what is known of the poses of their trajectory."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from test_adjust_satellites import flown
from tools.command import inside
from tools.line_strip import Strip
from tools.sim_strip import lines, places, projection, seen_by, simulated

from photoplan.cameras.base import project
from photoplan.cameras.correctable import PoseErrors, TrackPriors, displaced, map_axes
from photoplan.cameras.pushbroom import LineCamera
from photoplan.io.camera.line import read_pose_errors
from photoplan.io.project.file import load_project
from photoplan.orientation.bundle.adjust import adjust_block
from photoplan.orientation.bundle.model import AdjustSettings
from photoplan.products.adjust.run import AdjustRequest, adjust_project
from photoplan.products.adjust.sensors import LINES
from photoplan.project.cameras import camera_without_pixels
from photoplan.project.error_model import source_errors
from photoplan.project.ground import ground_of

HEIGHT = 100.0
PRIORS = TrackPriors(
    boresight=2e-3, lever_arm=0.1, time_offset=0.01, knots=10.0, position=0.05, attitude=5e-5, smooth_position=0.03,
    smooth_attitude=3e-5,
)  # fmt: skip


def strip_project(folder: Path, rows: dict[float, list[float]]) -> Path:
    """A strip with variances (6,) of its poses at some times: metres, degrees."""
    strip = Strip(columns=120, lines=160, waves=0.001)
    strip.strip_file(folder)
    text = 'format = "photoplan line correction 1"\n'
    if rows:
        full = [[float(row[i]) if i == j else 0.0 for i in range(6) for j in range(i + 1)] for row in rows.values()]
        text += f"[accuracy]\ntimes = {list(rows)}\ncovariance = {full}\n"
    (folder / "c.toml").write_text(text)
    with rasterio.open(folder / "s.tif", "w", driver="GTiff", width=120, height=160, count=1, dtype="uint8") as file:
        file.write(np.full((1, 160, 120), 80, np.uint8))
    path = folder / "project.toml"
    path.write_text(
        f'format = 1\ncrs = "{strip.crs}"\n[terrain]\nheight = {HEIGHT}\nheight_system = "ellipsoidal"\nsigma = 0.001\n'
        '[[images]]\nname = "s"\nfile = "s.tif"\nline = "strip.toml"\ndetectors = "nadir"\ncorrection = "c.toml"\n'
    )
    return path


def sigmas(path: Path) -> np.ndarray:
    said = inside("ortho", path, "--resolution", 0.5, "--no-quicklook", "--accuracy")
    assert said.code == 0, said.err
    with rasterio.open(next(path.parent.glob("products/*accuracy*.tif"))) as file:
        return file.read(masked=True).astype(float).filled(np.nan)


def test_variances_of_poses_are_carried_to_the_ground(tmp_path: Path) -> None:
    """A flight to the east: 0.2 m east and 0.1 mrad of roll, which grows to 0.3 mrad over the 0.69 s of the strip."""
    roll = np.degrees([1e-4, 3e-4]) ** 2
    span = 159 * Strip().line_time
    found = sigmas(strip_project(tmp_path, {t: [0.04, 0, 0, r, 0, 0] for t, r in zip((0.0, span), roll)}))
    middle = found[:, found.shape[1] // 2]
    seen = np.flatnonzero(np.isfinite(middle[0]))
    assert len(seen) > 60
    assert np.nanmedian(middle[0]) == pytest.approx(0.2, rel=0.02)
    expected = 2900 * 1e-4 * np.linspace(1, 3, len(seen))
    assert np.abs(middle[1][seen][5:-5] / expected[5:-5] - 1).max() < 0.06
    # The budget of the image says the same of its middle.
    said = inside("budget", tmp_path / "project.toml", "--json")
    assert said.code == 0, said.err
    (image,) = json.loads(said.out)["images"]
    assert image["contributions_m"]["trajectory"]["middle"] == pytest.approx(np.hypot(0.2, 2900 * 2e-4), rel=0.03)


@pytest.mark.parametrize(
    ("entry", "told"),
    [
        ("", "says nothing of the accuracy"),
        ("[accuracy]\ntimes = [0.0, 0.0]\ncovariance = [[]]\n", "21"),
        (f"[accuracy]\ntimes = [0.0]\ncovariance = [{[1.0, 3.0, 1.0] + [0.0] * 18}]\n", "is no covariance"),
        (f"[accuracy]\ntimes = [0.0]\ncovariance = [{[1e300] + [0.0] * 20}]\n", "1e+300 given"),
    ],
)
def test_what_is_not_known_is_said(tmp_path: Path, entry: str, told: str) -> None:
    path = strip_project(tmp_path, {})
    (tmp_path / "c.toml").write_text(f'format = "photoplan line correction 1"\n{entry}')
    said = inside("ortho", path, "--resolution", 0.5, "--no-quicklook", "--accuracy")
    assert said.code == 3 and told in said.err, said.err


@pytest.mark.slow
@pytest.mark.parametrize("splines", [True, False])
def test_an_adjustment_tells_how_exactly_the_trajectory_is_known(tmp_path: Path, splines: bool) -> None:
    """True errors of positions in the image, in units of what the poses' covariances say of them."""
    entries = ", knots = 4.0, attitude = 0.01, position = 0.1, smooth_attitude = 0.005" if splines else ""
    path, cameras = flown(tmp_path, entries, 60)
    adjust_project(AdjustRequest(path))
    assert read_pose_errors(tmp_path / "adjustment/nadir.correction.toml") is not None
    path.write_text(path.read_text() + '\n[terrain]\nheight = 100.0\nheight_system = "ellipsoidal"\n')
    opened = load_project(path)
    normal = []
    for name, true in cameras.items():
        rng = np.random.default_rng(1)
        xy = rng.uniform((5, 200), (395, 8800), (200, 2))
        at = true.rays(xy, HEIGHT)[0]
        camera = camera_without_pixels(opened, name)
        errors = source_errors(opened, opened.any_image(name), ground_of(opened), camera, 0.0)
        d = np.stack([cause.displacement(at) for cause in errors.causes])
        sigma = np.sqrt((d**2).sum(axis=0))
        normal.append((project(camera, at) - xy) / sigma)
        print(f"\n{name}: σ {np.median(sigma, axis=0)} px, normalised {np.sqrt((normal[-1] ** 2).mean(axis=0))}")
    # The noise is half of what the project states.
    assert 0.3 < np.sqrt((np.array(normal) ** 2).mean()) < 1.2


def carried(camera: LineCamera, errors: PoseErrors, XYZ: np.ndarray) -> np.ndarray:
    """Standard deviations in the image, (n, 2), of what six independent errors of the poses do."""
    axes, at = map_axes(camera.track), project(camera, XYZ)
    moved = [camera.along(displaced(camera.track, errors.course(part), axes)) for part in np.eye(6)]
    return np.sqrt(sum((project(each, XYZ) - at) ** 2 for each in moved))


@pytest.mark.slow
@pytest.mark.parametrize("runs", [200])
def test_simulated_trajectories_are_as_exact_as_is_said(tmp_path: Path, runs: int) -> None:
    """Truth drawn from what is known beforehand: normalised errors of positions in the images, 200 runs."""
    geometries, squares = lines(PRIORS), []
    settings = AdjustSettings(robust=False, variance_components=False, correlation=False)
    for seed in range(runs):
        made = simulated([projection(n, "lines", g, 250.0, 2250.0) for n, g in geometries.items()], places(60, 1), seed)
        found = adjust_block(made.block, settings)
        sets = {each.key: each for each in found.corrections}
        text = LINES.found(geometries["nadir"], sets).file
        assert text is not None
        (tmp_path / "c.toml").write_text(text)
        errors = read_pose_errors(tmp_path / "c.toml")
        assert errors is not None
        for row, geometry in enumerate(geometries.values()):
            used = geometry.camera({key: each.values for key, each in sets.items()})
            true = geometry.camera(made.true)
            XYZ = places(18, 3)[seen_by(true, places(18, 3))]
            off = (project(used, XYZ) - project(true, XYZ)) / carried(used, errors, XYZ) * found.sigma0
            squares.append((row, *(off**2).mean(axis=0)))
    table = np.array(squares)
    each = [np.sqrt(table[table[:, 0] == k, 1:].mean(axis=0)).round(3) for k in range(len(geometries))]
    whole = float(np.sqrt(table[:, 1:].mean()))
    print(f"\n{runs} runs: normalised {whole:.3f}; by line, across and along: {each}")
    assert 0.9 < whole < 1.1
