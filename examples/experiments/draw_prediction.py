"""Draws the figure of the page on linear prediction."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from photoplan.kernels.jit import kernel
from photoplan.kernels.prediction import EXPONENTIAL, GAUSSIAN, MATERN, correlation

FAMILIES = {"gaussian": GAUSSIAN, "matern": MATERN, "exponential": EXPONENTIAL}
COLOURS = {"gaussian": "#4477aa", "matern": "#228833", "exponential": "#cc3311"}
#: Six measured points of a profile, metres; standard deviation of the signal, half-value distance, filter value.
POINTS = np.array([(2.0, 0.2), (5.0, 0.9), (7.0, 1.1), (9.0, 0.3), (15.0, -0.2), (19.0, 0.5)])
SIGNAL, HALF, FILTER = 0.7, 2.5, 0.08


@kernel
def correlations(d2: NDArray[np.float64], family: int) -> NDArray[np.float64]:
    """Correlation at each squared distance, in half-value distances."""
    found = np.empty(d2.size)
    for i in range(d2.size):
        found[i] = correlation(d2.flat[i], family)
    return found.reshape(d2.shape)


def covariance(a: NDArray[np.float64], b: NDArray[np.float64], family: int) -> NDArray[np.float64]:
    """Covariances of the signal between two sets of places on a profile."""
    d2 = ((a[:, None] - b[None]) / HALF) ** 2
    return SIGNAL**2 * correlations(d2, family)


def predict(x: NDArray[np.float64], family: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Heights and standard deviations at `x`, with the mean as the trend."""
    at, z = POINTS.T
    C = covariance(at, at, family) + FILTER**2 * np.eye(len(at))
    c = covariance(at, x, family)
    ones = np.ones(len(at))
    weight = ones @ np.linalg.solve(C, ones)
    mean = ones @ np.linalg.solve(C, z) / weight
    solved = np.linalg.solve(C, c)
    variance = SIGNAL**2 - (c * solved).sum(axis=0) + (1 - ones @ solved) ** 2 / weight
    return mean + solved.T @ (z - mean), np.sqrt(variance)


def draw_prediction(steps: int = 401) -> Figure:
    """Correlation functions of the three families, and their prediction of the same points."""
    fig = Figure(figsize=(9.5, 3.6), dpi=130, layout="constrained")
    left, right = fig.subplots(1, 2, width_ratios=(1, 1.9))
    d = np.linspace(0, 3.5, steps)
    x = np.linspace(0, 21, steps)
    for name, family in FAMILIES.items():
        left.plot(d, correlations(d**2, family), color=COLOURS[name], label=name)
        z, sigma = predict(x, family)
        right.plot(x, z, color=COLOURS[name])
        if name == "matern":
            right.fill_between(x, z - sigma, z + sigma, color=COLOURS[name], alpha=0.13, lw=0, label="± σ, matern")
    left.plot([1], [0.5], "o", mfc="white", mec="black", zorder=5)
    left.annotate("half-value distance", (1, 0.5), (6, 4), textcoords="offset points")
    left.set(title="correlation", xlabel="distance in half-value distances", ylim=(0, 1.03), xlim=(0, 3.5))
    left.legend(loc="upper right")
    points = {"yerr": FILTER, "fmt": "o", "color": "black", "ms": 4, "capsize": 2, "zorder": 5}
    right.errorbar(*POINTS.T, **points, label="points ± filter value")
    right.set(title="prediction of six points", xlabel="m", ylabel="height, m", xlim=(0, 21))
    right.legend(loc="upper right")
    return fig
