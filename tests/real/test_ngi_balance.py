"""The four DMC frames without a reference: how much their overlaps differ at 20 m, before and after."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from tools.real_projects import dmc_project

from photoplan.io.project.file import load_project
from photoplan.products.balance import BalanceRequest, balance_project, open_reference
from photoplan.products.orthophoto.plan import plan_orthophotos, render

R = 20.0


def with_own_table(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Rms difference of two images if this overlap alone had a table, the best for 64 classes, flat as it may be: the
    geometric mean of both directions."""
    both, found = ~np.isnan(a + b), []
    for x, y in ((a[both], b[both]), (b[both], a[both])):
        order = np.argsort(x, kind="stable")
        found.append(np.concatenate([part - part.mean() for part in np.array_split(y[order], 64)]))
    return float(np.sqrt(np.prod([np.std(each) for each in found])))


def overlaps(project: Path) -> tuple[NDArray[np.float64], NDArray[np.float64], list[float]]:
    """Rms differences of the pairs (pairs, bands) where both see the ground, those with a table for each pair alone,
    and the clipped part of each image."""
    plan = plan_orthophotos(load_project(project), resolution=R, hidden="nodata")
    found = []
    for product in plan.products:
        values, valid = render(plan, product.plan.name)
        grid = product.grid
        found.append((round(grid.left / R), round(-grid.top / R), np.where(valid, values.astype(float), np.nan)))
    left, top = (min(one[k] for one in found) for k in (0, 1))
    shape = (3, *(max(one[1 - k] - (top, left)[k] + one[2].shape[1 + k] for one in found) for k in (0, 1)))
    whole = np.full((len(found), *shape), np.nan)
    for k, (col, row, values) in enumerate(found):
        whole[k, :, row - top :, col - left :][:, : values.shape[1], : values.shape[2]] = values
    pairs = [np.sqrt(np.nanmean((whole[i] - whole[j]) ** 2, axis=(1, 2))) for i in range(4) for j in range(i)]
    own = [[with_own_table(*both) for both in zip(whole[i], whole[j])] for i in range(4) for j in range(i)]
    clipped = [float(np.mean((v[~np.isnan(v)] <= 0) | (v[~np.isnan(v)] >= 255))) for v in whole]
    return np.array(pairs), np.array(own), clipped


def beside_satellite(project: Path, satellite: Path) -> NDArray[np.float64]:
    """Rms difference of all orthophotos to Sentinel-2 after one straight line for each band, (bands,)."""
    plan = plan_orthophotos(load_project(project), resolution=R, hidden="nodata")
    ours, theirs = [], []
    for product in plan.products:
        values, valid = render(plan, product.plan.name)
        found = open_reference(satellite, product.grid, 3, np.dtype(np.uint8)).pixels(product.grid, product.grid.window)
        assert found is not None
        ours.append(values[:, valid & found[1]].astype(float))
        theirs.append(found[0][:, valid & found[1]])
    x, y = np.concatenate(ours, axis=1), np.concatenate(theirs, axis=1)
    lines = [np.polyval(np.polyfit(a, b, 1), a) - b for a, b in zip(x, y)]
    return np.sqrt(np.square(lines).mean(axis=1))


@pytest.mark.slow
def test_overlaps_before_and_after(shared: Path, tmp_path: Path) -> None:
    project = dmc_project(shared, tmp_path / "plain")
    before, _, _ = overlaps(project)
    assert np.abs(before.mean(axis=0) - [35.4, 37.2, 32.0]).max() < 0.5
    shutil.copytree(project.parent, tmp_path / "even")
    found = balance_project(BalanceRequest(tmp_path / "even" / "project.toml", workers=2))
    after, own, clipped = overlaps(tmp_path / "even" / "project.toml")
    assert (after.mean(axis=0) < 0.4 * before.mean(axis=0)).all()
    # Nor would a table for each pair of images alone reach it: what differs is not of grey values.
    assert (own.mean(axis=0)[:2] > 10.5).all() and (own.mean(axis=0) > 0.93 * after.mean(axis=0)).all()
    assert max(clipped) <= 0.005
    assert found.balanced is not None and np.abs(np.array(found.balanced.contrast) - 1).max() < 0.05


@pytest.mark.slow
@pytest.mark.xfail(strict=True, reason="12.4, 12.1, 9.3 since slopes of the block are held: missed, see docs/status.md")
def test_overlaps_after_are_those_of_tables_without_a_prior(shared: Path, tmp_path: Path) -> None:
    """10 in every band were asked, 11.9, 11.5 and 9.3 were reached when slopes of the whole block were free."""
    project = dmc_project(shared, tmp_path / "even")
    balance_project(BalanceRequest(project, workers=2))
    assert (overlaps(project)[0].mean(axis=0) <= [11.9, 11.5, 9.3]).all()


@pytest.mark.slow
def test_balanced_colours_are_nearer_to_those_of_a_satellite(shared: Path, tmp_path: Path) -> None:
    """Independent of all that was adjusted."""
    satellite = shared / "data" / "ngi_dmc" / "ref" / "sentinel2_b432_byte.tif"
    project = dmc_project(shared, tmp_path / "plain")
    plain = beside_satellite(project, satellite)
    balance_project(BalanceRequest(project, workers=2))
    even = beside_satellite(project, satellite)
    print(plain, even)
    assert (even < 0.95 * plain).all()
