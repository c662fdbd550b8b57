"""Patterns formed with a known transfer function: bars by their Fourier series, stars and charts by oversampling."""

from __future__ import annotations

from math import pi

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.special import erf

from photoplan.quality.patterns.usaf import usaf_layout


def gauss_box(sigma):
    """MTF of a Gaussian of a standard deviation in pixels and a square pixel: a function of fx and fy."""

    def transfer(fx, fy=0.0):
        fx, fy = np.asarray(fx, float), np.asarray(fy, float)
        return np.exp(-2 * pi**2 * sigma**2 * (fx**2 + fy**2)) * np.sinc(fx) * np.sinc(fy)

    return transfer


def bars(shape, frequency, angle_deg, sigma=0.6, phase=0.1, duty=0.5, low=40.0, high=200.0):
    """Bars of levels low and high: exact pixels, the middle of a bright bar `phase` periods off the centre."""
    angle = np.deg2rad(angle_deg)
    fx, fy = frequency * np.cos(angle), frequency * np.sin(angle)
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    turn = fx * (x - (shape[1] - 1) / 2) + fy * (y - (shape[0] - 1) / 2) - phase
    transfer = gauss_box(sigma)
    value = np.full(shape, low + duty * (high - low))
    for k in range(1, 60):
        size = (high - low) * 2 / (pi * k) * np.sin(pi * k * duty) * transfer(k * fx, k * fy)
        if k * frequency > 6:
            break
        value += size * np.cos(2 * pi * k * turn)
    return value


def formed(draw, shape, sigma, over=6):
    """An object given at points (x, y), blurred by a Gaussian and summed over square pixels."""
    step = (np.arange(over) + 0.5) / over - 0.5
    x = (np.arange(shape[1])[:, None] + step).ravel()
    y = (np.arange(shape[0])[:, None] + step).ravel()
    fine = draw(x[None, :], y[:, None])
    if sigma:
        fine = gaussian_filter(fine, sigma * over, mode="nearest", truncate=6)
    return fine.reshape(shape[0], over, shape[1], over).mean((1, 3))


def star(shape, centre, sectors, sigma=0.6, turn=0.3, low=40.0, high=200.0, radius=None, sine=False, over=6):
    """A Siemens star with so many bright sectors; grey beyond the radius."""
    radius = radius if radius is not None else min(shape) / 2 - 4

    def draw(x, y):
        angle = np.arctan2(y - centre[1], x - centre[0])
        wave = np.cos(sectors * angle - turn)
        # The edge of a sector goes through fine points: the share of the point that it covers.
        r = np.hypot(x - centre[0], y - centre[1])
        share = (wave + 1) / 2 if sine else np.clip(0.5 + wave * r * over / sectors, 0, 1)
        return np.where(r <= radius, low + (high - low) * share, (low + high) / 2)

    return formed(draw, shape, sigma, over)


def box_edge(u, sigma):
    """A bright half u > 0 blurred by a Gaussian and a pixel, exact."""

    def integral(t):
        s = max(sigma, 1e-9)
        return t * 0.5 * (1 + erf(t / s / np.sqrt(2))) + s / np.sqrt(2 * pi) * np.exp(-(t**2) / (2 * s**2))

    return integral(u + 0.5) - integral(u - 0.5)


def rectangle(shape, x0, y0, x1, y1, sigma):
    """Share of each pixel in a bright rectangle with sides along the pixels, blurred: exact."""
    x, y = np.arange(shape[1]), np.arange(shape[0])
    across = box_edge(x - x0, sigma) - box_edge(x - x1, sigma)
    down = box_edge(y - y0, sigma) - box_edge(y - y1, sigma)
    return np.outer(down, across)


def usaf_chart(shape, scale, origin, sigma=0.7, turn=0.0, mirrored=False, low=30.0, high=200.0, groups=6, over=6):
    """A USAF-1951 target: `scale` pixels a period of its first element, its centre at `origin`."""
    c, s = np.cos(turn), np.sin(turn)
    matrix = scale * np.array([[c, -s], [s, c]]) @ np.diag([-1.0 if mirrored else 1.0, 1.0])
    inverse = np.linalg.inv(matrix)

    def draw(x, y):
        bright = np.zeros((y.size, x.size), bool)
        for item in usaf_layout(groups):
            middle, reach = matrix @ [item.x, item.y] + origin, 1.8 * scale * item.period
            rows = slice(*np.searchsorted(y[:, 0], [middle[1] - reach, middle[1] + reach]))
            columns = slice(*np.searchsorted(x[0], [middle[0] - reach, middle[0] + reach]))
            dx, dy = x[:, columns] - middle[0], y[rows] - middle[1]
            across, along = (inverse[k, 0] * dx + inverse[k, 1] * dy for k in (0, 1))
            across, along = across / item.period, along / item.period
            if item.horizontal:
                across, along = along, across
            inside = (np.abs(across) <= 1.25) & (np.abs(along) <= 1.25)
            bright[rows, columns] |= inside & (np.abs(across - np.round(across)) <= 0.25)
        return low + (high - low) * bright

    return formed(draw, shape, sigma, over)


def three_bars(period, sigma):
    """Contrast of three long bars along the pixels: mean of their middles less mean of the gaps' middles, exact."""

    def profile(t):
        return sum(
            box_edge(t - (k - 0.25) * period, sigma) - box_edge(t - (k + 0.25) * period, sigma) for k in (-1, 0, 1)
        )

    return float(
        np.mean([profile(k * period) for k in (-1, 0, 1)]) - np.mean([profile(k * period) for k in (-0.5, 0.5)])
    )
