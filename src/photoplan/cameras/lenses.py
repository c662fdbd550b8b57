"""Lens distortion and interior orientation: Brown, OpenCV, fisheye, tables; inversion by Newton's method."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import astuple, dataclass, field
from functools import lru_cache
from itertools import chain
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.fiducials import Affine2D, Bilinear2D
from photoplan.errors import InputError
from photoplan.geometry.pose import determinant, solve2


@dataclass(frozen=True)
class Interior:
    """From tangent coordinates to pixels: image-plane point = principal point + c · t, then plane to pixels.

    The image plane has x right, y up (positive image) and the unit of c: millimetres for film and metric cameras,
    pixels for cameras calibrated in pixels. Pixel (0, 0) is the centre of the upper-left pixel, y down.
    """

    c: float
    """Camera constant (principal distance), in the unit of the image plane."""
    principal_point: tuple[float, float]
    """x0, y0 in the image plane, same unit."""
    plane_to_pixel: Affine2D | Bilinear2D
    """From the image plane to pixels; for film from the fiducial marks."""
    size: tuple[int, int]
    """Width and height of the image in pixels."""
    tangent_to_pixel: Affine2D | Bilinear2D = field(init=False, repr=False, compare=False)
    """Principal point, camera constant and `plane_to_pixel` in one (Ecker 1991, eq. 4.10 and appendix B)."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.c) and self.c > 0):
            raise InputError(f"camera constant {self.c}; a positive number is needed")
        if len(self.principal_point) != 2 or not all(math.isfinite(v) for v in self.principal_point):
            raise InputError(f"principal point {self.principal_point}; two finite numbers are needed")
        if len(self.size) != 2 or not all(int(s) == s and s >= 1 for s in self.size):
            raise InputError(f"image size {self.size}; width and height in whole pixels are needed")
        x0, y0 = (float(v) for v in self.principal_point)
        object.__setattr__(self, "principal_point", (x0, y0))
        object.__setattr__(self, "size", (int(self.size[0]), int(self.size[1])))
        combined = self.plane_to_pixel @ Affine2D(a1=self.c, a2=0.0, a3=x0, a4=0.0, a5=self.c, a6=y0)
        object.__setattr__(self, "tangent_to_pixel", combined)

    @classmethod
    def digital(
        cls, size: tuple[int, int], focal_px: tuple[float, float], principal_offset_px: tuple[float, float] = (0.0, 0.0)
    ) -> Interior:
        """A camera that was calibrated in pixels.

        Parameters
        ----------
        size : (int, int)
            Width and height in pixels.
        focal_px : (float, float)
            fx, fy: camera constant in pixel widths and pixel heights.
        principal_offset_px : (float, float)
            Principal point minus the middle of the image ((width − 1) / 2, (height − 1) / 2), pixels, x right, y down.
        """
        fx, fy = focal_px
        if not (math.isfinite(fx) and math.isfinite(fy) and fx > 0 and fy > 0):
            raise InputError(f"focal lengths {focal_px} px; two positive numbers are needed")
        x, y = ((s - 1) / 2 + o for s, o in zip(size, principal_offset_px))
        return cls(fx, (0.0, 0.0), Affine2D(a1=1.0, a2=0.0, a3=x, a4=0.0, a5=-fy / fx, a6=y), size)

    @classmethod
    def metric(
        cls,
        size: tuple[int, int],
        c_mm: float,
        pixel_mm: float | tuple[float, float],
        principal_point_mm: tuple[float, float] = (0.0, 0.0),
    ) -> Interior:
        """A digital camera that is stated in millimetres.

        Parameters
        ----------
        size : (int, int)
            Width and height in pixels.
        c_mm : float
            Camera constant, millimetres.
        pixel_mm : float or (float, float)
            Side of a pixel, or its width and height, millimetres.
        principal_point_mm : (float, float)
            Principal point relative to the middle of the image, millimetres, x right, y up.
        """
        width, height = (pixel_mm, pixel_mm) if isinstance(pixel_mm, int | float) else pixel_mm
        if not (math.isfinite(width) and math.isfinite(height) and width > 0 and height > 0):
            raise InputError(f"pixel size {pixel_mm} mm; positive numbers are needed")
        x, y = ((s - 1) / 2 for s in size)
        return cls(c_mm, principal_point_mm, Affine2D(a1=1 / width, a2=0.0, a3=x, a4=0.0, a5=-1 / height, a6=y), size)

    def border(self, per_side: int = 8) -> NDArray[np.float64]:
        """Points on the outer edge of the image, corners first in each side, shape (4·per_side, 2), pixels."""
        w, h = self.size
        corners = np.array([(-0.5, -0.5), (w - 0.5, -0.5), (w - 0.5, h - 0.5), (-0.5, h - 0.5)])
        f = (np.arange(per_side) / per_side)[:, None]
        return np.concatenate([a + f * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0))])


class Lens(Protocol):
    """The deviation of a real lens from central projection.

    Points are dimensionless tangent coordinates t = (x, y) / c about the principal point, x right, y up: t = (tan αx,
    tan αy) of the ideal ray. *Distortion* is the direction ideal → real: where the lens puts a ray. *Correction* is the
    opposite direction, real → ideal: what has to be done to a measured point. Coefficients of every class describe
    distortion; a set of coefficients that was determined as a correction is wrapped in `Reversed`.
    """

    def distort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Ideal to real tangent coordinates, shapes (..., 2)."""
        ...

    def undistort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Real to ideal tangent coordinates, shapes (..., 2), exact to 1e-12; NaN where there is no solution."""
        ...

    def jacobian(self, t: ArrayLike) -> NDArray[np.float64]:
        """∂ distort(t) / ∂ t, shape (..., 2, 2)."""
        ...

    def __hash__(self) -> int:
        """Lenses are values: frozen, comparable, usable as keys."""
        ...


def decentred(t: NDArray[np.float64], factor: NDArray[np.float64], p1: float, p2: float) -> NDArray[np.float64]:
    """x·g + p1 (r² + 2x²) + 2 p2 x y and y·g + p2 (r² + 2y²) + 2 p1 x y, g = `factor` at t; shapes (..., 2)."""
    out = t * factor[..., None]
    if p1 or p2:
        x, y = t[..., 0], t[..., 1]
        # p1 (r² + 2x²) + 2 p2 x y = p1 r² + 2 x (p1 x + p2 y), and likewise for y.
        r2 = x * x + y * y
        s = 2.0 * (p1 * x + p2 * y)
        out[..., 0] += p1 * r2 + s * x
        out[..., 1] += p2 * r2 + s * y
    return out


def decentred_jacobian(
    t: NDArray[np.float64], factor: NDArray[np.float64], slope: NDArray[np.float64], p1: float, p2: float
) -> NDArray[np.float64]:
    """Derivative of `decentred`, shape (..., 2, 2); `slope` = dg / d(r²)."""
    x, y = t[..., 0], t[..., 1]
    J = np.empty((*t.shape, 2))
    J[..., 0, 0] = factor + 2.0 * x * x * slope + 6.0 * p1 * x + 2.0 * p2 * y
    J[..., 1, 1] = factor + 2.0 * y * y * slope + 6.0 * p2 * y + 2.0 * p1 * x
    J[..., 0, 1] = J[..., 1, 0] = 2.0 * (x * y * slope + p1 * y + p2 * x)
    return J


def radial_jacobian(
    t: NDArray[np.float64], r: NDArray[np.float64], across: NDArray[np.float64], along: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Derivative of a radial mapping at t (..., 2) of radius r: r'/r across and dr'/dr along the radius."""
    e = t / np.where(r > 0, r, 1.0)[..., None]
    excess = along - across
    J = np.empty((*t.shape, 2))
    J[..., 0, 0] = across + excess * e[..., 0] * e[..., 0]
    J[..., 1, 1] = across + excess * e[..., 1] * e[..., 1]
    J[..., 0, 1] = J[..., 1, 0] = excess * e[..., 0] * e[..., 1]
    return J


#: What is left of the residual at a point that counts as solved, relative to 1 + |t|.
PRECISION = 1e-12
_ITERATIONS = 60

_Map = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def upright(J: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether a lens's derivative (..., 2, 2) neither mirrors nor turns round; False for NaN.

    On the axis it is close to the unit matrix; on its way to a fold the determinant vanishes, and beyond the fold at
    least one of determinant and trace is negative.
    """
    return np.asarray((determinant(J) > 0) & (J[..., 0, 0] + J[..., 1, 1] > 0))


def newton_inverse(
    distort: _Map, jacobian: _Map, target: NDArray[np.float64], start: NDArray[np.float64]
) -> NDArray[np.float64]:
    """t with distort(t) = target, to 1e-12."""
    t = np.array(start, float)
    with np.errstate(all="ignore"):
        for _ in range(_ITERATIONS):
            step = solve2(jacobian(t), distort(t) - target)
            t -= step
            # A comparison with NaN is false: hopeless points do not keep the others waiting.
            if not (np.abs(step) > 4e-16 + 2e-15 * np.abs(t)).any():
                break
        miss = np.abs(distort(t) - target).max(axis=-1, initial=0.0)
        good = (miss <= PRECISION * (1.0 + np.abs(target).max(axis=-1, initial=0.0))) & upright(jacobian(t))
    t[~good] = np.nan
    return t


@dataclass(frozen=True)
class Brown:
    """Radial k1–k4, decentring p1–p2, affinity b1 and shear b2, as *distortion* of tangent coordinates, y up.

    ::

        xd = x (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + p1 (r² + 2x²) + 2 p2 x y
        yd = y (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + p2 (r² + 2y²) + 2 p1 x y
        x' = xd (1 + b1) + yd b2
        y' = yd

    A positive k1 moves points outwards. Programs that apply the same formula with y *down* (Agisoft) have p2 and b2 of
    opposite sign: see `from_y_down`. Programs that apply it to measured coordinates (the classical correction of
    Brown 1971) need `Reversed(Brown(…))`; mind whether their correction is added or subtracted.
    """

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    b1: float = 0.0
    b2: float = 0.0
    k4: float = 0.0

    def __post_init__(self) -> None:
        if not all(math.isfinite(v) for v in astuple(self)):
            raise InputError(f"{self!r}: every coefficient must be a finite number")
        if self.b1 <= -1.0:
            raise InputError(f"{self!r}: b1 must be larger than −1, or the image is turned inside out")

    @classmethod
    def from_image_units(
        cls,
        c: float,
        *,
        k: tuple[float, ...] = (),
        p: tuple[float, float] = (0.0, 0.0),
        b: tuple[float, float] = (0.0, 0.0),
    ) -> Brown:
        """From coefficients that act on image coordinates instead of tangents.

        Parameters
        ----------
        c : float
            Camera constant in the unit of the coefficients: millimetres (k1 in mm⁻², p1 in mm⁻¹) or pixels.
        k : tuple of up to four floats
            k1 [unit⁻²], k2 [unit⁻⁴], k3 [unit⁻⁶], k4 [unit⁻⁸].
        p : (float, float)
            p1, p2 [unit⁻¹].
        b : (float, float)
            b1, b2, without unit. Coefficients that are added to c as pixels (Agisoft) are divided by c first.

        Raises
        ------
        InputError
            The camera constant is not positive, or there are more than four radial coefficients.
        """
        if not (math.isfinite(c) and c > 0):
            raise InputError(f"camera constant {c}; a positive number in the unit of the coefficients is needed")
        if len(k) > 4:
            raise InputError(f"{len(k)} radial coefficients {k}; Brown's lens has at most four")
        k1, k2, k3, k4 = (*k, 0.0, 0.0, 0.0, 0.0)[:4]
        return cls(k1 * c**2, k2 * c**4, k3 * c**6, p[0] * c, p[1] * c, *b, k4 * c**8)

    @classmethod
    def from_y_down(
        cls, *, k: tuple[float, ...] = (), p: tuple[float, float] = (0.0, 0.0), b: tuple[float, float] = (0.0, 0.0)
    ) -> Brown:
        """From coefficients of the same formula in a system with y down; only p2 and b2 change their sign."""
        k1, k2, k3, k4 = (*k, 0.0, 0.0, 0.0, 0.0)[:4]
        return cls(k1=k1, k2=k2, k3=k3, p1=p[0], p2=-p[1], b1=b[0], b2=-b[1], k4=k4)

    def distort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Ideal to real tangent coordinates, shapes (..., 2)."""
        t = np.asarray(t, float)
        out = decentred(t, self._factor(t), self.p1, self.p2)
        if self.b1 or self.b2:
            out[..., 0] += self.b1 * out[..., 0] + self.b2 * out[..., 1]
        return out

    def undistort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Real to ideal tangent coordinates, shapes (..., 2), by Newton's method; NaN where there is no solution."""
        t = np.asarray(t, float)
        return newton_inverse(self.distort, self.jacobian, t, t)

    def jacobian(self, t: ArrayLike) -> NDArray[np.float64]:
        """∂ distort(t) / ∂ t, shape (..., 2, 2)."""
        t = np.asarray(t, float)
        r2 = _radius2(t)
        slope = self.k1 + r2 * (2.0 * self.k2 + r2 * (3.0 * self.k3 + r2 * 4.0 * self.k4))
        J = decentred_jacobian(t, self._factor(t), slope, self.p1, self.p2)
        if self.b1 or self.b2:
            J[..., 0, :] += self.b1 * J[..., 0, :] + self.b2 * J[..., 1, :]
        return J

    def _factor(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        r2 = _radius2(t)
        return 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * (self.k3 + r2 * self.k4)))


def _radius2(t: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y = t[..., 0], t[..., 1]
    return x * x + y * y


#: Exponents of x and y of the terms, in their order.
_TERMS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
Ten = tuple[float, ...]


@dataclass(frozen=True)
class Cubic:
    """x' and y' as sums of 1, x, y, x², x y, y², x³, x² y, x y², y³, each with ten coefficients; tangents, y up."""

    x: Ten
    y: Ten

    def __post_init__(self) -> None:
        if len(self.x) != len(_TERMS) or len(self.y) != len(_TERMS):
            raise InputError(
                f"{len(self.x)} and {len(self.y)} coefficients of cubic polynomials; ten and ten are needed"
            )
        if not all(math.isfinite(v) for v in chain(self.x, self.y)):
            raise InputError(f"{self!r}: every coefficient must be a finite number")

    @classmethod
    def from_y_down(cls, c: float, x: Ten, y: Ten) -> Cubic:
        """From coefficients that act on coordinates in the unit of the camera constant `c`, with y down."""
        scale = [c ** (i + j - 1) * (-1) ** j for i, j in _TERMS]
        return cls(tuple(v * s for v, s in zip(x, scale)), tuple(-v * s for v, s in zip(y, scale)))

    def distort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Ideal to real tangent coordinates, shapes (..., 2)."""
        t = np.asarray(t, float)
        terms = np.stack([t[..., 0] ** i * t[..., 1] ** j for i, j in _TERMS], axis=-1)
        return np.asarray(terms @ np.array([self.x, self.y]).T)

    def undistort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Real to ideal tangent coordinates, shapes (..., 2), by Newton's method; NaN where there is no solution."""
        t = np.asarray(t, float)
        return newton_inverse(self.distort, self.jacobian, t, t)

    def jacobian(self, t: ArrayLike) -> NDArray[np.float64]:
        """∂ distort(t) / ∂ t, shape (..., 2, 2)."""
        t = np.asarray(t, float)
        x, y = t[..., 0], t[..., 1]
        by_x = np.stack([i * x ** max(i - 1, 0) * y**j for i, j in _TERMS], axis=-1)
        by_y = np.stack([j * x**i * y ** max(j - 1, 0) for i, j in _TERMS], axis=-1)
        A = np.array([self.x, self.y]).T
        return np.stack([by_x @ A, by_y @ A], axis=-1)


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
        """Return initial values of Newton's search for real points (n, 2): the straight continuation seen from the
        axis."""
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
    """Return whether the lens maps all tangents into a bounded circle without folding (fisheye)."""
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


@dataclass(frozen=True)
class Fisheye:
    """Equidistant projection with four coefficients: r' = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸), θ = arctan r.

    Being radial, the coefficients of OpenCV's `fisheye` module serve unchanged with y up. Rays of 90° and more off the
    axis have no tangent: image points beyond that circle have no ideal point and give NaN.
    """

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    def __post_init__(self) -> None:
        if not all(math.isfinite(v) for v in astuple(self)):
            raise InputError(f"{self!r}: every coefficient must be a finite number")

    def distort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Ideal to real tangent coordinates, shapes (..., 2)."""
        t = np.asarray(t, float)
        r = np.hypot(t[..., 0], t[..., 1])
        theta = np.arctan(r)
        return t * (_sinc_like(theta, r) * self._factor(theta))[..., None]

    def undistort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Real to ideal tangent coordinates, shapes (..., 2), by Newton's method; NaN beyond 90° or a fold."""
        t = np.asarray(t, float)
        rd = np.hypot(t[..., 0], t[..., 1])
        theta = np.minimum(rd, 0.5 * math.pi)
        with np.errstate(all="ignore"):
            for _ in range(_ITERATIONS):
                step = (theta * self._factor(theta) - rd) / self._slope(theta)
                theta = theta - step
                if not (np.abs(step) > 4e-16 + 2e-15 * np.abs(theta)).any():
                    break
            miss = np.abs(theta * self._factor(theta) - rd)
            good = (miss <= 1e-12 * (1.0 + rd)) & (theta >= 0) & (theta < 0.5 * math.pi) & (self._slope(theta) > 0)
            r = np.tan(np.where(good, theta, np.nan))
            # At the centre both radii are zero and their ratio is the inverse of the slope there, 1.
            ratio = np.where(rd > 0, r / np.where(rd > 0, rd, 1.0), 1.0)
        return t * ratio[..., None]

    def jacobian(self, t: ArrayLike) -> NDArray[np.float64]:
        """∂ distort(t) / ∂ t, shape (..., 2, 2)."""
        t = np.asarray(t, float)
        r = np.hypot(t[..., 0], t[..., 1])
        theta = np.arctan(r)
        across = _sinc_like(theta, r) * self._factor(theta)
        along = self._slope(theta) / (1.0 + r * r)
        return radial_jacobian(t, r, across, along)

    def _factor(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        q = theta * theta
        return 1.0 + q * (self.k1 + q * (self.k2 + q * (self.k3 + q * self.k4)))

    def _slope(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        q = theta * theta
        return 1.0 + q * (3.0 * self.k1 + q * (5.0 * self.k2 + q * (7.0 * self.k3 + q * 9.0 * self.k4)))


def _sinc_like(theta: NDArray[np.float64], r: NDArray[np.float64]) -> NDArray[np.float64]:
    """θ / r with its limit 1 at the centre."""
    return np.where(r > 0, theta / np.where(r > 0, r, 1.0), 1.0)


@dataclass(frozen=True)
class NoLens:
    """Central projection without any deviation."""

    def distort(self, t: ArrayLike) -> NDArray[np.float64]:
        """The point itself, shapes (..., 2)."""
        return np.array(t, float)

    def undistort(self, t: ArrayLike) -> NDArray[np.float64]:
        """The point itself, shapes (..., 2)."""
        return np.array(t, float)

    def jacobian(self, t: ArrayLike) -> NDArray[np.float64]:
        """Unit matrices, shape (..., 2, 2)."""
        return np.broadcast_to(np.eye(2), (*np.shape(t), 2)).copy()


@dataclass(frozen=True)
class OpenCV:
    """OpenCV's eight coefficients, in its own order, as distortion.

    The coefficients are those of OpenCV, whose y axis points down; the class turns them into photoplan's system
    (y up), where p1 and p2 change places and p1 its sign. ::

        g  = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)
        x' = x g + 2 p1 x y + p2 (r² + 2x²)          (y down)
        y' = y g + p1 (r² + 2y²) + 2 p2 x y
    """

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    def __post_init__(self) -> None:
        if not all(math.isfinite(v) for v in astuple(self)):
            raise InputError(f"{self!r}: every coefficient must be a finite number")

    def distort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Ideal to real tangent coordinates, shapes (..., 2)."""
        t = np.asarray(t, float)
        top, bottom = self._fraction(_radius2(t))
        return decentred(t, top if bottom is None else top / bottom, self.p2, -self.p1)

    def undistort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Real to ideal tangent coordinates, shapes (..., 2), by Newton's method; NaN where there is no solution."""
        t = np.asarray(t, float)
        return newton_inverse(self.distort, self.jacobian, t, t)

    def jacobian(self, t: ArrayLike) -> NDArray[np.float64]:
        """∂ distort(t) / ∂ t, shape (..., 2, 2)."""
        t = np.asarray(t, float)
        r2 = _radius2(t)
        top, bottom = self._fraction(r2)
        slope = self.k1 + r2 * (2.0 * self.k2 + r2 * (3.0 * self.k3))
        if bottom is None:
            return decentred_jacobian(t, top, slope, self.p2, -self.p1)
        factor = top / bottom
        slope_bottom = self.k4 + r2 * (2.0 * self.k5 + r2 * (3.0 * self.k6))
        return decentred_jacobian(t, factor, (slope - factor * slope_bottom) / bottom, self.p2, -self.p1)

    def _fraction(self, r2: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Numerator and denominator of the radial factor; None where there is no denominator."""
        top = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        if not (self.k4 or self.k5 or self.k6):
            return top, None
        return top, 1.0 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6))


@dataclass(frozen=True)
class RadialTable:
    """Radial distortion known at a few radii; dimensionless, as everything about a lens: millimetres divided by c.

    A shift is *distortion*, positive outwards: the real image point lies at r + Δ(r). Reports that state corrections
    are entered with the opposite sign (the difference, Δ times its slope, is far below a micrometre).

    Between the knots, of which the axis with Δ = 0 is always one, Δ is a piecewise cubic that is monotone between
    neighbouring knots and has a continuous derivative (Fritsch and Carlson 1980): it never overshoots the report.
    Beyond the last knot the report says nothing, and nothing is invented: Δ keeps the last value, which it reaches
    with slope zero.
    """

    radii: tuple[float, ...]
    """Radii of the knots, tan α = r / c, increasing; the axis may be left out."""
    shifts: tuple[float, ...]
    """Δ at the knots, divided by c."""
    _knots: NDArray[np.float64] = field(init=False, repr=False, compare=False)
    _cubics: NDArray[np.float64] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        radii, shifts = tuple(map(float, self.radii)), tuple(map(float, self.shifts))
        if len(radii) != len(shifts) or not radii:
            raise InputError(
                f"radial table with {len(radii)} radii and {len(shifts)} shifts; as many of both are needed"
            )
        if not all(map(math.isfinite, radii + shifts)):
            raise InputError(f"radial table {self.radii}, {self.shifts}: every entry must be a finite number")
        if radii[0] != 0.0:
            radii, shifts = (0.0, *radii), (0.0, *shifts)
        if shifts[0] != 0.0:
            raise InputError(f"radial table: the shift on the axis is {shifts[0]}, it must be zero")
        if len(radii) < 2 or not all(a < b for a, b in itertools.pairwise(radii)):
            raise InputError(f"radial table: radii {self.radii} must be positive and increase")
        knots = np.array(radii)
        cubics = _monotone_cubics(knots, np.array(shifts))
        object.__setattr__(self, "radii", radii)
        object.__setattr__(self, "shifts", shifts)
        object.__setattr__(self, "_knots", knots)
        object.__setattr__(self, "_cubics", cubics)
        sample = np.linspace(0.0, knots[-1], 32 * len(knots))
        steep = 1.0 + self._shift(sample)[1] <= 0.0
        if steep.any():
            raise InputError(
                f"radial table folds back near r / c = {sample[steep][0]:.4g}: the shifts fall faster than the radii "
                "grow; check their unit (micrometres?)"
            )

    @classmethod
    def from_angles(cls, angles_deg: ArrayLike, micrometres: ArrayLike, c_mm: float) -> RadialTable:
        """From distortion in micrometres against the field angle in degrees (USGS reports), camera constant in mm."""
        angles = np.atleast_1d(np.asarray(angles_deg, float))
        if not ((angles >= 0) & (angles < 90)).all():
            raise InputError(f"field angles {angles.tolist()}; degrees from 0 to below 90 are needed")
        return cls.from_radii(_camera_constant(c_mm) * np.tan(np.radians(angles)), micrometres, c_mm)

    @classmethod
    def from_radii(cls, radii_mm: ArrayLike, micrometres: ArrayLike, c_mm: float) -> RadialTable:
        """From distortion in micrometres against the radius in the image in millimetres, camera constant in mm."""
        c = _camera_constant(c_mm)
        radii = np.atleast_1d(np.asarray(radii_mm, float)) / c
        shifts = np.atleast_1d(np.asarray(micrometres, float)) * 1e-3 / c
        return cls(tuple(radii.tolist()), tuple(shifts.tolist()))

    def distort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Ideal to real tangent coordinates, shapes (..., 2)."""
        t = np.asarray(t, float)
        r = np.hypot(t[..., 0], t[..., 1])
        return t * (1.0 + self._ratio(r))[..., None]

    def undistort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Real to ideal tangent coordinates, shapes (..., 2), by Newton's method."""
        t = np.asarray(t, float)
        rd = np.hypot(t[..., 0], t[..., 1])
        r = rd
        for _ in range(_ITERATIONS):
            shift, slope = self._shift(r)
            step = (r + shift - rd) / (1.0 + slope)
            r = np.maximum(r - step, 0.0)
            if not (np.abs(step) > 4e-16 + 2e-15 * r).any():
                break
        good = np.abs(r + self._shift(r)[0] - rd) <= 1e-12 * (1.0 + rd)
        return t * np.where(good, 1.0 / (1.0 + self._ratio(r)), np.nan)[..., None]

    def jacobian(self, t: ArrayLike) -> NDArray[np.float64]:
        """∂ distort(t) / ∂ t, shape (..., 2, 2)."""
        t = np.asarray(t, float)
        r = np.hypot(t[..., 0], t[..., 1])
        return radial_jacobian(t, r, 1.0 + self._ratio(r), 1.0 + self._shift(r)[1])

    def _shift(self, r: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Δ(r) and its slope."""
        # The last row of the cubics is the constant beyond the last knot.
        i = np.searchsorted(self._knots, r, side="right") - 1
        s = r - self._knots[i]
        a, b, c, d = np.moveaxis(self._cubics[i], -1, 0)
        return a + s * (b + s * (c + s * d)), b + s * (2.0 * c + s * 3.0 * d)

    def _ratio(self, r: NDArray[np.float64]) -> NDArray[np.float64]:
        """Δ(r) / r, on the axis its limit, the slope."""
        shift = self._shift(r)[0]
        return np.where(r > 0, shift / np.where(r > 0, r, 1.0), self._cubics[0, 1])


def _camera_constant(c_mm: float) -> float:
    if not (math.isfinite(c_mm) and c_mm > 0):
        raise InputError(f"camera constant {c_mm} mm; a positive number is needed")
    return float(c_mm)


def _monotone_cubics(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coefficients a + b s + c s² + d s³ of each interval and of the constant beyond, shape (len(x), 4)."""
    h, rise = np.diff(x), np.diff(y)
    steepness = rise / h
    slope = np.zeros(len(x))
    before, after = steepness[:-1], steepness[1:]
    with np.errstate(divide="ignore", invalid="ignore"):
        w1, w2 = 2.0 * h[1:] + h[:-1], h[1:] + 2.0 * h[:-1]
        slope[1:-1] = np.where(before * after > 0, (w1 + w2) / (w1 / before + w2 / after), 0.0)
    # On the axis the first chord; at the last knot zero, where the constant takes over.
    slope[0] = steepness[0]
    c = (3.0 * steepness - 2.0 * slope[:-1] - slope[1:]) / h
    d = (slope[:-1] + slope[1:] - 2.0 * steepness) / h**2
    return np.vstack([np.stack([y[:-1], slope[:-1], c, d], axis=1), [y[-1], 0.0, 0.0, 0.0]])


@dataclass(frozen=True)
class Reversed:
    """The lens that undoes another: its distortion is the other's correction, exactly.

    Calibration programs of the classical school state x_ideal = x_measured + Δx(x_measured). With Δ as coefficients
    of `lens`, `Reversed(lens)` puts ideal points where they were measured.
    """

    lens: Lens
    """The lens whose `distort` takes real to ideal coordinates."""

    def distort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Ideal to real tangent coordinates, shapes (..., 2); NaN where there is no solution."""
        return self.lens.undistort(t)

    def undistort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Real to ideal tangent coordinates, shapes (..., 2), in closed form."""
        return self.lens.distort(t)

    def jacobian(self, t: ArrayLike) -> NDArray[np.float64]:
        """∂ distort(t) / ∂ t, shape (..., 2, 2)."""
        J = self.lens.jacobian(self.lens.undistort(t))
        inverse = np.empty_like(J)
        inverse[..., 0, 0], inverse[..., 1, 1] = J[..., 1, 1], J[..., 0, 0]
        inverse[..., 0, 1], inverse[..., 1, 0] = -J[..., 0, 1], -J[..., 1, 0]
        return inverse / determinant(J)[..., None, None]
