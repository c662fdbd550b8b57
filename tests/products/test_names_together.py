"""Products of several files: they get their names together, and a run that died among the names goes on."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tools.adjust_project import Make, write_project
from tools.dem_file import write_dem
from tools.facet_scene import GROUND, write_scene
from tools.forked import QUIET, Mishap, Ran, content, forked
from tools.small_block import CRS, X0, Y0, texture, write_block, write_image
from tools.town import write_town

pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs fork and signals")

Words = Callable[[Path], list[object]]
"""Words of a command that works in a folder, which holds its inputs and gets its outputs."""


def ortho(at: Path) -> list[object]:
    words = ["--images", "one", "--resolution", 2, "--tile", 128, "--hidden", "mark"]
    return ["ortho", at / "block" / "project.toml", *words, "--workers", 1]


def restore(at: Path) -> list[object]:
    return ["restore", at / "scan.tif", "--filter", at / "weights.csv", "--workers", 1]


def flow(at: Path) -> list[object]:
    words = ["--catchments", at / "catchments.gpkg", "-o", at / "flow.tif", "--workers", 1]
    return ["dtm", "flow", at / "dem.tif", *words]


def volume(at: Path) -> list[object]:
    words = ["--height-system", "same", "--difference", at / "difference.tif", "--workers", 1]
    return ["dtm", "volume", at / "dem.tif", at / "dem.tif", *words]


def shade(at: Path) -> list[object]:
    words = ["--preview", at / "preview.png", "-o", at / "shade.tif", "--workers", 1]
    return ["dtm", "shade", at / "dem.tif", *words]


def contours(at: Path) -> list[object]:
    words = ["--interval", 1, "--labels", "--preview", at / "preview.png", "-o", at / "lines.shp"]
    return ["dtm", "contours", at / "dem.tif", *words]


def adjust(at: Path) -> list[object]:
    return ["adjust", at / "made" / "project.toml"]


def seams(at: Path) -> list[object]:
    return ["seams", at / "block" / "project.toml", "--resolution", 4, "-o", at / "seams.gpkg", "--workers", 1]


def surface(at: Path) -> list[object]:
    bounds = ["--bounds", X0 - 18, Y0 - 30, X0 + 18, Y0 + 30, "--resolution", 3]
    report = ["--report", at / "report.html", "--points", at / "points.ply"]
    return ["surface", at / "project.toml", *bounds, "--start", GROUND, *report, "--workers", 1]


CASES: dict[str, Words] = {
    each.__name__: each for each in (ortho, restore, flow, volume, shade, contours, adjust, seams, surface)
}


_FAST = ("flow", "contours")


def inputs(case: Words, folder: Path) -> Path:
    folder.mkdir()
    if case in (ortho, seams):
        write_block(folder / "block")
    elif case is surface:
        write_scene(folder, 3)
    elif case is adjust:
        write_project(folder / "made", Make(pixel_noise=0.3))
    elif case is restore:
        write_image(folder / "scan.tif", np.ascontiguousarray(texture(bands=1)[:, :300, :300]), tiled=True)
        (folder / "weights.csv").write_text("0,-0.8,0\n-0.8,4.2,-0.8\n0,-0.8,0\n")
    else:
        write_dem(folder / "dem.tif", lambda x, y: 200 + 5 * np.abs(y - 20) + 0.1 * x, (60, 41))
    return folder


def files(folder: Path) -> dict[str, Path]:
    return {str(path.relative_to(folder)): path for path in folder.rglob("*") if path.is_file()}


def run(case: Words, folder: Path, said: Path, mishap: Mishap = QUIET, *more: object) -> Ran:
    return forked([*case(folder), *more], said, mishap)


@pytest.fixture(
    scope="module", params=[pytest.param(name, marks=[] if name in _FAST else pytest.mark.slow) for name in CASES]
)
def quiet(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Words, Path, set[str]]:
    """A case, its folder after a run that nothing happened to, and what that run made."""
    top, case = tmp_path_factory.mktemp(request.param), CASES[request.param]
    folder = inputs(case, top / "quiet")
    before = set(files(folder))
    said = run(case, folder, top / "said")
    assert said.code == 0, said.err
    return case, folder, set(files(folder)) - before


@pytest.mark.parametrize("end", ["first", pytest.param("last but one", marks=pytest.mark.slow)])
def test_fault_03_killed_between_two_names(quiet: tuple[Words, Path, set[str]], tmp_path: Path, end: str) -> None:
    """What has its name already does not stand in the way of the same command; everything is there in the end."""
    case, undisturbed, made = quiet
    folder = inputs(case, tmp_path / "again")
    names = 1 if end == "first" else len(made) - 1
    killed = run(case, folder, tmp_path / "killed", Mishap(names=names))
    assert killed.code == -9
    assert len(made & set(files(folder))) < len(made)
    again = run(case, folder, tmp_path / "said")
    assert again.code == 0, again.err
    assert not [name for name in files(folder) if Path(name).name.startswith(".")]
    assert made <= set(files(folder))
    for name in made:
        if name.endswith((".tif", ".shp", ".png")):
            assert content(folder / name) == content(undisturbed / name), name
    done = run(case, folder, tmp_path / "twice")
    assert done.code == 2 and "exist" in done.err


@pytest.mark.parametrize(("case", "names"), [(ortho, 3), (restore, 3)])
def test_fault_03_killed_after_the_last_name_of_a_product(case: Words, names: int, tmp_path: Path) -> None:
    """It is finished; what the dead run had beside it goes, but not the tiles of another run."""
    folder = inputs(case, tmp_path / "in")
    assert run(case, folder, tmp_path / "killed", Mishap(names=names)).code == -9
    left = [path for path in files(folder).values() if path.suffix == ".unfinished"]
    assert len(left) >= 3 and all(path.with_name(path.name[1:-11]).exists() for path in left)
    again = run(case, folder, tmp_path / "said")
    assert again.tasks == [] and again.code == (2 if case is restore else 0), again.err
    there = set(files(folder))
    assert not [name for name in there if Path(name).name.startswith(".")]
    log = next(path for name, path in files(folder).items() if name.endswith(("_ortho.tif", "_restored.tif")))
    log = log.with_name(f".{log.name}.tiles")
    log.write_text("of a run with other settings")
    assert run(case, folder, tmp_path / "twice").code == 2 and log.exists()


def test_fault_13_a_file_of_other_origin_under_a_name_that_a_dead_run_gave(tmp_path: Path) -> None:
    folder = inputs(flow, tmp_path / "in")
    assert run(flow, folder, tmp_path / "killed", Mishap(names=1)).code == -9
    given = folder / "catchments.gpkg"
    given.unlink()
    given.write_text("my own")
    said = run(flow, folder, tmp_path / "said")
    assert said.code == 2 and str(given) in said.err and given.read_text() == "my own"


def test_fault_13_records_and_overviews_of_other_origin_are_refused(tmp_path: Path) -> None:
    folder = inputs(ortho, tmp_path / "in")
    products = folder / "block" / "products"
    products.mkdir()
    for name in ("one_ortho.run.json", "ortho_overview.png"):
        other = products / name
        other.write_text('{"a": "paper of mine"}')
        said = run(ortho, folder, tmp_path / "said")
        assert said.code == 2 and str(other) in said.err, said.err
        assert list(products.iterdir()) == [other]
        other.unlink()
    folder = inputs(shade, tmp_path / "heights")
    (folder / "shade.run.json").write_text("[]")
    said = run(shade, folder, tmp_path / "said")
    assert said.code == 2 and "shade.run.json" in said.err
    assert run(shade, folder, tmp_path / "said", QUIET, "--overwrite").code == 0
    assert json.loads((folder / "shade.run.json").read_text())["file"] == "shade.tif"


def test_fault_13_marks_of_hidden_ground_do_not_outlive_their_orthophoto(tmp_path: Path) -> None:
    folder = inputs(ortho, tmp_path / "in")
    products = folder / "block" / "products"
    first = run(ortho, folder, tmp_path / "said")
    marks = products / "one_ortho_hidden.tif"
    assert first.code == 0 and marks.exists()
    refused = run(ortho, folder, tmp_path / "said", QUIET, "--hidden", "show")
    assert refused.code == 2 and "and 1 more exist;" in refused.err
    assert run(ortho, folder, tmp_path / "said", QUIET, "--hidden", "show", "--overwrite").code == 0
    assert not marks.exists() and (products / "one_ortho.tif").exists()
    shutil.copy(products / "one_ortho.tif", tmp_path / "one.tif")
    marks.write_text("my own")
    assert run(ortho, folder, tmp_path / "said", QUIET, "--hidden", "show", "--overwrite").code == 0
    assert marks.read_text() == "my own"


def test_each_command_has_a_preview_of_its_own(tmp_path: Path) -> None:
    """Orthophotos, two mosaics and an object in one folder; a mosaic called `ortho` replaces nobody's preview."""
    block, out = tmp_path / "block", tmp_path / "out"
    write_town(write_block(block).project, (X0, Y0), 100.0, CRS)
    common = ["--resolution", 2, "--workers", 1, "-o", out]
    alone = [block / "town.toml", block / "town.gpkg", "--objects", "house", "--force"]
    commands: dict[str, list[object]] = {
        "ortho_overview.png": ["ortho", block / "project.toml", "--images", "one"],
        "mosaic_overview.png": ["mosaic", block / "project.toml"],
        "east_overview.png": ["mosaic", block / "project.toml", "--images", "t*", "--name", "east"],
        "object_overview.png": ["object", *alone],
    }
    made: dict[str, bytes] = {}
    for name, words in commands.items():
        said = forked([*words, *common], tmp_path / "said")
        assert said.code == 0 and f"quick look: {out / name}" in said.err, said.err
        made[name] = (out / name).read_bytes()
        assert {path.name: path.read_bytes() for path in out.glob("*.png")} == made
    assert len(set(made.values())) == len(made)
    again: list[object] = ["mosaic", block / "project.toml", "--name", "ortho", *common]
    said = forked(again, tmp_path / "said")
    assert said.code == 2 and str(out / "ortho_overview.png") in said.err
    assert forked([*again, "--no-quicklook"], tmp_path / "said").code == 0
    assert {path.name: path.read_bytes() for path in out.glob("*.png")} == made


def test_an_overview_that_is_missing_is_made(tmp_path: Path) -> None:
    folder = inputs(ortho, tmp_path / "in")
    overview = folder / "block" / "products" / "ortho_overview.png"
    assert run(ortho, folder, tmp_path / "said").code == 0
    overview.unlink()
    again = run(ortho, folder, tmp_path / "said")
    assert again.code == 0 and again.tasks == [] and overview.exists(), again.err
