"""Faults and bad inputs of `photoplan surface`: refused by name, or told with the command that mends it."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from cli import test_place_faults
from scipy.ndimage import gaussian_filter
from tools.command import Here, Said, inside, patience, sabotage, start, wait_for
from tools.effort import at_most
from tools.facet_scene import write_scene
from tools.line_strip import Strip
from tools.small_block import CRS, X0, Y0, Block, write_image

BOUNDS = (X0 - 15, Y0 - 27, X0 + 15, Y0 + 27)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scene"), 3).path


@pytest.fixture
def project(rendered: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(rendered.parent, tmp_path / "scene")) / rendered.name


def surface(project: Path, *words: object) -> Said:
    return inside("surface", project, *options(), *words)


def options() -> list[object]:
    return ["--resolution", 1.5, "--bounds", *BOUNDS, "--workers", 1, "--no-quicklook"]


def change(image: Path, how: Callable[[np.ndarray], np.ndarray]) -> None:
    """Replace the pixels of an image."""
    with rasterio.open(image) as file:
        pixels, profile = file.read(), file.profile
    with rasterio.open(image, "w", **profile) as file:
        file.write(how(pixels).astype(np.uint8))


def notes(said: Said) -> str:
    assert said.code == 0, said.err
    return " ".join(json.loads(said.out)["notes"])


@pytest.mark.slow
def test_an_orientation_that_is_wrong_by_five_pixels_is_named(project: Path) -> None:
    """Across the flight, where no height makes up for it; along it the image contradicts the two others."""
    change(project.parent / "rendered" / "i3.tif", lambda pixels: np.roll(pixels, 5, axis=1))
    told = notes(surface(project, "--json"))
    assert "sigma0 of" in told and "i3" in told
    assert "`photoplan tie` and `photoplan adjust`" in told


def test_images_without_texture_are_told(project: Path) -> None:
    noise = np.random.default_rng(2)
    for image in sorted((project.parent / "rendered").glob("*.tif")):
        change(image, lambda pixels: 120 + noise.normal(0, 1.0, pixels.shape))
    said = surface(project, "--json")
    assert "no texture" in notes(said)
    # Hills of a metre cannot be known: only that the start is wrong by no more than a tenth of the flying height.
    with rasterio.open(project.parent / "products" / "surface_sigma.tif") as file:
        assert np.median(file.read(1)) > 5


def test_images_of_one_grey_value_tell_no_heights(project: Path) -> None:
    """What single precision rounds of it is no texture."""
    for image in sorted((project.parent / "rendered").glob("*.tif")):
        change(image, lambda pixels: np.full_like(pixels, 128))
    assert "hardly any texture" in notes(surface(project, "--json"))
    with rasterio.open(project.parent / "products" / "surface_sigma.tif") as file:
        assert file.read(1).min() > 5


@pytest.mark.parametrize("kind", ["smooth", "noise", "moved"])
def test_fault_33_images_of_unrelated_content_are_refused_unless_forced(project: Path, kind: str) -> None:
    for number, image in enumerate(sorted((project.parent / "rendered").glob("*.tif"))):
        rng = np.random.default_rng(number)

        def unrelated(pixels: np.ndarray, rng: np.random.Generator = rng, number: int = number) -> np.ndarray:
            if kind == "moved":
                return np.roll(pixels, (9 * number**2, 7 * number), (1, 2))
            found = gaussian_filter(rng.normal(0, 1, pixels.shape), (0, 1.5, 1.5) if kind == "smooth" else 0)
            return np.clip(120 + 25 * found / found.std(), 1, 255)

        change(image, unrelated)
    said = surface(project, "--resolution", 3)
    assert said.code == 3 and "the images contradict it" in said.err and "--force writes it" in said.err, said.err
    assert not list((project.parent / "products").glob("surface*"))
    if kind == "moved":
        assert surface(project, "--resolution", 3, "--force").code == 0


def test_heights_that_texture_does_not_tell_have_a_large_sigma(tmp_path: Path) -> None:
    """A bare strip of twenty metres: what stands there follows its surroundings, and its sigma says how well."""
    scene = write_scene(tmp_path, 3, bare=10.0)
    assert surface(scene.path).code == 0
    with rasterio.open(tmp_path / "products" / "surface.tif") as file:
        heights, to_map = file.read(1), file.transform
    with rasterio.open(tmp_path / "products" / "surface_sigma.tif") as file:
        sigma = file.read(1)
    col, row = np.meshgrid(np.arange(heights.shape[1]) + 0.5, np.arange(heights.shape[0]) + 0.5)
    X, Y = to_map @ (col, row)
    off = heights - scene.heights(X, Y)
    bare, textured = np.abs(Y - Y0) < 7, np.abs(Y - Y0) > 16
    assert np.median(sigma[bare]) > 3 * np.median(sigma[textured])
    assert np.sqrt(np.mean((off / sigma)[bare] ** 2)) < 3 and np.sqrt(np.mean((off / sigma)[textured] ** 2)) < 1.5


def test_a_start_that_is_farther_away_than_stated(project: Path) -> None:
    """Nothing is made up at the end of the reach: there is no height, and what helps is told."""
    said = surface(project, "--start", 80, "--reach", 5, "--json")
    assert "larger one if the start is that wrong" in notes(said)
    assert json.loads(said.out)["valid_share"] < 0.8


def test_a_start_above_the_images_is_refused_and_one_far_from_the_terrain_told(project: Path, tmp_path: Path) -> None:
    """As a height and as a file: 100 m of ground, images at 300 m."""
    for height, code in ((320, 2), (170, 0), (30, 0)):
        file = tmp_path / f"{height}.tif"
        with rasterio.open(
            file, "w", driver="GTiff", width=4, height=4, count=1, dtype="float32", crs=CRS,
            transform=rasterio.Affine(200.0, 0, X0 - 400, 0, -200.0, Y0 + 400),
        ) as out:  # fmt: skip
            out.write(np.full((1, 4, 4), height, np.float32))
        for begun in (height, file):
            said = surface(project, "--start", begun, "--dry-run")
            assert said.code == code, said.err
            if code:
                assert f"start {begun}: 320 m is above the images, which look down from 300 m (i" in said.err
            else:
                side = "70 m above" if height == 170 else "70 m below"
                assert f"(--start) lies {side} the project's terrain: farther than the reach of 20 m" in said.out
    assert "cannot be right" not in surface(project, "--start", 110, "--dry-run").out
    assert "cannot be right" not in surface(project, "--start", 170, "--reach", 80, "--dry-run").out


def test_a_start_is_compared_with_the_terrain_inside_the_bounds(project: Path, tmp_path: Path) -> None:
    """Outside of them the terrain falls to 40 m: a start of 45 m is in its range, yet 40 to 60 m below what is here."""
    y, x = np.mgrid[300:-301:-5, -300:301:5].astype(float)
    dem = np.where(np.hypot(x, y) > 60, 40.0, 100 + x / 4)
    with rasterio.open(
        tmp_path / "dem.tif", "w", driver="GTiff", width=dem.shape[1], height=dem.shape[0], count=1, dtype="float32",
        crs=CRS, transform=rasterio.Affine(5.0, 0, X0 - 302.5, 0, -5.0, Y0 + 302.5),
    ) as out:  # fmt: skip
        out.write(dem.astype(np.float32), 1)
    project.write_text(project.read_text().replace("height = 100.0", f'file = "{tmp_path / "dem.tif"}"'))
    said = surface(project, "--start", 45, "--dry-run")
    assert said.code == 0 and "(--start) lies 55.1 m below the project's terrain: farther than the reach" in said.out
    assert "cannot be right" not in surface(project, "--start", 90, "--dry-run").out
    # A file that is right in one half alone.
    dem += np.where(x > 0, 50.0, 0.0)
    with rasterio.open(tmp_path / "dem.tif") as file:
        profile = file.profile
    with rasterio.open(tmp_path / "half.tif", "w", **profile) as out:
        out.write(dem.astype(np.float32), 1)
    said = surface(project, "--start", tmp_path / "half.tif", "--dry-run", "--json")
    assert 0.4 < json.loads(said.out)["start_gap_share"] < 0.6
    assert "% of the places inside the bounds" in surface(project, "--start", tmp_path / "half.tif", "--dry-run").out


def test_images_without_overlap_are_told(project: Path) -> None:
    said = surface(project, "--bounds", X0 + 4000, Y0, X0 + 4010, Y0 + 10)
    assert said.code == 3 and "no two images see anything there; together they see" in said.err


def test_bounds_that_reach_far_beyond_the_images_are_told(project: Path) -> None:
    """Three images see a square of some 80 m; nothing is said of bounds inside. One of them may see none."""
    far = X0 - 500, Y0 - 500, X0 + 500, Y0 + 500
    said = surface(project, "--bounds", *far, "--dry-run")
    assert said.code == 0 and re.search(r"two images see 0\.[67]\d% of these bounds at most", said.out), said.out
    assert "of these bounds" not in surface(project, "--dry-run").out
    said = surface(project, "--bounds", X0 - 38, Y0 - 10, X0 - 26, Y0 + 10, "--dry-run")
    assert said.out.startswith("surface of 3 images, 2 of which see more than 1% of it: "), said.out


def test_fault_02_undeclared_height_systems(project: Path) -> None:
    project.write_text(project.read_text().replace('height_system = "same"', ""))
    said = surface(project)
    assert said.code == 3 and "declare one" in said.err


def test_fault_07_a_bomb_is_refused_from_its_header(project: Path) -> None:
    surface(project, "--dry-run")  # what is loaded once does not count
    bomb = project.parent / "rendered" / "i1.tif"
    profile = {"driver": "GTiff", "width": 400_000, "height": 400_000, "count": 3, "dtype": "uint8", "SPARSE_OK": True}
    with rasterio.open(bomb, "w", tiled=True, blockxsize=4096, blockysize=4096, bigtiff="YES", **profile):
        pass
    with at_most(1):
        said = surface(project, "--images", "i1,i2")
    assert said.code == 3 and f"{bomb}: the header promises 400000 × 400000 pixels" in said.err


def test_bands_that_are_none(project: Path) -> None:
    for words, code, text in (
        (["--bands", "2"], 2, "bands 2: image 'i1' has 1"),
        (["--bands", "0"], 2, "numbers from 1 on"),
        (["--bands", "1,1"], 2, "each once"),
        (["--bands", "red"], 2, "bands red: numbers from 1 on are needed"),
    ):
        said = surface(project, *words, "--dry-run")
        assert said.code == code and text in said.err, said.err


def test_fault_18_records_of_strips_as_spreadsheets_leave_them(tmp_path: Path) -> None:
    """A BOM and CRLF are read as what they are; a cell that is no number, ragged rows, a header alone: by line."""
    strip = Strip(lines=120, columns=200, waves=0.0)
    text = f'format = 1\ncrs = "{strip.crs}"\n[terrain]\nheight = 200.0\nheight_system = "ellipsoidal"\n'
    for name, ahead in (("forward", 46.6), ("nadir", 0.0)):
        (tmp_path / name).mkdir()
        back = (strip.origin[0] - 28.0 * ahead, strip.origin[1])
        replace(strip, origin=back).strip_file(tmp_path / name)
        text += f'[[images]]\nname = "{name}"\nfile = "{name}.tif"\nline = "{name}/strip.toml"\ndetectors = "{name}"\n'
        write_image(tmp_path / f"{name}.tif", np.full((1, 120, 200), 9, np.uint8))
    project, table = tmp_path / "project.toml", tmp_path / "forward" / "flight.csv"
    project.write_text(text)
    plain = table.read_text()
    rows = plain.splitlines()
    words = ("surface", project, "--resolution", 1.0, "--dry-run", "--json")
    said = inside(*words)
    assert said.code == 0, said.err
    table.write_bytes(b"\xef\xbb\xbf" + plain.replace("\n", "\r\n").encode())
    again = inside(*words)
    plans = [json.loads(one.out) for one in (said, again)]
    assert plans[0].pop("key") != plans[1].pop("key") and plans[0] == plans[1]
    no_number = ",".join([rows[5].split(",")[0], "nan", *rows[5].split(",")[2:]])
    for changed, told in (
        ([*rows[:5], no_number, *rows[6:]], "row 5"),
        ([*rows[:5], "1,2", *rows[6:]], "columns changed from 7 to 2 at row 5)"),
        (rows[:1], "flight.csv"),
    ):
        table.write_text("\n".join(changed) + "\n")
        said = inside(*words)
        assert said.code == 3 and told in said.err, said.err


@pytest.mark.slow
def test_fault_14_gon_declared_as_degrees(photoplan: Here, small: Block) -> None:
    """Refused before any pixel is touched, with the unit that fits."""
    test_place_faults.TestFaults14And18Tables.strip(small, [0, 90, 180, 270, 90, 0, 270, 180], 400 / 360)
    declare = ["--height-system", "same", "--overwrite"]
    assert photoplan("init", small.folder, *small.init_options(), *declare).code == 0
    said = photoplan("surface", small.project, "--resolution", 3)
    assert said.code == 3 and "--angle-unit gon" in said.err


@pytest.mark.parametrize(
    ("words", "code", "text"),
    [
        (["--resolution", "1e300"], 2, "resolution"),
        (["--resolution", "nan"], 2, "resolution"),
        (["--resolution", "-1"], 2, "resolution"),
        (["--start", "1e300"], 2, "start"),
        (["--start", "nan"], 2, "start"),
        (["--reach", "1e300"], 2, "reach"),
        (["--bounds", 0, 0, 1e300, 1e300], 2, "bounds"),
    ],
)
def test_fault_30_finite_nonsense(project: Path, words: list[object], code: int, text: str) -> None:
    said = surface(project, *words, "--dry-run")
    assert (said.code, said.out) == (code, ""), said.err
    assert text in said.err


@pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")
@pytest.mark.parametrize(
    "number",
    [signal.SIGKILL, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)],
    ids=["fault_03_killed", "fault_25_ended"],
)
def test_a_run_that_is_ended_goes_on(project: Path, number: signal.Signals) -> None:
    """Two tiles: of the first one images see nothing, the second one is held up."""
    bounds = (X0 - 570, Y0 - 6, X0 + 4, Y0 + 6)
    words = ["surface", project, "--resolution", 1.5, "--bounds", *bounds, "--workers", 1]
    products, begun = project.parent / "products", project.parent / "begun"
    begun.mkdir()
    job = "photoplan.products.surface.plan:SurfaceJob"
    running = start(*words, "--no-quicklook", env=sabotage(job=job, hold=begun / "go", quick=1, begun=begun))
    wait_for(lambda: any(begun.iterdir()), running)
    os.kill(running.pid, number)
    _, err = running.communicate(timeout=patience(20))
    assert not (products / "surface.tif").exists()
    if number == signal.SIGTERM:
        assert running.returncode == 130 and "same command continues" in err.splitlines()[-1]
    said = inside(*words, "--no-quicklook", "--json")
    assert said.code == 0, said.err
    assert json.loads(said.out)["resumed_tiles"] == 1
    assert not [path for path in products.iterdir() if path.name.startswith(".")]
