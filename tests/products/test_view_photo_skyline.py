"""The skyline of a photograph against that of the terrain: distances, control, and the turn of the camera."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin
from scipy.ndimage import gaussian_filter
from tools.command import inside

from photoplan.errors import GeometryError
from photoplan.io.orientation.block import TableFormat
from photoplan.io.orientation.text import _read_toml as read_toml_orientation
from photoplan.io.product import write_png
from photoplan.orientation.intersection import fit_skyline
from photoplan.products.init import InitRequest, init_project
from photoplan.products.view.camera import open_view_ground, view_camera
from photoplan.products.view.make import seen_surface
from photoplan.products.view.photo import doubt, turned
from photoplan.products.view.skyline import Skyline, skyline
from photoplan.requests.view import CameraRequest, SkylineRequest
from photoplan.surfaces.seen import skyline_of
from photoplan.targets.view import FrameBundle

TRUE = CameraRequest(
    position=(502_000.0, 5_300_300.0), altitude=900.0, azimuth=3.0, pitch=-1.0, roll=1.5, field_of_view=50.0,
    size=(480, 300),
)  # fmt: skip
NAMES = ("azimuth", "pitch", "roll", "field_of_view")


def write_mountains(path: Path, seed: int = 3, error: float = 0.0, wrong: int = 0) -> Path:
    """Terrain of posts of 20 m, rough at all sizes, that rises to the north; errors of neighbours go together."""
    rng = np.random.default_rng(seed)
    z = np.zeros((200, 200))
    for width, size in ((20.0, 220.0), (8.0, 90.0), (3.0, 30.0), (1.2, 8.0)):
        part = gaussian_filter(rng.normal(size=z.shape), width, mode="wrap")
        z += size * part / part.std()
    z += 500.0 + np.linspace(500.0, -300.0, 200)[:, None]
    if error:
        off = gaussian_filter(np.random.default_rng(wrong).normal(size=z.shape), 2.0, mode="wrap")
        z += error * off / off.std()
    place = {"crs": "EPSG:32633", "transform": from_origin(500_000.0, 5_304_000.0, 20.0, 20.0)}
    with rasterio.open(path, "w", driver="GTiff", width=200, height=200, count=1, dtype="float32", **place) as file:
        file.write(z.astype(np.float32), 1)
    return path


def photograph(path: Path, terrain: Path, camera: CameraRequest, seed: int) -> Path:
    """Bright sky over dark ground with texture and grain; the border takes part of its pixels."""
    ground = open_view_ground(terrain)
    seen = skyline_of(view_camera(camera, ground, force=True).target, seen_surface(ground, np.inf, 0.01))
    width, height = camera.size
    y = np.interp(np.arange(width), seen.uvh[:, 0], seen.uvh[:, 1])
    rng = np.random.default_rng(seed)
    texture = 70 + 25 * gaussian_filter(rng.normal(size=(height, width)), 3.0) / 0.094
    sky = np.clip(y - np.arange(height)[:, None] + 0.5, 0, 1)
    values = gaussian_filter(sky * 205 + (1 - sky) * texture, 0.7) + rng.normal(0, 3, (height, width))
    return write_png(
        path, np.stack([*[np.clip(np.rint(values), 0, 255)] * 3, np.full((height, width), 255.0)]).astype(np.uint8)
    )


def refined(folder: Path, dem: Path, photo: Path, start: CameraRequest, focal: bool = False) -> Skyline:
    asked = {"photo": photo, "refine": True, "focal": focal, "search": 60}
    return skyline(SkylineRequest(dem, start, force=True, output=folder / "s.csv", overwrite=True, **asked))


@pytest.fixture(scope="module")
def mountains(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("mountains")
    dem = write_mountains(folder / "dem.tif")
    return dem, photograph(folder / "photo.png", dem, TRUE, 1)


def test_the_edge_is_found_to_a_part_of_a_pixel(mountains: tuple[Path, Path], tmp_path: Path) -> None:
    """With the camera that took it: in every column, but for rocks that overhang by a blur."""
    dem, photo = mountains
    asked = {"photo": photo, "picture": tmp_path / "both.png"}
    found = skyline(SkylineRequest(dem, TRUE, force=True, output=tmp_path / "s.csv", **asked))
    assert found.match is not None
    apart = np.abs(found.match.residuals)
    print(f"median {np.nanmedian(apart):.3f} px, 95 % below {np.nanpercentile(apart, 95):.3f} px")
    assert np.isfinite(apart).mean() > 0.99
    assert np.nanmedian(apart) < 0.15 and np.nanpercentile(apart, 95) < 0.8
    header, first = (tmp_path / "s.csv").read_text().split("\n")[:2]
    assert header.endswith("surface,y_photo,residual")
    y, y_photo, residual = (float(first.split(",")[k]) for k in (1, 8, 9))
    assert residual == pytest.approx(y_photo - y, abs=2e-4)
    with rasterio.open(tmp_path / "both.png") as file:
        picture = file.read()
    column, row = (round(v) for v in found.points[240, :2])
    red, blue = picture[[0, 2], row - 2 : row + 3, column].astype(int)
    assert (np.abs(red - blue) > 60).any()  # both are coloured lines over a grey photograph


def test_a_turn_beyond_the_rows_that_were_searched_is_doubted(mountains: tuple[Path, Path]) -> None:
    target = view_camera(TRUE, open_view_ground(mountains[0]), force=True).target
    XYZ = np.array([[501_500.0, 5_303_000.0, 900.0], [502_800.0, 5_303_500.0, 1100.0]])
    now = turned(target, np.array([np.radians(5.0), 0.0, 0.0]))
    rows = np.median(np.abs(now.to_view(XYZ)[:, 1] - target.to_view(XYZ)[:, 1]))
    assert rows > 20
    assert doubt(target, now, XYZ, round(rows + 2)) is None
    assert "this standpoint" in (doubt(target, now, XYZ, round(rows - 2)) or "")


def test_the_camera_is_turned_back_and_written(mountains: tuple[Path, Path], tmp_path: Path) -> None:
    """From 2° beside, by command; the camera that is written shows the skyline of the photograph."""
    dem, photo = mountains
    words = ["--from", 502000, 5300300, "--altitude", 900, "--fov", 50, "--size", 480, 300, "--force"]
    with (tmp_path / "control.csv").open("w") as file:
        file.write("name,x,y,E,N,H\n")
        target = view_camera(TRUE, open_view_ground(dem), force=True).target
        for k, ground in enumerate([(501_500.0, 5_303_000.0, 900.0), (502_800.0, 5_303_500.0, 1100.0)]):
            x, y, _ = target.to_view(ground)
            file.write(f"P{k},{x + 0.5},{y},{','.join(map(str, ground))}\n")
    more = ["--photo", photo, "--refine", "--refined", tmp_path / "c.toml", "--control", tmp_path / "control.csv"]
    out = tmp_path / "s.csv"
    said = inside(
        "view",
        "skyline",
        dem,
        *words,
        "--azimuth",
        5,
        "--pitch",
        -1.8,
        "--roll",
        0,
        "--search",
        60,
        *more,
        "-o",
        out,
        "--json",
    )
    assert said.code == 0, said.err
    told = json.loads(said.out)
    for name, true in (("azimuth", 3.0), ("pitch", -1.0), ("roll", 1.5)):
        assert abs(told["refined"][name]["after"] - true) < 0.02, name
        assert 0 < told["refined"][name]["sigma"] < 0.02
    assert told["photo"]["median_distance_px"] > 5 > 0.2 > told["photo_refined"]["median_distance_px"]
    assert told["photo_refined"]["control_rms_px"] == pytest.approx(np.sqrt(0.125), abs=0.1)
    said = inside(
        "view", "skyline", dem, "--camera", tmp_path / "c.toml", "--force", "--photo", photo, "-o", tmp_path / "t.csv"
    )
    assert said.code == 0 and "as stated: edge" in said.out
    again = (tmp_path / "t.csv").read_text().split("\n")[5].split(",")
    assert abs(float(again[1]) - float(out.read_text().split("\n")[5].split(",")[1])) < 0.01


def true_angles(dem: Path) -> np.ndarray:
    """ω, φ and κ of the photograph, degrees."""
    bundle = view_camera(TRUE, open_view_ground(dem), force=True).target.bundle
    assert isinstance(bundle, FrameBundle)
    return np.degrees(bundle.camera.pose.opk)


def photo_project(folder: Path, dem: Path, photo: Path, off: np.ndarray, longer: float = 1.0) -> Path:
    """A project of the photograph, with angles that are so much off, degrees, and a camera constant that is longer."""
    bundle = view_camera(TRUE, open_view_ground(dem), force=True).target.bundle
    assert isinstance(bundle, FrameBundle)
    focal = longer * 240 / np.tan(np.radians(25.0))
    camera = folder / "camera.yaml"
    camera.write_text(
        f"c:\n  type: pinhole\n  im_size: [480, 300]\n  focal_len: {float(focal)!r}\n  sensor_size: [480, 300]\n"
    )
    numbers = ",".join(repr(float(v)) for v in (*bundle.camera.pose.center, *(true_angles(dem) + off)))
    (folder / "ext.csv").write_text(f"name,x,y,z,omega,phi,kappa\nphoto,{numbers}\n")
    request = InitRequest(
        folder=folder / "p", images=(str(photo),), camera=camera, orientation=folder / "ext.csv", terrain=str(dem),
        crs="EPSG:32633", height_system="same",
    )  # fmt: skip
    return init_project(request).path


@pytest.mark.slow
def test_an_image_of_a_project_is_turned_in_its_own_angles(mountains: tuple[Path, Path], tmp_path: Path) -> None:
    """Its orientation is half a degree wrong in ω, φ and κ; the file that is written holds the right one."""
    dem, photo = mountains
    off = np.array([0.5, -0.4, 0.3])
    project = photo_project(tmp_path, dem, photo, off)
    true = true_angles(dem)
    camera = CameraRequest(image="photo", curvature="bend")
    asked = {"photo": photo, "refine": True, "search": 60, "refined": tmp_path / "t.toml"}
    found = skyline(SkylineRequest(project, camera, force=True, output=tmp_path / "s.csv", **asked)).refined
    assert found is not None and found.names == ("omega", "phi", "kappa")
    np.testing.assert_allclose(found.before, true + off, atol=1e-6)
    np.testing.assert_allclose(found.after, true, atol=0.03)
    table = read_toml_orientation(tmp_path / "t.toml", TableFormat()).table
    assert table.images[0].name == "photo" and table.crs == "EPSG:32633"
    np.testing.assert_allclose(table.images[0].angles, found.after, atol=1e-7)


@pytest.mark.slow
def test_the_camera_constant_of_an_image_is_a_factor_of_its_cameras(
    mountains: tuple[Path, Path], tmp_path: Path
) -> None:
    """It is stated 2 % too long; the file of the orientation notes it, and the project is another one's to alter."""
    dem, photo = mountains
    project = photo_project(tmp_path, dem, photo, np.array([0.3, -0.2, 0.1]), 1.02)
    words = ("--photo", photo, "--refine", "--focal", "--search", 60, "--refined", tmp_path / "t.toml")
    said = inside("view", "skyline", project, "--camera", "photo", "--curvature", "bend", "--force", *words,
                  "-o", tmp_path / "s.csv", "--json")  # fmt: skip
    assert said.code == 0, said.err
    found = json.loads(said.out)["refined"]["constant_factor"]
    assert abs(found["after"] - 1 / 1.02) < min(4 * found["sigma"], 0.002)
    first = (tmp_path / "t.toml").read_text().split("\n")[0]
    assert first.startswith("#") and f"{found['after']:.7f}" in first
    read_toml_orientation(tmp_path / "t.toml", TableFormat())


@pytest.mark.slow
@pytest.mark.parametrize("focal", [False, True])
def test_normalised_errors_of_the_turn(tmp_path: Path, focal: bool) -> None:
    """Thirty photographs of terrain whose model is wrong by 6 m, neighbours together: what is stated is found."""
    found = []
    for k in range(30):
        dem = write_mountains(tmp_path / "model.tif", seed=100 + k, error=6.0, wrong=900 + k)
        real = write_mountains(tmp_path / "real.tif", seed=100 + k)
        photo = photograph(tmp_path / "photo.png", real, TRUE, k)
        rng = np.random.default_rng(k)
        start = TRUE.replace(
            azimuth=3.0 + rng.uniform(-1, 1), pitch=-1.0 + rng.uniform(-1, 1),
            roll=1.5 + rng.uniform(-1, 1),
            field_of_view=50.0 + (rng.uniform(-1, 1) if focal else 0.0),
        )  # fmt: skip
        result = refined(tmp_path, dem, photo, start, focal).refined
        assert result is not None
        true = np.array([getattr(TRUE, name) for name in result.names])
        found.append((np.array(result.after) - true) / result.sigma)
    rms = np.sqrt(np.mean(np.square(found), axis=0))
    print(f"normalised errors, focal {focal}:", dict(zip(NAMES, rms.round(2).tolist())))
    assert ((rms > 0.6) & (rms < 1.4)).all()


def test_a_level_horizon_tells_no_azimuth() -> None:
    x = np.arange(-50.0, 350.0)

    def pixels(step: np.ndarray) -> np.ndarray:
        pitch, azimuth, roll = step
        return np.column_stack([x + 300 * azimuth, 100.0 + 300 * pitch + roll * (x - 150)])

    edge = 101.0 + np.random.default_rng(1).normal(0, 0.3, 300)
    with pytest.raises(GeometryError, match="does not determine azimuth"):
        fit_skyline(pixels, np.full(400, 1000.0), edge, 3)
    with pytest.raises(GeometryError, match="20 columns"):
        fit_skyline(pixels, np.full(400, 1000.0), np.where(np.arange(300) < 20, edge, np.nan), 3)


def test_what_makes_no_sense_is_refused(mountains: tuple[Path, Path], tmp_path: Path) -> None:
    dem, photo = mountains
    words = ("--from", 502000, 5300300, "--altitude", 900, "--azimuth", 3, "--size", 480, 300, "-o", tmp_path / "s.csv")
    for more, why in (
        (("--refine",), "requires --photo"),
        (("--photo", photo, "--focal"), "--focal requires --refine"),
        (("--photo", photo, "--exaggeration", 2, "--reference", 500, "--force"), "heights as they are"),
        (("--photo", photo, "--refine", "--panorama", "cylinder", "--force"), "panorama"),
        (("--photo", photo, "--picture", tmp_path / "p.jpg"), "must end with .png"),
    ):
        said = inside("view", "skyline", dem, *words, *more)
        assert said.code == 2 and why in said.err, said.err
    said = inside("view", "skyline", dem, *words, "--size", 400, 300, "--photo", photo)
    assert said.code == 3 and "480 × 300" in said.err
    assert not (tmp_path / "s.csv").exists()
