"""Line cameras: the image-to-ground values of other programs, the way back, what is not oriented."""

from __future__ import annotations

import copy
import json
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import rasterio
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from tools.body_axes import over_its_body
from tools.command import inside
from tools.line_strip import Strip, pattern

from photoplan.cameras.base import project
from photoplan.cameras.pushbroom import LineCamera
from photoplan.cameras.rpc import fit_rpc
from photoplan.errors import HeightSystemError, InputError
from photoplan.geometry.local import EARTH_RADII, BodyGround, Ellipsoid, GeodeticGround
from photoplan.io.camera.line import StatedLine, read_csm, read_line
from photoplan.plan.footprint import footprint
from photoplan.surfaces.base import LevelSurface

FILES = ["chandrayaan2_tmc2_isd", "ctxLineScan", "hirise_isd", "lrolroc_isd", "mexhrsc_isd", "constVelocityLineScan"]
#: Here the reference intersects rays behind the camera: it looks away from the body.
BEHIND = ["orbitalLineScan", "flippedOrbitalLineScan"]


def reference(folder: Path, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Image points (column, row from the middle of the first pixel), ground points, and times, centres, directions."""
    table = np.loadtxt(folder / f"{name}.points.txt")
    return table[:, 1::-1] - 0.5, table[:, 3:6], table[:, 8:]


@pytest.mark.parametrize("name", FILES + BEHIND)
def test_rays_are_those_of_the_reference_implementation(shared: Path, name: str) -> None:
    """Asked: 1e-4 px. Lenses (radial, LROC NAC), sparse tables and pauses between lines are among them."""
    folder = shared / "data/csm_linescan_oracle"
    stated = read_line(folder / f"{name}.json")
    xy, ground, (t, *_) = *reference(folder, name)[:2], reference(folder, name)[2].T
    assert np.abs(stated.track.time(xy[:, 1]) - t).max() < 1e-10
    S, d = over_its_body(stated).body_rays(xy)
    away = np.einsum("ni,ni->n", ground - S, d)
    beside = np.linalg.norm(ground - S - away[:, None] * d, axis=1)
    assert (beside <= 1e-6 * np.abs(away) * stated.look.pitch).all()
    assert (away > 0).all() == (name not in [*BEHIND, "constVelocityLineScan"])


@pytest.mark.parametrize("name", FILES)
def test_positions_are_those_of_the_reference_implementation(shared: Path, name: str) -> None:
    """Asked: 1e-5 px. What lies behind the camera has no position."""
    folder = shared / "data/csm_linescan_oracle"
    camera = over_its_body(read_line(folder / f"{name}.json"))
    xy, ground, _ = reference(folder, name)
    S, d = camera.body_rays(xy)
    front = np.einsum("ni,ni->n", ground - S, d) > 0
    found = project(camera, ground)
    assert np.abs(found[front] - xy[front]).max() < 1e-6
    assert np.isnan(found[~front]).all()
    assert front.mean() == (0.5 if name == "constVelocityLineScan" else 1.0)


def test_fault_23_lines_beyond_the_ephemeris_are_not_known(shared: Path) -> None:
    """The lines after the pause of this image were taken after its positions end (the reference goes 470 km astray)."""
    stated = read_line(shared / "data/csm_linescan_oracle/mexhrsc_isd.json")
    camera = over_its_body(stated)
    assert stated.size == (1288, 15088)
    assert stated.track.oriented == pytest.approx((-0.5, 6665.5), abs=0.1)
    S, d = camera.body_rays(np.array([[600.0, 6664.0], [600.0, 6667.0], [600.0, 15_000.0]]))
    assert np.isfinite(d[0]).all() and np.isnan(S[1:]).all() and np.isnan(d[1:]).all()
    assert "0 to 6665 only" in stated.describe()["oriented lines"]


@pytest.mark.parametrize("name", ["instrument_pointing", "body_rotation"])
def test_fault_23_lines_beyond_one_of_the_tables_of_attitudes_are_not_known(name: str) -> None:
    """The pointing of ale's image of MGS MOC begins a second after its last line; the body's rotation covers it."""
    isd = Strip(lines=40, columns=30).isd()
    table = isd["body_rotation"] | isd["instrument_pointing"] if name == "body_rotation" else dict(isd[name])
    middle = int(np.searchsorted(table["ephemeris_times"], isd["center_ephemeris_time"]))
    isd[name] = table | {k: table[k][middle:] for k in ("ephemeris_times", "quaternions")}
    oriented = read_csm(isd, Path("strip.json")).track.oriented
    assert 15 < oriented[0] < 25 and oriented[1] == 39.5


@pytest.fixture
def pleiades(shared: Path) -> StatedLine:
    return read_line(next((shared / "data/pleiades_line_model").glob("PHRDIMAP*.XML")))


def test_pleiades_rays_meet_its_location_grid(shared: Path, pleiades: StatedLine) -> None:
    """81 nodes at 9 heights. Half a line beside them the same rays miss by 0.26 m."""
    with rasterio.open(next((shared / "data/pleiades_line_model").glob("GRID*.tif"))) as grid:
        bands, tags = grid.read().astype(float), grid.tags()
    i, j = (v.ravel() for v in np.mgrid[0:65:8, 0:65:8])
    xy = np.column_stack([624.984375 * j, 597.609375 * i])
    camera = pleiades.camera("EPSG:32631", "ellipsoidal")
    worst, half_a_line = 0.0, []
    for band in range(0, 18, 2):
        lon, lat = np.radians(bands[band : band + 2, i, j])
        height = np.full(lon.shape, float(tags[f"ALTITUDE_B{band}"]))
        ground = Ellipsoid.of_radii(*EARTH_RADII).geocentric(lon, lat, height)[0]
        worst = max(worst, beside(camera, xy, ground).max())
        half_a_line.append(beside(camera, xy + np.array([0.0, 0.5]), ground).min())
        assert np.abs(camera.seen_from(ground - camera.near.origin) - xy).max() < 0.001
    print(f"\nworst of 729: {1000 * worst:.2f} mm")
    assert worst <= 0.001
    assert min(half_a_line) > 0.2


def beside(camera: LineCamera, xy: NDArray[np.float64], ground: NDArray[np.float64]) -> NDArray[np.float64]:
    S, d = camera.body_rays(xy)
    return np.linalg.norm(np.cross(ground - S, d), axis=1)


def test_project_and_rays_are_inverse_and_derivatives_those_of_differences(pleiades: StatedLine) -> None:
    camera = pleiades.camera("EPSG:32631", "ellipsoidal")
    xy = np.random.default_rng(1).uniform([0, 0], [39_999, 38_247], (500, 2))
    for height in (0.0, 3000.0):
        XYZ, d = camera.rays(xy, height)
        assert np.abs(project(camera, XYZ) - xy).max() < 1e-8
        assert np.abs(project(camera, XYZ + 100 * d) - xy).max() < 1e-3  # the map bends straight rays
    steps = np.eye(3)
    differences = np.stack([project(camera, XYZ + s) - project(camera, XYZ - s) for s in steps], axis=-1) / 2
    assert np.abs(camera.derivatives(XYZ) - differences).max() < 1e-6


def test_rational_polynomials_replace_it(pleiades: StatedLine) -> None:
    """Asked: 0.001 px as standard deviation."""
    camera = pleiades.camera("EPSG:32631", "ellipsoidal")
    fitted = fit_rpc(camera, GeodeticGround("EPSG:32631", "ellipsoidal"), (0.0, 1000.0))
    print(f"\nrms {fitted.rms}, worst {fitted.worst} px")
    assert max(fitted.rms) < 0.001


def test_another_planet_with_its_own_map(shared: Path) -> None:
    stated = read_line(shared / "data/csm_linescan_oracle/ctxLineScan.json")
    mars = "+proj=eqc +lat_ts=15 +lon_0=77 +a=3396190 +b=3376200 +units=m +type=crs"
    camera = stated.camera(mars, "same")
    xy = np.array([[0.0, 0.0], [4999.0, 11_263.0], [2000.0, 6000.0]])
    XYZ, _ = camera.rays(xy, -2500.0)
    assert np.abs(project(camera, XYZ) - xy).max() < 1e-6
    assert camera.vantage.reach is not None and 30_000 < camera.vantage.reach < 60_000
    with pytest.raises(InputError, match=r"3396\.2 km.*6378\.1 km"):
        stated.camera("EPSG:32631", "ellipsoidal")


class TestStrip:
    """A flight over level ground, its pixels drawn ray by ray by other means."""

    def test_pixels_see_what_was_drawn(self) -> None:
        strip = Strip(lines=120)
        camera = read_csm(strip.isd(), Path("strip.json")).camera(strip.crs, "ellipsoidal")
        XY = strip.seen(300.0)
        found = project(camera, np.concatenate([XY, np.full((*XY.shape[:2], 1), 300.0)], axis=-1))
        y, x = np.mgrid[: strip.lines, : strip.columns]
        assert np.abs(found - np.stack([x, y], axis=-1)).max() < 1e-3

    def test_commands(self, tmp_path: Path) -> None:
        """Information, check, orthophoto: each place of the map shows the grey value that it has."""
        project_file = Strip(lines=160).write(tmp_path, 300.0)
        assert "160 lines of 4.28571 ms" in inside("info", tmp_path / "strip.json").out
        assert "all plausible" in inside("check", project_file).out
        said = inside("ortho", project_file, "--resolution", 0.3, "--no-quicklook")
        assert said.code == 0, said.err
        with rasterio.open(said.out.strip()) as product:
            values, valid, T = product.read(1), product.read_masks(1) > 0, product.transform
        row, column = np.mgrid[: values.shape[0], : values.shape[1]] + 0.5
        # The outermost pixels have no neighbours on one side.
        whole = ndimage.binary_erosion(valid, iterations=2)
        error = (values - pattern(np.stack([T.c + T.a * column, T.f + T.e * row], axis=-1)))[whole]
        pixel = 0.3 * float(np.hypot(40 / 4, 40 / 5)) / np.sqrt(2)
        print(f"\nrms {error.std() / pixel:.4f} px, worst {np.abs(error).max() / pixel:.3f} px")
        assert valid.mean() > 0.8
        assert error.std() / pixel < 0.03 and np.abs(error).max() / pixel < 0.3

    def test_a_record_that_ends_with_the_last_line_is_enough_for_the_whole_footprint(self) -> None:
        """The outer edges of the first and last line have no orientation then, and their middles have."""
        strip = Strip(beyond=1e-6)
        camera = read_csm(strip.isd(), Path("strip.json")).camera(strip.crs, "ellipsoidal")
        corner = np.array([[-0.5, -0.5]])
        assert np.isnan(camera.rays(corner, 300.0)[0]).all()
        seen = footprint(camera, LevelSurface(300.0), None)
        assert seen.on_surface == 1.0
        across, along = strip.columns * strip.pixel, strip.lines * strip.pixel
        assert np.ptp(seen.outline[:, :2], axis=0) == pytest.approx([along, across], rel=0.15)

    def test_an_image_that_leaves_the_grid_of_its_heights_is_projected_where_that_holds(self) -> None:
        strip = Strip()
        whole = read_csm(strip.isd(), Path("strip.json")).camera(strip.crs, "ellipsoidal")
        camera = LineCamera(whole.track, whole.look, Ending(strip.crs, "ellipsoidal", EARTH_RADII))
        xy = np.stack(np.meshgrid([20.0, 380.0], [20.0, 100.0, 200.0, 400.0, 500.0, 580.0]), axis=-1).reshape(-1, 2)
        ground = whole.rays(xy, 300.0)[0]
        held = ground[:, 0] < Ending.east
        assert 3 < held.sum() < 9
        assert np.abs(project(camera, ground[held]) - xy[held]).max() < 1e-6
        with pytest.raises(HeightSystemError, match="outside of the grid"):
            project(camera, ground)
        # What lies beyond is never taken for ground of another height: an outline that needs it is refused.
        with pytest.raises(HeightSystemError, match="outside of the grid"):
            footprint(camera, LevelSurface(300.0), None)

    def test_an_image_of_another_size_is_refused(self, tmp_path: Path) -> None:
        project_file = Strip(lines=60).write(tmp_path, 300.0)
        isd = Strip(lines=50).isd()
        (tmp_path / "strip.json").write_text(json.dumps(isd))
        said = inside("ortho", project_file, "--resolution", 0.3)
        assert said.code == 3 and "400 × 60 pixels" in said.err and "400 × 50" in said.err


@dataclass(frozen=True)
class Ending(BodyGround):
    """The earth, with heights by a grid that ends in the east, and says so as grids do."""

    east: ClassVar[float] = 600_000.0

    @property
    def bare(self) -> BodyGround:
        return BodyGround(self.crs, self.heights, self.radii)

    def held(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        XYZ = np.asarray(XYZ, float)
        if (XYZ[..., 0] > self.east).any():
            raise HeightSystemError("a point lies outside of the grid")
        return XYZ

    def __call__(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        return self.bare(self.held(XYZ))

    def ellipsoidal(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        return self.held(XYZ)[..., 2]

    def to_map(self, xyz: ArrayLike) -> NDArray[np.float64]:
        return self.held(self.bare.to_map(xyz))


@pytest.mark.parametrize(
    ("entry", "value", "told"),
    [
        ("image_lines", None, "image_lines is missing"),
        ("image_lines", 1e20, "an image of"),
        ("image_lines", 1e300, "image_lines holds numbers"),
        ("line_scan_rate", [[0.5, -1.0, 0.0]], "times of the image's lines do not grow"),
        ("line_scan_rate", [[0.5, 900.0, 0.004]], "no line of the image is oriented"),
        ("optical_distortion", {"cahvor": {"coefficients": [0]}}, "the distortion 'cahvor' is not known"),
        ("focal_length_model", {"focal_length": -1.0}, "focal length"),
        ("focal2pixel_lines", [0.0, 0.0, 100.0], "parallel"),
        ("radii", {"semimajor": 1.0, "semiminor": 2.0, "unit": "km"}, "radii"),
        ("instrument_position", {"unit": "m", "positions": [[0, 0, 0]], "ephemeris_times": [0]}, "single moment"),
        ("instrument_position", {"unit": "ft", "positions": [[0, 0, 0]] * 2, "ephemeris_times": [0, 1]}, "'ft'"),
        (
            "instrument_position",
            {
                "unit": "m",
                "positions": [[7e6, 0, i * (7e6 if i == 3 else 7e3)] for i in range(9)],
                "ephemeris_times": [*range(9)],
            },
            "from record 3 to 4, in 1 s, .* usual speed of 7e.03",
        ),
        ("instrument_pointing", {"quaternions": [[2, 0, 0, 0]] * 2, "ephemeris_times": [0, 1]}, "the length 2"),
        ("instrument_pointing", {"quaternions": "none", "ephemeris_times": [0, 1]}, "not a table of numbers"),
    ],
)
def test_what_is_wrong_in_a_file_is_named(entry: str, value: object, told: str) -> None:
    isd = copy.deepcopy(Strip(lines=20, columns=30).isd())
    isd[entry] = value
    with pytest.raises(InputError, match=told) as error:
        read_csm(isd, Path("some.json"))
    assert str(error.value).startswith("some.json: ")
