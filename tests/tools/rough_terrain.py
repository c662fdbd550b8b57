"""Terrain of which nothing is stationary or smooth, made without the covariance functions of linear prediction."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

__all__ = ["Ground", "bench_edges", "benches", "fractal", "sampled"]

Ground = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Heights of places (n, 2)."""


def fractal(slope: float, nodes: int, seed: int, step: float = 1.0) -> Ground:
    """A surface whose spectrum falls with the wave number to the power of −slope, with slopes of one in ten or so.

    The field is drawn at nodes `step` apart and linear between them; differences over ten nodes have the standard
    deviation of one node's spacing.
    """
    k = np.hypot(np.fft.fftfreq(nodes)[:, None], np.fft.rfftfreq(nodes)[None])
    k[0, 0] = np.inf
    white = np.fft.rfft2(np.random.default_rng(seed).normal(size=(nodes, nodes)))
    field = np.fft.irfft2(white * k ** (-slope / 2), s=(nodes, nodes))
    field *= step / np.std(field[10:] - field[:-10])
    return lambda xy: np.asarray(map_coordinates(field, [xy[:, 1] / step, xy[:, 0] / step], order=1, mode="nearest"))


def benches(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Terraces of 6 m, 1 m above each other, with slopes of 1.5 m width, in a field of 60 m."""
    bench, part = np.divmod(xy[:, 0] / 7.5, 1.0)
    return np.asarray(100 + bench + 0.2 * np.sin(xy[:, 1] / 6) + np.maximum(part - 0.8, 0) / 0.2)


def bench_edges() -> list[NDArray[np.float64]]:
    """Upper and lower edges of the benches, vertices 2 m apart."""
    y = np.linspace(0, 60, 31)
    edges = []
    for x in np.sort(np.concatenate([7.5 * np.arange(8) + 6.0, 7.5 * np.arange(1, 8)])):
        xy = np.column_stack([np.full(31, x), y])
        edges.append(np.column_stack([xy, benches(xy - [1e-9, 0])]))
    return edges


def sampled(ground: Ground, xy: NDArray[np.float64], noise: float, seed: int) -> NDArray[np.float64]:
    """Measured points, shape (n, 3)."""
    return np.column_stack([xy, ground(xy) + np.random.default_rng(seed).normal(0, noise, len(xy))])
