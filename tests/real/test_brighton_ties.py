"""Tie points of the drone block, judged by its given orientation.

The orientation itself leaves 0.40 px in its own tie points (see the block's licence file), which limits what can be
seen here. Six of the 18 images, over lawn, road and beach; all 18 are in `tests/slow/test_ties.py`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from tools.real_projects import drone_project
from tools.ties import reprojection

from photoplan.cameras.observed import ImagePoints
from photoplan.io.points import read_image_points
from photoplan.io.project.file import load_project
from photoplan.products.tie import TieReport, TieRequest, find_ties
from photoplan.project.scene import open_scene

IMAGES = tuple(f"DJI_00{k}" for k in (25, 26, 27, 32, 33))


@pytest.fixture(scope="module")
def project(block: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return drone_project(block, tmp_path_factory.mktemp("ties"))


def ties(project: Path, **how: object) -> tuple[TieReport, ImagePoints, NDArray]:
    """Report, points, and their residuals against the given orientation."""
    output = project.with_name("ties.csv")
    report = find_ties(TieRequest(project, IMAGES, features=3000, per_image=300, output=output, overwrite=True, **how))
    points = read_image_points(output)
    cameras = [open_scene(load_project(project), name).camera for name in points.images]
    return report, points, reprojection(points, cameras)


@pytest.fixture(scope="module")
def free(project: Path) -> tuple[TieReport, ImagePoints, NDArray]:
    return ties(project, use_orientation=False)


def within(residuals: NDArray, limit: float) -> float:
    return float((np.hypot(*residuals.T) <= limit).mean())


@pytest.mark.slow
def test_without_any_orientation_all_images_hang_together_and_points_fit(free) -> None:
    report, points, residuals = free
    assert report.chosen == "all pairs" and report.pairs == 10 and report.unconnected == ()
    assert min(report.per_image.values()) >= 150
    print(f"{len(points)} observations, {within(residuals, 3):.4f} within 3 px")
    assert within(residuals, 3.0) >= 0.95  # measured: 0.999


@pytest.mark.slow
def test_approximate_orientation_guides(project: Path) -> None:
    report, points, residuals = ties(project)
    assert report.chosen.startswith("pairs with common ground") and report.unconnected == ()
    print(f"{len(points)} observations, {within(residuals, 3):.4f} within 3 px")
    assert within(residuals, 3.0) >= 0.95


@pytest.mark.slow
def test_refined_points_fit_better_than_features(project: Path, free) -> None:
    residuals = free[2]
    _, plain, before = ties(project, use_orientation=False, refine=False)
    fit, fit_before = (np.sqrt((r[np.hypot(*r.T) <= 3] ** 2).mean()) for r in (residuals, before))
    print(f"rms of a coordinate: refined {fit:.3f} px, features {fit_before:.3f} px")
    assert fit < 0.85 * fit_before
    assert within(residuals, 3.0) > within(before, 3.0)
    assert np.isfinite(plain.sigma).all() and plain.sigma.min() >= 0.3


@pytest.mark.slow
def test_standard_deviations_come_from_loops(free) -> None:
    report, points, _ = free
    assert report.loops is not None and report.loops.measured
    assert 1.5 <= report.loops.factor <= 3.5  # measured: 2.3
    assert np.isfinite(points.sigma).all() and points.sigma.max() <= 0.2


@pytest.mark.slow
def test_features_of_reduced_images_are_refined_at_full_resolution(project: Path, free) -> None:
    report, _, residuals = ties(project, use_orientation=False, scale=0.5)
    assert report.factor == 2 and report.unconnected == ()
    print(f"rms of a coordinate {np.sqrt((residuals[np.hypot(*residuals.T) <= 3] ** 2).mean()):.3f} px")
    assert within(residuals, 3.0) >= 0.95
    fit, full = (np.sqrt((r[np.hypot(*r.T) <= 3] ** 2).mean()) for r in (residuals, free[2]))
    assert fit < 1.25 * full
