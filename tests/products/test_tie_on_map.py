"""Tie points between a strip and a frame image: matched on the map, carried back to the same ground."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
import rasterio
from scipy.ndimage import gaussian_filter, map_coordinates
from tools.command import inside
from tools.line_strip import Strip

from photoplan.io.project.file import load_project
from photoplan.project.cameras import camera_without_pixels

pytest.importorskip("cv2")
GROUND = 100.0
SIDE = 600


def texture(XY: np.ndarray) -> np.ndarray:
    """Grey values of the map: random, smooth over a metre and over five."""
    rng = np.random.default_rng(5)
    fields = [gaussian_filter(rng.normal(size=(1200, 1200)), s, mode="wrap") for s in (1.5, 6.0)]
    field = sum(f / f.std() for f in fields)
    at = (XY - (600_000.0, 5_340_000.0)) / 0.6
    return 2000.0 + 400.0 * map_coordinates(field, [at[..., 1], at[..., 0]], order=3, mode="grid-wrap")


def write(path: Path, values: np.ndarray) -> None:
    height, width = values.shape
    with rasterio.open(path, "w", driver="GTiff", width=width, height=height, count=1, dtype="uint16") as file:
        file.write(np.rint(values).astype(np.uint16), 1)


def test_a_strip_and_a_frame_are_tied(tmp_path: Path) -> None:
    strip = Strip(columns=SIDE, lines=SIDE, waves=0.004)
    strip.strip_file(tmp_path)
    XY = strip.seen(GROUND)
    write(tmp_path / "strip.tif", texture(XY))
    x, y = XY.reshape(-1, 2).mean(axis=0)
    path = tmp_path / "project.toml"
    path.write_text(
        f'format = 1\ncrs = "{strip.crs}"\n[terrain]\nheight = {GROUND}\nheight_system = "ellipsoidal"\n'
        '[orientation]\nheight_system = "ellipsoidal"\n[observations]\n'
        f"[cameras.c]\nsize = [{SIDE}, {SIDE}]\nfocal_px = 5000.0\n"
        f'[[images]]\nname = "frame"\nfile = "frame.tif"\ncamera = "c"\ncenter = [{x}, {y}, 1600.0]\n'
        "angles = [1.0, -0.5, 30.0]\n"
        '[[images]]\nname = "strip"\nfile = "strip.tif"\nline = "strip.toml"\ndetectors = "nadir"\n'
    )
    write(tmp_path / "frame.tif", np.zeros((SIDE, SIDE)))
    camera = camera_without_pixels(load_project(path), "frame")
    row, col = np.mgrid[0:SIDE, 0:SIDE]
    origin, direction = camera.rays(np.stack([col, row], axis=-1).reshape(-1, 2), GROUND)
    seen = origin + direction * ((GROUND - origin[:, 2:]) / direction[:, 2:])
    write(tmp_path / "frame.tif", texture(seen[:, :2].reshape(SIDE, SIDE, 2)))
    said = inside("tie", path, "--per-image", "100")
    assert said.code == 0, said.err
    assert "on the map" in said.err
    assert tomllib.loads(path.read_text())["observations"]["image_points"] == ["tie_points.csv"]
    measured: dict[str, dict[str, np.ndarray]] = {}
    for line in (tmp_path / "tie_points.csv").read_text().splitlines()[1:]:
        point, image, *numbers = line.split(",")
        measured.setdefault(point, {})[image] = np.array(numbers, float)[:2]
    pairs = [each for each in measured.values() if len(each) == 2]
    assert len(pairs) > 40
    in_strip = np.array([p["strip"] for p in pairs])
    ground = np.stack([map_coordinates(XY[..., k], in_strip.T[::-1], order=1) for k in (0, 1)], axis=-1)
    origin, direction = camera.rays(np.array([p["frame"] for p in pairs]), GROUND)
    other = (origin + direction * ((GROUND - origin[:, 2:]) / direction[:, 2:]))[:, :2]
    off = (ground - other) / strip.pixel
    assert np.sqrt((off**2).mean()) < 0.1 and np.abs(off.mean(axis=0)).max() < 0.03
