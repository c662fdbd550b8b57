"""Rotations from angles and back, for every order that orientation tables use."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import UsageError

#: Parts of a full circle of each unit of angles.
ANGLE_UNITS = {"deg": 360.0, "gon": 400.0, "rad": 2 * np.pi}

#: Orders of the three angles; the first letter is the primary rotation (about the fixed axis).
ROTATION_ORDERS = ("opk", "pok", "kpo", "kop", "okp", "pko")

_AXIS = {"o": 0, "p": 1, "k": 2}


def _about(axis: int, angle: NDArray[np.float64]) -> NDArray[np.float64]:
    c, s = np.cos(angle), np.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.zeros((*angle.shape, 3, 3))
    R[..., axis, axis] = 1.0
    R[..., i, i] = R[..., j, j] = c
    R[..., i, j], R[..., j, i] = -s, s
    return R


def rotation_from_angles(angles: ArrayLike, order: str = "opk") -> NDArray[np.float64]:
    """Rotation matrices of three angles given in the sequence of `order`."""
    if order not in ROTATION_ORDERS:
        raise UsageError(f"rotation order {order!r}; allowed are {', '.join(ROTATION_ORDERS)}")
    angles = np.asarray(angles, float)
    first, second, third = (_about(_AXIS[k], angles[..., place]) for place, k in enumerate(order))
    return np.asarray(first @ second @ third)


def rotation_opk(omega: float, phi: float, kappa: float) -> NDArray[np.float64]:
    """R_ground_camera = R_ω R_φ R_κ, angles in radians (Ecker 1991, eq. 3.3)."""
    return rotation_from_angles((omega, phi, kappa), "opk")


def angles_from_rotation(R_ground_camera: ArrayLike, order: str = "opk") -> NDArray[np.float64]:
    """Angles in radians, in the sequence of `order`, of a rotation matrix; inverse of `rotation_from_angles`.

    The second one is in [−π/2, π/2]. At its ends only one combination of the others is determined; the first is then 0.
    """
    if order not in ROTATION_ORDERS:
        raise UsageError(f"rotation order {order!r}; allowed are {', '.join(ROTATION_ORDERS)}")
    # Renaming the axes turns every order into ω φ κ; an odd renaming mirrors space, which negates the angles.
    axes = [_AXIS[k] for k in order]
    P = np.eye(3)[axes]
    R = P @ np.asarray(R_ground_camera, float) @ P.T
    # The arc sine would lose half the digits near ±π/2.
    cos_phi = np.hypot(R[0, 0], R[0, 1])
    omega, kappa = np.arctan2(-R[1, 2], R[2, 2]), np.arctan2(-R[0, 1], R[0, 0])
    if cos_phi < 1e-12:
        omega, kappa = 0.0, np.arctan2(R[1, 0], R[1, 1])
    return np.asarray(np.linalg.det(P) * np.array([omega, np.arctan2(R[0, 2], cos_phi), kappa]))


def axes_of_angles(R_ground_camera: ArrayLike, order: str = "opk") -> NDArray[np.float64]:
    """Axes in ground space about which small changes of ω, φ and κ turn a camera, as rows, shape (3, 3).

    Each turns about its own axis, which the rotations before it in the order have moved.
    """
    angles = angles_from_rotation(R_ground_camera, order)
    axes = np.empty((3, 3))
    for k, letter in enumerate(order):
        before = rotation_from_angles(np.where(np.arange(3) < k, angles, 0.0), order)
        axes["opk".index(letter)] = before[:, "opk".index(letter)]
    return axes


def rotation_from_view(azimuth: float, pitch: float, roll: float) -> NDArray[np.float64]:
    """Camera axes x right, y up, z backwards on the map, as columns, of a view; radians.

    Azimuths are from north to the east, pitches upwards; a positive roll turns the camera's right side downwards.
    """
    sa, ca, sp, cp = math.sin(azimuth), math.cos(azimuth), math.sin(pitch), math.cos(pitch)
    axis, right = np.array([sa * cp, ca * cp, sp]), np.array([ca, -sa, 0.0])
    up = np.cross(right, axis)
    s, c = math.sin(roll), math.cos(roll)
    return np.stack([c * right - s * up, s * right + c * up, -axis], axis=1)


def view_from_rotation(R: NDArray[np.float64]) -> tuple[float, float, float]:
    """Azimuth, pitch and roll of a view; inverse of `rotation_from_view`, but for views straight up or down."""
    axis = -R[:, 2]
    azimuth = math.atan2(axis[0], axis[1])
    right = np.array([math.cos(azimuth), -math.sin(azimuth), 0.0])
    roll = math.atan2(-R[:, 0] @ np.cross(right, axis), R[:, 0] @ right)
    return azimuth, math.asin(max(-1.0, min(1.0, axis[2]))), roll


def dot(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scalar products of vectors (..., k), shape (...): several times as fast as a sum over their short last axis."""
    return np.asarray(np.einsum("...i,...i", a, b))


def skew(v: NDArray[np.float64]) -> NDArray[np.float64]:
    """[v]× of vectors (..., 3), shape (..., 3, 3): [v]× w = v × w."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def small_rotations(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """exp([δ]×) of rotation vectors (n, 3), shape (n, 3, 3) (Rodrigues' formula)."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    K = skew(vectors)
    safe = np.where(angle > 1e-9, angle, 1.0)
    first = np.where(angle > 1e-9, np.sin(safe) / safe, 1.0)
    second = np.where(angle > 1e-9, (1.0 - np.cos(safe)) / safe**2, 0.5)
    return np.asarray(np.eye(3) + first * K + second * (K @ K))


def rotation_vector(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation vectors (..., 3) of rotation matrices (..., 3, 3) that are not near half a turn."""
    v = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1) / 2
    sine = np.linalg.norm(v, axis=-1, keepdims=True)
    cosine = ((np.trace(R, axis1=-2, axis2=-1) - 1.0) / 2.0)[..., None]
    factor = np.where(sine > 1e-9, np.arctan2(sine, cosine) / np.where(sine > 1e-9, sine, 1.0), 1.0)
    return np.asarray(v * factor)
