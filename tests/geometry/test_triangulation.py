"""The adapter to the constrained triangulation."""

import numpy as np
import pytest

from photoplan.errors import GeometryError
from photoplan.surfaces.mesh import constrained_faces


def area(xy, faces):
    a, b, c = xy[faces[:, 0]], xy[faces[:, 1]], xy[faces[:, 2]]
    return ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2


def test_fills_the_hull_counter_clockwise_and_keeps_edges():
    rng = np.random.default_rng(3)
    xy = np.vstack([[[0, 0], [1, 0], [1, 1], [0, 1]], [[0.1, 0.5], [0.9, 0.5], [0.5, 0.1]], rng.random((200, 2))])
    xy += [2.1e7, 6.7e6]
    faces = constrained_faces(xy, np.array([[4, 5], [0, 6]]))
    areas = area(xy - xy[0], faces)
    assert (areas > 0).all()
    assert areas.sum() == pytest.approx(1, abs=1e-6)
    sides = {tuple(sorted(s)) for f in faces.tolist() for s in ((f[0], f[1]), (f[1], f[2]), (f[2], f[0]))}
    assert {(4, 5), (0, 6)} <= sides


@pytest.mark.parametrize(
    "xy, edges, words",
    [
        ([[0, 0], [1, 1], [0, 1], [1, 0]], [[0, 1], [2, 3]], "cross"),
        ([[0, 0], [1, 1], [0, 0]], [], "two points at one place"),
        ([[0, 0], [1, np.nan], [0, 1]], [], "not finite"),
        ([[0, 0], [1, 1], [0, 1]], [[1, 1]], "begins and ends"),
    ],
)
def test_what_cannot_be_triangulated_is_named(xy, edges, words):
    with pytest.raises(GeometryError, match=words):
        constrained_faces(np.array(xy, float), np.array(edges, int).reshape(-1, 2))


def test_points_on_one_line_have_no_triangles():
    assert len(constrained_faces(np.array([[0.0, 0], [1, 1], [2, 2]]), np.empty((0, 2), int))) == 0
