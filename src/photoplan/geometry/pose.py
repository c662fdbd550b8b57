"""Poses, rotations and angle conventions, systems of two and three equations, and motion over time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import InputError, UsageError

#: Parts of a full circle of each unit of angles.
ANGLE_UNITS = {"deg": 360.0, "gon": 400.0, "rad": 2 * np.pi}

#: Orders of the three angles; the first letter is the primary rotation (about the fixed axis).
ROTATION_ORDERS = ("opk", "pok", "kpo", "kop", "okp", "pko")

_AXIS = {"o": 0, "p": 1, "k": 2}
#: From camera axes x right, y down, z forwards to x right, y up, z backwards, and back.
FLIP = np.diag([1.0, -1.0, -1.0])


def angle_in_radians(value: NDArray[np.float64], unit: str) -> NDArray[np.float64]:
    """Convert angles of a unit (deg, gon, rad) to radians."""
    return value * (2 * np.pi / ANGLE_UNITS[unit])


def angle_in_unit(radians: NDArray[np.float64], unit: str) -> NDArray[np.float64]:
    """Convert angles in radians to a unit."""
    return radians * (ANGLE_UNITS[unit] / (2 * np.pi))


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


def degrees_of(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ω, φ, κ in degrees of matrices (n, 3, 3); rounded to 1e-12°, below the noise of the conversion."""
    # Adding zero turns −0.0 into 0.0.
    angles = np.array([angles_from_rotation(R) for R in rotations], np.float64)
    return np.asarray(np.round(np.degrees(angles), 12) + 0.0, np.float64)


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


def determinant(J: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the determinants of matrices (..., 2, 2), or of the first two columns of wider ones."""
    return J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]


def solve2(J: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return x of J x = b for matrices (..., 2, 2) and vectors (..., 2); inf or NaN where J is singular."""
    det = determinant(J)
    x = np.empty_like(b)
    x[..., 0] = (J[..., 1, 1] * b[..., 0] - J[..., 0, 1] * b[..., 1]) / det
    x[..., 1] = (J[..., 0, 0] * b[..., 1] - J[..., 1, 0] * b[..., 0]) / det
    return x


def solve3(J: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return x of J x = b for matrices (n, 3, 3) and vectors (n, 3); inf or NaN where J is singular."""
    u, v, w = J[..., 0], J[..., 1], J[..., 2]
    vw = np.cross(v, w)
    x = np.stack([(b * vw).sum(-1), (b * np.cross(w, u)).sum(-1), (b * np.cross(u, v)).sum(-1)], axis=-1)
    return x / (u * vw).sum(axis=-1)[..., None]


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


#: Unknowns of a pose, in the order of covariances: centre, and small rotations about the axes of the camera
#: (R ← R · exp[δ]×).
UNKNOWNS = ("X0", "Y0", "Z0", "rotation about x", "rotation about y", "rotation about z")


@dataclass(frozen=True, eq=False)
class Pose:
    """Exterior orientation: where the projection centre is and how the camera axes lie in ground space.

    `~pose` is the inverse motion, `a @ b` is the motion b followed by a.
    """

    center: NDArray[np.float64]
    """Projection centre X0, Y0, Z0 in ground coordinates, shape (3,), metres."""

    R_ground_camera: NDArray[np.float64]
    """Rotation from camera axes to ground axes, shape (3, 3) (Ecker 1991, eq. 3.3)."""

    def __post_init__(self) -> None:
        center = np.array(self.center, float)
        R = np.array(self.R_ground_camera, float)
        if center.shape != (3,) or not np.isfinite(center).all():
            raise InputError(f"projection centre {self.center!r}; three finite coordinates are needed")
        if R.shape != (3, 3) or not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0:
            raise InputError("rotation matrix is not a right-handed rotation")
        center.setflags(write=False)
        R.setflags(write=False)
        object.__setattr__(self, "center", center)
        object.__setattr__(self, "R_ground_camera", R)

    @classmethod
    def from_angles(cls, center: ArrayLike, angles: ArrayLike, order: str = "opk") -> Pose:
        """Pose from a projection centre and three angles in radians, in the sequence of `order`."""
        return cls(np.asarray(center, float), rotation_from_angles(angles, order))

    @property
    def opk(self) -> NDArray[np.float64]:
        """ω, φ, κ in radians."""
        return angles_from_rotation(self.R_ground_camera)

    @property
    def tilt(self) -> float:
        """Angle between the optical axis and the nadir direction, radians: 0 for a strictly vertical image."""
        return float(np.arccos(np.clip(self.R_ground_camera[2, 2], -1.0, 1.0)))

    def to_ground(self, xyz_camera: ArrayLike) -> NDArray[np.float64]:
        """Camera coordinates (origin at the projection centre) to ground, shapes (..., 3)."""
        return np.asarray(xyz_camera, float) @ self.R_ground_camera.T + self.center

    def to_camera(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Ground coordinates to camera axes with origin at the projection centre, shapes (..., 3)."""
        return (np.asarray(XYZ, float) - self.center) @ self.R_ground_camera

    def __invert__(self) -> Pose:
        return Pose(-self.R_ground_camera.T @ self.center, self.R_ground_camera.T)

    def __matmul__(self, other: Pose) -> Pose:
        return Pose(self.R_ground_camera @ other.center + self.center, self.R_ground_camera @ other.R_ground_camera)


_Floats = NDArray[np.float64]
#: Values (n, k) at the times (n,), seconds.
Course = Callable[[_Floats], _Floats]
#: So many times its usual speed nothing flies.
_JUMP = 10.0


@dataclass(frozen=True, eq=False)
class EvenTable:
    """Values at even times, interpolated by Lagrange's polynomials of an even number of neighbours.

    Towards the ends of the table fewer neighbours are taken, as many on either side: polynomials that are not centred
    swing. Beyond the ends the outermost polynomial goes on; who asks there decides whether that is known.
    """

    start: float
    """Time of the first row, seconds."""
    step: float
    """Seconds from row to row."""
    values: _Floats
    """Shape (n, k)."""
    neighbours: int = 8

    def __post_init__(self) -> None:
        if len(self.values) < 2 or not np.isfinite(self.values).all():
            raise InputError(f"a table over time of {len(self.values)} rows, or with values that are not finite")
        if not (np.isfinite([self.start, self.step]).all() and self.step > 0):
            raise InputError(f"a table over time from {self.start:g} s on, every {self.step:g} s")

    @classmethod
    def over(cls, times: _Floats, values: _Floats) -> EvenTable:
        """Values (n, k) at even times (n,), whose step is that of all of them: large times are rounded."""
        return cls(float(times[0]), float(times[-1] - times[0]) / max(len(times) - 1, 1), values)

    @property
    def end(self) -> float:
        """Time of the last row, seconds."""
        return self.start + self.step * (len(self.values) - 1)

    def __call__(self, t: _Floats) -> _Floats:
        """Values (n, k) at times (n,)."""
        at = (np.asarray(t, float) - self.start) / self.step
        last = len(self.values) - 2
        # NaN has no row; it comes out as NaN by its weights.
        row = np.clip(np.nan_to_num(np.floor(at)), 0, last).astype(np.int64)
        count = np.minimum(self.neighbours, 2 * np.minimum(row + 1, last + 1 - row))
        out = np.empty((len(at), self.values.shape[1]))
        for each in np.unique(count):
            mine = count == each
            nodes = np.arange(1 - each // 2, each // 2 + 1)
            weights = _lagrange(at[mine] - row[mine], nodes)
            out[mine] = np.einsum("nj,njk->nk", weights, self.values[row[mine, None] + nodes])
        return out


def _lagrange(x: _Floats, nodes: NDArray[np.int64]) -> _Floats:
    """Weights (n, m) of the values at whole numbers (m,), at x (n,)."""
    away = x[:, None] - nodes
    weights = np.empty_like(away)
    for j in range(len(nodes)):
        others = np.arange(len(nodes)) != j
        weights[:, j] = away[:, others].prod(axis=1) / float(np.prod(nodes[j] - nodes[others]))
    return weights


def cubic(times: _Floats, values: _Floats, slopes: _Floats | None, t: _Floats) -> _Floats:
    """Values (m, k) at t (m,) of a table (n, k) at uneven times (n,) with its derivatives; without them, linear."""
    row = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
    width = (times[row + 1] - times[row])[:, None]
    u = ((t - times[row]) / width[:, 0])[:, None]
    left, right = values[row], values[row + 1]
    if slopes is None:
        return np.asarray(left + u * (right - left))
    h00, h10, h01, h11 = (1 + 2 * u) * (1 - u) ** 2, u * (1 - u) ** 2, u * u * (3 - 2 * u), u * u * (u - 1)
    return np.asarray(h00 * left + h10 * width * slopes[row] + h01 * right + h11 * width * slopes[row + 1])


def cubic_convolution(u: _Floats) -> _Floats:
    """Weights (n, 4) of the neighbours at −1, 0, 1, 2 of places (n,) from 0 to 1 (Keys 1981, eq. 4, a = −1/2)."""
    return np.stack(
        [((2 - u) * u - 1) * u / 2, ((3 * u - 5) * u * u + 2) / 2, ((4 - 3 * u) * u + 1) * u / 2, (u - 1) * u * u / 2],
        axis=-1,
    )


def between(times: _Floats, quaternions: _Floats, t: _Floats) -> _Floats:
    """Unit quaternions (m, 4) at t (m,), along the great circle between those of a table (n, 4), scalar first."""
    if len(times) == 1:
        return np.broadcast_to(quaternions[0], (len(t), 4)).copy()
    row = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
    u = (t - times[row]) / (times[row + 1] - times[row])
    a, b = quaternions[row], quaternions[row + 1]
    cos = np.einsum("nk,nk->n", a, b)
    b = b * np.where(cos < 0, -1.0, 1.0)[:, None]
    angle = 2.0 * np.arctan2(np.linalg.norm(b - a, axis=1), np.linalg.norm(b + a, axis=1))
    near = angle < 1e-8
    sin = np.where(near, 1.0, np.sin(angle))
    wa = np.where(near, 1.0 - u, np.sin((1.0 - u) * angle) / sin)
    wb = np.where(near, u, np.sin(u * angle) / sin)
    return np.asarray(wa[:, None] * a + wb[:, None] * b)


def odd_step(times: _Floats, places: _Floats) -> str | None:
    """Return the place where a track (n,), (n, 3) jumps by far more than its usual speed allows; None if there is none.

    A number in another unit, a wrong sign or a lost digit in a single record is finite, and no other test sees it.
    """
    steps, spans = np.linalg.norm(np.diff(places, axis=0), axis=1), np.diff(times)
    usual = float(np.median(steps / spans))
    # A metre is left to receivers that stand still.
    row = int(np.argmax(steps - _JUMP * usual * spans))
    if not steps[row] > _JUMP * usual * spans[row] + 1.0:
        return None
    return (
        f"from record {row + 1} to {row + 2}, in {spans[row]:.3g} s, it is {steps[row]:.4g} m, at a usual speed of "
        f"{usual:.3g} m/s"
    )


def continuous(quaternions: _Floats) -> _Floats:
    """The same rotations (n, 4) with signs that do not jump from row to row: only such can be interpolated."""
    cos = np.einsum("nk,nk->n", quaternions[1:], quaternions[:-1])
    sign = np.cumprod(np.concatenate([[1.0], np.where(cos < 0, -1.0, 1.0)]))
    return np.asarray(quaternions * sign[:, None])


def times(p: _Floats, q: _Floats) -> _Floats:
    """Hamilton's product of quaternions (..., 4), scalar first: first the rotation q, then p."""
    a, u, b, v = p[..., :1], p[..., 1:], q[..., :1], q[..., 1:]
    scalar = a * b - (u * v).sum(axis=-1, keepdims=True)
    return np.concatenate([scalar, a * v + b * u + np.cross(u, v)], axis=-1)


def conjugate(q: _Floats) -> _Floats:
    """The rotation back, (..., 4)."""
    return np.asarray(q * [1.0, -1.0, -1.0, -1.0])


def quaternions(R: _Floats) -> _Floats:
    """Unit quaternions (n, 4), scalar first, of rotation matrices (n, 3, 3) (Shepperd 1978)."""
    w = np.trace(R, axis1=1, axis2=2)
    x, y, z = (2 * R[:, k, k] - w for k in range(3))
    a, b, c = R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]
    p, q, r = R[:, 0, 1] + R[:, 1, 0], R[:, 0, 2] + R[:, 2, 0], R[:, 1, 2] + R[:, 2, 1]
    # Each row of this matrix is the quaternion times one of its elements: the largest is taken.
    rows = np.array([[1 + w, a, b, c], [a, 1 + x, p, q], [b, p, 1 + y, r], [c, q, r, 1 + z]])
    best = rows[np.argmax([1 + w, 1 + x, 1 + y, 1 + z], axis=0), :, np.arange(len(R))]
    return np.asarray(best / np.linalg.norm(best, axis=1, keepdims=True))


def rotations(q: _Floats) -> _Floats:
    """Rotation matrices (n, 3, 3) of quaternions (n, 4), scalar first, of any length but 0."""
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)
