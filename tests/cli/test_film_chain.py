"""A scanned film photo becomes an orthophoto by commands alone, and lies where the ground is known to lie.

The scan is rendered (`tools.film_scan`) from a real orthophoto and its terrain: film that shrank unevenly, lies turned
on the scanner, has a lens with a calibration table, grain and vignetting. Nothing of that is told to the commands
except what a user has: the calibration report, the scan, image points measured to a fraction of a pixel, and control
points surveyed to some centimetres. The orthophoto made from the scan is then matched, patch by patch, with the one
that the scan was rendered from.

Figures are root mean squares over all patches of 15 m inside the picture that can be matched (correlation above 0.8),
in each coordinate, in pixels of the scan on the ground (0.26 m). Nothing else is left out: patches at walls and
terraces, where the two pictures differ by what is hidden, count too.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from tools.command import inside
from tools.film_scan import ARM, HALF_LINE, PICTURE, RING, Film, Ground, Scan, read_ground, render
from tools.matching import Matches, match
from tools.pictures import gray

FILM = Film((-1497.3, 338546.8, 341.6))
#: Side of a pixel on the ground below the camera, metres.
GSD = FILM.pitch / FILM.c * (FILM.center[2] - 30.0)
#: Noise of measured image points (pixels) and of surveyed control (metres).
SIGMA_IMAGE, SIGMA_CONTROL = 0.15, 0.03


@dataclass(frozen=True)
class Case:
    """What a user has in his folder, and the truth beside it."""

    folder: Path
    orthophoto: Path
    terrain: Path
    ground: Ground
    scan: Scan

    @property
    def project(self) -> Path:
        return self.folder / "project.toml"


def table(points: dict[str, tuple[float, float]], digits: int = 3) -> str:
    return "{ " + ", ".join(f"{n} = [{x:.{digits}f}, {y:.{digits}f}]" for n, (x, y) in points.items()) + " }"


def camera_text() -> str:
    """The calibration report, and what the marks look like."""
    radii, distortion = FILM.table()
    return (
        f'type = "film"\ncamera_constant_mm = {FILM.c}\nprincipal_point_mm = {list(FILM.principal_point)}\n'
        f"fiducials_mm = {table(FILM.marks)}\n"
        f'marks = {{ type = "ring_cross", diameter = {2 * RING[1]}, width = {RING[1] - RING[0]:.3f}, arm = {ARM}, '
        f"cross_width = {2 * HALF_LINE} }}\n"
        f'lens = {{ type = "radial_table", radii_mm = {radii}, distortion_um = {distortion} }}\n'
    )


@pytest.fixture(scope="module")
def case(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Case:
    data = shared / "data" / "vienna_ortho_dtm"
    files = data / "44_2_op_2023_30cm.tif", data / "44_2_dgm.tif"
    folder = tmp_path_factory.mktemp("film")
    ground = read_ground(*files)
    scan = render(FILM, ground)
    scan.write(folder / "1987_112.tif")
    return Case(folder, *files, ground, scan)


def offsets(case: Case, orthophoto: Path) -> Matches:
    """Of the patches that lie inside the picture with all corners."""
    found = match(gray(orthophoto), gray(case.orthophoto), patch=15, stride=24, search=1.5, filled=0.95)
    inside = np.ones(len(found), bool)
    for dx, dy in ((-8, -8), (-8, 8), (8, -8), (8, 8)):
        X, Y = found.x + dx, found.y + dy
        at = FILM.scan_of_ground(np.stack([X, Y, case.ground.height_at(X, Y)], axis=-1))
        inside &= np.abs(FILM.film_of_scan(at)).max(axis=-1) < PICTURE - 1
    return found.keep(inside)


def rms(found: Matches, name: str) -> tuple[float, float]:
    """Root mean square in X and Y, pixels of the scan; printed with what else is worth knowing."""
    kept = found.keep(found.quality > 0.8)
    assert len(kept) > 0.9 * len(found) > 200
    d = np.stack([kept.dx, kept.dy], axis=1) / GSD
    x, y = np.sqrt(np.mean(d**2, axis=0))
    long = np.hypot(*d.T)
    print(
        f"\n{name}: {len(kept)} of {len(found)} patches, rms {x:.3f} {y:.3f} px, mean {d[:, 0].mean():+.3f} "
        f"{d[:, 1].mean():+.3f} px, median length {np.median(long):.3f}, 95 % below {np.percentile(long, 95):.3f} px"
    )
    return float(x), float(y)


@pytest.mark.slow
def test_the_renderer_goes_both_ways(case: Case) -> None:
    """Pixels to the ground and back, the ground on the terrain, nothing of the terrain above the ray."""
    rng = np.random.default_rng(2)
    at = rng.uniform(250, FILM.size - 250, (3000, 2))
    d = FILM.rays(at)
    XYZ = case.ground.hit(FILM.center, d)
    np.testing.assert_allclose(FILM.scan_of_ground(XYZ), at, atol=1e-8)
    np.testing.assert_allclose(case.ground.height_at(XYZ[:, 0], XYZ[:, 1]), XYZ[:, 2], atol=2e-3)
    for above in np.linspace(0.01, 14.0, 400):
        up = XYZ - above * d
        assert (case.ground.height_at(up[:, 0], up[:, 1]) < up[:, 2] + 0.1).all()


@pytest.mark.slow
def test_orientation_that_is_true_gives_the_true_orthophoto(case: Case, tmp_path: Path) -> None:
    """Rendering and orthophoto share no code, and agree: what is found below is due to the orientation."""
    (tmp_path / "true.toml").write_text(
        f'format = 1\ncrs = "EPSG:31256"\n[terrain]\nfile = "{case.terrain.as_posix()}"\nheight_system = "same"\n'
        f'[orientation]\nheight_system = "same"\n[cameras.RC]\n{camera_text()}size = [{FILM.size}, {FILM.size}]\n'
        f'[[images]]\nname = "true"\nfile = "{(case.folder / "1987_112.tif").as_posix()}"\ncamera = "RC"\n'
        f"center = {list(FILM.center)}\nangles = {list(FILM.opk_deg)}\nfiducials = {table(case.scan.marks)}\n"
    )
    said = inside("ortho", tmp_path / "true.toml", "--resolution", 0.25, "--no-quicklook")
    assert said.code == 0, said.err
    found = rms(offsets(case, Path(said.out.strip())), "true orientation")
    assert max(found) <= 0.06  # measured: 0.033


def measure_points(case: Case, count: int = 12, seed: int = 11) -> tuple[Path, Path]:
    """Tables of image points and control, spread over the picture, with the noise that such measurements have."""
    rng = np.random.default_rng(seed)
    rows = count // 4
    grid = np.array([(c, r) for c in (0.16, 0.39, 0.61, 0.84) for r in np.linspace(0.16, 0.84, rows)])
    at = grid * FILM.size + rng.uniform(-60, 60, grid.shape)
    ground = case.ground.hit(FILM.center, FILM.rays(at))
    at = at + rng.normal(0, SIGMA_IMAGE, at.shape)
    ground = ground + rng.normal(0, SIGMA_CONTROL, ground.shape)
    image_points, control = case.folder / "image_points.csv", case.folder / "control.csv"
    lines = [f"P{k},1987_112,{x:.2f},{y:.2f}" for k, (x, y) in enumerate(at)]
    image_points.write_text("\n".join(["point,image,x,y", *lines]) + "\n")
    lines = [f"P{k},{X:.3f},{Y:.3f},{Z:.3f}" for k, (X, Y, Z) in enumerate(ground)]
    control.write_text("\n".join(["name,x,y,z", *lines]) + "\n")
    return image_points, control


@pytest.mark.slow
def test_from_scan_to_orthophoto_by_commands(case: Case) -> None:
    """Calibration, scan, twelve measured points and the terrain; nobody tells where the camera was or how it looked."""
    camera = case.folder / "camera.toml"
    camera.write_text(f"[cameras.RC]\n{camera_text()}")
    image_points, control = measure_points(case)
    folder, project = case.folder / "block", case.folder / "block" / "project.toml"

    options = ["--camera", camera, "--terrain", case.terrain, "--crs", "EPSG:31256", "--height-system", "same"]
    options += ["--image-points", image_points, "--control", control]
    said = inside("init", folder, "--images", case.folder / "*.tif", *options)
    assert said.code == 0, said.err

    said = inside("fiducials", project, "--json")
    assert said.code == 0, said.err
    (found,) = json.loads(said.out)["images"]
    marks = {m["name"]: (m["x"], m["y"]) for m in found["marks"]}
    off = np.array([np.subtract(marks[name], at) for name, at in case.scan.marks.items()])
    print(f"\nfiducial marks: rms {np.sqrt((off**2).mean()):.4f} px, worst {np.abs(off).max():.4f} px from truth")
    assert np.abs(off).max() <= 0.1

    said = inside("interior", project, "--json")
    assert said.code == 0, said.err
    (interior,) = json.loads(said.out)["images"]
    assert interior["shrinkage_permille"] == pytest.approx(1000 * np.array(FILM.shrinkage), abs=0.02)
    assert interior["rotation_deg"] == pytest.approx(FILM.turn_deg, abs=0.005)
    residuals = {m["name"]: m["residual_um"] for m in interior["marks"]}
    for mark in found["marks"]:  # both verbs state them in one sense
        assert mark["residual_um"] == pytest.approx(residuals[mark["name"]], abs=0.02)

    said = inside("resect", project, "--sigma-image", SIGMA_IMAGE, "--sigma-control", SIGMA_CONTROL, SIGMA_CONTROL)
    assert said.code == 0, said.err
    print(said.out)

    said = inside("check", project)
    assert said.code == 0, said.err
    said = inside("ortho", project, "--resolution", 0.25, "--no-quicklook")
    assert said.code == 0, said.err
    x, y = rms(offsets(case, Path(said.out.strip())), "from scan to orthophoto")
    assert max(x, y) <= 0.3  # measured: 0.10
