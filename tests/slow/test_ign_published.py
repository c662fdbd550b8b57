"""Why the adjusted orientations of the real UltraCam block differ from the published ones by more than their sigma."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
from tools.command import process
from tools.ign_block import ign_project


def squares(project: Path, *options: str) -> tuple[float, int]:
    """Sum of squares of the residuals of image points, pixels², and the number of coordinates."""
    said = process("adjust", project, "--no-robust", "-q", *options)
    assert said.code == 0, said.err
    report = json.loads((project.parent / "adjustment" / "report.json").read_text())
    (group,) = [g for g in report["groups"] if g["name"].startswith("image points")]
    return group["rms"] ** 2 * group["count"], group["count"]


def used_points(source: Path, target: Path) -> None:
    """Keep the measurements that an adjustment used."""
    with source.open(newline="") as file:
        rows = [r for r in csv.DictReader(file) if r["used"] in ("1", "True", "true", "yes")]
    assert len(rows) > 10_000
    target.write_text("point,image,x,y\n" + "".join(f"{r['point']},{r['image']},{r['x']},{r['y']}\n" for r in rows))


@pytest.mark.slow
def test_published_orientations_do_not_minimise_the_residuals(shared: Path, tmp_path: Path) -> None:
    """Held at the published orientations, the same measurements have far larger residuals than their number allows."""
    data = shared / "data" / "ign_borea"
    free = ign_project(tmp_path / "free", data)
    assert process("adjust", free, "-q").code == 0
    held = ign_project(tmp_path / "held", data, position_noise=1e-4, attitude_noise_deg=1e-6, sigma_control=10.0)
    table = tmp_path / "free" / "adjustment" / "image_points.csv"
    used_points(table, tmp_path / "held" / "image_points.csv")
    used_points(table, tmp_path / "free" / "image_points.csv")
    best, count = squares(free, "--overwrite")
    worse, same = squares(held)
    assert same == count
    # Sixty-eight exposures have measured points; each of their 408 parameters may raise the sum by one variance.
    sigma2 = best / (count - 3 * 2987 - 6 * 68)
    increase = (worse - best) / sigma2
    print(f"\npublished orientations raise the sum of squares by {increase:.0f} variances, 408 expected")
    assert increase > 3 * 408
