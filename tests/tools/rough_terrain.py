"""Terrain of which nothing is stationary or smooth, made without the covariance functions of linear prediction."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

__all__ = ["Ground", "bench_edges", "benches", "dunes", "fractal", "ridged", "sampled"]

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


def _smooth(wave: float, seed: int) -> Ground:
    """A random surface of standard deviation 0.6 or so with waves of about twice this length, smooth, in 400 m."""
    field = np.random.default_rng(seed).normal(size=(int(400 / wave) + 8,) * 2)
    return lambda xy: np.asarray(map_coordinates(field, [xy[:, 1] / wave + 3, xy[:, 0] / wave + 3], order=3))


def ridged(seed: int) -> Ground:
    """Sharp crests 20 m high, 1 − |noise| in three octaves, in a field of 400 m."""
    parts = [(0.4**k, _smooth(120 / 2**k, 100 * seed + k)) for k in range(3)]
    return lambda xy: np.asarray(20 * sum(part * (1 - np.abs(noise(xy))) for part, noise in parts))


def dunes(seed: int) -> Ground:
    """Waves 8 m high and 60 m long that fall three times as steeply as they rise, in a field of 400 m."""
    bend, high, small = _smooth(80, seed + 1), _smooth(100, seed + 2), _smooth(25, seed + 3)

    def heights(xy: NDArray[np.float64]) -> NDArray[np.float64]:
        along = (xy[:, 0] + 0.3 * xy[:, 1] + 12 * bend(xy)) / 60 % 1.0
        shape = np.where(along < 0.75, along / 0.75, (1 - along) / 0.25)
        return np.asarray(8 * shape * (1 + 0.3 * high(xy)) + 0.3 * small(xy))

    return heights


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
