"""`photoplan surface`: heights and grey values from rendered images of known truth."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rasterio
from tools.command import Said, inside
from tools.facet_scene import CONTRAST, GROUND, GSD, Scene, write_scene
from tools.sketched import drawn
from tools.small_block import X0, Y0, write_image, write_terrain

from photoplan.errors import InputError
from photoplan.events import SILENT, listening
from photoplan.geometry.grid import MapGrid, Window
from photoplan.io.project.file import load_project
from photoplan.matching.facets.observe import facets_of, look
from photoplan.matching.facets.reconstruct import Scheme
from photoplan.plan.footprint import Tile
from photoplan.products.surface import plan as surface_job
from photoplan.products.surface.plan import (
    SurfaceJob,
    counted,
    finer_levels,
    median,
    over_map,
    pixels_of_places,
    plan_surface,
    scheme_of,
)
from photoplan.products.surface.run import findings
from photoplan.project.scene import ScenesAddress
from photoplan.report import maps as report
from photoplan.requests.surface import SurfaceSettings

CLOUDS = (".las", ".laz", ".ply")
BOUNDS = (X0 - 18, Y0 - 30, X0 + 18, Y0 + 30)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return write_scene(tmp_path_factory.mktemp("facets"), 5, gain=0.3)


def surface(scene: Scene, *words: object) -> Said:
    return inside("surface", scene.path, "--resolution", 1.5, "--bounds", *BOUNDS, "--workers", 1, *words)


@dataclass(frozen=True, eq=False)
class Judged:
    """Heights and what they should be."""

    error: np.ndarray
    """Pixels of parallax."""
    normalised: np.ndarray
    grey_error: np.ndarray
    """Against what pixels of the size of the images' see."""
    grey_normalised: np.ndarray

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.mean(self.error**2)))


def places(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A band and X, Y of its pixels."""
    with rasterio.open(path) as file:
        col, row = np.meshgrid(np.arange(file.width) + 0.5, np.arange(file.height) + 0.5)
        return file.read(1).astype(float), *(file.transform * (col, row))


def judge(scene: Scene, folder: Path) -> Judged:
    heights, X, Y = places(folder / "surface.tif")
    sigma, *_ = places(folder / "surface_sigma.tif")
    known = np.isfinite(heights)
    assert (np.isfinite(sigma) == known).all()
    off = (heights - scene.heights(X, Y))[known]
    grey, X, Y = places(folder / "surface_grey.tif")
    grey_sigma, *_ = places(folder / "surface_grey_sigma.tif")
    seen = np.isfinite(grey)
    assert (np.isfinite(grey_sigma) == seen).all()
    # Pixels are means of two by two rays. The images differ by factors: their mean is what the surface has.
    around = [scene.grey(X + i, Y + j) for i in (-GSD / 4, GSD / 4) for j in (-GSD / 4, GSD / 4)]
    true = np.mean(around, axis=0)[seen]
    line = np.polyfit(true, grey[seen], 1)
    left = grey[seen] - np.polyval(line, true)
    return Judged(off / scene.height_of_a_pixel, off / sigma[known], left / line[0], left / grey_sigma[seen])


@pytest.fixture(scope="module")
def made(scene: Scene) -> Path:
    clouds = [word for kind in CLOUDS for word in ("--points", scene.path.parent / "clouds" / f"points{kind}")]
    report = scene.path.parent / "report.html"
    with drawn():
        said = surface(scene, "--start", GROUND, "--json", "--residuals", *clouds, "--report", report)
    assert said.code == 0, said.err
    files = [Path(file) for file in json.loads(said.out)["other_files"]]
    assert len(files) == 9 and all(file.exists() for file in files) and report.exists()
    return scene.path.parent / "products"


def test_five_images_of_different_brightness(scene: Scene, made: Path) -> None:
    judged = judge(scene, made)
    assert judged.rms < 0.04 and abs(judged.error.mean()) < 0.01
    assert 0.6 < np.sqrt(np.mean(judged.normalised**2)) < 1.4
    assert np.sqrt(np.mean(judged.grey_error**2)) < 0.02 * CONTRAST
    assert 0.8 < np.sqrt(np.mean(judged.grey_normalised**2)) < 1.4
    with rasterio.open(made / "surface_count.tif") as file:
        assert file.read(1).max() == 5
    record = json.loads((made / "surface.run.json").read_text())
    sigma0 = np.array(list(record["product"]["sigma0"].values()))
    # Noise of 0.4 and rounding of 0.29 grey values, and what facets cannot follow.
    assert ((sigma0 > 0.4) & (sigma0 < 0.8)).all()
    assert max(record["product"]["corrections_px"]) < 0.05 and record["product"]["redundancy"] > 1000
    assert (made / "surface.png").exists()


def test_grey_values_are_as_fine_as_the_pixels_where_images_are_enough(scene: Scene) -> None:
    project = load_project(scene.path)

    def scheme(resolution: float, *images: str) -> Scheme:
        return plan_surface(project, SurfaceSettings(resolution, bounds=BOUNDS), images or None).scheme

    def ratio(resolution: float, *images: str) -> int:
        return scheme(resolution, *images).ratio

    # Pixels of 0.5 m: of five images four facets on 1.55 m have three each, of two images one.
    assert ratio(1.5) == ratio(1.45) == 3 and ratio(1.55) == ratio(2.0) == 4
    assert ratio(1.55, "i1", "i2") == 3 and ratio(1.8, "i1", "i2") == 4
    # Where those of few images are hardly finer, or coarser, this is known.
    assert scheme(1.55, "i1", "i2").coarse and scheme(1.45, "i1", "i2").coarse
    assert not scheme(1.55).coarse and not scheme(1.5).coarse and not scheme(1.3, "i1", "i2").coarse


def test_coarser_images_leave_fewer_pixels_for_fine_grey_values(scene: Scene) -> None:
    project, settings = load_project(scene.path), SurfaceSettings(1.55, bounds=BOUNDS)
    plan = plan_surface(project, settings)
    looked, _ = over_map(project, plan.images, force=False, events=SILENT)

    def ratio(*times: float) -> int:
        ones = [replace(one, gsd=time * GSD) for one, time in zip(looked, times)]
        pixels = pixels_of_places(ones, finer_levels(ones, GSD), plan.grid, GSD)
        return scheme_of(settings, ones, plan.grid, None, GSD, pixels)[0].ratio

    # Beyond any two images 3, 1.5 and 2.1 pixels of 0.5 m; four facets on 1.55 m need 1.7 of them.
    assert (ratio(1, 1, 1, 1, 1), ratio(1, 1, 1, 2, 2), ratio(0.5, 0.5, 1, 1, 3)) == (4, 3, 4)


def test_a_tile_tells_its_levels_and_how_much_is_done(scene: Scene) -> None:
    plan = plan_surface(load_project(scene.path), SurfaceSettings(3.0, bounds=BOUNDS, start=str(GROUND), reach=20.0))
    job = SurfaceJob(address=plan.address, grid=plan.grid, scheme=plan.scheme, start=str(GROUND))
    told: list[tuple[float, str]] = []
    with listening(lambda share, what: told.append((share, what))):
        job(Tile(0, Window(0, 0, 4, 4)))
    shares, names = [share for share, _ in told], list(dict.fromkeys(what for _, what in told if what))
    count = plan.scheme.coarsest + 1
    assert count > 2 and names == [f"level {k + 1} of {count}" for k in range(count)]
    assert shares == sorted(shares) and shares[0] == 0 and shares[-1] == 1 and len(set(shares)) > 3 * count


def test_residuals_of_a_surface_that_fits(made: Path) -> None:
    fit, *_ = places(made / "surface_fit.tif")
    assert 0.9 < np.median(fit) < 1.1 and fit.max() < 1.5
    with rasterio.open(made / "surface_residuals.tif") as file:
        assert file.count == 5 and file.descriptions[2] == "standardised residual of i3"
        pictures = file.read()
    with rasterio.open(made / "surface_grey.tif") as file:
        assert pictures.shape[1:] == file.shape
    spread = np.sqrt(np.nanmean(pictures**2, axis=(1, 2)))
    # Grey values take a part of the noise of the pixels, one in five.
    assert ((spread > 0.8) & (spread < 1)).all() and np.abs(np.nanmean(pictures, axis=(1, 2))).max() < 0.02


@pytest.mark.parametrize("kind", CLOUDS)
def test_points_of_a_surface(made: Path, kind: str) -> None:
    path = made.parent / "clouds" / f"points{kind}"
    if kind == ".ply":
        head, _, body = path.read_bytes().partition(b"end_header\n")
        assert b"element vertex 000000001025\n" in head and b"property float sigma" in head
        found = np.frombuffer(body, [("xyz", "<f8", 3), ("sigma", "<f4"), ("grey", "<f4")])
        xyz, sigma, grey = found["xyz"], found["sigma"], found["grey"]
    else:
        laspy = pytest.importorskip("laspy")
        cloud = laspy.read(path)
        assert cloud.header.parse_crs().to_epsg() == 32633
        assert cloud.header.creation_date is None, "equal runs give equal files on every day"
        assert path.read_bytes()[90:94] == bytes(4)
        xyz, sigma, grey = np.asarray(cloud.xyz), np.asarray(cloud.sigma), np.asarray(cloud.intensity)
    heights, X, Y = places(made / "surface.tif")
    sigmas, *_ = places(made / "surface_sigma.tif")
    fine, *_ = places(made / "surface_grey.tif")
    means = fine.reshape(len(heights), 3, -1, 3).mean(axis=(1, 3))
    for values, there, within in ((xyz[:, 0], X, 1e-3), (xyz[:, 1], Y, 1e-3), (xyz[:, 2], heights, 1e-3),
                                  (sigma, sigmas, 1e-6), (grey, means, 0.51)):  # fmt: skip
        assert values == pytest.approx(there.ravel(), abs=within)


def test_the_report_of_a_surface(made: Path) -> None:
    text = (made.parent / "report.html").read_text()
    assert text.count("<img") == 4 and "100.0%" in text and "<td>i5</td>" in text


def test_a_surface_serves_as_terrain(scene: Scene, made: Path) -> None:
    text = scene.path.read_text().replace(f"height = {GROUND}", 'file = "products/surface.tif"')
    project = scene.path.with_name("again.toml")
    project.write_text(text)
    said = inside("ortho", project, "--images", "i3", "--resolution", 0.5, "--output", made / "ortho", "--no-quicklook")
    assert said.code == 0, said.err


@pytest.mark.slow
def test_grey_values_are_those_of_places_with_heights(scene: Scene, tmp_path: Path) -> None:
    """What one image alone sees would be there in some tiles and not in others."""
    words = ("--images", "i1,i2", "--start", GROUND, "--no-quicklook", "-q", "--output", tmp_path)
    said = inside("surface", scene.path, "--resolution", 3, *words)
    assert said.code == 0, said.err
    count, *_ = places(tmp_path / "surface_count.tif")
    grey, *_ = places(tmp_path / "surface_grey.tif")
    ratio = grey.shape[0] // count.shape[0]
    two = np.repeat(np.repeat(count > 1, ratio, axis=0), ratio, axis=1)
    assert (count == 1).sum() > 10 and (np.isfinite(grey) == two).all()


@pytest.mark.slow
def test_two_images_and_a_wrong_start(tmp_path: Path) -> None:
    """The start is 20 m below the ground, a tenth of the flying height: eight pixels of parallax."""
    scene = write_scene(tmp_path, 2, seed=7)
    said = surface(scene, "--start", GROUND - 20, "--no-quicklook", "-q")
    assert said.code == 0, said.err
    judged = judge(scene, tmp_path / "products")
    assert judged.rms < 0.04 and abs(judged.error.mean()) < 0.015
    assert 0.6 < np.sqrt(np.mean(judged.normalised**2)) < 1.6


def test_heights_that_are_searched(scene: Scene, tmp_path: Path) -> None:
    """The start is 15 m above the ground; facets begin on the finest level where the search left them."""
    words = ["--start", GROUND + 15, "--reach", 20, "--search", "--output", tmp_path, "--no-quicklook"]
    said = surface(scene, *words)
    assert said.code == 0, said.err
    assert "  1 level, the coarsest with heights of 1.5 m" in said.err and "heights searched within 20 m (" in said.err
    judged = judge(scene, tmp_path)
    print(judged.rms, judged.error.mean(), np.sqrt(np.mean(judged.normalised**2)))
    assert judged.rms < 0.02 and abs(judged.error.mean()) < 0.005
    assert 0.6 < np.sqrt(np.mean(judged.normalised**2)) < 1.6


def test_a_plan_is_told_and_nothing_is_written(scene: Scene, tmp_path: Path) -> None:
    said = surface(scene, "--dry-run", "--output", tmp_path / "new")
    assert said.code == 0 and "surface of 5 images: 25 × 41 heights of 1.5 m" in said.out
    assert not (tmp_path / "new").exists()
    plan = json.loads(surface(scene, "--dry-run", "--json").out)
    assert plan["levels"] >= 2 and plan["grey_resolution"] == pytest.approx(0.5)


def test_what_cannot_be_is_refused_by_name(scene: Scene, made: Path) -> None:
    for words, code, text in (
        ([], 2, "exists already"),
        (["--images", "i1"], 2, "two images at least"),
        (["--start", "nowhere.tif"], 2, "is no height and no file"),
        (["--reach", -1], 2, "positive number"),
        (["--reach", 9000], 2, "height above the ground"),
        (["--name", "../x"], 2, "without folder"),
        (["--name", "x\ny"], 2, "without folder"),
        (["--name", "x" * 300], 2, "without folder"),
        (["--start", "1e300"], 2, "start: Z = 1e+300 m"),
        (["--memory", "300MB"], 2, "needed for one tile"),
        (["--points", "a.xyz"], 2, ".las, .laz, .ply"),
        (["--points", "a.ply", "--points", "./a.ply", "--overwrite"], 2, "one file twice"),
        (["--report", "a.docx"], 2, "ends in .html"),
    ):
        said = surface(scene, *words)
        assert said.code == code and text in said.err, said.err
    far = ["--resolution", 1.5, "--bounds", X0 + 900, Y0, X0 + 950, Y0 + 50]
    said = inside("surface", scene.path, *far)
    assert said.code == 3 and "together they see" in said.err
    said = inside("surface", scene.path, "--resolution", 0.2)
    assert said.code == 2 and "finer than the images" in said.err


def test_the_file_of_a_start_is_an_input_like_all_others(scene: Scene, tmp_path: Path) -> None:
    """No output replaces it, the record names it, and a tile that finds another one there is not made."""
    start = write_terrain(tmp_path / "surface.tif", np.full((40, 40), GROUND))
    said = surface(scene, "--start", start, "--output", tmp_path, "--overwrite")
    assert said.code == 2 and "the output is an input" in said.err
    plan = plan_surface(load_project(scene.path), SurfaceSettings(1.5, bounds=BOUNDS, start=str(start)))
    assert plan.inputs == (*plan.address.digests, plan.begun) and plan.begun is not None
    job = SurfaceJob(address=plan.address, grid=plan.grid, scheme=plan.scheme, start=str(start), begun=plan.begun)
    write_terrain(start, np.full((40, 40), GROUND + 5.0))
    with pytest.raises(InputError, match="has changed since the run was planned"):
        job(Tile(0, Window(0, 0, 4, 4)))


def test_memory_of_a_tile_counts_its_pictures_and_the_images_that_see_the_place_that_most_see(scene: Scene) -> None:
    """Bounds five times as long as what is seen hold the same places; of ratios below 3 a part is a tile."""
    x0, y0, x1, y1 = BOUNDS
    plan = plan_surface(load_project(scene.path), SurfaceSettings(1.5, bounds=(x0 - 80, y0, x1 + 80, y1)))
    assert sum(plan.parts.values()) < 2.5 and plan.most == pytest.approx(5, rel=0.02)
    grid = MapGrid(0.0, 0.0, 1.0, 1000, 1000, None)
    job = SurfaceJob(address=plan.address, grid=grid, scheme=plan.scheme, start="0", seen=plan.most)
    picture = 4 * (336 * plan.scheme.ratio) ** 2
    assert replace(job, residuals=True).bytes - job.bytes == 2 * 5 * picture
    assert replace(job, scheme=replace(plan.scheme, ratio=1)).part == 336 == job.part


def test_an_image_of_far_smaller_pixels_takes_part_with_some_like_those_of_the_others(
    scene: Scene, tmp_path: Path
) -> None:
    """Eight times finer, it would take 64 times the memory and time of each of the others, not four times."""
    folder = Path(shutil.copytree(scene.path.parent / "rendered", tmp_path / "rendered")).parent
    camera = '[cameras.f]\ntype = "frame"\nsize = [1280, 1120]\nfocal_px = 3200.0\n\n'
    text, last = scene.path.read_text().replace("[[images]]", camera + "[[images]]", 1).rsplit("[[images]]", 1)
    project = folder / "project.toml"
    project.write_text(text + "[[images]]" + last.replace('"c"', '"f"'))
    write_image(folder / "rendered" / "i5.tif", np.full((1, 1120, 1280), 99, np.uint8))
    plan = plan_surface(load_project(project), SurfaceSettings(1.5, bounds=BOUNDS, start=str(GROUND)))
    assert plan.finer == (0, 0, 0, 0, 2) and "1 image with far smaller pixels reduced" in str(plan)
    views = surface_job._views(plan.address, plan.finer, None, BOUNDS, ())
    facets = facets_of(plan.grid, plan.grid.window, 0, plan.scheme.ratio)
    one, other = (look(view, 0, facets, (GROUND - 1, GROUND + 1)) for view in views[::4])
    assert one is not None and other is not None and 3 < other.raw.size / one.raw.size < 5 and 7 < plan.most < 9


def test_images_are_kept_for_the_next_tile_however_many_they_are(scene: Scene) -> None:
    (one, *_) = plan_surface(load_project(scene.path), SurfaceSettings(1.5, bounds=BOUNDS)).address.scenes
    address = ScenesAddress(tuple(replace(one, text=one.text + " " * k) for k in range(260)))
    first, again = (surface_job._views(address, (), None, BOUNDS, ()) for _ in range(2))
    assert len(first) == 260 and all(a.pyramid is b.pyramid for a, b in zip(first, again))


def test_the_median_of_tiles_is_counted_in_classes() -> None:
    rng = np.random.default_rng(2)
    sigmas = np.exp(rng.normal(-4, 1, (3, 5000)))
    sigmas[2, ::3] = 9.0  # a few that doubt do not speak for all
    sigmas[0, :7] = np.nan
    counts = np.sum([counted(part) for part in sigmas], axis=0).tolist()
    assert median(counts) == pytest.approx(np.nanmedian(sigmas), rel=0.02)
    assert median(counted(np.full((2, 2), np.nan))) is None


def planned(base: int = 0, search: object = None, name: str = "surface", gap_text: str = "") -> Any:
    """Of a plan what its findings look at."""
    scheme = SimpleNamespace(base=base, search=search, reach=20.0)
    settings, parts = SimpleNamespace(name=name), {"beside": 0.0}
    return SimpleNamespace(scheme=scheme, settings=settings, height_error=0.1, gap_text=gap_text, parts=parts)


def test_pixels_of_reduced_images_are_those_that_count() -> None:
    told = []
    for base in (0, 3):
        plan = planned(base)
        told.append(findings(plan, {"a": 5.0}, 8.0, 2.0, 0.0, 0.5, 0.0))
    assert (
        len(told[0]) == 3 and "not settled; a coarser `resolution`" in told[0][1] and "hardly any texture" in told[0][2]
    )
    assert "not settled; a finer `resolution`" in findings(plan, {"a": 0.1}, 8.0, 0.05, 0.0, 5.0, 0.0)[0]
    vague = [findings(plan, {"a": 1.0}, 80.0, 11.0, part, 0.01, 0.0) for part in (0.1, 0.4)]
    assert ["hardly any texture" in "".join(lines) for lines in vague] == [True, False]
    assert len(told[1]) == 1 and "the relief is finer than" in told[1][0] and "finer than" not in told[0][0]


def test_an_image_that_sees_nothing_but_margins_is_not_named() -> None:
    sigma0: dict[str, float | None] = {"a": 1.0, "b": 1.1, "c": 0.9}
    for name, told in (("beside", False), ("inside", True)):
        lines = "".join(findings(planned(), {**sigma0, name: 5.0}, 80.0, 0.1, 0.0, 0.01, 0.0))
        assert (f"sigma0 of {name} 5 (1)" in lines) == told


def test_that_there_is_no_height_is_told() -> None:
    told = findings(planned(), {"a": None, "b": None}, 0.0, None, 0.0, 0.0, 0.0)
    assert len(told) == 1 and told[0].startswith("there is no height: within `reach`")


def test_heights_that_fit_badly_are_told_with_what_helps() -> None:
    told = []
    for search in (None, object()):
        told += findings(planned(search=search, name="s"), {"a": 1.0}, 80.0, 0.1, 0.03, 0.01, 0.0)
    assert all("3.0% of the heights fit badly: see s_fit.tif" in line and "s_sigma.tif" in line for line in told)
    assert len(told) == 2 and "`search`" in told[0] and "`search`" not in told[1] and "`target`" in told[1]
    assert "a larger `reach` where things stand more than 20 m above or below the start" in told[1]


def test_heights_that_know_hardly_more_than_the_reach_are_told() -> None:
    """Standard deviations of 50 px where the reach is 200 px, or of 5 px: these follow their surroundings."""
    cases = ((50, 0.0), (50, 0.3), (5, 0.1))
    told = ["".join(findings(planned(), {"a": 1.0}, 80.0, s, misfit, 0.01, 0.0)) for s, misfit in cases]
    assert ["25% of the reach: images agree on no height" in lines for lines in told] == [True, True, False]
    assert ["follows its surroundings" in lines for lines in told] == [False, False, True]
    assert findings(planned(gap_text="it lies apart"), {"a": 1.0}, 80.0, 0.1, 0.0, 0.01, 0.0) == ("it lies apart",)


def test_labels_of_a_report_keep_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Any] = []
    monkeypatch.setattr(report, "png", drawn.append)
    one_level: Any = SimpleNamespace(sigma0={"a": 2.0}, corrections=(0.2,))
    report._draw_adjustment(one_level)
    axes = drawn[0].axes[1]
    assert axes.get_xticks().tolist() == [0]
    assert {f"{tick:.0e}"[0] for tick in axes.get_yticks(minor=True)} == {"2", "5"}


def test_a_report_leaves_room_for_the_name_of_long_coordinates() -> None:
    with drawn():
        picture = report._draw_fit(np.ones((60, 80)), (576704.0, 5188144.0, 576720.0, 5188156.0), ("X", "Y"))
    with rasterio.MemoryFile(picture) as memory, memory.open() as file:
        assert file.read(1)[:, :3].min() > 200


def test_a_report_draws_the_residuals_of_images_that_fit_worst(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Of fourteen images one sees nothing, and the one that fits best is not drawn, which is told."""
    bands = np.ones((14, 4, 5), np.float32)
    bands[3] = np.nan
    path = tmp_path / "residuals.tif"
    with rasterio.open(
        path, "w", driver="GTiff", width=5, height=4, count=14, dtype="float32",
        transform=rasterio.Affine(1, 0, 0, 0, -1, 4),
    ) as file:  # fmt: skip
        file.write(bands)
    drawn: list[str] = []
    monkeypatch.setattr(report, "_draw_residuals", lambda pictures, shape: drawn.extend(pictures) or b"")
    names = tuple("abcdefghijklmn")
    plan: Any = SimpleNamespace(images=names)
    result: Any = SimpleNamespace(sigma0={**dict.fromkeys(names, 2.0), "d": 90.0, "k": 1.0})
    (picture,) = report._residuals(plan, result, path)
    assert drawn == [*"abcefghijlmn"] and "Those of 1 more images" in picture
