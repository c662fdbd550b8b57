"""Nothing is lost: what exists stays, runs that died are completed by the same command, doubt is said also with -q."""

from __future__ import annotations

import ast
import json
import os
import shutil
from pathlib import Path

import pytest
from tools.command import inside
from tools.facet_scene import GROUND, write_scene
from tools.forked import QUIET, Mishap, Ran, content, forked
from tools.small_block import X0, Y0, write_block, write_terrain

import photoplan
from photoplan.cli.output import talking
from photoplan.cli.telling import Telling

pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs fork and signals")


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): content(p) for p in folder.rglob("*") if p.is_file()}


class TestDemo:
    def test_a_project_that_was_worked_on_stays(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("photoplan.products.orthophoto.make.execute_all", lambda *a: [])
        monkeypatch.setattr("photoplan.products.orthophoto.make.ProductsReport.figures", ())
        assert inside("demo", tmp_path / "demo", "-q").code == 0
        project = tmp_path / "demo" / "project.toml"
        assert inside("demo", tmp_path / "demo", "-q").code == 0, "an interrupted one goes on"
        changed = project.read_text().replace("[[images]]", '[[images]]\nbalance = "a.toml"', 1)
        project.write_text(changed)
        said = inside("demo", tmp_path / "demo", "-q")
        assert said.code == 2 and "project.toml: exists already and differs" in said.err and "--overwrite" in said.err
        assert project.read_text() == changed
        table = tmp_path / "demo" / "data" / "ext.csv"
        project.unlink()
        table.write_text("mine")
        said = inside("demo", tmp_path / "demo", "-q")
        assert said.code == 2 and table.read_text() == "mine" and not project.exists()
        assert inside("demo", tmp_path / "demo", "-q", "--overwrite").code == 0
        assert "balance" not in project.read_text() and table.read_text() != "mine"

    def test_a_link_in_its_folder_is_not_followed(self, tmp_path: Path) -> None:
        (tmp_path / "outside").mkdir()
        (tmp_path / "demo").mkdir()
        (tmp_path / "demo" / "data").symlink_to(tmp_path / "outside")
        said = inside("demo", tmp_path / "demo", "-q")
        assert said.code == 2 and "is a link that leads out" in said.err and not list((tmp_path / "outside").iterdir())


def test_edits_of_a_project_keep_every_state_before(tmp_path: Path) -> None:
    from photoplan.io.project.edit import ProjectChanges, edit_project

    project = write_block(tmp_path).project
    states = [project.read_text()]
    (tmp_path / "project.previous.toml").write_text("of the user")
    for number in range(3):
        edit_project(project, ProjectChanges(tables={"orientation": {"refraction": number % 2 == 0}}))
        states.append(project.read_text())
    kept = {p.read_text() for p in tmp_path.glob("project.previous*.toml")}
    assert kept >= {*states[:3], "of the user"}


SURFACE = ["--bounds", X0 - 18, Y0 - 30, X0 + 18, Y0 + 30, "--resolution", 3, "--start", GROUND]
#: Commands of many files, and the words that make more of them.
RUNS = {
    "ortho": ["ortho", "--resolution", 2, "--tile", 128, "--hidden", "mark"],
    "mosaic": ["mosaic", "--resolution", 2, "--tile", 128, "--sources", "--sheets", 100],
    "balance": ["balance"],
    "convert": ["convert", "--to", "colmap", "-o", "points.colmap"],
    "tie": ["tie", "--features", 600, "--per-image", 60],
    "surface": ["surface", *SURFACE, "--points", "points.las", "--report", "report.html"],
}


@pytest.mark.parametrize(
    "name", [each if each in ("mosaic", "convert") else pytest.param(each, marks=pytest.mark.slow) for each in RUNS]
)
def test_fault_03_killed_at_every_name_the_same_command_completes(name: str, tmp_path: Path) -> None:
    """Also after the last product and before its pictures: whatever has its name does not stand in the way."""
    verb, *words = RUNS[name]
    workers = [] if verb == "convert" else ["--workers", 1]

    def run(folder: Path, mishap: Mishap = QUIET) -> Ran:
        placed = [folder / word if str(word).startswith(("points.", "report.")) else word for word in words]
        return forked([verb, folder / "project.toml", *placed, *workers], tmp_path / "said", mishap)

    if name in ("tie", "surface"):
        (tmp_path / "in").mkdir()
        write_scene(tmp_path / "in", 3)
    else:
        write_block(tmp_path / "in")
    shutil.copytree(tmp_path / "in", tmp_path / "quiet")
    assert run(tmp_path / "quiet").code == 0
    wanted = files(tmp_path / "quiet")
    before = files(tmp_path / "in")
    names = sum(before.get(each) != made for each, made in wanted.items())
    for count in sorted({1, 2, names // 2, names - 2, names - 1}) if name == "mosaic" else range(1, 100):
        folder = tmp_path / f"at{count}"
        shutil.copytree(tmp_path / "in", folder)
        killed = run(folder, Mishap(names=count))
        if killed.code == 0 and name != "mosaic":  # it gives no more names
            assert count > names // 2
            break
        assert killed.code == -9, (count, killed.err)
        again = run(folder)
        # A run that has given all of its names may find that it is finished.
        finished = again.code == 2 and "exist" in again.err and count >= names // 2
        assert again.code == 0 or finished, (count, again.err)
        made = files(folder)
        if finished:  # the next run that is not refused removes what the dead one worked in
            made = {each: bytes_ for each, bytes_ in made.items() if ".part/" not in each}
        assert made.keys() == wanted.keys(), count
        different = [each for each in wanted if made[each] != wanted[each] and not each.endswith(".run.json")]
        assert not different, (count, different)
        shutil.rmtree(folder)


@pytest.mark.slow
def test_fault_03_a_simulation_killed_at_each_name_is_completed(tmp_path: Path) -> None:
    words = ["simulate", "edge", "--size", 64, 64, "-o"]
    assert forked([*words, tmp_path / "quiet.tif"], tmp_path / "said").code == 0
    for count in (1, 2):
        made = tmp_path / f"at{count}.tif"
        assert forked([*words, made], tmp_path / "said", Mishap(names=count)).code == -9
        again = forked([*words, made], tmp_path / "said")
        assert again.code == 0, again.err
        assert content(made) == content(tmp_path / "quiet.tif")


def test_a_folder_that_is_not_there_is_named_and_no_working_file(tmp_path: Path) -> None:
    block = write_block(tmp_path / "block")
    for words in (("shade", "-o", "s.tif"), ("contours", "--interval", 2, "-o", "c.gpkg")):
        said = inside("dtm", words[0], block.terrain, *words[1:-1], tmp_path / "missing" / str(words[-1]))
        assert said.code == 2 and f"{tmp_path / 'missing'}: no such folder; make it first" in said.err


@pytest.mark.parametrize("words", [("shade",), ("tint",), ("flow",), ("visible", "--from", X0, Y0)])
@pytest.mark.parametrize("suffix", [".gpkg", ".png", ""])
def test_no_raster_gets_the_name_of_something_else(tmp_path: Path, words: tuple[object, ...], suffix: str) -> None:
    terrain = write_terrain(tmp_path / "dem.tif")
    said = inside("dtm", words[0], terrain, *words[1:], "-o", tmp_path / f"a{suffix}")
    assert said.code == 2 and "images are written as TIFF; give a name that ends in .tif" in said.err


def test_records_say_nothing_of_the_disk(tmp_path: Path) -> None:
    project = write_block(tmp_path / "block").project
    said = inside("ortho", project, "--images", "one", "--resolution", 4, "-o", tmp_path / "out" / "deep")
    assert said.code == 0, said.err
    text = (tmp_path / "out" / "deep" / "one_ortho.run.json").read_text()
    assert str(tmp_path) not in text and str(Path.cwd()) not in text
    folder = tmp_path / "out" / "deep"
    assert all((folder / each["path"]).is_file() for each in json.loads(text)["inputs"])


def test_quiet_hides_progress_and_no_doubt(capsys: pytest.CaptureFixture[str]) -> None:
    with Telling(quiet=True, terminal=False) as events:
        events.begin("tiles", 10)
        events.done()
        events.talk("plan: 3 images")
        events.talk("  note: two: sees no terrain and is left out")
        events.talk("warning: 5 values were clipped")
    talking(True)("found 3 images")
    talking(True)("  warning: the positions differ by 5 m")
    said = capsys.readouterr().err.splitlines()
    assert [line.strip().partition(":")[0] for line in said] == ["note", "warning", "warning"]


def test_no_command_hides_what_was_noticed_behind_quiet() -> None:
    """Lists of notes, warnings and doubts are printed outside of conditions on `quiet`."""
    for path in (Path(photoplan.__file__).parent / "cli").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.If) and "quiet" in ast.unparse(node.test) and "not" in ast.unparse(node.test):
                hidden = [n.attr for part in node.body for n in ast.walk(part) if isinstance(n, ast.Attribute)]
                assert not {"notes", "warnings", "warning", "doubt", "failed", "left_out"}.intersection(hidden), path
