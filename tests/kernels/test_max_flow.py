"""Least cuts against the largest flow that SciPy finds."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_flow

from photoplan.kernels.graph_cut import SINK, minimum_cut
from photoplan.kernels.jit import COMPILED

STEP = ((0, 1), (0, -1), (1, 0), (-1, 0))


def random_grid(rng: np.random.Generator, rows: int, cols: int, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Edges and ends with their rim."""
    edges, ends = np.zeros((4, rows + 2, cols + 2), np.int32), np.zeros((rows + 2, cols + 2), np.int32)
    ends[1:-1, 1:-1] = rng.integers(-most, most + 1, (rows, cols))
    for way, (down, right) in enumerate(STEP):
        for r, c in product(range(1, rows + 1), range(1, cols + 1)):
            if 1 <= r + down <= rows and 1 <= c + right <= cols:
                edges[way, r, c] = rng.integers(0, most)
    return edges.reshape(4, -1), ends.ravel()


def cut_cost(edges: np.ndarray, ends: np.ndarray, sink: np.ndarray, width: int) -> int:
    total = int(ends[(ends > 0) & sink].sum() - ends[(ends < 0) & ~sink].sum())
    for way, (down, right) in enumerate(STEP):
        other = np.roll(sink, -(down * width + right))
        total += int(edges[way][~sink & other].sum())
    return total


@pytest.mark.parametrize("most", [2, 9])
def test_cut_costs_what_the_largest_flow_of_scipy_is(most: int) -> None:
    rng = np.random.default_rng(most)
    for _ in range(40 if COMPILED else 5):
        rows, cols = rng.integers(1, 14, 2).tolist()
        edges, ends = random_grid(rng, rows, cols, most)
        width, n = cols + 2, (rows + 2) * (cols + 2)
        table = np.zeros((n + 2, n + 2), np.int32)
        for way, (down, right) in enumerate(STEP):
            (at,) = np.nonzero(edges[way])
            table[at, at + down * width + right] = edges[way][at]
        table[n, :n], table[:n, n + 1] = np.maximum(ends, 0), np.maximum(-ends, 0)
        tree = np.zeros(n, np.int8)
        minimum_cut(edges.copy(), ends.copy(), width, tree)
        assert cut_cost(edges, ends, tree == SINK, width) == maximum_flow(csr_array(table), n, n + 1).flow_value
