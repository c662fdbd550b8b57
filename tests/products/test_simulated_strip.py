"""A scene as a line camera on a turbulent flight sees it, by command."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio
from tools.command import inside
from tools.shaken_strip import ShakenStrip

from photoplan.cameras.base import project as projected
from photoplan.io.camera.line import read_line


def test_each_pixel_shows_what_its_line_sees(tmp_path: Path) -> None:
    """Terrain with a slope and a step: truth of every pixel to 0.01 px; its colours are those of the place."""
    strip = ShakenStrip(columns=48, lines=90, vibration=(2.0, 0.8, 0.3), events=(10.0, 12.0, 4.0), event_lines=20.0)
    strip.strip_file(tmp_path)
    y, x = np.mgrid[:400, :400]
    terrain = (300.0 + 0.1 * x + np.where(y > 200, 15.0, 0.0)).astype(np.float32)
    profile = {"driver": "GTiff", "width": 400, "height": 400, "count": 1, "dtype": "float32", "crs": strip.crs}
    with rasterio.open(
        tmp_path / "dtm.tif", "w", **profile, transform=rasterio.Affine(1, 0, 599_800, 0, -1, 5_340_200)
    ) as file:
        file.write(terrain, 1)
    path = tmp_path / "project.toml"
    image = 'name = "a"\nfile = "a.tif"\nline = "strip.toml"\ndetectors = "nadir"\nsize = [48, 90]\n'
    ground = '[terrain]\nfile = "dtm.tif"\nheight_system = "ellipsoidal"\n'
    path.write_text(f'format = 1\ncrs = "{strip.crs}"\n{ground}[[images]]\n{image}')
    said = inside("simulate", "--scene", path, "--truth", "--grain", 6.0, "--oversampling", 1)
    assert said.code == 0, said.err
    with rasterio.open(tmp_path / "rendered" / "a_truth.tif") as file:
        truth = file.read().astype(float) + np.array(file.offsets)[:, None, None]
    camera = read_line(tmp_path / "strip.toml", "nadir").camera(strip.crs, "ellipsoidal")
    v, u = np.mgrid[:90, :48].astype(float)
    XYZ = np.moveaxis(truth[:3], 0, -1)
    assert np.isfinite(XYZ).mean() > 0.99
    # By rays that were drawn without this code, at the heights that were met.
    S, R = strip.pose((np.arange(90) - 45) * strip.line_time)
    P = camera.ground(XYZ.reshape(-1, 3)).reshape(90, 48, 3)
    d = np.einsum("nij,nci->ncj", R, P - S[:, None])
    y_mm = d[..., 1] / d[..., 2] * strip.focal
    column = (np.arange(48) + 0.5 - 24) * strip.pitch
    away = np.hypot(y_mm - column * (1 - 2e-5 * column**2), d[..., 0] / d[..., 2] * strip.focal) / strip.pitch
    print(f"\nworst {np.nanmax(away):.4f} px")
    assert np.nanmax(away) < 0.01
    some = (slice(2, None, 4), slice(1, None, 4))
    count = np.bincount(camera.moments(XYZ[some]).point, minlength=XYZ[some][..., 0].size)
    again = np.abs(projected(camera, XYZ[some]) - np.stack([u, v], axis=-1)[some]).max(axis=-1).ravel()
    assert np.nanmedian(again[count == 1]) < 0.01 and (count == 1).mean() > 0.3
    with rasterio.open(tmp_path / "rendered" / "a.tif") as file:
        assert file.shape == (90, 48) and file.read().std() > 5


def test_what_has_no_size_is_told(tmp_path: Path) -> None:
    ShakenStrip(columns=40, lines=60).strip_file(tmp_path)
    path = tmp_path / "project.toml"
    image = 'name = "a"\nfile = "a.tif"\nline = "strip.toml"\ndetectors = "nadir"\n'
    level = '[terrain]\nheight = 300.0\nheight_system = "ellipsoidal"\n'
    path.write_text(f'format = 1\ncrs = "EPSG:32633"\n{level}[[images]]\n{image}')
    said = inside("simulate", "--scene", path)
    assert said.code == 3 and "no size is stated" in said.err
