"""Rational polynomial coefficients that stand for a frame camera, so that programs without one can be compared."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rasterio.rpc import RPC

from photoplan.cameras.base import Camera, project

_ROUNDS = 8  # of the weighting by the denominator; it stands still after three


@dataclass(frozen=True)
class FittedRpc:
    """Coefficients, and what they leave of the camera at points between those of the fit."""

    rpc: RPC
    worst: float
    """Largest residual of a check point, pixels."""


def terms(P: NDArray[np.float64], L: NDArray[np.float64], H: NDArray[np.float64]) -> NDArray[np.float64]:
    """The 20 monomials of latitude P, longitude L and height H in the order of RPC00B, shape (n, 20)."""
    one = np.ones_like(P)
    cubes = [P * L * H, L**3, L * P**2, L * H**2, L**2 * P, P**3, P * H**2, L**2 * H, P**2 * H, H**3]
    return np.stack([one, L, P, H, L * P, L * H, P * H, L**2, P**2, H**2, *cubes], axis=-1)


def _quotient(T: NDArray[np.float64], v: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Numerator and denominator (first coefficient 1) with v ≈ (T num) / (T den), by reweighted least squares."""
    weight = np.ones(len(v))
    solution = np.zeros(39)
    for _ in range(_ROUNDS):
        A = np.concatenate([T, -v[:, None] * T[:, 1:]], axis=1) * weight[:, None]
        solution = np.linalg.lstsq(A, v * weight, rcond=1e-13)[0]
        weight = 1 / (1 + T[:, 1:] @ solution[20:])
    return solution[:20], np.concatenate([[1.0], solution[20:]])


def _ground_grid(camera: Camera, heights: NDArray[np.float64], steps: int) -> NDArray[np.float64]:
    """Ground points (n, 3) seen by a regular grid of image points, on each of the level planes."""
    width, height = camera.size
    xy = np.stack(np.meshgrid(np.linspace(-0.5, width - 0.5, steps), np.linspace(-0.5, height - 0.5, steps)), axis=-1)
    planes = []
    for z in heights:
        origin, direction = camera.rays(xy.reshape(-1, 2), z)
        planes.append(origin + (z - origin[:, 2:]) / direction[:, 2:] * direction)
    return np.concatenate(planes)


def fit_rpc(
    camera: Camera,
    height_range: tuple[float, float],
    to_lonlat: Callable[[NDArray, NDArray], tuple[NDArray, NDArray]],
) -> FittedRpc:
    """Least-squares fit over the image's cone between two heights.

    Heights stay what they are: the terrain model must hold them in the same system.
    """
    low, high = height_range
    XYZ = _ground_grid(camera, np.linspace(low, high, 7), 15)
    lon, lat = to_lonlat(XYZ[:, 0], XYZ[:, 1])
    xy = project(camera, XYZ)
    columns = {"long": lon, "lat": lat, "height": XYZ[:, 2], "samp": xy[:, 0], "line": xy[:, 1]}
    offset = {k: float((v.max() + v.min()) / 2) for k, v in columns.items()}
    scale = {k: float((v.max() - v.min()) / 2) for k, v in columns.items()}
    n = {k: (v - offset[k]) / scale[k] for k, v in columns.items()}
    T = terms(n["lat"], n["long"], n["height"])
    fits = {k: _quotient(T, n[k]) for k in ("samp", "line")}

    # Points between those of the fit.
    check = _ground_grid(camera, np.linspace(low, high, 5), 22)
    lon, lat = to_lonlat(check[:, 0], check[:, 1])
    T = terms(*((v - offset[k]) / scale[k] for k, v in (("lat", lat), ("long", lon), ("height", check[:, 2]))))
    found = [T @ fits[k][0] / (T @ fits[k][1]) * scale[k] + offset[k] for k in ("samp", "line")]
    worst = float(np.abs(np.stack(found, axis=-1) - project(camera, check)).max())
    rpc = RPC(
        err_bias=0.0,
        err_rand=0.0,
        height_off=offset["height"],
        height_scale=scale["height"],
        lat_off=offset["lat"],
        lat_scale=scale["lat"],
        long_off=offset["long"],
        long_scale=scale["long"],
        line_off=offset["line"],
        line_scale=scale["line"],
        samp_off=offset["samp"],
        samp_scale=scale["samp"],
        line_num_coeff=fits["line"][0].tolist(),
        line_den_coeff=fits["line"][1].tolist(),
        samp_num_coeff=fits["samp"][0].tolist(),
        samp_den_coeff=fits["samp"][1].tolist(),
    )
    return FittedRpc(rpc, worst)
