"""Where something that moves was at any moment: tables over time, quaternions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError

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
    """Where a track (n,), (n, 3) jumps as nothing does that flies: far more than its usual speed; None: nowhere.

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
