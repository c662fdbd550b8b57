"""Verbs, streams, figures and plans: what a user and a script see."""

from __future__ import annotations

import json
import re
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.command import COMMAND, OPTIONS, Here, Undisturbed, inside, process
from tools.small_block import CRS, NAMES, SIZE, Block, texture, write_image

from photoplan.cli.table import VERBS
from photoplan.io.project.file import load_project
from photoplan.project.cameras import camera_without_pixels
from photoplan.project.ground import ground_of
from photoplan.surfaces.shifted import intersect


def test_help_answers_at_once() -> None:
    """Under 0.3 s of process time: heavy imports happen inside the verbs."""
    best = np.inf
    for _ in range(5):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = subprocess.run([*COMMAND, "--help"], capture_output=True, text=True, check=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        best = min(best, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
        if best < 0.3:
            break
    assert best < 0.3
    for verb in VERBS:
        assert re.search(rf"^  {verb} ", done.stdout, re.MULTILINE)
    assert "Exit codes: 0 done" in done.stdout
    assert done.stderr == ""


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_explains_itself(photoplan: Here, verb: str) -> None:
    said = photoplan(verb, "--help")
    assert said.code == 0
    assert said.out.startswith(f"Usage: photoplan {verb} ")
    assert said.err == ""


def test_help_loads_nothing_heavy() -> None:
    code = "import sys, photoplan.cli.main; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "photoplan.cli.main" in loaded
    assert not {"numpy", "numba", "rasterio", "pyproj", "rich", "pydantic"} & set(loaded)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["orto"], "No such command 'orto'"),
        (["ortho"], "Missing argument 'PROJECT'"),
        (["ortho", "p.toml", "--memory", "much"], "'much' is no size; write for example 2GB"),
        (["ortho", "p.toml", "--workers", "0"], "0 is not in the range x>=1"),
        (["ortho", "p.toml", "--bounds", "1", "2", "3"], "--bounds"),
    ],
)
def test_wrong_use_ends_with_2(photoplan: Here, words: list[str], message: str) -> None:
    said = photoplan(*words)
    assert (said.code, said.out) == (2, "")
    assert message in said.err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--kernel", "sinc"], "kernel 'sinc' must be one of nearest"),
        (["--compress", "rar"], "compression 'rar' must be one of"),
        (["--resolution", "-1"], "resolution -1.0; a positive number"),
        (["--resolution", "nan"], "resolution nan; a positive number"),
        (["--resolution", "inf"], "resolution inf"),
        (
            ["--tolerance", "1e-7"],
            "--tolerance 1e-07 px must be 0 (every pixel strictly by its camera) or",
        ),
        (["--tile", "64"], "--tile 64 must be a multiple of 16 from 128"),
        (["--tile", "200"], "--tile 200 must be a multiple of 16 from 128"),
        (["--nodata", "black"], "--nodata 'black' must be auto, mask or a number"),
        (["--nodata", "300"], "nodata"),
        (["--images", "four"], "image 'four' is not in the project; its 3 images begin with one, three, two"),
        (["--executor", "magic"], "executor 'magic'; allowed are threads, processes"),
        (["--memory", "100MB"], "at least 464 MiB are needed"),
        (["--bounds", "1", "2", "3", "4"], "no image sees terrain inside the bounds"),
        (["--bounds", "3", "2", "1", "4"], "bounds"),
        (["--resolution", "1e-6"], "one: resolution 1e-06 m gives 3.1"),
    ],
)
def test_values_that_cannot_be_meant(
    photoplan: Here, pristine: Block, tmp_path: Path, options: list[str], message: str
) -> None:
    said = photoplan("ortho", pristine.project, "--output", tmp_path / "out", *options)
    assert said.code in (2, 3)
    assert message in said.err
    assert said.out == ""
    assert not (tmp_path / "out").exists()


def test_json_is_one_object_and_talk_is_on_stderr(undisturbed: Undisturbed) -> None:
    said = undisturbed.said
    facts = json.loads(said.out)
    assert [p["image"] for p in facts["products"]] == sorted(NAMES)
    for product in facts["products"]:
        assert Path(product["path"]) == undisturbed.folder / f"{product['image']}_ortho.tif"
        assert product["seconds"] > 0
        assert product["worst_anchor_residual_px"] <= 0.02
        assert product["failed_tiles"] == []
        with rasterio.open(product["path"]) as file:
            assert product["valid_share"] == pytest.approx((file.dataset_mask() > 0).mean(), abs=1e-6)
    assert "kernel bicubic · tolerance 0.02 px · nodata auto · hidden show · 1 thread" in said.err
    assert "quick look" in said.err
    names = {f"{n}_ortho{end}" for n in NAMES for end in (".tif", ".run.json")} | {"ortho_overview.png"}
    assert {p.name for p in undisturbed.folder.iterdir()} == names


def test_paths_on_stdout_and_nothing_else(photoplan: Here, pristine: Block, tmp_path: Path) -> None:
    said = photoplan("ortho", pristine.project, *OPTIONS, "--output", tmp_path, "--images", "t*", "--quiet")
    assert said.code == 0
    assert said.out.splitlines() == [str(tmp_path / f"{name}_ortho.tif") for name in ("three", "two")]
    assert said.err == ""


def test_a_reader_that_goes_away_is_met_in_silence() -> None:
    """`photoplan … | head -1`."""
    running = subprocess.Popen([*COMMAND, "ortho", "--help"], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert running.stdout is not None and running.stderr is not None
    running.stdout.close()
    assert running.stderr.read() == b""
    assert running.wait() == 1


def test_dry_run_touches_nothing(photoplan: Here, pristine: Block, tmp_path: Path) -> None:
    said = photoplan("ortho", pristine.project, *OPTIONS, "--output", tmp_path / "out", "--dry-run")
    assert said.code == 0
    assert re.search(r"plan: 3 orthophotos, \d+ tiles, \d+ cells, worst anchor residual [\d.e-]+ px", said.out)
    assert list(tmp_path.iterdir()) == []
    said = photoplan("ortho", pristine.project, *OPTIONS, "--output", tmp_path / "out", "--dry-run", "--json")
    facts = json.loads(said.out)
    assert facts["plan"] is None
    assert sum(p["tiles"] for p in facts["products"]) == facts["tiles"]
    assert list(tmp_path.iterdir()) == []


def test_check_prints_a_line_for_each_image(photoplan: Here, pristine: Block) -> None:
    said = photoplan("check", pristine.project)
    assert said.code == 0
    assert len(re.findall(r"^(one|two|three) .* 100%", said.out, re.MULTILINE)) == 3
    assert "sensible resolution 1.5 m · all plausible" in said.out
    facts = json.loads(photoplan("check", pristine.project, "--json", "--images", "two").out)
    assert [i["image"] for i in facts["images"]] == ["two"]
    assert facts["images"][0]["gsd"] == pytest.approx(1.5, rel=0.05)
    assert facts["height_systems"] == {"terrain": "same", "orientation": "same", "working": "same"}


def test_check_tells_how_much_of_an_image_shows_terrain(photoplan: Here, small: Block) -> None:
    """By rays all over it: the model has hills inside of the image, and none along its border or in its middle."""
    with rasterio.open(small.terrain, "r+") as file:
        heights, half = file.read(1), file.height // 2
        island = np.zeros(heights.shape, bool)
        island[half - 12 : half - 3, 20:45] = True
        file.nodata = -9999.0
        file.write(np.where(island, heights, -9999.0).astype(np.float32), 1)
    said = json.loads(photoplan("check", small.project, "--json", "--images", "two").out)
    (found,) = said["images"]
    project = load_project(small.project)
    camera, ground = camera_without_pixels(project, "two"), ground_of(project)
    x, y = np.meshgrid(*(np.linspace(0, side - 1, 60) for side in camera.size))
    range_ = ground.bare.height_range(ground.bounds)
    true = np.isfinite(intersect(camera, np.stack([x, y], -1).reshape(-1, 2), ground.bare, range_)[:, 0]).mean()
    assert 0.1 < true < 0.8 and found["on_terrain"] == pytest.approx(true, abs=0.06)


def test_info_knows_rasters_projects_plans_and_records(
    photoplan: Here, pristine: Block, undisturbed: Undisturbed, tmp_path: Path
) -> None:
    raster = json.loads(photoplan("info", undisturbed.folder / "one_ortho.tif", "--json").out)
    assert raster["bands"].startswith("3 of uint8")
    assert raster["pixel"] == "1 × 1"
    assert CRS in raster["crs"]
    project = photoplan("info", pristine.project).out
    assert all(f"{name}: images/{name}.tif" in project for name in NAMES)
    record = json.loads(photoplan("info", undisturbed.folder / "one_ortho.run.json", "--json").out)
    assert record["settings"]["kernel"] == "bicubic"
    plan = tmp_path / "p.gpkg"
    assert photoplan("ortho", pristine.project, *OPTIONS, "--plan", plan).code == 0
    facts = json.loads(photoplan("info", plan, "--json").out)
    assert facts["tiles"] > 10
    assert "kernel = bicubic" in facts["settings"]
    assert f"{SIZE[0]} × {SIZE[1]} pixels" in photoplan("info", pristine.images[0]).out


def test_run_executes_a_plan_and_nothing_else(photoplan: Here, small: Block, undisturbed: Undisturbed) -> None:
    """`ortho --plan`, a look, `run`: the bytes of `ortho`; a plan whose input has changed since is refused."""
    plan = small.folder / "p.gpkg"
    said = photoplan("ortho", small.project, *OPTIONS, "--plan", plan)
    assert said.code == 0, said.err
    assert said.out.splitlines()[-1] == str(plan)
    assert not (small.folder / "products").exists()
    said = photoplan("run", plan, "--json")
    assert said.code == 0, said.err
    assert [p["image"] for p in json.loads(said.out)["products"]] == sorted(NAMES)
    for name in NAMES:
        assert (small.folder / "products" / f"{name}_ortho.tif").read_bytes() == undisturbed.bytes_of(name)
    write_image(small.images[1], texture(seed=77))
    said = photoplan("run", plan, "--output", small.folder / "other")
    assert (said.code, said.out) == (3, "")
    assert f"{plan}: inputs have changed since the plan was written (two)" in said.err
    assert not (small.folder / "other").exists()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.tif", b"not a raster", "not a raster that is read here"),
        ("a.gpkg", b"SQLite format 3\0 no more", "not a plan of photoplan"),
        ("a.json", b'{"a": 1}', "neither a run record of photoplan"),
        ("a.json", b"{", "not valid JSON"),
        ("deep.json", b"[" * 200_000, "nested far too deep"),
        ("a.toml", b"= 3", "a.toml"),
        ("absent.tif", None, "no such file"),
    ],
)
def test_info_refuses_by_name(photoplan: Here, tmp_path: Path, name: str, content: bytes | None, message: str) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    said = photoplan("info", tmp_path / name)
    assert (said.code, said.out) == (3, "")
    assert str(tmp_path / name) in said.err
    assert message in said.err


def test_init_check_ortho_by_the_installed_steps(small: Block, undisturbed: Undisturbed, tmp_path: Path) -> None:
    """A job as the help tells it, its last step a process: init → check → ortho."""
    small.project.unlink()
    said = inside("init", small.folder, *small.init_options(), "--height-system", "same")
    assert said.code == 0, said.err
    assert said.out.splitlines() == [str(small.project)]
    assert "3 images" in said.err
    said = inside("check", small.project)
    assert said.code == 0, said.err
    said = process("ortho", small.project, *OPTIONS)
    assert said.code == 0, said.err
    for name in NAMES:
        path = small.folder / "products" / f"{name}_ortho.tif"
        assert str(path) in said.out.splitlines()
        assert path.read_bytes() == undisturbed.bytes_of(name)


def test_the_demo_runs_on_the_package_alone(photoplan: Here, tmp_path: Path) -> None:
    said = photoplan("demo", tmp_path / "demo", "--resolution", "1")
    assert said.code == 0, said.err
    assert len(said.out.splitlines()) == 18
    assert (tmp_path / "demo" / "products" / "ortho_overview.png").stat().st_size > 10_000
    assert "$ photoplan ortho" in said.err


def test_fault_08_one_bad_image_does_not_end_a_check(small: Block) -> None:
    """The others are checked; the bad one is listed with its reason, and the command fails."""
    project = load_project(small.project)
    project.resolve(project.image("two").file).write_bytes(b"II*\0 cut off")
    said = inside("check", small.project, "--json")
    found = {image["image"]: image["fault"] for image in json.loads(said.out)["images"]}
    assert said.code == 4
    assert json.loads(said.out)["unusable"]["two"].startswith("cannot be used: ")
    assert len(found) > 1
    assert set(found.values()) == {None}
    assert inside("check", small.project, "--images", "two").code == 3
