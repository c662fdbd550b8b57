"""Blocks of which a part is oriented, and blocks that only their approximate orientations place."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from tools.adjust_project import Make, write_project
from tools.command import Here, edit
from tools.small_block import Block

from photoplan.io.project.file import load_project

pytest.importorskip("matplotlib")


def without_points(path: Path, *names: str) -> None:
    """Drop all measurements of some images."""
    kept = [line for line in path.read_text().splitlines() if not any(f",{name}.tif," in line for name in names)]
    path.write_text("\n".join(kept) + "\n")


def test_adjust_ends_with_the_images_that_are_not_oriented(photoplan: Here, tmp_path: Path) -> None:
    made = write_project(tmp_path / "block", Make(pixel_noise=0.3))
    whole = (tmp_path / "block" / "points.csv").read_text()
    without_points(tmp_path / "block" / "points.csv", "a1", "b4")
    said = photoplan("adjust", made.path)
    assert said.code == 4, said.err
    assert "2 of 8 images could not be oriented" in said.err and "a1, b4: " in said.err
    assert "photoplan tie --overwrite" in said.err
    report = json.loads((tmp_path / "block" / "adjustment" / "report.json").read_text())
    assert [one["name"] for one in report["not_oriented"]] == ["a1", "b4"]
    project = load_project(made.path)
    approximate = [image.name for image in project.posed if image.approximate]
    assert approximate == ["a1", "b4"]
    # What is asked for alone is oriented: no failure. With all measurements every image is, and the entries go.
    assert photoplan("adjust", made.path, "--images", "a2,a3,a4,b1,b2,b3", "--dry-run", "-q").code == 0
    (tmp_path / "block" / "points.csv").write_text(whole)
    assert photoplan("adjust", made.path, "--overwrite", "-q").code == 0
    assert "approximate" not in made.project_text()


@pytest.mark.parametrize("how", ["none", "approximate"])
def test_products_use_what_is_oriented_and_list_the_rest(photoplan: Here, small: Block, how: str) -> None:
    text = small.project.read_text()
    if how == "approximate":
        text = text.replace('name = "two"', 'name = "two"\napproximate = true', 1)
    else:
        head, tail = text.split('name = "two"', 1)
        tail = re.sub(r"center = .*\n", "", tail, count=1)
        text = head + 'name = "two"' + re.sub(r"angles = .*\n", "", tail, count=1)
    small.project.write_text(text)
    wanted = r"left out: two: (has no orientation; `photoplan resect`|its orientation is approximate)"
    said = photoplan("check", small.project)
    assert said.code == 0 and re.search(wanted, said.out), said
    assert "1 of 3 images are not oriented" in said.out
    assert len(json.loads(photoplan("check", small.project, "--json").out)["left_out"]) == 1
    for words in (
        ("ortho", "--resolution", 3),
        ("mosaic", "--resolution", 3),
        ("balance",),
        ("seams",),
        ("surface", "--start", 100, "--resolution", 6, "--dry-run"),
        ("budget", "--sigma-height", 1),
    ):
        said = photoplan(words[0], small.project, *words[1:])
        if words[0] == "budget" and said.code == 2:  # needs more figures than this block states
            continue
        assert said.code == 0, said
        assert re.search(wanted, said.err + said.out), said
    assert sorted(p.name for p in small.folder.glob("products/*_ortho.tif")) == ["one_ortho.tif", "three_ortho.tif"]
    # An image that is asked for by name is refused by name, unless others can be made.
    said = photoplan("ortho", small.project, "--images", "two", "--overwrite")
    assert said.code == 3 and re.search(r"image two: (has no orientation|its orientation is approx)", said.err), said


def test_a_block_without_observations_that_place_it(photoplan: Here, tmp_path: Path) -> None:
    """Refused with the way out by its name; placed by its orientations it keeps their place and gets its shape."""
    make = Make(control=False, pixel_noise=0.1, start=(2.0, 0.2))
    made = write_project(tmp_path / "block", make)
    said = photoplan("adjust", made.path)
    assert said.code == 3 and "scale of the block" in said.err
    assert "--datum to orientations" in said.err and "starting again" not in said.err
    said = photoplan("adjust", made.path, "--datum", "orientations")
    assert said.code == 0, said.err
    assert "datum from orientations, height" in said.out and "known to 3 m, 5 m in height, angles to 3°" in said.err
    project = load_project(made.path)
    centers = np.array([project.image(name).center for name in made.names])
    off = centers - made.centers
    # 2 m of errors in each of eight positions: their mean stays, what differs from image to image goes.
    assert np.abs(off.mean(axis=0)).max() < 2.5
    near, far = made.centers - made.centers.mean(axis=0), centers - centers.mean(axis=0)
    U, s, Vt = np.linalg.svd(near.T @ far)
    shape = near @ (U @ Vt) * (s.sum() / (near**2).sum()) - far
    assert np.sqrt((shape**2).mean()) < 0.3
    sigma = np.array([project.image(name).sigma_center for name in made.names])
    assert (sigma > 0.9).all() and (sigma[:, 2] < 10.0).all()
    # Once more it is where it was: the orientations that place it are those that it has got.
    assert photoplan("adjust", made.path, "--datum", "orientations", "--overwrite", "-q").code == 0
    again = load_project(made.path)
    np.testing.assert_allclose([again.image(name).center for name in made.names], centers, atol=0.02)


def test_the_datum_is_stated_in_the_project_and_refused_beside_positions(photoplan: Here, tmp_path: Path) -> None:
    made = write_project(tmp_path / "block", Make(control=False, pixel_noise=0.1))
    edit(made.path, "[adjustment]", '[adjustment]\ndatum = "orientations"')
    edit(made.path, "[observations]", "[observations]\nsigma_position = [0.5, 0.8]\nsigma_attitude = 1.0")
    said = photoplan("adjust", made.path, "--dry-run")
    assert said.code == 0 and "known to 0.5 m, 0.8 m in height, angles to 1°" in said.err, said
    placed = write_project(tmp_path / "placed", Make(control=False, positions=True))
    said = photoplan("adjust", placed.path, "--datum", "orientations")
    assert said.code == 3 and "--datum is set to orientations, and the project has observed positions" in said.err
    bare = write_project(tmp_path / "bare", Make(control=False, start=(np.nan, np.nan)))
    said = photoplan("adjust", bare.path, "--datum", "orientations")
    assert said.code == 3 and "no image of the project has center and angles" in said.err
