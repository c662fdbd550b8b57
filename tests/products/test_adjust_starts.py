"""Start orientations that are none: the adjustment begins again without them, by itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tools.adjust_project import Make, write_project
from tools.thinned import some

from photoplan.io.project.edit import ProjectChanges, edit_project
from photoplan.io.project.file import load_project
from photoplan.products.adjust.run import AdjustRequest, adjust_project


@pytest.mark.parametrize("kind", some(["60 m and 10 degrees", "kappa + 90 degrees"], 1))
def test_bad_starts_fall_back_to_none(tmp_path: Path, kind: str) -> None:
    made = write_project(tmp_path, Make(pixel_noise=0.3, curvature="none", start=(0.0, 0.0)))
    adjust_project(AdjustRequest(made.path))
    good = {name: load_project(made.path).image(name).pose_numbers[0] for name in made.names}
    rng = np.random.default_rng(5)
    images = {}
    for image in load_project(made.path).images:
        center, angles = image.pose_numbers
        R = Rotation.from_euler("XYZ", angles, degrees=True)
        if kind.startswith("60"):
            center = (np.array(center) + rng.normal(0, 60, 3)).tolist()
            R = R * Rotation.from_rotvec(np.radians(rng.normal(0, 10, 3)))
        else:
            R = R * Rotation.from_euler("z", 90, degrees=True)
        images[image.name] = {"center": list(center), "angles": R.as_euler("XYZ", degrees=True).tolist()}
    edit_project(made.path, ProjectChanges(images=images))
    report = adjust_project(AdjustRequest(made.path, overwrite=True))
    for name in made.names:
        np.testing.assert_allclose(load_project(made.path).image(name).pose_numbers[0], good[name], rtol=0, atol=0.01)
    assert report.sigma0 == pytest.approx(1.0, abs=0.2)
    print(report.notes)
    if kind.startswith("kappa"):
        assert any("the stated orientations were no start" in note for note in report.notes)


def test_iterations_are_an_option(tmp_path: Path) -> None:
    from photoplan.errors import GeometryError

    made = write_project(tmp_path, Make(pixel_noise=0.3, curvature="none", control=False, positions=True))
    with pytest.raises(GeometryError, match="not converged after 1 iteration"):
        adjust_project(AdjustRequest(made.path, iterations=1, robust=False))


def test_a_point_outside_or_measured_twice_does_not_stop_a_block(tmp_path: Path) -> None:
    made = write_project(tmp_path, Make(pixel_noise=0.3, curvature="none"))
    rows = (tmp_path / "points.csv").read_text().splitlines()
    before = adjust_project(AdjustRequest(made.path, dry_run=True)).measurements
    point, image, x, y = rows[40].split(",")
    (tmp_path / "points.csv").write_text("\n".join([*rows, f"{point},{image},{float(x) + 9},{y}"]) + "\n")
    figures = adjust_project(AdjustRequest(made.path, dry_run=True))
    assert figures.measurements == before - 1
    assert any(f"{point!r} is measured in image {image!r} in line 41 already" in note for note in figures.notes)
    rows[40] = f"{point},{image},-45.5,{y}"
    (tmp_path / "points.csv").write_text("\n".join(rows) + "\n")
    figures = adjust_project(AdjustRequest(made.path, dry_run=True))
    assert figures.measurements == before - 1
    assert any("column -45.5" in note and "1 such measurements take no part" in note for note in figures.notes)


def test_a_turn_about_a_line_is_called_so(tmp_path: Path) -> None:
    from photoplan.errors import GeometryError

    made = write_project(tmp_path, Make(curvature="none"))
    rows = (tmp_path / "control.csv").read_text().splitlines()
    line = [rows[0]]
    for k, row in enumerate(r for r in rows[1:] if r.split(",")[0] in ("G1", "G5", "G9")):
        name = row.split(",")[0]
        a, b = made.points["G1"], made.points["G9"]
        line.append(",".join([name, *(f"{v:.6f}" for v in a + 0.5 * k * (b - a)), "control"]))
    (tmp_path / "control.csv").write_text("\n".join(line) + "\n")
    points = (tmp_path / "points.csv").read_text().splitlines()
    (tmp_path / "points.csv").write_text("\n".join(r for r in points if not r.startswith("G5,")) + "\n")
    with pytest.raises(GeometryError, match="rotation of the block about the line through X") as error:
        adjust_project(AdjustRequest(made.path, robust=False))
    assert "free: ." not in str(error.value)
