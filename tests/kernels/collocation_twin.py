"""Linear prediction as the textbooks write it: dense matrices, numpy, one target after the other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.prediction import EXPONENTIAL, GAUSSIAN

_MATERN = 1.6783469900166605


def covariance(d: NDArray[np.float64], family: int) -> NDArray[np.float64]:
    """Correlation at distances in half-value distances."""
    if family == GAUSSIAN:
        return 0.5 ** (d**2)
    if family == EXPONENTIAL:
        return 0.5**d
    return (1 + _MATERN * d) * np.exp(-_MATERN * d)


def side(xy: NDArray[np.float64], line: NDArray[np.float64]) -> NDArray[np.float64]:
    """sin(θ/2), θ being the sum of the angles that the segments subtend."""
    to = line[None] - xy[:, None]
    heading = np.arctan2(to[..., 1], to[..., 0])
    alpha = np.mod(np.diff(heading, axis=1) + np.pi, 2 * np.pi) - np.pi
    return np.sin(alpha.sum(axis=1) / 2)


def places(xy: NDArray[np.float64], lines: list[NDArray[np.float64]], length: float, gap: float) -> NDArray[np.float64]:
    """Coordinates whose distances a covariance function takes: on the map, and one for each line."""
    return np.column_stack([xy / length, *(side(xy, line) * gap / 2 for line in lines)])


def distances(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.sqrt(((a[:, None] - b[None]) ** 2).sum(axis=2))


def collocation(
    xyz: NDArray[np.float64],
    noise: NDArray[np.float64],
    targets: NDArray[np.float64],
    model: tuple[int, float, float, float],
    lines: list[NDArray[np.float64]],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Predicted heights and their variances, the plane of the trend estimated by generalised least squares."""
    family, variance, length, gap = model
    data, there = places(xyz[:, :2], lines, length, gap), places(targets, lines, length, gap)
    inverse = np.linalg.inv(variance * covariance(distances(data, data), family) + np.diag(noise))
    c = variance * covariance(distances(data, there), family)
    A, A0 = np.c_[np.ones(len(data)), data[:, :2]], np.c_[np.ones(len(there)), there[:, :2]]
    N = np.linalg.inv(A.T @ inverse @ A)
    beta = N @ A.T @ inverse @ xyz[:, 2]
    heights = A0 @ beta + c.T @ inverse @ (xyz[:, 2] - A @ beta)
    rest = A0 - c.T @ inverse @ A
    variances = variance - np.einsum("ij,ik,kj->j", c, inverse, c) + np.einsum("ij,jk,ik->i", rest, N, rest)
    return heights, variances


def stacked(lines: list[NDArray[np.float64]]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Lines as the kernels take them: vertices and beginnings."""
    start = np.concatenate([[0], np.cumsum([len(line) for line in lines])]).astype(np.int64)
    return np.vstack([np.empty((0, 2)), *lines]), start
