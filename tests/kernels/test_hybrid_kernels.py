"""Triangles scanned line by line against a plain search of the triangle under each pixel."""

from __future__ import annotations

import numpy as np
import pytest

from photoplan.kernels.terrain import sample_hybrid, sample_lattice, scan_faces

FRAME = (100.0, 200.0, 0.5)


def some_faces(n: int, rng: np.random.Generator, part: float):
    """Some meshes of n × n cut into four triangles at a point inside."""
    vertices, corners, start = [], [], [0]
    for r in range(n):
        for c in range(n):
            if rng.random() < part:
                first = len(vertices)
                inside = (c + rng.uniform(0.2, 0.8), r + rng.uniform(0.2, 0.8))
                for x, y in ((c, r), (c, r + 1), (c + 1, r + 1), (c + 1, r), inside):
                    vertices.append((100 + 2 * x, 200 - 2 * y, height(100 + 2 * x, 200 - 2 * y)))
                corners += [(first + i, first + (i + 1) % 4, first + 4) for i in range(4)]
            start.append(len(corners))
    return np.array(vertices).reshape(-1, 3), np.array(corners, np.int32).reshape(-1, 3), np.array(start, np.int64)


def height(X, Y):
    return 3.0 + 0.5 * (X - 100) - 0.25 * (Y - 200)


def naive(vertices, corners, X: float, Y: float) -> float:
    for a, b, c in vertices[corners]:
        matrix = np.array([[a[0], b[0], c[0]], [a[1], b[1], c[1]], [1, 1, 1]])
        weights = np.linalg.solve(matrix, [X, Y, 1])
        if (weights >= -1e-9).all():
            return float(weights @ [a[2] + a[3], b[2] + b[3], c[2] + c[3]])
    return np.nan


@pytest.mark.parametrize("step", [0.13, 0.25, 0.5, 1.0])
@pytest.mark.parametrize("part", [0.4, 1.0])
def test_scan_and_search_agree(step: float, part: float) -> None:
    n = 3
    rng = np.random.default_rng(int(step * 100 + part * 10))
    vertices, corners, start = some_faces(n, rng, part)
    bump = rng.uniform(0, 1, len(vertices)) * (np.arange(len(vertices)) % 5 == 4)  # middles leave the plane
    values = vertices[:, 2] + bump
    posts = height(*np.meshgrid(100 + 2 * np.arange(n + 1.0), 200 - 2 * np.arange(n + 1.0))).astype(np.float32)
    # Pixel centres on edges and posts with steps of 1/4, 1/2 and 1.
    count = int(n / step) + 1
    result = sample_lattice(posts, 0.0, step, count, 0.0, step, count)
    plain = result.copy()
    frame = (*FRAME, n)
    faces = (np.column_stack([vertices[:, :2], values]), corners, start)
    scan_faces(result, (0.0, step, 0.0, step), frame, *faces)
    at = np.arange(count) * step
    xy = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)
    single = np.empty(len(xy))
    sample_hybrid(posts, *faces, frame, xy, single)
    np.testing.assert_allclose(result.reshape(-1), single, atol=1e-5)
    assert np.isfinite(result).all()
    raised = np.column_stack([vertices, bump])
    slow = np.array([naive(raised, corners, 100 + 2 * x, 200 - 2 * y) for x, y in xy])
    np.testing.assert_allclose(single, np.where(np.isnan(slow), plain.reshape(-1), slow), atol=1e-5)


def test_where_triangles_leave_a_gap_there_is_no_value() -> None:
    vertices = np.array([(100.0, 200.0, 1.0), (100.0, 198.0, 1.0), (102.0, 198.0, 1.0)])
    corners, start = np.array([[0, 1, 2]], np.int32), np.array([0, 1], np.int64)
    posts = np.zeros((2, 2), np.float32)
    xy = np.array([(0.2, 0.8), (0.8, 0.2), (0.5, 0.5), (1.0, 0.5)])
    result = np.empty(4)
    sample_hybrid(posts, vertices, corners, start, (*FRAME, 1), xy, result)
    np.testing.assert_array_equal(result, [1, np.nan, 1, np.nan])
