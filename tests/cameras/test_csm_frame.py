"""Frame cameras of support data (CSM ISD): values of the USGS's own implementation, products, what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from scipy import ndimage
from scipy.spatial.transform import Rotation
from tools.command import inside

from photoplan.cameras.base import project
from photoplan.errors import InputError
from photoplan.geometry.crs import crs_step
from photoplan.io.camera.line import read_line
from photoplan.io.camera.satellite import frame_of, is_frame, read_frame
from photoplan.plan.footprint import footprint
from photoplan.surfaces.base import LevelSurface

#: Support data of USGS's ale and usgscsm; `edited_…` have other coefficients, sums and first detectors.
DATA = Path(__file__).parents[1] / "data/csm_frame"
NAMES = sorted(file.stem for file in DATA.glob("*.json"))
#: The reference follows this lens back to 1e-6 mm only.
COARSE = {"ceres_dawnfc": 1e-5}
MERCURY = "+proj=stere +lat_0=48 +lon_0=-112 +R=2439400 +units=m +no_defs"


def support_data(name: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((DATA / f"{name}.json").read_text())
    return found


@pytest.mark.parametrize("name", NAMES)
def test_image_to_ground_and_back_are_those_of_the_reference_implementation(name: str) -> None:
    """Asked: 1e-4 px, and 1e-5 px back. Its pixels begin at 0, ours in their middle."""
    frame = read_frame(DATA / f"{name}.json").frame
    table = np.loadtxt(DATA / f"{name}.points.txt")
    xy, ground, directions, centres = table[:, 1::-1] - 0.5, table[:, 3:6], table[:, 8:11], table[:, 11:14]
    S, d = frame.rays(xy)
    pixel = np.linalg.norm(np.subtract(*frame.rays(np.array([[1.0, 1.0], [2.0, 1.0]]))[1]))
    off = float(np.linalg.norm(d - directions, axis=1).max() / pixel)
    back = float(np.abs(project(frame, ground) - xy).max())
    print(f"\n{name}: rays {off:.1e} px, back {back:.1e} px, centre {np.abs(S - centres).max():.1e} m")
    assert off < COARSE.get(name, 2e-7)
    assert back < COARSE.get(name, 1e-9)
    assert np.abs(S - centres).max() < 1e-6


def test_points_of_the_usgs_unit_tests() -> None:
    """usgscsm, tests/FrameCameraTests.cpp: a body of 10 m from 1000 m away; rays beside it go through the points."""
    isd = support_data("jupiter_none") | {
        "center_ephemeris_time": 50.0,
        "focal2pixel_lines": [0.0, 0.0, 10.0],
        "focal2pixel_samples": [0.0, 10.0, 0.0],
        "focal_length_model": {"focal_length": 50},
        "image_lines": 15,
        "image_samples": 15,
        "detector_center": {"line": 7.5, "sample": 7.5},
        "radii": {"semimajor": 0.01, "semiminor": 0.01, "unit": "km"},
        "instrument_position": {"unit": "km", "positions": [[1.0, 0, 0]], "ephemeris_times": [50]},
        "instrument_pointing": {"quaternions": [[0.0, -(0.5**0.5), 0.0, 0.5**0.5]], "ephemeris_times": [50]},
        "body_rotation": {"quaternions": [[1, 0, 0, 0]], "ephemeris_times": [50]},
    }
    frame = frame_of(isd, Path("framer.json")).frame
    far, side = 0.44979759, 14.99325304
    seen = {(7.5, 7.5): (10, 0, 0), (7.5, 6.5): (9.80194018, 0, 1.98039612), (15, 0): (far, -side, side)}
    seen |= {(0, 15): (far, side, -side), (0, 0): (far, side, side), (15, 15): (far, -side, -side)}
    line_sample, XYZ = np.array(list(seen)), np.array(list(seen.values()))
    assert np.abs(project(frame, XYZ) - (line_sample[:, ::-1] - 0.5)).max() < 1e-6


def test_orientation_is_that_of_the_middle_of_the_exposure() -> None:
    """From tables: between their rows; beyond them it is not known, but a single row holds always."""
    isd = support_data("mercury_transverse")
    t = isd["center_ephemeris_time"]
    position, velocity = (np.array(isd["instrument_position"][k][0]) for k in ("positions", "velocities"))
    still = frame_of(isd, Path("one.json")).frame.center
    rows = [(position + s * velocity).tolist() for s in (-1.0, 2.0)]
    isd["instrument_position"] |= {"positions": rows, "velocities": [velocity.tolist()] * 2}
    isd["instrument_position"]["ephemeris_times"] = [t - 1.0, t + 2.0]
    assert np.abs(frame_of(isd, Path("two.json")).frame.center - still).max() < 1e-5
    isd["instrument_position"]["ephemeris_times"] = [t + 1.0, t + 2.0]
    with pytest.raises(InputError, match=r"two.json: instrument_position is stated from .* the image is of"):
        frame_of(isd, Path("two.json"))


class TestOverItsBody:
    def test_ways_there_and_back_and_derivatives(self) -> None:
        stated = read_frame(DATA / "mercury_transverse.json")
        camera = stated.camera(MERCURY, "ellipsoidal")
        xy = np.stack(np.meshgrid(np.linspace(0, 511, 5), np.linspace(0, 511, 5)), axis=-1)
        XYZ, d = camera.rays(xy, 500.0)
        print(f"\ninverse {np.abs(project(camera, XYZ) - xy).max():.1e} px")
        assert np.abs(project(camera, XYZ) - xy).max() < 1e-8
        assert np.abs(np.einsum("...ij,...j", camera.derivatives(XYZ), d)).max() < 1e-6
        apart = np.stack([project(camera, XYZ + e) - project(camera, XYZ - e) for e in 10 * np.eye(3)], axis=-1) / 20
        assert np.abs(camera.derivatives(XYZ) - apart).max() < 1e-6

    def test_beside_and_behind_the_body_there_is_nothing(self) -> None:
        """Ceres fills the image: rays beside it meet nothing, and its far side is not seen."""
        stated = read_frame(DATA / "ceres_dawnfc.json")
        camera = stated.camera("+proj=stere +lat_0=-90 +a=482000 +b=446000 +units=m +no_defs", "ellipsoidal")
        middle, corner, beside = camera.rays(np.array([[511.5, 511.5], [1023.0, 1023.0], [1600.0, 1600.0]]), 0.0)[0]
        seen = footprint(camera, LevelSurface(0.0), None)
        assert np.isfinite([middle, corner]).all() and np.isnan(beside).all()
        assert seen.bounds is not None and seen.on_surface == 1.0
        # A point over the other pole, in a map that has it, lies on the line of sight, and is not seen.
        north = stated.camera("+proj=eqc +a=482000 +b=446000 +units=m +no_defs", "ellipsoidal")
        over = np.stack([np.linspace(-1e6, 1e6, 9), np.full(9, 7e5), np.zeros(9)], axis=-1)
        assert np.isnan(project(north, over)).all()
        assert np.isfinite(project(stated.frame, north.ground(over))).any()

    @pytest.mark.parametrize(
        "projection", ["eqc", "merc", "lcc +lat_1=20 +lat_2=40", "stere +lat_0=40 +lon_0=30", "stere +lat_0=90", "moll"]
    )
    @pytest.mark.parametrize("name", ["vesta_radtan", "edited_vesta_radtan"])
    def test_every_ray_that_meets_a_flattened_body_has_its_place(self, name: str, projection: str) -> None:
        """The reference's places, by PROJ's own forward projection, over all of the image; asked: to a centimetre."""
        stated = read_frame(DATA / f"{name}.json")
        crs = f"+proj={projection} +a={stated.radii[0]!r} +b={stated.radii[1]!r} +units=m +no_defs"
        camera = stated.camera(crs, "ellipsoidal")
        table = np.loadtxt(DATA / f"{name}.points.txt")
        table = table[(table[:, -1] == 0) & (table[:, 2] == 0)]
        place = camera.rays(table[:, 1::-1] - 0.5, table[:, 2])[0]
        X, Y, Z = table[:, 3:6].T
        lon, lat = np.arctan2(Y, X), np.arctan(Z / np.hypot(X, Y) * (stated.radii[0] / stated.radii[1]) ** 2)
        wanted = Transformer.from_crs(CRS(crs).geodetic_crs, crs, always_xy=True).transform(*np.degrees([lon, lat]))
        off = np.abs(place[:, :2] - np.stack(wanted, axis=-1)).max()
        print(f"\n{name}, {projection}: {len(table)} rays, {off:.1e} m")
        assert off < 0.01
        assert np.abs(project(camera, place) - (table[:, 1::-1] - 0.5)).max() < 1e-6

    @pytest.mark.parametrize("projection", ["laea", "laea +lat_0=40 +lon_0=10", "sinu", "cea"])
    def test_a_projection_that_proj_cannot_invert_there_is_refused_by_name(self, projection: str) -> None:
        """They lead 1 to 900 m away on Vesta; the same projections are right on a sphere, and on the earth."""
        stated = read_frame(DATA / "vesta_radtan.json")
        a, b = stated.radii
        camera = stated.camera(f"+proj={projection} +a={a!r} +b={b!r} +units=m +no_defs", "ellipsoidal")
        name = projection.split()[0]
        with pytest.raises(InputError, match=rf"\+proj={name}.*PROJ cannot invert.*289 and 229 km.* m away; choose"):
            camera.rays(np.array([[511.5, 511.5], [300.0, 700.0]]), 0.0)
        with pytest.raises(InputError, match="PROJ cannot invert"):
            footprint(camera, LevelSurface(0.0), None)
        eqc = f"+proj=eqc +a={a!r} +b={b!r} +units=m +no_defs"
        with pytest.raises(InputError, match="PROJ cannot invert"):
            crs_step(camera.ground.crs, eqc, (50_000.0, 50_000.0, 60_000.0, 60_000.0))
        sphere = stated.camera(f"+proj={projection} +R={a!r} +units=m +no_defs", "ellipsoidal")
        assert np.isfinite(sphere.rays(np.array([[511.5, 511.5]]), 0.0)[0]).all()
        crs_step(f"+proj={projection} +datum=WGS84 +units=m", "EPSG:4326", (1e5, 1e5, 2e5, 2e5))

    def test_a_map_of_another_body_is_refused(self) -> None:
        with pytest.raises(InputError, match=r"radius 2439.4 km.* 6378.1 km"):
            read_frame(DATA / "mercury_transverse.json").camera("EPSG:32633", "ellipsoidal")

    def test_commands(self, tmp_path: Path) -> None:
        """A picture drawn ray by ray becomes an orthophoto on which every place has its grey value."""
        isd = support_data("edited_mercury_transverse")
        file = _project(tmp_path, isd, 1000.0)
        assert "200 columns, 300 lines" in inside("info", tmp_path / "frame.json").out
        assert inside("check", file).code == 0
        said = inside("ortho", file, "--resolution", 3.0, "--no-quicklook")
        assert said.code == 0, said.err
        with rasterio.open(said.out.strip()) as product:
            values, valid, T = product.read(1), product.read_masks(1) > 0, product.transform
        row, column = np.mgrid[: values.shape[0], : values.shape[1]] + 0.5
        whole = ndimage.binary_erosion(valid, iterations=3)
        error = (values - _pattern(np.stack([T.c + T.a * column, T.f + T.e * row], axis=-1)))[whole]
        # How much the pattern changes over a pixel of the image, on average.
        pixel = 3.0 * 40.0 / 60.0
        print(f"\nrms {error.std() / pixel:.4f} px, worst {np.abs(error).max() / pixel:.3f} px")
        assert valid.sum() > 20_000
        assert error.std() / pixel < 0.03 and np.abs(error).max() / pixel < 0.3
        assert "not corrected by an adjustment" in inside("adjust", file).err

    def test_an_image_of_another_size_is_refused(self, tmp_path: Path) -> None:
        file = _project(tmp_path, support_data("edited_mercury_transverse"), 1000.0)
        (tmp_path / "frame.json").write_text((DATA / "mercury_transverse.json").read_text())
        said = inside("check", file)
        assert said.code == 3 and "200 × 300 pixels" in said.err and "512 × 512" in said.err


@pytest.mark.parametrize(
    ("entry", "value", "told"),
    [
        ("image_samples", None, "image_samples is missing"),
        ("detector_line_summing", None, "detector_line_summing is missing"),
        ("detector_sample_summing", 0, "0 samples of the detector in one"),
        ("detector_center", {"line": None, "sample": None}, "detector_center.line is missing"),
        ("focal2pixel_lines", [0.0, 71.0, 0.0], "parallel"),
        ("focal_length_model", {"focal_length": "long"}, "not a table of numbers"),
        ("focal_length_model", {"focal_length": 1e300}, "or such as cannot be"),
        ("optical_distortion", {"cahvor": {"coefficients": [0] * 5}}, "'cahvor' is not known; radial, transverse"),
        ("optical_distortion", {"lunarorbiter": {"perspective_x": 0}}, "'lunarorbiter' is not known"),
        ("optical_distortion", {"kaguyalism": {"x": [0] * 4}}, "'kaguyalism' is not known"),
        ("optical_distortion", {"radial": {"coefficients": []}}, "has 0 numbers; 1 to 3 are known"),
        ("optical_distortion", {"radial": {"coefficients": [0, 1e-5, 0, 1e-9]}}, "has 4 numbers; .* more must be 0"),
        ("optical_distortion", {"radtan": {"coefficients": [0.0, -1e9, 0, 0, 0]}}, "folds back"),
        ("optical_distortion", {"transverse": {"x": [0, 1] + [0] * 8}}, "transverse.y is missing"),
        ("jitter", {"lineExposureTimes": [0, 1]}, "one after the other"),
        ("name_model", "USGS_ASTRO_PUSH_FRAME_SENSOR_MODEL", "of USGS_ASTRO_PUSH_FRAME_SENSOR_MODEL, not"),
        ("instrument_pointing", {"quaternions": [[2, 0, 0, 0]], "ephemeris_times": [0]}, "the length 2"),
    ],
)
def test_what_is_wrong_in_a_file_is_named(entry: str, value: object, told: str) -> None:
    with pytest.raises(InputError, match=told) as error:
        frame_of(support_data("mercury_transverse") | {entry: value}, Path("some.json"))
    assert str(error.value).startswith("some.json: ")


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
def test_radial_coefficients_that_are_not_there_are_zero(count: int) -> None:
    """As in usgscsm: the first is the constant part, then r² and r⁴."""
    full = [-2.5e-3, 1e-5, -2e-9]
    given = [*full, 0.0, 0.0][:count]
    expected = [*full[:count], 0.0, 0.0][:3]
    xy = np.stack(np.meshgrid([0.0, 300.0, 900.0], [10.0, 500.0]), axis=-1).reshape(-1, 2)
    rays = [
        frame_of(
            support_data("dione_radial") | {"optical_distortion": {"radial": {"coefficients": c}}}, Path("a.json")
        ).frame.rays(xy)[1]
        for c in (given, expected)
    ]
    np.testing.assert_array_equal(*rays)


def test_a_camera_that_looks_away_is_refused() -> None:
    isd = support_data("mercury_transverse")
    isd["instrument_position"]["positions"] = (-np.array(isd["instrument_position"]["positions"])).tolist()
    with pytest.raises(InputError, match="looks away from its body"):
        frame_of(isd, Path("some.json"))


def test_files_of_lines_and_frames_are_told_apart(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="state the file as `frame`"):
        read_line(DATA / "mercury_transverse.json")
    (tmp_path / "line.json").write_text('{"name_model": "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL", "line_scan_rate": []}')
    with pytest.raises(InputError, match="state the file as `line`"):
        read_frame(tmp_path / "line.json")
    (tmp_path / "no.json").write_text("[")
    files = [DATA / "mercury_transverse.json", tmp_path / "line.json", tmp_path / "no.json"]
    assert [is_frame(file) for file in files] == [True, False, False]


def _pattern(XY: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(100 + 40 * np.sin(XY[..., 0] / 60.0) + 40 * np.cos(XY[..., 1] / 70.0))


def _project(folder: Path, isd: dict[str, Any], height: float) -> Path:
    """Image, support data and project over a level ground of a sphere; drawn by no code of photoplan."""
    row, column = np.mgrid[: isd["image_lines"], : isd["image_samples"]] + 0.5
    sums = isd["detector_line_summing"], isd["detector_sample_summing"]
    detector = [v * s + isd[f"starting_detector_{n}"] for v, s, n in zip((row, column), sums, ("line", "sample"))]
    to = np.array([isd["focal2pixel_lines"], isd["focal2pixel_samples"]])
    away = [v - isd["detector_center"][n] - a for v, n, a in zip(detector, ("line", "sample"), to[:, 0])]
    d = np.moveaxis(np.tensordot(np.linalg.inv(to[:, 1:]), np.stack(away), 1), 0, -1)
    c = np.array([isd["optical_distortion"]["transverse"][axis] for axis in "xy"])
    u = d.copy()
    for _ in range(60):
        x, y = u[..., 0], u[..., 1]
        terms = np.stack([x**0, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], axis=-1)
        u = u + 0.9 * (d - terms @ c.T)
    look = np.concatenate([u, np.full((*row.shape, 1), isd["focal_length_model"]["focal_length"])], axis=-1)
    to_camera, to_body = (_turn(isd[name]) for name in ("instrument_pointing", "body_rotation"))
    v = (to_body * to_camera.inv()).apply(look.reshape(-1, 3))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    S = 1000.0 * to_body.apply(isd["instrument_position"]["positions"][0])
    radius = 1000.0 * isd["radii"]["semimajor"] + height
    along = v @ S
    P = S - (along + np.sqrt(along**2 - S @ S + radius**2))[:, None] * v
    lon, lat = np.degrees(np.arctan2(P[:, 1], P[:, 0])), np.degrees(np.arcsin(P[:, 2] / radius))
    XY = Transformer.from_crs("+proj=longlat +R=2439400 +no_defs", MERCURY, always_xy=True).transform(lon, lat)
    values = _pattern(np.column_stack(XY)).reshape(row.shape)
    profile = {"driver": "GTiff", "width": row.shape[1], "height": row.shape[0], "count": 1, "dtype": "float32"}
    with rasterio.open(folder / "frame.tif", "w", **profile) as file:
        file.write(values.astype(np.float32), 1)
    (folder / "frame.json").write_text(json.dumps(isd))
    (folder / "project.toml").write_text(
        f'format = 1\ncrs = "{MERCURY}"\n[terrain]\nheight = {height}\nheight_system = "ellipsoidal"\n'
        '[[images]]\nname = "frame"\nfile = "frame.tif"\nframe = "frame.json"\n'
    )
    return folder / "project.toml"


def _turn(entry: dict[str, Any]) -> Rotation:
    turn = Rotation.from_quat(np.roll(entry["quaternions"][0], -1))
    if "constant_rotation" not in entry:
        return turn
    return Rotation.from_matrix(np.reshape(entry["constant_rotation"], (3, 3))) * turn
