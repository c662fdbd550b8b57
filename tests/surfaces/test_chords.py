"""Long rays onto terrain of another CRS: straight pieces, and by how much they leave the ray."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from pyproj import Transformer

from photoplan.surfaces.base import STRAIGHT, chords

#: Curvature of the earth less that of a line of sight, per metre.
BEND = -6.8e-8


@pytest.mark.parametrize("crs", ["EPSG:25833", "EPSG:4258", "EPSG:3035"])
@pytest.mark.parametrize("bend", [0.0, BEND])
def test_no_piece_leaves_a_ray_by_more_than_a_quarter_of_the_bound(crs: str, bend: float) -> None:
    """30 km in Norway; pieces of 200 m left the rays by up to 2.1 mm where the grid is one of degrees."""
    to = Transformer.from_crs("EPSG:25832", crs, always_xy=True)

    def carry(XYZ: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack([*to.transform(XYZ[..., 0], XYZ[..., 1]), XYZ[..., 2]], axis=-1)

    angle = np.linspace(0.0, 2 * np.pi, 7)[:-1]
    start = np.broadcast_to([600_000.0, 7_600_000.0, 3000.0], (6, 3))
    end = start + np.stack([30_000 * np.cos(angle), 30_000 * np.sin(angle), np.full(6, -2900.0)], axis=1)
    paths = np.stack([start, end], axis=1)
    fine, carried = chords(paths, bend, carry)
    part = np.linspace(0, 1, 9)[1:-1, None, None, None]
    away = np.linalg.norm(fine[:, :, :2] - start[:, None, :2], axis=-1)
    strict = fine[:, :-1] + part * np.diff(fine, axis=1)
    between = away[:, :-1] + part[..., 0] * np.diff(away, axis=1)
    slope = -2900.0 / 30_000
    strict[..., 2] = 3000.0 + slope * between + bend * between**2
    on_chord = carried[:, :-1] + part * np.diff(carried, axis=1)
    there = carry(strict)
    metres = np.stack([carry(strict + step)[..., :2] - there[..., :2] for step in np.eye(3)[:2]], axis=-1)
    off = on_chord - there
    off[..., :2] = np.linalg.solve(metres, off[..., :2, None])[..., 0]
    assert 0.01 * STRAIGHT < np.linalg.norm(off, axis=-1).max() <= 0.3 * STRAIGHT


def test_rays_without_a_place_there_do_not_matter() -> None:
    paths = np.full((2, 2, 3), np.nan)
    paths[0] = [(0, 0, 10), (3000, 0, 0)]
    fine, carried = chords(paths, 0.0, lambda XYZ: XYZ * 2)
    np.testing.assert_allclose(carried, 2 * fine)
    assert fine.shape == (2, 3, 3)
