"""Fiducial marks: patterns, plane transformations between marks and scan, and their fit."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import astuple, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.adjustment.least_squares import Fit, solve
from photoplan.errors import GeometryError, InputError, UsageError


@dataclass(frozen=True, eq=False)
class MarkPart:
    """A polygon of one tone."""

    outline: NDArray[np.float64]
    """Vertices x right, y up about the mark's reference point, shape (n, 2), millimetres."""
    tone: float
    """0 dark to 1 bright, as in a positive; NaN: not compared (image content, that differs from photo to photo)."""


@dataclass(frozen=True, eq=False)
class MarkPattern:
    """A mark drawn from parts: each covers those before it."""

    name: str
    """Kind of the mark, for messages: cross, dot, ring, block …"""
    parts: tuple[MarkPart, ...]
    background: float
    """Tone where no part is; NaN: not compared."""
    window: tuple[float, float, float, float]
    """Area that is compared: xmin, ymin, xmax, ymax about the reference point, millimetres."""

    def __post_init__(self) -> None:
        x0, y0, x1, y1 = self.window
        if not (np.isfinite(self.window).all() and x0 < x1 and y0 < y1):
            raise InputError(f"mark {self.name!r}: window {self.window} mm; xmin < xmax and ymin < ymax are needed")

    def scaled(self, factor: float) -> MarkPattern:
        """The same mark in another size."""
        x0, y0, x1, y1 = (factor * side for side in self.window)
        parts = tuple(MarkPart(factor * part.outline, part.tone) for part in self.parts)
        return MarkPattern(self.name, parts, self.background, (x0, y0, x1, y1))

    def turned(self, degrees: float) -> MarkPattern:
        """The same mark turned anticlockwise about its reference point, in the same window."""
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        R = np.array([[c, s], [-s, c]])
        return replace(self, parts=tuple(MarkPart(part.outline @ R, part.tone) for part in self.parts))


@dataclass(frozen=True, eq=False)
class MarkExample:
    """A mark cut from an image."""

    name: str
    values: NDArray[Any]
    """Grey values, shape (rows, columns)."""
    reference: tuple[float, float]
    """Column and row of the mark's reference point in `values`."""
    pixel_mm: float
    """Side of a pixel of the example, millimetres."""

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or min(self.values.shape) < 5:
            raise InputError(f"example of mark {self.name!r}: shape {self.values.shape}; a grey image is needed")
        if not (np.isfinite(self.pixel_mm) and self.pixel_mm > 0):
            raise InputError(f"example of mark {self.name!r}: pixel of {self.pixel_mm} mm; a positive one is needed")

    def scaled(self, factor: float) -> MarkExample:
        """The same mark in another size."""
        return replace(self, pixel_mm=factor * self.pixel_mm)


def _affine(xy: ArrayLike, a: tuple[float, float, float, float, float, float]) -> NDArray[np.float64]:
    """Points (..., 2) by a1 to a6 of an affine transformation."""
    xy = np.asarray(xy, float)
    x, y, out = xy[..., 0], xy[..., 1], np.empty_like(xy)
    out[..., 0] = a[0] * x + a[1] * y + a[2]
    out[..., 1] = a[3] * x + a[4] * y + a[5]
    return out


@dataclass(frozen=True)
class Affine2D:
    """x' = a1 x + a2 y + a3, y' = a4 x + a5 y + a6 (Ecker 1991, eq. 4.2; Behr 1989, eq. 5.2).

    `f @ g` is g followed by f (with a bilinear g: Ecker 1991, appendix A), `~f` the inverse.
    """

    a1: float
    a2: float
    a3: float
    a4: float
    a5: float
    a6: float

    def __post_init__(self) -> None:
        if not all(math.isfinite(v) for v in astuple(self)):
            raise InputError(f"{self!r}: every coefficient must be a finite number")
        if self.determinant == 0.0:
            raise GeometryError(f"{self!r} maps the plane onto a line; its inverse does not exist")

    @property
    def determinant(self) -> float:
        """a1 a5 − a2 a4; negative where one system has y up and the other y down."""
        return self.a1 * self.a5 - self.a2 * self.a4

    def __call__(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Transform points, shapes (..., 2)."""
        return _affine(xy, (self.a1, self.a2, self.a3, self.a4, self.a5, self.a6))

    def inverse(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Points back, shapes (..., 2)."""
        return _affine(xy, self._inverted)

    def derivative(self, xy: ArrayLike) -> NDArray[np.float64]:
        """∂(x', y') / ∂(x, y), shape (..., 2, 2)."""
        J = np.array([[self.a1, self.a2], [self.a4, self.a5]])
        return np.broadcast_to(J, (*np.shape(xy), 2))

    @property
    def _inverted(self) -> tuple[float, float, float, float, float, float]:
        """a1 to a6 of the inverse."""
        d = self.determinant
        a1, a2, a4, a5 = self.a5 / d, -self.a2 / d, -self.a4 / d, self.a1 / d
        return a1, a2, -(a1 * self.a3 + a2 * self.a6), a4, a5, -(a4 * self.a3 + a5 * self.a6)

    def __invert__(self) -> Affine2D:
        return Affine2D(*self._inverted)

    def __matmul__(self, other: Affine2D | Bilinear2D) -> Affine2D | Bilinear2D:
        first, second = (self.a1, self.a2, self.a3), (self.a4, self.a5, self.a6)
        if isinstance(other, Bilinear2D):
            g, h = astuple(other)[:4], astuple(other)[4:]
            x, y = ([p * u + q * v for u, v in zip(g, h)] for p, q, _ in (first, second))
            x[3] += self.a3
            y[3] += self.a6
            return Bilinear2D(*x, *y)
        if isinstance(other, Affine2D):
            g, h = astuple(other)[:3], astuple(other)[3:]
            x, y = ([p * u + q * v for u, v in zip(g, h)] for p, q, _ in (first, second))
            x[2] += self.a3
            y[2] += self.a6
            return Affine2D(*x, *y)
        return NotImplemented


@dataclass(frozen=True)
class Bilinear2D:
    """x' = b1 x + b2 y + b3 x y + b4, y' = b5 x + b6 y + b7 x y + b8 (Ecker 1991, eq. 4.3).

    Invertible where its determinant keeps the sign that it has at x = y = 0, so the origin should lie in the image.
    The inverse is not bilinear: it is the method `inverse`, there is no `~`.
    """

    b1: float
    b2: float
    b3: float
    b4: float
    b5: float
    b6: float
    b7: float
    b8: float

    def __post_init__(self) -> None:
        if not all(math.isfinite(v) for v in astuple(self)):
            raise InputError(f"{self!r}: every coefficient must be a finite number")
        if self.determinant == 0.0:
            raise GeometryError(f"{self!r} is singular at x = y = 0; the origin must lie inside the image")

    @property
    def determinant(self) -> float:
        """Determinant of the derivative at the origin; negative where one system has y up and the other y down."""
        return self.b1 * self.b6 - self.b2 * self.b5

    def __call__(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Transform points, shapes (..., 2)."""
        xy = np.asarray(xy, float)
        x, y = xy[..., 0], xy[..., 1]
        out = np.empty_like(xy)
        out[..., 0] = self.b1 * x + (self.b2 + self.b3 * x) * y + self.b4
        out[..., 1] = self.b5 * x + (self.b6 + self.b7 * x) * y + self.b8
        return out

    def inverse(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Points back, shapes (..., 2), in closed form; NaN where no point of the origin's sheet is mapped there."""
        xy = np.asarray(xy, float)
        u, v = xy[..., 0] - self.b4, xy[..., 1] - self.b8
        # Eliminating y (or x) leaves A x² + B x + C = 0. Its discriminant is the squared determinant of the derivative,
        # so the root with the origin's sign lies on the origin's sheet; this form of it also holds for A = 0.
        d = self.determinant
        mixed = self.b7 * u - self.b3 * v
        sign = math.copysign(1.0, d)
        with np.errstate(all="ignore"):
            out = np.empty_like(xy)
            C = self.b6 * u - self.b2 * v
            B = mixed - d
            out[..., 0] = 2.0 * C / (sign * np.sqrt(B * B - 4.0 * (self.b3 * self.b5 - self.b1 * self.b7) * C) - B)
            C = self.b5 * u - self.b1 * v
            B = mixed + d
            out[..., 1] = 2.0 * C / (-sign * np.sqrt(B * B - 4.0 * (self.b3 * self.b6 - self.b2 * self.b7) * C) - B)
        return out

    def derivative(self, xy: ArrayLike) -> NDArray[np.float64]:
        """∂(x', y') / ∂(x, y), shape (..., 2, 2)."""
        xy = np.asarray(xy, float)
        x, y = xy[..., 0], xy[..., 1]
        J = np.empty((*xy.shape, 2))
        J[..., 0, 0] = self.b1 + self.b3 * y
        J[..., 0, 1] = self.b2 + self.b3 * x
        J[..., 1, 0] = self.b5 + self.b7 * y
        J[..., 1, 1] = self.b6 + self.b7 * x
        return J

    def __matmul__(self, other: Affine2D) -> Bilinear2D:
        """An affine transformation followed by this one, where that is bilinear again: axes kept or exchanged."""
        if isinstance(other, Bilinear2D):
            raise UsageError("two bilinear transformations in succession are not bilinear (Ecker 1991, eq. A.8)")
        if not isinstance(other, Affine2D):
            return NotImplemented
        a = other
        if a.a1 * a.a4 != 0.0 or a.a2 * a.a5 != 0.0:
            raise UsageError("a bilinear transformation after a rotation or shear is not bilinear")
        rows = []
        for p, q, m, s in (astuple(self)[:4], astuple(self)[4:]):
            rows += [
                p * a.a1 + q * a.a4 + m * (a.a1 * a.a6 + a.a3 * a.a4),
                p * a.a2 + q * a.a5 + m * (a.a2 * a.a6 + a.a3 * a.a5),
                m * (a.a1 * a.a5 + a.a2 * a.a4),
                p * a.a3 + q * a.a6 + m * a.a3 * a.a6 + s,
            ]
        return Bilinear2D(*rows)


@dataclass(frozen=True)
class AffineFacts:
    """The derivative of a plane transformation, taken apart."""

    scale: tuple[float, float]
    """Pixels per unit of the image plane along its x and its y axis (Behr 1989, app. B: scale factors)."""
    pixel_size: tuple[float, float]
    """The inverse: how far one pixel reaches along the plane's x and y axis, in the plane's unit (Behr: pixel size)."""
    direction_x: float
    """Direction of the plane's x axis in the scan, counted from columns to rows, that is clockwise as one looks at the
    scan, 0 to 2 π (Behr: rotation of the x axis)."""
    direction_y: float
    """Direction of the plane's y axis in the same way; 3 π / 2 for a scan that is upright."""
    shear: float
    """Angle between the two axes minus a right angle, radians."""
    mirrored: bool
    """Whether the scan shows the plane through its back."""

    @property
    def rotation(self) -> float:
        """Return how far the picture is turned in the scan, clockwise, −π to π: x and y axis in the mean.

        0: x to the right, y up. Of a mirrored scan: x to the left, y up, since `photoplan fiducials` too exchanges left
        and right first and turns then.
        """
        if self.mirrored:
            return _half_turn(self.direction_x + math.pi + self.shear / 2)
        return _half_turn(self.direction_x - self.shear / 2)


@dataclass(frozen=True)
class Shrinkage:
    """Shrinkage of the film since its camera was calibrated, as parts of the length."""

    x: float
    """Along the image's x axis; negative where it has grown."""
    y: float
    """Along its y axis."""
    sigma: tuple[float, float] = (math.nan, math.nan)
    """Standard deviations of both, from the adjustment of the marks; NaN: not known."""

    @property
    def mean(self) -> float:
        """Return the mean of both axes."""
        return (self.x + self.y) / 2


def affine_facts(transformation: Affine2D | Bilinear2D) -> AffineFacts:
    """Take a transformation from image plane (y up) to scan (rows down) apart, at the plane's origin."""
    x, y = transformation.derivative(np.zeros(2)).T
    scale = float(np.hypot(*x)), float(np.hypot(*y))
    direction_x, direction_y = (math.atan2(v[1], v[0]) % math.tau for v in (x, y))
    mirrored = bool(transformation.determinant > 0)
    # From x to y it is a quarter turn anticlockwise, of a mirrored scan clockwise.
    turn = _half_turn(direction_y - direction_x) * (1.0 if mirrored else -1.0)
    size = 1.0 / scale[0], 1.0 / scale[1]
    return AffineFacts(
        scale=scale,
        pixel_size=size,
        direction_x=direction_x,
        direction_y=direction_y,
        shear=turn - math.pi / 2,
        mirrored=mirrored,
    )


def film_shrinkage(
    transformation: Affine2D | Bilinear2D, pitch: tuple[float, float], covariance: NDArray[np.float64] | None = None
) -> Shrinkage:
    """Shrinkage of the film since its calibration, if the scanner's sampling distance is known.

    It includes what the scanner errs: only that of a calibrated scanner is true to some hundredths of a permille.
    """
    if not all(math.isfinite(p) and p > 0 for p in pitch):
        raise InputError(f"sampling distance {pitch} of the scan; two positive numbers are needed")
    on_film = np.asarray(pitch, float)[:, None] * transformation.derivative(np.zeros(2))
    length = np.linalg.norm(on_film, axis=0)
    sigma = (math.nan, math.nan)
    if covariance is not None:
        # Coefficients of x, of y: the first two of each row of the transformation.
        second = len(covariance) // 2
        along = on_film / length * np.asarray(pitch, float)[:, None]
        parts = (covariance[np.ix_([k, k + second], [k, k + second])] for k in (0, 1))
        variances = [float(along[:, k] @ part @ along[:, k]) for k, part in enumerate(parts)]
        sigma = (math.sqrt(variances[0]), math.sqrt(variances[1]))
    x, y = 1.0 - length
    return Shrinkage(float(x), float(y), sigma)


def residuals_on_film(
    transformation: Affine2D | Bilinear2D, plane: ArrayLike, residuals: ArrayLike
) -> NDArray[np.float64]:
    """Residuals in the scan as residuals in the image plane: x right, y up, in its unit, shape (n, 2)."""
    J = transformation.derivative(np.asarray(plane, float))
    return np.linalg.solve(J, np.asarray(residuals, float)[..., None])[..., 0]


def _half_turn(angle: float) -> float:
    """The same direction from −π to π."""
    return math.remainder(angle, math.tau)


#: Marks as name → (x, y), or as rows (name, x, y) of a file, in which a name may by mistake occur twice.
Marks = Mapping[str, tuple[float, float]] | Iterable[tuple[str, float, float]]

_Design = Callable[[NDArray[np.float64]], NDArray[np.float64]]

#: Transformations and how many marks each needs. A similarity could do with two, but two marks check nothing.
MODELS = {"similarity": 3, "affine": 3, "bilinear": 4}

#: Film shrinks by a few parts in ten thousand; residuals beyond this part of the marks' extent are blunders.
BLUNDER = 0.005


@dataclass(frozen=True, eq=False)
class FiducialFit:
    """Result of the adjustment."""

    transformation: Affine2D | Bilinear2D
    """From the image plane (millimetres, x right, y up) to pixels."""
    names: tuple[str, ...]
    """The marks that were used."""
    residuals: NDArray[np.float64]
    """Transformed minus measured position of each mark, shape (n, 2), pixels."""
    redundancy: int
    """Observations minus unknowns: 0 means that nothing checks the marks."""
    sigma0: float
    """Standard deviation of one measured coordinate, pixels; NaN without redundancy."""
    covariance: NDArray[np.float64]
    """Covariance of the coefficients, in the transformation's order, (6, 6) or (8, 8); NaN without redundancy. For a
    similarity, whose six coefficients are functions of four, it has rank 4."""
    missing: tuple[str, ...]
    """Calibrated marks that were not measured."""
    model: str = "affine"
    """One of `MODELS`."""

    def __str__(self) -> str:
        check = f"sigma0 {self.sigma0:.3f} px" if self.redundancy else "no redundancy: the marks are not checked"
        lines = [f"{self.model} interior orientation from {len(self.names)} fiducial marks, {check}"]
        lines += [f"  {n:>8}  vx {v[0]:+8.3f}  vy {v[1]:+8.3f} px" for n, v in zip(self.names, self.residuals)]
        if self.missing:
            lines.append(f"  not measured: {', '.join(self.missing)}")
        return "\n".join(lines)


def fit_marks(model: str, plane_mm: Marks, scan_px: Marks, *, mirrored: bool = False) -> FiducialFit:
    """`fit_similarity`, `fit_affine` or `fit_bilinear`, by the name of the model."""
    fits = {"similarity": fit_similarity, "affine": fit_affine, "bilinear": fit_bilinear}
    if model not in fits:
        raise InputError(f"interior orientation {model!r}; allowed are {', '.join(fits)}")
    return fits[model](plane_mm, scan_px, mirrored=mirrored)


def fit_affine(plane_mm: Marks, scan_px: Marks, *, mirrored: bool = False) -> FiducialFit:
    """Affine transformation from image plane to scan by least squares (Ecker 1991, eq. 4.2; Behr 1989, eq. 5.2)."""
    common = _pair(plane_mm, scan_px, "affine")
    found = _adjust(common.plane, common.scan, _affine_design)
    _check_marks(common, found.residuals, found.unknowns, mirrored)
    return _result(common, Affine2D(*found.unknowns), found, "affine")


def fit_bilinear(plane_mm: Marks, scan_px: Marks, *, mirrored: bool = False) -> FiducialFit:
    """Bilinear transformation from image plane to scan by least squares (Ecker 1991, eq. 4.3).

    Four marks determine it without any check, so they are first compared with an affine transformation. Parameters
    and errors are those of `fit_affine`, with at least four marks.
    """
    common = _pair(plane_mm, scan_px, "bilinear")
    affine = _adjust(common.plane, common.scan, _affine_design)
    _check_marks(common, affine.residuals, affine.unknowns, mirrored)
    found = _adjust(common.plane, common.scan, _bilinear_design)
    return _result(common, Bilinear2D(*found.unknowns), found, "bilinear")


def fit_similarity(plane_mm: Marks, scan_px: Marks, *, mirrored: bool = False) -> FiducialFit:
    """Similarity (shift, rotation, one scale; turned over, where the scan is) from image plane to scan.

    x' = p x + q y + s, y' = q x − p y + t, since rows run down and y runs up; of a mirrored scan x' = p x − q y + s,
    y' = q x + p y + t. It serves where film and scanner are known to be true to scale, and marks few or bad. Marks are
    first compared with an affine transformation. Parameters and errors are those of `fit_affine`; an `InputError` also
    tells scales that differ in x and y by more than film does.
    """
    common = _pair(plane_mm, scan_px, "similarity")
    affine = _adjust(common.plane, common.scan, _affine_design)
    _check_marks(common, affine.residuals, affine.unknowns, mirrored)
    found = _adjust_similarity(common.plane, common.scan, mirrored)
    off = np.linalg.norm(found.residuals, axis=1)
    limit = BLUNDER * float(np.ptp(common.scan, axis=0).max())
    if off.max() > limit:
        listed = ", ".join(f"{n} {v:.1f}" for n, v in zip(common.names, off))
        raise InputError(
            f"fiducial marks: a similarity leaves residuals (px: {listed}) above {limit:.1f} px. Either a mark is "
            "wrong, or the scan's pixels are not square: then use an affine transformation"
        )
    return _result(common, Affine2D(*found.unknowns), found, "similarity")


@dataclass(frozen=True, eq=False)
class _Pairs:
    names: tuple[str, ...]
    plane: NDArray[np.float64]
    scan: NDArray[np.float64]
    missing: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Adjusted:
    unknowns: NDArray[np.float64]
    covariance: NDArray[np.float64]
    residuals: NDArray[np.float64]
    redundancy: int
    sigma0: float


def _result(common: _Pairs, transformation: Affine2D | Bilinear2D, found: _Adjusted, model: str) -> FiducialFit:
    return FiducialFit(
        transformation=transformation,
        names=common.names,
        residuals=found.residuals,
        redundancy=found.redundancy,
        sigma0=found.sigma0,
        covariance=found.covariance,
        missing=common.missing,
        model=model,
    )


def _pair(plane_mm: Marks, scan_px: Marks, model: str) -> _Pairs:
    least = MODELS[model]
    plane, scan = _table(plane_mm, "calibrated"), _table(scan_px, "measured")
    unknown = [name for name in scan if name not in plane]
    if unknown:
        raise InputError(
            f"measured fiducial mark {_list(unknown)} is not calibrated; the calibration has {_list(plane)}"
        )
    names = tuple(name for name in plane if name in scan)
    missing = tuple(name for name in plane if name not in scan)
    if len(names) < least:
        raise InputError(
            f"{len(names)} fiducial marks ({_list(names) or 'none'}) for {model} interior orientation; "
            f"{least} are needed. Not measured: {_list(missing) or 'none'}"
        )
    P, p = np.array([plane[n] for n in names]), np.array([scan[n] for n in names])
    for points, what in ((P, "calibrated"), (p, "measured")):
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if spread[1] < 0.01 * spread[0]:
            raise GeometryError(f"the {what} fiducial marks {_list(names)} lie on a line; marks beside it are needed")
    return _Pairs(names, P, p, missing)


def _table(marks: Marks, what: str) -> dict[str, tuple[float, float]]:
    rows = [(n, *xy) for n, xy in marks.items()] if isinstance(marks, Mapping) else list(marks)
    table: dict[str, tuple[float, float]] = {}
    for name, x, y in rows:
        if name in table:
            raise InputError(f"{what} fiducial mark {name!r} is given twice; remove one of the two")
        if not (math.isfinite(x) and math.isfinite(y)):
            raise InputError(f"{what} fiducial mark {name!r} at ({x}, {y}); two finite numbers are needed")
        table[name] = (float(x), float(y))
    if len(table) > 1:
        extent = max(np.ptp([v[k] for v in table.values()]) for k in (0, 1))
        for (a, p), (b, q) in itertools.combinations(table.items(), 2):
            if math.dist(p, q) <= BLUNDER * extent:
                raise InputError(
                    f"{what} fiducial marks {a!r} and {b!r} have the same place ({p[0]:g}, {p[1]:g}); one is wrong"
                )
    return table


def _affine_design(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.column_stack([xy, np.ones(len(xy))])


def _bilinear_design(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.column_stack([xy, xy[:, 0] * xy[:, 1], np.ones(len(xy))])


def _adjust(plane: NDArray[np.float64], scan: NDArray[np.float64], design: _Design) -> _Adjusted:
    """Least squares with one design for columns and rows."""
    fit = _solve(design(plane), scan)
    covariance = np.asarray(np.kron(np.eye(2), fit.cofactors) * fit.sigma0**2, float)
    return _Adjusted(
        unknowns=fit.unknowns.T.ravel(),
        covariance=covariance,
        residuals=fit.residuals,
        redundancy=fit.redundancy,
        sigma0=fit.sigma0,
    )


def _adjust_similarity(plane: NDArray[np.float64], scan: NDArray[np.float64], mirrored: bool) -> _Adjusted:
    """Least squares with columns and rows in one; unknowns are the six coefficients of an affine transformation."""
    turn = 1.0 if mirrored else -1.0
    # Coefficients a1 … a6 of p, q, s, t.
    J = np.array([[1, 0, 0, 0], [0, -turn, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [turn, 0, 0, 0], [0, 0, 0, 1]], float)
    fit = _solve(np.kron(np.eye(2), _affine_design(plane)) @ J, scan.T.ravel())
    covariance = J @ fit.covariance @ J.T if fit.redundancy else np.full((6, 6), math.nan)
    return _Adjusted(
        unknowns=J @ fit.unknowns,
        covariance=covariance,
        residuals=fit.residuals.reshape(2, -1).T,
        redundancy=fit.redundancy,
        sigma0=fit.sigma0,
    )


def _solve(A: NDArray[np.float64], observed: NDArray[np.float64]) -> Fit:
    fit = solve(A, observed)
    if fit.rank < A.shape[1]:
        raise GeometryError("the fiducial marks do not determine the transformation; marks at other places are needed")
    return fit


def _check_marks(common: _Pairs, residuals: NDArray[np.float64], affine: NDArray[np.float64], mirrored: bool) -> None:
    """Refuse residuals that no film has and scans of the wrong handedness, and say what would explain them."""
    off = np.linalg.norm(residuals, axis=1)
    limit = BLUNDER * float(np.ptp(common.scan, axis=0).max())
    turned = not _has_handedness(affine, mirrored)
    if off.max() <= limit and not turned:
        return
    exchanged = _exchanged(common, limit, mirrored)
    if off.max() <= limit:
        raise InputError(_turned_message(mirrored, exchanged))
    if exchanged:
        raise InputError(
            f"fiducial marks {' or '.join(exchanged)} are exchanged: residuals reach {off.max():.1f} px, and "
            f"less than {limit:.1f} px when these two change places"
        )
    listed = ", ".join(f"{n} {v:.1f}" for n, v in zip(common.names, off))
    raise InputError(
        f"fiducial marks: {_suspect(common)}; residuals (px: {listed}) exceed {limit:.1f} px, more than film deforms. "
        "Measure again, or check that the calibration belongs to this camera"
    )


def _exchanged(common: _Pairs, limit: float, mirrored: bool) -> list[str]:
    """Pairs of marks that make all residuals small, with the right handedness, when they change places."""
    pairs = []
    for i, j in itertools.combinations(range(len(common.names)), 2):
        order = list(range(len(common.names)))
        order[i], order[j] = j, i
        found = _adjust(common.plane, common.scan[order], _affine_design)
        if np.linalg.norm(found.residuals, axis=1).max() <= limit and _has_handedness(found.unknowns, mirrored):
            pairs.append(f"{common.names[i]!r} and {common.names[j]!r}")
    return pairs


def _has_handedness(affine: NDArray[np.float64], mirrored: bool) -> bool:
    # Image plane y up, rows downwards: the determinant of an unmirrored scan is negative.
    return bool((affine[0] * affine[4] - affine[1] * affine[3] > 0) == mirrored)


def _turned_message(mirrored: bool, exchanged: list[str]) -> str:
    also = f"; or the marks {' or '.join(exchanged)} are exchanged" if exchanged else ""
    if mirrored:
        return f"the fiducial marks are not mirrored in the scan, but mirrored = true was stated{also}"
    return (
        "the scan is mirrored: its fiducial marks run the other way round than the calibrated ones. If the film was "
        "scanned through its back, set `mirrored = true`; if marks and angles are stated with the scene at z > 0 (ω is "
        'then near half a circle for an aerial photograph), set `scene = "z > 0"` under [orientation] instead; else '
        f"check that rows are counted downwards and y upwards{also}"
    )


def _suspect(common: _Pairs) -> str:
    """The mark without which the others fit best; all, where nothing tells them apart."""
    n = len(common.names)
    if n < 5:
        return f"one of {_list(common.names)} is wrong (four marks cannot tell which)"
    left = []
    for k in range(n):
        rest = np.arange(n) != k
        left.append(_adjust(common.plane[rest], common.scan[rest], _affine_design).sigma0)
    return f"{common.names[int(np.argmin(left))]!r} is wrong"


def _list(names: Iterable[str]) -> str:
    return ", ".join(map(repr, names))
