"""`ortho` makes nothing of what `check` calls a fault, nor much finer than the images see, unless it is said."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
from tools.real_projects import drone_project
from tools.small_block import Block, make_project

from photoplan.errors import GeometryError, UsageError
from photoplan.io.project.edit import ProjectChanges, edit_project
from photoplan.io.project.file import load_project
from photoplan.products.check import check_project
from photoplan.products.orthophoto.plan import plan_orthophotos


def test_a_fault_of_check_is_refused(small: Block) -> None:
    path = make_project(small)
    project = load_project(path)
    name = project.images[0].name
    center, angles = project.images[0].pose_numbers
    edit_project(path, ProjectChanges(images={name: {"center": [center[0], center[1], 99_000.0], "angles": angles}}))
    project = load_project(path)
    (fault,) = [text for text in check_project(project).implausible if text.startswith(name)]
    assert "above the terrain; are heights in millimetres?" in fault
    with pytest.raises(GeometryError, match=f"image '{name}': .*are heights in millimetres.*`photoplan check` lists"):
        plan_orthophotos(project, [name], resolution=1.0)
    assert plan_orthophotos(project, [name], resolution=1.0, force=True, bounds=None).products


def test_a_resolution_much_finer_than_the_images_is_refused(small: Block) -> None:
    project = load_project(make_project(small))
    (gsd,) = {p.gsd for p in plan_orthophotos(project, [project.images[0].name]).products}
    fine = gsd / 5
    with pytest.raises(UsageError, match=r"5 times finer than the images see the ground .* pixels in .* tiles"):
        plan_orthophotos(project, [project.images[0].name], resolution=fine)
    assert plan_orthophotos(project, [project.images[0].name], resolution=fine, force=True).products
    assert plan_orthophotos(project, [project.images[0].name], resolution=gsd / 3.9).products


@pytest.mark.parametrize("images", [["DJI_0018"], pytest.param(None, marks=pytest.mark.slow)], ids=["one", "all"])
def test_a_block_in_another_unit_is_noticed_by_one_image_of_it(
    block: Path, tmp_path: Path, images: list[str] | None
) -> None:
    """Radians declared as degrees: every image is upright then and sees the terrain, and only the flight lines tell."""
    path = drone_project(block, tmp_path / "block")

    def radians(found: re.Match[str]) -> str:
        return f"angles = {[math.radians(float(a)) for a in found[1].split(',')]}"

    path.write_text(re.sub(r"angles = \[(.*)\]", radians, path.read_text()))
    project = load_project(path)
    told = check_project(project, images)
    assert told.implausible == () and told.alternative is not None
    assert "radians that were declared as degrees" in told.alternative
    assert "image axes are" in told.alternative and "instead of 8" not in told.alternative
    assert told.alternative not in str(told)
    with pytest.raises(GeometryError, match=r"another reading of the orientations fits better; .*radians"):
        plan_orthophotos(project, ["DJI_0018"], resolution=1.0)
