"""Blocks in which tie points are stiff and what says where the block lies is weak."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tools.adjust_project import MIDDLE, Make, write_project

from photoplan.io.project.edit import ProjectChanges, edit_project
from photoplan.io.project.file import load_project
from photoplan.products.adjust.run import AdjustRequest, adjust_project


@pytest.mark.parametrize("turn", [0.5, 3.0])
def test_a_whole_block_far_from_its_positions_moves_there(tmp_path: Path, turn: float) -> None:
    """Shape and scale are right, the block is shifted by 60 m and turned; positions of 10 m bring it back.

    The way leads through turns of the whole block that image points of 0.02 pixels allow in small steps only.
    """
    make = Make(curvature="none", pixel_noise=0.02, sigma_image=0.02, control=False, positions=True, start=(0.0, 0.0))
    made = write_project(tmp_path / "block", make)
    text = made.project_text()
    made.path.write_text(text.replace("sigma_position = [0.05, 0.05]", "sigma_position = [10.0, 10.0]"))
    project = load_project(made.path)
    R = Rotation.from_euler("xyz", [turn, -turn, 2 * turn], degrees=True)
    pivot, images = np.array([*MIDDLE, 500.0]), {}
    for image in project.images:
        center, angles = image.pose_numbers
        moved = pivot + R.apply(np.array(center) - pivot) + [20.0, -20.0, 50.0]
        turned = (R * Rotation.from_euler("XYZ", angles, degrees=True)).as_euler("XYZ", degrees=True)
        images[image.name] = {"center": moved.tolist(), "angles": turned.tolist()}
    edit_project(made.path, ProjectChanges(images=images))
    report = adjust_project(AdjustRequest(made.path, variance_components=False))
    assert report.iterations <= 40
    found = np.array([load_project(made.path).image(name).pose_numbers[0] for name in made.names])
    assert np.abs(found - made.centers).max() < 1.0
