"""Upstream areas, flow lengths and catchments that geometry knows."""

from __future__ import annotations

import numpy as np
import pytest

from photoplan.errors import InputError, UsageError
from photoplan.terrain.analysis import flow_of, snapped

#: Directions, of eight from east by north.
EAST, SOUTH_EAST = 0, 7


def grid(rows, columns):
    j, i = np.mgrid[:rows, :columns].astype(float)
    return j, i


def test_tilted_plane():
    _, i = grid(30, 50)
    flow = flow_of((100 - 0.2 * i).astype(np.float32), 2.0)
    np.testing.assert_allclose(flow.area, (i + 1) * 4.0)
    np.testing.assert_allclose(flow.length, (49 - i) * 2.0, rtol=1e-6)
    np.testing.assert_allclose(flow.longest, i * 2.0, rtol=1e-6)
    assert (flow.direction[:, :-1] == EAST).all() and (flow.direction[:, -1] == -1).all()
    np.testing.assert_array_equal(flow.leaves, i == 49)


def test_diagonal_plane_flows_along_the_diagonal():
    j, i = grid(20, 20)
    flow = flow_of((100 - i - j).astype(np.float32), 3.0)
    assert (flow.direction[:-1, :-1] == SOUTH_EAST).all()
    assert flow.length[0, 0] == pytest.approx(19 * 3 * np.sqrt(2), rel=1e-6)


@pytest.mark.parametrize("method", ["d8", "dinf"])
def test_v_valley(method):
    """Sides fall straight to the axis, the axis to the west: areas and lengths follow."""
    j, i = grid(41, 60)
    z = np.abs(j - 20) * 5.0 + i * 0.1
    flow = flow_of(z.astype(np.float32), 10.0, method=method)
    rel = 1e-9 if method == "d8" else 0.03
    np.testing.assert_allclose(flow.area[20], (60 - i[20]) * 41 * 100.0, rtol=rel, atol=0 if method == "d8" else 1e3)
    np.testing.assert_allclose(flow.length, (np.abs(j - 20) + i) * 10, rtol=1e-5)
    assert flow.longest[20, 0] == pytest.approx((59 + 20) * 10, rel=1e-6)


def test_cone():
    """Water of a cone runs down radially: through a piece of contour w at radius r comes r w / 2.

    A way that turns by θ from the nearest axis takes one cell for 1 / cos θ of its length, so w = cos θ.
    """
    j, i = grid(121, 121)
    r = np.hypot(j - 60, i - 60)
    z = np.where(r <= 58, 100 - r, np.nan).astype(np.float32)
    split, single = (flow_of(z, 1.0, method=method) for method in ("dinf", "d8"))
    ring = (r > 20) & (r < 50)
    width = np.maximum(np.abs(j - 60), np.abs(i - 60)) / np.maximum(r, 1)
    ratio = split.area[ring] / (r * width / 2)[ring]
    assert np.median(ratio) == pytest.approx(1, abs=0.02) and ratio.std() < 0.15
    for flow in (split, single):
        assert flow.area[flow.leaves].sum() == pytest.approx(np.isfinite(z).sum())
    # A way in eight directions misses the fall by up to 22.5° and is up to a fifth longer than the straight one.
    inner = (r > 5) & (r < 15)
    run = single.length[inner] / (58 - r[inner])
    assert run.min() > 0.98 and 1.05 < run.max() < 1.2


def test_pits_are_filled_and_passed():
    j, i = grid(21, 40)
    z = 100 - 1.0 * i + 0.3 * np.abs(j - 10)
    z[8:13, 15:20] -= 30
    flow = flow_of(z.astype(np.float32), 1.0)
    lowest_pass = 100 - 20.0
    assert flow.filled[10, 17] == pytest.approx(lowest_pass) and flow.filled[10, 5] == pytest.approx(95)
    assert flow.area[10, 39] == pytest.approx(flow.area[flow.leaves].max())
    assert flow.area[flow.leaves].sum() == pytest.approx(z.size)
    assert (flow.direction[8:13, 15:20] >= 0).all()


def test_plains_drain_on_short_ways():
    flow = flow_of(np.full((31, 31), 5, np.float32), 1.0)
    j, i = grid(31, 31)
    edge = np.minimum.reduce([j, i, 30 - j, 30 - i])
    assert (flow.length <= edge * np.sqrt(2) + 1e-4).all() and flow.area[flow.leaves].sum() == 961


def test_catchments_of_outlets_share_the_area():
    rng = np.random.default_rng(4)
    j, i = grid(60, 80)
    z = (np.abs(j - 30) * 2.0 + i + rng.normal(0, 0.4, (60, 80))).astype(np.float32)
    z[5:9, 50:60] = np.nan
    first = flow_of(z, 5.0)
    below = snapped(first.area, 30, 5, 3)
    above = snapped(first.area, 30, 40, 3)
    flow = flow_of(z, 5.0, [below, above])
    own = [(flow.catchment == k).sum() * 25.0 for k in (1, 2)]
    assert own[1] == pytest.approx(flow.area[above])
    assert own[0] == pytest.approx(flow.area[below] - flow.area[above]), "what the upper one has is not counted twice"
    assert flow.length[below] == 0 and flow.length[above] == 0
    assert (flow.catchment[np.isnan(z)] == -1).all() and (flow.catchment == 0).any()
    everywhere = flow_of(z, 5.0)
    sizes = np.bincount(everywhere.catchment[~np.isnan(z)])
    assert sizes[0] == 0 and len(sizes) - 1 == everywhere.leaves.sum()
    for row, column in zip(*np.nonzero(everywhere.leaves)):
        number = everywhere.catchment[row, column]
        assert sizes[number] * 25.0 == pytest.approx(everywhere.area[row, column])


def test_wrong_use():
    z = np.zeros((4, 4), np.float32)
    with pytest.raises(UsageError, match="method"):
        flow_of(z, 1.0, method="d4")
    with pytest.raises(InputError, match="no terrain"):
        flow_of(np.full((4, 4), np.nan, np.float32), 1.0)
    with pytest.raises(InputError, match="one cell"):
        flow_of(z, 1.0, [(1, 1), (1, 1)])
    with pytest.raises(InputError, match="outlet 1"):
        flow_of(z, 1.0, [(5, 1)])
