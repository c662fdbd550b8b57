"""Ground points from one image: round trips, standard deviations against simulation, and real data."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import dataclass

import numpy as np
import pyogrio.raw
import pytest
import shapely
from cameras.camera_examples import BROWN
from scipy.ndimage import gaussian_filter
from tools.function_surface import FunctionSurface, raster_surface
from tools.real_projects import drone_project
from tools.recorded import recorded
from tools.small_block import hills

from photoplan.cameras.base import project
from photoplan.cameras.framed import oriented_camera
from photoplan.cameras.lenses import Interior, NoLens
from photoplan.cli.main import run
from photoplan.errors import UsageError
from photoplan.geometry.pose import Pose, axes_of_angles
from photoplan.io.project.file import load_project
from photoplan.products.monoplot import MonoplotRequest, monoplot_file
from photoplan.project.scene import open_scene
from photoplan.surfaces.base import LevelSurface
from photoplan.terrain.analysis import MonoplotErrors, MonoplotPoints, monoplot

X0, Y0, H = 500_000.0, 5_300_000.0, 900.0
INTERIOR = Interior.digital((2000, 1125), (1435.5, 1432.9), (3.2, -5.1))


def random_terrain(seed: int, roughness: float = 25.0):
    rng = np.random.default_rng(seed)
    z = gaussian_filter(rng.normal(size=(500, 500)), 12)
    return raster_surface(300 + z / z.std() * roughness, X0 - 1250, Y0 + 1250, 5.0)


def camera(tilt: float, lens=BROWN, moved=(0, 0, 0), turned=(0, 0, 0), **more):
    pose = Pose.from_angles(np.array([X0, Y0, H]) + moved, np.radians([tilt, -6.0, 31.0]) + turned)
    return oriented_camera(INTERIOR, lens, pose, **more)


def image_points(count: int, seed: int = 1):
    return np.random.default_rng(seed).uniform([0, 0], [1999, 1124], (count, 2))


@pytest.mark.parametrize("tilt", [0.0, 25.0, -40.0])
@pytest.mark.parametrize(
    "more",
    [{}, {"crs": "EPSG:32633", "earth_curvature": "strict", "refraction": True}, {"earth_curvature": "correction"}],
    ids=["cartesian", "strict", "correction"],
)
def test_projected_ground_points_are_the_image_points(tilt, more):
    terrain, lens = random_terrain(3), camera(tilt, **more)
    xy = image_points(300)
    found = monoplot(lens, xy, terrain, (200, 420), MonoplotErrors(), 5.0)
    met = found.reasons == ""
    assert met.mean() > 0.7
    np.testing.assert_allclose(project(lens, found.XYZ[met]), xy[met], atol=1e-3)
    np.testing.assert_allclose(terrain.heights(found.XYZ[met, :2]), found.XYZ[met, 2], atol=1e-3)
    assert set(found.reasons[~met]) <= {"none"}


def test_of_several_intersections_the_first_is_taken():
    """A wall of 100 m across the view hides the ground behind it."""
    wall = FunctionSurface(lambda x, y: np.where(np.abs(y - Y0 - 500) < 4, 100.0, 0.0))
    lens = oriented_camera(INTERIOR, NoLens(), Pose.from_angles([X0, Y0, 300.0], np.radians([60.0, 0, 0])))
    behind = project(lens, np.array([[X0, Y0 + 600.0, 0.0], [X0, Y0 + 400.0, 0.0], [X0, Y0 + 900.0, 0.0]]))
    found = monoplot(lens, behind, wall, (0, 100), MonoplotErrors(), 2.0)
    # The line over the wall's top meets the ground at 500 · 300 / 200 = 750 m.
    assert found.XYZ[0, 1] - Y0 == pytest.approx(496, abs=0.5) and 40 < found.XYZ[0, 2] < 60
    assert found.XYZ[1:, 1] - Y0 == pytest.approx([400, 900], abs=0.01)


@dataclass
class Case:
    """One source of errors."""

    tilt: float
    errors: MonoplotErrors


CASES = {
    "image": Case(20, MonoplotErrors(1.5, 0.0)),
    "terrain": Case(35, MonoplotErrors(0.0, 0.4)),
    "position": Case(25, MonoplotErrors(0.0, 0.0, (0.5, 0.2, 0.8))),
    "angles": Case(30, MonoplotErrors(0.0, 0.0, (0, 0, 0), (4e-4, 2e-4, 9e-4))),
    "all": Case(-25, MonoplotErrors(0.7, 0.3, (0.1, 0.3, 0.2), (2e-4, 1e-4, 3e-4))),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name == "all" else pytest.mark.slow) for name in CASES]
)
def test_standard_deviations_are_those_of_simulated_errors(name):
    """Within 10 %, on smooth hills, from 400 trials of 25 points."""
    tilt, errors = CASES[name].tilt, CASES[name].errors
    terrain = FunctionSurface(lambda x, y: 300 + 0.2 * (x - X0) + 30 * np.sin((x - X0) / 400) * np.cos((y - Y0) / 300))
    rng = np.random.default_rng(7)
    xy = image_points(25)
    axes = axes_of(tilt)
    stated = MonoplotErrors(errors.image, errors.terrain, errors.position, errors.angles, axes)
    found = monoplot(camera(tilt), xy, terrain, (100, 700), stated, 5.0)
    trials = []
    for _ in range(400):
        moved, turned = rng.normal(0, 1, 3) * errors.position, rng.normal(0, 1, 3) * errors.angles
        dh = rng.normal(0, 1, len(xy)) * errors.terrain
        noisy = xy + rng.normal(0, 1, xy.shape) * errors.image
        trials.append(direct(camera(tilt, moved=moved, turned=turned), noisy, found.XYZ, terrain, dh))
    simulated = np.std(trials, axis=0)
    seen = np.isfinite(simulated).all(axis=1) & (found.angle > math.radians(20))
    assert seen.sum() >= 20
    big = simulated > 1e-3 * simulated.max()
    ratio = (found.sigmas / np.where(big, simulated, np.nan))[seen]
    assert np.nanmean(ratio, axis=0) == pytest.approx(1, abs=0.08, nan_ok=True)
    assert np.nanmin(ratio) > 0.85 and np.nanmax(ratio) < 1.15


def axes_of(tilt):
    return axes_of_angles(Pose.from_angles([X0, Y0, H], np.radians([tilt, -6.0, 31.0])).R_ground_camera, "opk")


def direct(lens, xy, start, terrain, dh):
    """Ray and surface + dh met by Newton's method on the ray: another way than the one under test."""
    origin, direction = lens.rays(xy)
    t = np.linalg.norm(start - origin, axis=1)
    for _ in range(8):
        f = [
            (p := origin + (t + e)[:, None] * direction)[:, 2] - terrain.heights(p[:, :2]) - dh for e in (-0.5, 0, 0.5)
        ]
        t = t - f[1] / (f[2] - f[0])
    return origin + t[:, None] * direction


def test_a_vertical_image_of_level_ground_has_the_textbook_standard_deviations():
    """σ_X² = (h/c σ_x)² + (x/c σ_h)², σ_Z = σ_h."""
    lens = oriented_camera(
        Interior.digital((2001, 1001), (1000.0, 1000.0), (0.0, 0.0)),
        NoLens(),
        Pose.from_angles([0, 0, 500.0], [0, 0, 0]),
    )
    found = monoplot(lens, [[1000, 500], [1800, 500]], LevelSurface(0.0), (0, 0), MonoplotErrors(0.5, 0.3), 1.0)
    np.testing.assert_allclose(found.sigmas[0], [0.25, 0.25, 0.3], rtol=1e-6)
    np.testing.assert_allclose(found.sigmas[1], [math.hypot(0.25, 0.8 * 0.3), 0.25, 0.3], rtol=1e-6)
    assert np.degrees(found.angle) == pytest.approx([90, 90 - math.degrees(math.atan(0.8))])


def test_fault_21_points_without_ground_say_why():
    lens = oriented_camera(INTERIOR, NoLens(), Pose.from_angles([X0, Y0, 100.0], np.radians([80.0, 0, 0])))
    ring = FunctionSurface(lambda x, y: np.where((y - Y0 < 300) & ~((y - Y0 > 100) & (y - Y0 < 120)), 0.0, np.nan))
    xy = [[1000, 100], [1000, 600], [-5, 100], [1000, 1100]]
    found = monoplot(lens, xy, ring, (0, 0), MonoplotErrors(0.5, 0.1), 2.0)
    assert [*found.reasons] == ["up", "none", "outside", ""]
    assert np.isnan(found.XYZ[:3]).all() and np.isnan(found.sigmas[:3]).all()
    low = oriented_camera(INTERIOR, NoLens(), Pose.from_angles([X0, Y0, -5.0], np.radians([80.0, 0, 0])))
    assert (monoplot(low, xy, ring, (0, 0), MonoplotErrors(), 2.0).reasons == "below").all()
    hill = FunctionSurface(lambda x, y: np.where((y - Y0 > 100) & (y - Y0 < 120), np.nan, 0.2 * (y - Y0) - 50))
    slow = oriented_camera(INTERIOR, NoLens(), Pose.from_angles([X0, Y0, 100.0], np.radians([60.0, 0, 0])))
    through: MonoplotPoints = monoplot(slow, [[1000, 560]], hill, (-50, 100), MonoplotErrors(), 2.0)
    assert through.reasons[0] == "" and through.hole[0]


def test_wrong_standard_deviations_are_refused():
    for wrong in ({"image": -1.0}, {"terrain": -0.1}, {"angles": (0.0, math.nan, 0.0)}):
        with pytest.raises(UsageError):
            MonoplotErrors(**wrong)


@pytest.fixture(scope="module")
def brighton_project(block, tmp_path_factory):
    """The drone block of the package."""
    return drone_project(block, tmp_path_factory.mktemp("brighton"))


def test_the_drone_block_gives_one_point_from_two_images(brighton_project, tmp_path):
    """A place of the ground, found in two images, comes out twice within a few standard deviations."""
    project_ = load_project(brighton_project)
    names = [image.name for image in project_.images][9:11]
    scenes = [open_scene(project_, name) for name in names]
    middle = np.mean([s.camera.center[:2] for s in scenes], axis=0)
    XY = middle + np.array([[0, 0], [5, 3], [-6, 4], [3, -8]])
    XYZ = np.column_stack([XY, scenes[0].surface.heights(XY)])
    for scene, name in zip(scenes, names):
        points, out = tmp_path / f"{name}.csv", tmp_path / f"{name}_ground.csv"
        xy = project(scene.camera, XYZ)
        points.write_text("name,x,y\n" + "".join(f"p{i},{x!r},{y!r}\n" for i, (x, y) in enumerate(xy.tolist())))
        report = monoplot_file(MonoplotRequest(brighton_project, name, points, out, sigma_terrain=0.1))
        assert report.met == 4 and 0 < report.median_sigma[0] < 0.2
        with out.open() as file:
            rows = [*csv.DictReader(file)]
        got = np.array([[float(r[k]) for k in "XYZ"] for r in rows])
        visible = np.abs(got - XYZ).max(axis=1) < 2e-3
        assert visible.sum() >= 3, "a tree may hide one of them"
        assert rows[0]["name"] == "p0" and float(rows[0]["sigma_Z"]) > 0


def test_lines_become_lines_in_space(small, tmp_path, capsys):
    lines = tmp_path / "road.geojson"
    shape = shapely.LineString([(20, -30), (100, -80), (500, -90), (150, -40), (60, -60)])
    feature = {"type": "Feature", "properties": {"name": "road"}, "geometry": json.loads(shapely.to_geojson(shape))}
    lines.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    assert run(["init", str(small.folder), *small.init_options(), "--overwrite", "--height-system", "same"]) == 0
    out, vectors = tmp_path / "ground.csv", tmp_path / "ground.gpkg"
    words = ["monoplot", str(small.project), "one", str(lines), "-o", str(out), "--vectors", str(vectors)]
    assert run([*words, "--gis-axes", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out.split("\n}")[-2].rpartition("\n{")[2].join(["{", "}"]))
    assert facts["points"] == 5 and facts["met"] == 4 and facts["median_sigma"] is None
    meta, _, wkb, _ = pyogrio.raw.read(vectors, force_2d=False)
    found = shapely.from_wkb(wkb)
    assert [len(line.coords) for line in found] == [2, 2] and meta["geometry_type"] == "LineString Z"
    assert recorded(out.with_suffix(".run.json"), "monoplot", small.project, lines)["product"]["met"] == 4
    with out.open() as file:
        rows = [*csv.DictReader(file)]
    assert rows[2]["X"] == "" and "outside" in rows[2]["reason"] and rows[0]["sigma_X"] == ""
    np.testing.assert_allclose(found[0].coords[1], [float(rows[1][k]) for k in "XYZ"], atol=1e-4)
    assert float(rows[1]["Z"]) == pytest.approx(float(hills(float(rows[1]["X"]), float(rows[1]["Y"]))), abs=0.3)
    camera_ = open_scene(load_project(small.project), "one").camera
    back = project(camera_, [float(rows[1][k]) for k in "XYZ"])
    assert back == pytest.approx([100 - 0.5, 80 - 0.5], abs=1e-3)


def test_wrong_use(small, tmp_path, capsys):
    points, out = tmp_path / "p.csv", tmp_path / "out.csv"
    points.write_text("x,y\n10,10\n")
    assert run(["init", str(small.folder), *small.init_options(), "--overwrite", "--height-system", "same"]) == 0
    far = tmp_path / "far.csv"
    far.write_text("x,y\n-50,10\n")
    capsys.readouterr()
    assert run(["monoplot", str(small.project), "one", str(far), "-o", str(tmp_path / "far_out.csv")]) == 0
    said = capsys.readouterr()
    assert "0 of 1" in said.out and "1 without: outside the image" in said.out and "camera at" in said.err
    bad = tmp_path / "bad.csv"
    bad.write_text("x,y\n10\n")
    for image, file, target, extra, code, text in [
        ("one", points, points, (), 2, "is the input"),
        ("four", points, out, (), 3, "four"),
        ("one", bad, out, (), 3, "bad.csv:2"),
        ("one", points, out, ("--sigma-image", "-1"), 2, "standard deviations"),
        ("one", points, out, ("--vectors", str(tmp_path / "x.shp")), 2, ".gpkg"),
        ("one", points, small.terrain, ("--overwrite",), 2, "is the input"),
    ]:
        capsys.readouterr()
        assert run(["monoplot", str(small.project), image, str(file), "-o", str(target), *extra]) == code
        assert text in capsys.readouterr().err
        assert not out.exists()
