"""A lens that stays invertible outside the image."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.interior import Interior
from photoplan.cameras.lenses.base import Lens
from photoplan.cameras.lenses.inverse import newton_inverse, solve2, upright
from photoplan.errors import InputError

#: The field reaches this much beyond the farthest corner; less where the lens folds before that.
_MARGINS = (1.05, 1.02, 1.005, 1.0)
_STEPS = 24
_AZIMUTHS = 32


@dataclass(frozen=True)
class FieldLimited:
    """A lens inside its field, and the tangent of it along every radius beyond.

    Distortion polynomials are determined inside the image and fold back somewhere outside; ground far beside an image
    would then be seen in it. Beyond `radius` the distortion continues linearly in the radius with the value and the
    slope that it has there: the mapping is continuously differentiable, free of folds, and has an exact inverse.
    """

    lens: Lens
    radius: float
    """Largest ideal radius (tangent) at which the lens itself is used; infinite: everywhere."""

    def __post_init__(self) -> None:
        if not self.radius > 0:
            raise InputError(f"field radius {self.radius} of {self.lens!r}; a positive number is needed")
        fold = _first_fold(self.jacobian, self.radius, (1.001, 1.1, 2.0, 10.0, 1e3))
        if fold is not None:
            raise InputError(
                f"{self.lens!r} is not invertible: its distortion folds back at the tangent radius {fold:.4g}, "
                f"with the field ending at {self.radius:.4g}; check signs, order and units of the coefficients"
            )

    def distort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Ideal to real tangent coordinates, shapes (..., 2)."""
        t = np.asarray(t, float)
        outside = self._outside(t)
        if not outside.any():
            return self.lens.distort(t)
        edge, excess, direction = self._split(t[outside])
        inner = t.copy()
        inner[outside] = edge
        out = self.lens.distort(inner)
        out[outside] += excess[:, None] * self._slope(edge, direction)
        return out

    def undistort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Real to ideal tangent coordinates, shapes (..., 2), by Newton's method; NaN where there is no solution."""
        t = np.asarray(t, float)
        if math.isinf(self.radius):
            return self.lens.undistort(t)
        inside = self.lens.undistort(t)
        # A solution inside the field is the only one, as the field is free of folds. A closed form (`Reversed`) may
        # return a point that is none, so the way forward is looked at.
        with np.errstate(invalid="ignore"):
            good = np.hypot(inside[..., 0], inside[..., 1]) <= self.radius
            good &= np.abs(self.lens.distort(inside) - t).max(axis=-1, initial=0.0) < 1e-9
        if good.all():
            return inside
        beyond = t[~good]
        inside[~good] = newton_inverse(self.distort, self.jacobian, beyond, self._start(beyond))
        return inside

    def jacobian(self, t: ArrayLike) -> NDArray[np.float64]:
        """∂ distort(t) / ∂ t, shape (..., 2, 2)."""
        t = np.asarray(t, float)
        outside = self._outside(t)
        if not outside.any():
            return self.lens.jacobian(t)
        edge, excess, e = self._split(t[outside])
        inner = t.copy()
        inner[outside] = edge
        J = self.lens.jacobian(inner)
        across = np.stack([-e[:, 1], e[:, 0]], axis=1)
        r = self.radius + excess
        along = self._slope(edge, e)
        turning = np.einsum("nij,nj->ni", J[outside], across) * self.radius + excess[:, None] * self._turn(e)
        J[outside] = along[:, :, None] * e[:, None, :] + (turning / r[:, None])[:, :, None] * across[:, None, :]
        return J

    def _outside(self, t: NDArray[np.float64]) -> NDArray[np.bool_]:
        x, y = t[..., 0], t[..., 1]
        return x * x + y * y > self.radius * self.radius

    def _split(self, t: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """The point on the field's edge, the distance beyond it, and the direction, of points (n, 2) outside."""
        r = np.hypot(t[:, 0], t[:, 1])
        e = t / r[:, None]
        return self.radius * e, r - self.radius, e

    def _slope(self, edge: NDArray[np.float64], e: NDArray[np.float64]) -> NDArray[np.float64]:
        """Change of the distorted point per unit of radius, at points of the field's edge."""
        return np.einsum("nij,nj->ni", self.lens.jacobian(edge), e)

    def _turn(self, e: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivative of `_slope` by the azimuth, from five points: exact to 1e-12, and only Newton's step needs it."""
        total = np.zeros_like(e)
        h = 2e-3
        for k, weight in ((-2, 1.0), (-1, -8.0), (1, 8.0), (2, -1.0)):
            c, s = math.cos(k * h), math.sin(k * h)
            turned = e @ np.array([[c, s], [-s, c]])
            total += weight * self._slope(self.radius * turned, turned)
        return total / (12.0 * h)

    def _start(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where Newton's search begins for real points (n, 2): the straight continuation seen from the axis."""
        rd = np.hypot(t[:, 0], t[:, 1])
        edge = self.radius * t / rd[:, None]
        image = self.lens.distort(edge)
        slope = self._slope(edge, edge / self.radius)
        # Along the direction of the point the continuation is nearly radial.
        e = t / rd[:, None]
        lack = rd - (image * e).sum(axis=1)
        growth = np.maximum((slope * e).sum(axis=1), 1e-3)
        return (self.radius + np.maximum(lack / growth, 0.0))[:, None] * e


@lru_cache(maxsize=256)
def field_limited(lens: Lens, interior: Interior) -> FieldLimited:
    """Limit a lens to the field of an image: the farthest point of its border and 5 % beyond."""
    real = interior.tangent_to_pixel.inverse(interior.border(2))
    farthest = _farthest(lens, real)
    if math.isinf(farthest):
        return FieldLimited(lens, farthest)
    for margin in _MARGINS:
        radius = farthest * margin
        if _first_fold(lens.jacobian, radius) is None or margin == _MARGINS[-1]:
            return FieldLimited(lens, radius)
    raise AssertionError("unreachable")


def _farthest(lens: Lens, real: NDArray[np.float64]) -> float:
    """Largest ideal radius of real points (n, 2), each followed outwards from the axis so that no fold is jumped.

    Infinite if the image reaches beyond 90° (fisheye), where rays have no tangent.
    """
    t = np.zeros_like(real)
    for step in range(1, _STEPS + 1):
        target = real * (step / _STEPS)
        for _ in range(6):
            with np.errstate(all="ignore"):
                J = lens.jacobian(t)
                t = t - solve2(J, lens.distort(t) - target)
        bad = ~((np.abs(lens.distort(t) - target).max(axis=-1) < 1e-9) & upright(lens.jacobian(t)))
        if bad.any():
            if _is_endless(lens):
                return math.inf
            raise InputError(
                f"{lens!r} is not invertible inside the image: it folds back at {100 * step / _STEPS:.0f} % of the way "
                f"from the principal point to the image's border, where the distorted tangent radius is "
                f"{np.hypot(*target[bad][0]):.4g}; check signs, order and units of the coefficients"
            )
    return float(np.hypot(t[:, 0], t[:, 1]).max())


def _is_endless(lens: Lens) -> bool:
    """Whether the lens maps all tangents into a bounded circle without folding (fisheye)."""
    far = np.array([[1e6, 0.0], [0.0, 1e6], [-1e7, 0.0]])
    with np.errstate(all="ignore"):
        image = lens.distort(far)
        return bool((np.hypot(image[:, 0], image[:, 1]) < 10.0).all()) and _first_fold(lens.jacobian, 1e3) is None


def _first_fold(
    jacobian: Callable[[NDArray[np.float64]], NDArray[np.float64]], radius: float, beyond: tuple[float, ...] = ()
) -> float | None:
    """Smallest sampled radius, up to `radius` and at its multiples `beyond`, where orientation is lost; or None."""
    if math.isinf(radius):
        radius, beyond = 1e3, ()
    f = np.array([*np.linspace(0.0, 1.0, 65)[1:], *beyond])
    phi = np.arange(_AZIMUTHS) * (2.0 * math.pi / _AZIMUTHS)
    t = radius * f[:, None, None] * np.stack([np.cos(phi), np.sin(phi)], axis=-1)
    with np.errstate(all="ignore"):
        folded = ~upright(jacobian(t)).all(axis=1)
    return float(radius * f[folded][0]) if folded.any() else None
