"""Scenes with straight edges of known sharpness: half planes and polygons seen through Gaussian optics and pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import ndtr

Array = NDArray[np.float64]


def mtf50_of(sigma: float, angle_deg: float = 0.0) -> float:
    """Frequency at half modulation of a Gaussian and a square pixel, cycles per pixel along the edge's normal."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return float(
        brentq(lambda f: np.exp(-2 * (np.pi * sigma * f) ** 2) * np.sinc(f * c) * np.sinc(f * s) - 0.5, 1e-3, 1.5)
    )


def half_plane(size: tuple[int, int], at: tuple[float, float], angle_deg: float, sigma: float) -> Array:
    """Share of light, 0 to 1, (rows, columns): brightness rises through `at` in a direction, 0 = to the right.

    The pixel is integrated by 7 × 7 points, the Gaussian in closed form.
    """
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    away = (np.arange(size[0]) - at[0]) * c + (np.arange(size[1])[:, None] - at[1]) * s
    total = (away > 0).astype(float)
    # Farther away it is as dark or as bright as it becomes.
    near = np.abs(away) < 1.0 + 9.0 * sigma
    steps, weights = np.polynomial.legendre.leggauss(7)
    total[near] = sum(
        wx * wy * ndtr((away[near] + dx * c + dy * s) / sigma)
        for dx, wx in zip(steps / 2, weights / 2)
        for dy, wy in zip(steps / 2, weights / 2)
    )
    return total


def blocks(size: tuple[int, int], angle_deg: float, sigma: float, seed: int, pitch: int = 110) -> Array:
    """A field of turned rectangles of several brightnesses on an even ground, 0 to 1, (rows, columns)."""
    rng = np.random.default_rng(seed)
    scene = np.full((size[1], size[0]), 0.25)
    for row in range(pitch // 2, size[1], pitch):
        for col in range(pitch // 2, size[0], pitch):
            half = rng.uniform(26, 34, 2)
            turn = angle_deg + rng.uniform(-6, 6)
            centre = np.array([col, row]) + rng.uniform(-4, 4, 2)
            level = rng.uniform(0.55, 0.85)
            left, top = max(0, col - pitch // 2), max(0, row - pitch // 2)
            window = (slice(top, row + pitch // 2), slice(left, col + pitch // 2))
            part = scene[window]
            shape = (part.shape[1], part.shape[0])
            share = np.ones_like(part)
            for k, reach in enumerate((half[0], half[1], half[0], half[1])):
                way = np.radians(turn + 90 * k)
                foot = centre - (left, top) + reach * np.array([np.cos(way), np.sin(way)])
                share *= half_plane(shape, (float(foot[0]), float(foot[1])), turn + 90 * k + 180, sigma)
            scene[window] += share * (level - 0.25)
    return scene


def noisy(scene: Array, snr: float, seed: int, dtype: str = "uint8", contrast: float = 0.5) -> NDArray[np.generic]:
    """The scene as pixels of a type with noise: a contrast over `snr`; integers use nearly their whole range."""
    rng = np.random.default_rng(seed)
    light = scene + rng.normal(0, contrast / snr, scene.shape)
    if dtype == "float32":
        return light.astype(np.float32)
    top = {"uint8": 255, "uint12": 4095, "uint16": 65535, "int16": 32767}[dtype]
    values = np.round(np.clip(light, 0.02, 0.98) * top)
    return values.astype("uint16" if dtype == "uint12" else dtype)
