"""Start values of a real block: 68 UltraCam exposures, no attitudes, positions only."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from tools.ign_block import ign_project, published
from tools.photos import turned_by

from photoplan.geometry.pose import Pose, rotation_from_angles
from photoplan.io.project.file import load_project
from photoplan.products.adjust.inputs import read_inputs, started


@pytest.mark.slow
def test_exposures_with_positions_and_no_attitudes(shared: Path, tmp_path: Path) -> None:
    data = shared / "data" / "ign_borea"
    path = ign_project(tmp_path, data, every=False)
    text = re.sub(r"(?m)^(center|angles|sigma_attitude) = .*\n", "", path.read_text())
    path.write_text(text)
    table = tmp_path / "positions.csv"
    table.write_text("\n".join(",".join(line.split(",")[:4]) for line in table.read_text().splitlines()) + "\n")
    project = load_project(path)
    assert all(image.center is None for image in project.images)
    inputs, poses = started(read_inputs(project, [image.name for image in project.images]))
    # Ten exposures at the block's border show five points or fewer.
    assert len(poses) == 58
    assert len(inputs.lost) == 10
    truth = published(data)
    known = {
        n: Pose(c, rotation_from_angles(np.radians(a))) for n, c, a in zip(truth.names, truth.centers, truth.angles)
    }
    assert max(np.linalg.norm(pose.center - known[name].center) for name, pose in poses.items()) < 2.0
    assert max(np.degrees(turned_by(pose, known[name])) for name, pose in poses.items()) < 0.05
