"""`photoplan tie` on a few images of the drone block."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from tools.command import Here, edit
from tools.real_projects import drone_project

from photoplan.io.points import read_image_points
from photoplan.io.project.file import load_project
from photoplan.io.store import record_path
from photoplan.products import tie as tie_work

NEAR = ("DJI_0025", "DJI_0026", "DJI_0033")
FAST = ("--scale", 0.5, "--features", 1200, "--per-image", 150, "--workers", 1)


@pytest.fixture(scope="module")
def pristine_ties(block: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tie")
    drone_project(block, folder, *NEAR, "DJI_0018")
    return folder


@pytest.fixture
def project(pristine_ties: Path, tmp_path: Path) -> Path:
    """A fresh project file; features are kept for all tests in one folder."""
    path = pristine_ties / f"{tmp_path.name}.toml"
    path.write_text((pristine_ties / "project.toml").read_text())
    return path


def names(*images: str) -> list[str]:
    return [word for image in images for word in ("--images", image)]


@pytest.mark.drawn
def test_table_project_and_picture(photoplan: Here, project: Path) -> None:
    output = project.with_name("a.csv")
    said = photoplan("tie", project, *names(*NEAR), *FAST, "-o", output, "--overwrite")
    assert said.code == 0, said
    lines = said.out.splitlines()
    assert lines[0] == str(output) and lines[1] == str(output.with_suffix(".png"))
    assert output.with_suffix(".png").read_bytes()[:4] == b"\x89PNG"
    assert "3 tried (pairs with common ground" in said.out and "loops" in said.out
    points = read_image_points(output)
    assert set(points.images) == set(NEAR) and len(points.points) > 60
    assert np.isfinite(points.sigma).all() and points.sigma.max() <= 0.4  # pixels of the whole image, twice as fine
    assert load_project(project).observations.image_points == ("a.csv",)
    # Once more: the entry is not doubled; without --overwrite nothing is done.
    assert photoplan("tie", project, *names(*NEAR), *FAST, "-o", output).code == 2
    said = photoplan("tie", project, *names(*NEAR), *FAST, "-o", output, "--overwrite", "--json", "-q")
    found = json.loads(said.out)
    assert said.err == ""
    assert found["points"] == len(points.points) and found["pairs"] == {"tried": 3, "verified": 3}
    assert found["unconnected"] == [] and found["loops"]["factor"] >= 1
    assert load_project(project).observations.image_points == ("a.csv",)


def test_another_run_begins_with_what_is_known(
    photoplan: Here, project: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Features and matches are kept for other numbers of points too; a damaged file costs only time."""
    output = tmp_path / "b.csv"
    options = ["tie", project, *names(*NEAR[:2]), *FAST, "-o", output, "--no-refine", "--no-picture"]
    record = record_path(output)
    assert photoplan(*options).code == 0
    content, key = output.read_bytes(), json.loads(record.read_text())["key"]

    def never(*_: object, **__: object) -> None:
        raise AssertionError("features and matches are kept")

    with monkeypatch.context() as patch:
        patch.setattr(tie_work, "extract_features", never)
        patch.setattr(tie_work, "match_features", never)
        assert photoplan(*options, "--overwrite", "--per-image", 20).code == 0
        assert output.read_bytes() != content and json.loads(record.read_text())["key"] != key
        assert photoplan(*options, "--overwrite").code == 0
    # Meanwhile the project has got the table: that moves no point.
    assert json.loads(record.read_text())["key"] == key
    assert output.read_bytes() == content
    kept = output.with_suffix(".matches")
    kept.write_bytes(kept.read_bytes()[:200])
    assert photoplan(*options, "--overwrite").code == 0
    assert output.read_bytes() == content


def test_dry_run_writes_nothing(photoplan: Here, project: Path, tmp_path: Path) -> None:
    said = photoplan("tie", project, "--dry-run", "-o", tmp_path / "c.csv")
    assert said.code == 0 and "4 images, 3 pairs" in said.out
    assert list(tmp_path.iterdir()) == []


def test_fault_16_images_without_overlap_are_named(photoplan: Here, project: Path) -> None:
    output = project.with_name("d.csv")
    words = [*FAST, "-o", output, "--overwrite", "--no-refine", "--no-picture", "--pairs", "all"]
    said = photoplan("tie", project, *names("DJI_0025", "DJI_0026", "DJI_0018"), *words)
    assert said.code == 0
    assert "no overlap: 1 of 3 images" in said.err and "DJI_0018" in said.err
    said = photoplan("tie", project, *names("DJI_0025", "DJI_0018"), *words)
    assert said.code == 3 and "no overlap" in said.err and "DJI_0018" in said.err


def test_pairs_of_a_file(photoplan: Here, project: Path, tmp_path: Path) -> None:
    pairs = tmp_path / "pairs.txt"
    output = project.with_name("e.csv")
    words = ["tie", project, *names(*NEAR), *FAST, "-o", output, "--overwrite", "--no-refine", "--pairs", pairs]
    pairs.write_text("# strip\nDJI_0025.jpg, DJI_0026.jpg\nDJI_0026;DJI_0033\n")
    assert "2 tried" in photoplan(*words).out
    for text, message in (
        ("DJI_0025 DJI_0099\n", r"pairs.txt:1: image 'DJI_0099' is not among the 3 images"),
        ("DJI_0025 DJI_0025\n", "paired with itself"),
        ("DJI_0025\n", "1 names"),
        ("", "holds no pair"),
    ):
        pairs.write_text(text)
        said = photoplan(*words)
        assert said.code == 3 and message in said.err, said


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--images", "DJI_0025"], "tie points need two images"),
        (["--scale", "0"], "--scale 0 must be from 0.01 to 1"),
        (["--features", "3"], "--features 3 must be at least 50"),
        (["--images", "nothing*"], "is not in the project"),
        (["-o", "points.png"], "must be the name of a table"),
    ],
)
def test_wrong_use(photoplan: Here, project: Path, options: list[str], message: str) -> None:
    said = photoplan("tie", project, *options)
    assert said.code == 2 and message in said.err


def test_the_output_is_no_input(photoplan: Here, project: Path) -> None:
    image = load_project(project).resolve(load_project(project).images[0].file)
    said = photoplan("tie", project, "-o", image, "--overwrite")
    assert said.code == 2 and "is the input" in said.err


def test_unoriented_images_need_no_terrain(photoplan: Here, project: Path) -> None:
    text = project.read_text()
    head, *images = text.split("[[images]]")
    images = ["".join(x for x in i.splitlines(True) if not x.startswith(("center", "angles"))) for i in images]
    project.write_text("[[images]]".join([head, *images]))
    start = head.index("[terrain]")
    edit(project, head[start : head.index("\n[", start + 1) + 1], "")
    output = project.with_name("f.csv")
    said = photoplan("tie", project, *names(*NEAR[:2]), *FAST, "-o", output, "--overwrite", "--no-refine")
    assert said.code == 0 and "1 tried (all pairs)" in said.out


def test_small_standard_deviations_are_printed_with_two_figures() -> None:
    counts = {
        "factor": 1,
        "pairs": 1,
        "verified": 1,
        "tracks": 7,
        "points": 7,
        "rays": {2: 7},
        "per_image": {"a": 7, "b": 7},
    }
    report = tie_work.TieReport(None, ("a", "b"), "all", notes=(), sigma=0.00556, **counts)  # type: ignore[arg-type]
    assert "standard deviation 0.0056 px" in "\n".join(report.summary())
