"""Seams of real blocks: where they run, how far images are apart along them, what is left to see."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
import shapely
from numpy.typing import NDArray
from tools.matching import Picture, match
from tools.real_projects import dmc_project, drone_project

from photoplan.io.project.file import load_project
from photoplan.products.balance import BalanceRequest, balance_project
from photoplan.products.orthophoto.execution import Run, execute
from photoplan.products.orthophoto.mosaic import plan_mosaic
from photoplan.products.orthophoto.plan import plan_orthophotos, render
from photoplan.products.seams import SeamsRequest, make_seams
from photoplan.requests.ortho import Choice

#: The pavilion of the drone block.
PAVILION = shapely.Point(576687.7, 5188131.8).buffer(2.5)


def offsets(project: Path, shapes: dict[str, shapely.Geometry], pixel: float) -> NDArray[np.float64]:
    """Offsets between the orthophotos of both images along their seams, in pixels of the product."""
    plan = plan_orthophotos(load_project(project), resolution=pixel)
    pictures = {}
    for product in plan.products:
        values, valid = render(plan, product.plan.name)
        grey = np.where(valid, values.astype(float).mean(axis=0), np.nan)
        pictures[product.images[0]] = Picture(grey[None], product.grid.left, product.grid.top, pixel)
    found, names = [], sorted(shapes)
    for k, one in enumerate(names):
        for other in names[:k]:
            seam = shapely.intersection(shapes[one].buffer(pixel), shapes[other].buffer(pixel))
            if seam.area < 10 * pixel:
                continue
            near = match(pictures[one], pictures[other], patch=2.0, stride=1.0, search=0.5, filled=0.9)
            on = shapely.contains_xy(seam.buffer(0.5), near.x, near.y) & (near.quality > 0.7)
            found.append(np.column_stack([near.dx, near.dy])[on])
    return np.concatenate(found) / pixel


@pytest.mark.slow
def test_the_drone_block(block: Path, tmp_path: Path) -> None:
    project = drone_project(block, tmp_path)
    found = make_seams(SeamsRequest(project, workers=2))
    assert found.shapes is not None and found.differences is not None
    halfway, best = found.differences
    assert best is not None and halfway is not None and best < 0.6 * halfway
    around = [name for name, shape in found.shapes.items() if shape.intersects(PAVILION)]
    assert len(around) == 1  # no seam crosses it
    apart = np.hypot(*offsets(project, found.shapes, 0.05).T)
    print(f"\n{len(apart)} places on seams: median {np.median(apart):.2f}, 90 % {np.percentile(apart, 90):.2f} px")
    assert len(apart) > 50 and np.median(apart) <= 1.0


def across(folder: Path, name: str) -> tuple[float, float]:
    """Mean difference of neighbouring pixels across seams, and of those 3 and 4 pixels beside them."""
    with rasterio.open(folder / f"{name}.tif") as file:
        values = file.read().astype(float)
    with rasterio.open(folder / f"{name}_sources.tif") as file:
        sources = file.read(1)
    on, beside = [], []
    for axis in (0, 1):
        steps = np.abs(np.diff(values, axis=axis + 1)).mean(axis=0)
        first, second = (np.take(sources, np.arange(n, sources.shape[axis] - 1 + n), axis) for n in (0, 1))
        painted = (first > 0) & (second > 0)
        seam = painted & (first != second)
        on.append(steps[seam])
        for away in (-4, -3, 3, 4):
            at = np.argwhere(seam)
            at[:, axis] += away
            at = at[(at[:, axis] >= 0) & (at[:, axis] < steps.shape[axis])]
            row, col = at[(painted & ~seam)[at[:, 0], at[:, 1]]].T
            beside.append(steps[row, col])
    return float(np.concatenate(on).mean()), float(np.concatenate(beside).mean())


@pytest.fixture(scope="module")
def frames(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, float]:
    """Gradient across seams, parts of that beside them, of mosaics of the four balanced DMC frames."""
    folder = tmp_path_factory.mktemp("frames")
    project = dmc_project(shared, folder)
    balance_project(BalanceRequest(project, workers=2))
    seams = make_seams(SeamsRequest(project, resolution=5.0, workers=2)).path
    ratios = {}
    cases = [("score", None, 0.0, "mean"), ("content", str(seams), 0.0, "mean"), ("soft", str(seams), 20.0, "mean")]
    for name, file, feather, blend in [*cases, ("bands", str(seams), 80.0, "multiband")]:
        choice = Choice(name, seams=file, feather=feather, blend=blend)
        plan = plan_mosaic(load_project(project), resolution=5.0, sources=True, choice=choice)
        execute(plan, folder / "products", Run(workers=2, quicklook=False))
        on, beside = across(folder / "products", name)
        ratios[name] = on / beside
        print(f"\n{name}: across {on:.2f}, beside {beside:.2f} grey values, ratio {ratios[name]:.3f}")
    return ratios


@pytest.mark.slow
def test_four_frames_balanced(frames: dict[str, float]) -> None:
    """Asked: the gradient across seams is not above that beside them."""
    assert frames["soft"] < 1.0 < frames["content"] < frames["score"] and frames["score"] > 1.1
    assert frames["bands"] <= 1.0


@pytest.mark.slow
@pytest.mark.xfail(strict=True, reason="1.103 since slopes of the block have a prior: missed, see docs/status.md")
def test_four_frames_balanced_without_blending(frames: dict[str, float]) -> None:
    """1.05 was reached when slopes of the whole block were free."""
    assert frames["content"] < 1.1
