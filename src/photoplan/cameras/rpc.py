"""Rational polynomial cameras (RPC): functions, projection and rays, and their fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import Camera, Vantage, project
from photoplan.cameras.fiducials import Affine2D
from photoplan.errors import GeometryError, InputError, UsageError
from photoplan.geometry.crs import nearest_turn
from photoplan.geometry.local import GeodeticGround
from photoplan.geometry.pose import solve2

#: Polynomials hold for normalised coordinates from −1 to 1; as far as this they are followed: images reach a little
#: beyond what the coefficients were fitted to. Further out there is no position.
BOUND = 1.5
#: A denominator below this part of its value in the middle is near a pole: no position.
_POLE = 1e-3
#: Where positions lie this near to a linear function of the ground, no pole is (normalised); seen where denominators
#: are this part of their value in the middle at least.
_STRAIGHT, _APART = 0.1, 0.2
#: Normalised image coordinates beyond this are no part of an image, and at so many of 27 places no accident.
_FAR, _MOST_FAR = 100.0, 6
#: Powers of longitude, latitude and height of the 20 terms, in the order of RPC00B.
_POWERS = np.array(
    [
        *((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (2, 0, 0), (0, 2, 0), (0, 0, 2)),
        *((1, 1, 1), (3, 0, 0), (1, 2, 0), (1, 0, 2), (2, 1, 0), (0, 3, 0), (0, 1, 2), (2, 0, 1), (0, 2, 1), (0, 0, 3)),
    ]
)
_ITERATIONS = 20
#: A position is found again to this, pixels; what rounds map coordinates to 1e-9 m is below it.
_FOUND = 1e-6


#: An image was scaled if its sides differ by more than a part from those of the stated range, equally and from a
#: common corner but for a part of that. It is the whole one if its borders lie near to the range's, and begins with it
#: if it is this near. It may go on beyond the range without a word, in half ranges from the middle.
_SCALED, _ALIKE, _SAME, _BEGINS, _LITTLE = 0.01, 0.04, 0.05, 0.02, 1.1


@dataclass(frozen=True)
class SizeFit:
    """Place of an image in the range of sample and line that rational polynomials state."""

    kind: Literal["whole", "scaled", "part", "corner", "beyond", "outside", "unknown"]
    """``scaled``: it has the shape of the range and begins with it, but has another size. ``corner``: it begins with
    the range and is a part of it. ``beyond``: it goes on a little behind the range; ``outside``: far."""
    whole: tuple[int, int]
    """Width and height of the range, pixels."""
    scale: float = 1.0
    """Pixels of a scaled image for one of the range."""


@dataclass(frozen=True, eq=False)
class RationalFunctions:
    """The numbers of RPC00B, checked at birth.

    Raises
    ------
    InputError
        A number is not finite, a scale 0, an offset no place on earth, or a denominator vanishes in the middle.
    """

    image_offset: tuple[float, float]
    """Sample and line offset, pixels; (0, 0) is the centre of the upper-left pixel."""
    image_scale: tuple[float, float]
    ground_offset: tuple[float, float, float]
    """Offsets of longitude and latitude (degrees, WGS 84) and ellipsoidal height (metres)."""
    ground_scale: tuple[float, float, float]
    coefficients: NDArray[np.float64]
    """Numerator and denominator of the sample, then of the line, shape (4, 20)."""

    def __post_init__(self) -> None:
        coefficients = np.array(self.coefficients, float)
        if coefficients.shape != (4, 20):
            raise InputError(f"{coefficients.shape} coefficients; RPC00B has 4 × 20")
        coefficients.setflags(write=False)
        object.__setattr__(self, "coefficients", coefficients)
        parts = (self.image_offset, self.image_scale, self.ground_offset, self.ground_scale)
        if not (np.isfinite(np.concatenate(parts)).all() and np.isfinite(coefficients).all()):
            raise InputError("an offset, scale or coefficient is not a finite number")
        scales = (*self.image_scale, *self.ground_scale)
        if 0 in scales:
            told = ", ".join(f"{scale:g}" for scale in scales)
            raise InputError(f"scales {told} (sample, line, longitude, latitude, height); none of them is 0")
        if min(scales) < 0:
            self._turn_scales()
        lon, lat, height = self.ground_offset
        if not (abs(lon) <= 360 and abs(lat) <= 90 and abs(height) < 1e4):
            raise InputError(
                f"its middle is at longitude {lon:g}°, latitude {lat:g}°, height {height:g} m, which is nowhere on "
                "earth; are the offsets in degrees and metres?"
            )
        if not (max(self.ground_scale[:2]) <= 180 and self.ground_scale[2] < 1e5):
            told = ", ".join(f"{scale:g}" for scale in self.ground_scale)
            raise InputError(
                f"scales {told} (longitude, latitude, height) exceed the earth; are they in degrees and metres?"
            )
        if (coefficients[1::2, 0] == 0).any():
            raise InputError("a denominator vanishes in the middle of the image; the first of its coefficients is 0")
        if (coefficients[::2, 1:3] == 0).all(axis=1).any():
            raise InputError("a numerator does not change with longitude and latitude; coefficients are missing")
        self._refuse_far()

    def _turn_scales(self) -> None:
        """Bring signs of scales into the terms of odd degree: some producers count latitudes southwards (Planet)."""
        image, ground = np.sign(self.image_scale), np.sign(self.ground_scale)
        coefficients = self.coefficients * np.prod(ground**_POWERS, axis=1)
        coefficients[::2] *= image[:, None]
        coefficients.setflags(write=False)
        object.__setattr__(self, "coefficients", coefficients)
        for name in ("image_scale", "ground_scale"):
            object.__setattr__(self, name, tuple(abs(scale) for scale in getattr(self, name)))

    def _refuse_far(self) -> None:
        """Refuse what leads from the box of ground coordinates to places many images away: a coefficient is wrong.

        Some producers scale by a whole degree (SkySat): of such a box that part counts in which the image lies, by the
        slopes in the middle.
        """
        nodes = np.stack(np.meshgrid(*[(-1.0, 0.0, 1.0)] * 3), axis=-1).reshape(-1, 3)
        top, bottom = self.coefficients[::2, :3], self.coefficients[1::2, :3]
        with np.errstate(all="ignore"):
            J = (top[:, 1:] - top[:, :1] / bottom[:, :1] * bottom[:, 1:]) / bottom[:, :1]
            nodes[:, :2] *= np.fmin(1.0, 2.0 * np.linalg.norm(J) / np.abs(J[0, 0] * J[1, 1] - J[0, 1] * J[1, 0]))
        p = terms(nodes) @ self.coefficients.T
        with np.errstate(all="ignore"):
            value, bottom = p[:, ::2] / p[:, 1::2], p[:, 1::2] / self.coefficients[1::2, 0]
        far = ~(np.abs(value) < _FAR) & (bottom > _POLE)
        # A pole may lie beside one of the 27 places, outside the image.
        if (far.sum(axis=0) >= _MOST_FAR).any():
            what = ("sample", "line")[int(np.argmax(far.sum(axis=0)))]
            raise InputError(
                f"the {what} at the border of its ground lies more than {_FAR:g} images away; one of its coefficients "
                "is wrong: get a fresh copy"
            )

    def scaled(self, scale: float) -> RationalFunctions:
        """The functions of an image with so many pixels for one of theirs: pixel corners keep their places."""
        (x, y), (width, height) = self.image_offset, self.image_scale
        offset = (scale * (x + 0.5) - 0.5, scale * (y + 0.5) - 0.5)
        return replace(self, image_offset=offset, image_scale=(scale * width, scale * height))

    def apart(self, other: RationalFunctions) -> float:
        """The largest distance of two functions' positions over the ground of this one, pixels."""
        nodes = np.stack(np.meshgrid(*[(-0.8, 0.0, 0.8)] * 3), axis=-1).reshape(-1, 3)
        ground = nodes * self.ground_scale + self.ground_offset
        away = np.linalg.norm(self(ground) - other(ground), axis=1)
        known = np.isfinite(self(ground)[:, 0])
        return float(np.nan_to_num(away[known], nan=np.inf).max(initial=0.0))

    def fit(self, size: tuple[int, int], shift: tuple[float, float] = (0.0, 0.0)) -> SizeFit:
        """Return how an image of a size lies in the range of sample and line that the offsets and scales state."""
        centre = np.array(
            [self.coefficients[0, 0] / self.coefficients[1, 0], self.coefficients[2, 0] / self.coefficients[3, 0]]
        )
        W, scale = np.array(size, float), np.array(self.image_scale)
        first = np.array(self.image_offset) + shift - scale + 0.5
        span = 2.0 * scale
        ends = np.stack([first, first + span - W]) / span
        whole = (round(float(span[0])), round(float(span[1])))
        if (np.abs(centre) > 0.5).any():
            # Scales that do not belong to the coefficients state no range.
            return SizeFit("unknown", whole)
        factor = W / span
        change = float(np.abs(1.0 - factor).min())
        if change > _SCALED and float(np.abs(ends[0]).max()) <= _ALIKE * change >= float(np.ptp(factor)):
            return SizeFit("scaled", whole, float(np.sqrt(factor.prod())))
        if (np.abs(ends) <= _SAME).all():
            return SizeFit("whole", whole)
        beyond = float(np.maximum(ends[0], -ends[1]).max()) * 2.0 + 1.0
        if beyond > BOUND:
            return SizeFit("outside", whole)
        if beyond > _LITTLE:
            return SizeFit("beyond", whole)
        return SizeFit("corner" if (np.abs(ends[0]) <= _BEGINS).all() else "part", whole)

    @cached_property
    def _shares(self) -> NDArray[np.bool_]:
        """Return whether numerator and denominator, of sample and line (2,), vanish together inside the box.

        Polynomials that were fitted without restraint can share a factor: it changes its sign, and positions go
        straight on behind, as they never do behind a pole.
        """
        nodes = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 7)] * 3), axis=-1).reshape(-1, 3)
        p, plane = terms(nodes) @ self.coefficients.T, np.column_stack([np.ones(len(nodes)), nodes])
        shares = np.zeros(2, np.bool_)
        for k in range(2):
            bottom = p[:, 2 * k + 1] / self.coefficients[2 * k + 1, 0]
            seen = np.abs(bottom) > _APART
            if (bottom > _POLE).all() or not (bottom[seen] < 0).any():
                continue
            value = p[seen, 2 * k] / p[seen, 2 * k + 1]
            if np.abs(value).max() < _FAR:
                miss = value - plane[seen] @ np.linalg.lstsq(plane[seen], value, rcond=None)[0]
                shares[k] = np.abs(miss).max() < _STRAIGHT
        return shares

    @property
    def heights(self) -> tuple[float, float]:
        """Lowest and highest ellipsoidal height at which there are positions, metres."""
        middle, half = self.ground_offset[2], self.ground_scale[2] * BOUND
        return middle - half, middle + half

    def __call__(self, geodetic: ArrayLike) -> NDArray[np.float64]:
        """Longitude, latitude (degrees) and ellipsoidal height (..., 3) to sample and line (..., 2).

        NaN where a normalised coordinate is beyond `BOUND`, and near a pole.
        """
        return self._evaluate(geodetic, None)[0]

    def with_derivatives(self, geodetic: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Sample and line (..., 2), and their derivatives by longitude, latitude and height (..., 2, 3)."""
        return self._evaluate(geodetic, 3)

    def inverse(self, xy: ArrayLike, height: ArrayLike) -> NDArray[np.float64]:
        """Longitude, latitude and height (n, 3) of sample and line (n, 2) at ellipsoidal heights (n,), by Newton.

        It starts in the middle of the polynomials, which are nearly linear. NaN where no position is found.
        """
        xy = np.asarray(xy, float)
        ground = np.broadcast_to(self.ground_offset, (len(xy), 3)).copy()
        ground[:, 2] = height
        found = np.zeros(len(xy), np.bool_)
        with np.errstate(all="ignore"):
            for _ in range(_ITERATIONS):
                at, J = self._evaluate(ground, 2, bound=np.inf)
                miss = at - xy
                ground[:, :2] -= solve2(J, miss)
                found = np.asarray((np.abs(miss) < _FOUND).all(axis=1))
                if found.all():
                    break
        ground[~found | np.isnan(self(ground)[:, 0])] = np.nan
        return ground

    def _evaluate(
        self, geodetic: ArrayLike, by: int | None, bound: float = BOUND
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Sample and line, and their derivatives by the first `by` ground coordinates (none: an empty array)."""
        geodetic = np.asarray(geodetic, float)
        away = geodetic - self.ground_offset
        # Longitudes of files may be counted from 0 to 360°.
        away[..., 0] -= 360.0 * np.round(away[..., 0] / 360.0)
        n = away / self.ground_scale
        C = self.coefficients
        powers = _powers_of(n)
        p = _terms(powers, _POWERS) @ C.T
        with np.errstate(all="ignore"):
            part = p[..., 1::2] / C[1::2, 0]
            part = np.where(self._shares, np.abs(part), part)
            good = np.all(np.abs(n) <= bound, axis=-1) & np.all(part > _POLE, axis=-1)
            top, bottom = p[..., ::2], np.where(np.expand_dims(good, -1), p[..., 1::2], np.nan)
            value = top / bottom
            xy = value * self.image_scale + self.image_offset
            J = np.empty((*value.shape, by or 0))
            for k in range(by or 0):
                lower = _POWERS.copy()
                lower[:, k] -= 1
                dp = (_terms(powers, np.maximum(lower, 0)) * _POWERS[:, k]) @ C.T
                slope = (dp[..., ::2] - value * dp[..., 1::2]) / bottom
                J[..., k] = slope * self.image_scale / self.ground_scale[k]
        return xy, J


def terms(normalised: NDArray[np.float64]) -> NDArray[np.float64]:
    """The twenty terms of normalised longitude, latitude and height (..., 3), in the order of RPC00B, (..., 20)."""
    return _terms(_powers_of(normalised), _POWERS)


def _powers_of(n: NDArray[np.float64]) -> NDArray[np.float64]:
    """Powers 0 to 3, shape (4, ...)."""
    powers = np.ones((4, *n.shape))
    for k in range(3):
        np.multiply(powers[k], n, out=powers[k + 1])
    return powers


def _terms(powers: NDArray[np.float64], exponents: NDArray[np.int64]) -> NDArray[np.float64]:
    """Products of powers (4, ..., 3) of the three coordinates, shape (..., 20)."""
    L, P, H = (np.moveaxis(powers[exponents[:, k], ..., k], 0, -1) for k in range(3))
    return L * P * H


@dataclass(frozen=True, eq=False)
class RpcCamera:
    """An image with rational polynomials over the ground of a project: a camera without a projection centre."""

    functions: RationalFunctions
    ground: GeodeticGround
    size: tuple[int, int]
    """Width and height of the image in pixels."""
    correction: Affine2D | None = None
    """From the polynomials' positions to those in the image (Fraser & Hanley 2003, eq. 4): a shift, a drift along the
    lines, or all six parameters; None: there is none."""

    field: ClassVar[None] = None
    """All is in the first factor."""
    breaks: ClassVar[None] = None
    """Polynomials are smooth."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Return remarks on how the polynomials fit the image, a sentence each."""
        shift = (0.0, 0.0) if self.correction is None else (self.correction.a3, self.correction.a6)
        fit = self.functions.fit(self.size, shift)
        size = f"{self.size[0]} × {self.size[1]} pixels, and its polynomials hold for {fit.whole[0]} × {fit.whole[1]}"
        if fit.kind == "corner":
            return (
                f"the image has {size} from its first pixel on; if it was cut out elsewhere, set shift = "
                "[-COLUMN, -ROW] in [[images]]",
            )
        return (f"the image has {size}: it goes on beyond them",) if fit.kind == "beyond" else ()

    def project_homogeneous(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Ground (..., 3) to (x, y, 1); NaN where the polynomials do not hold."""
        XYZ = np.asarray(XYZ, float)
        out = np.ones(XYZ.shape)
        out[..., :2] = self._corrected(self.functions(self.ground(XYZ)))
        out[np.isnan(out[..., 0])] = np.nan
        return out

    def derivatives(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """∂(x, y)/∂(X, Y, Z), shape (..., 2, 3), pixels per metre; NaN where the polynomials do not hold."""
        return self._with_derivatives(np.asarray(XYZ, float))[1]

    def rays(self, xy: ArrayLike, height: ArrayLike | None = None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Image points (..., 2) to rays: the point of the ray at `height` and its tangent there, each (..., 3).

        `height` is one number or one for each point. NaN where the polynomials do not hold.

        Raises
        ------
        UsageError
            `height` is missing.
        """
        if height is None:
            raise UsageError("rays of an image with rational polynomials begin nowhere; give a height")
        xy = np.asarray(xy, float)
        shape = (*xy.shape[:-1], 3)
        heights = np.broadcast_to(np.asarray(height, float), shape[:-1]).ravel()
        point = self._meet(xy.reshape(-1, 2), heights)
        with np.errstate(all="ignore"):
            A = self.derivatives(point)
            # Along the ray neither x nor y changes; it leads down.
            d = np.cross(A[:, 0], A[:, 1])
            d *= -np.sign(d[:, 2:]) / np.linalg.norm(d, axis=1, keepdims=True)
        return point.reshape(shape), d.reshape(shape)

    @cached_property
    def vantage(self) -> Vantage:
        """The highest point of a ray in the middle, and how far from it the ground is that the image may show."""
        low, high = self._levels()
        corners = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5), (0.0, 0.0)])
        t = np.linspace(0.0, 1.0, 9)[:, None, None]
        border = (corners + t * (np.roll(corners, -1, axis=0) - corners)).reshape(-1, 2)
        xy = border * self.size + (np.array(self.size) - 1) / 2
        feet = np.concatenate([self.rays(xy, level)[0][:, :2] for level in (low, high)])
        if np.isnan(feet).all():
            raise InputError("the polynomials of the image do not hold anywhere in it; are they those of this image?")
        middle = (np.nanmin(feet, axis=0) + np.nanmax(feet, axis=0)) / 2
        reach = 1.1 * float(np.nanmax(np.linalg.norm(feet - middle, axis=1)))
        return Vantage(np.array([*middle, high]), low, reach)

    @cached_property
    def _undulation(self) -> float:
        """Ellipsoidal height minus the ground's, in the middle of the polynomials, metres."""
        middle = self.functions.ground_offset
        return middle[2] - float(self.ground.to_map(middle)[2])

    def _levels(self) -> tuple[float, float]:
        """Heights of the ground between which the polynomials hold, a little inside."""
        lon, lat, _ = self.functions.ground_offset
        half_lon, half_lat, _ = self.functions.ground_scale
        levels = []
        for height, inwards in zip(self.functions.heights, (1, -1)):
            places = [(lon + u * half_lon, lat + v * half_lat, height) for u in (-1, 0, 1) for v in (-1, 0, 1)]
            known = self.ground.to_map(places)[:, 2]
            levels.append(inwards * float(np.nanmax(inwards * known)) + inwards * 1e-3)
        return levels[0], levels[1]

    def _corrected(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        return xy if self.correction is None else self.correction(xy)

    def _with_derivatives(self, XYZ: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        xy, J = self.functions.with_derivatives(self.ground(XYZ))
        J = J @ self.ground.jacobian(XYZ)
        if self.correction is not None:
            J = self.correction.derivative(xy) @ J
        return self._corrected(xy), J

    def _meet(self, xy: NDArray[np.float64], heights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Map points (n, 3) at given heights that have the positions xy; NaN where there is none."""
        wanted = xy if self.correction is None else self.correction.inverse(xy)
        # The height above the ellipsoid changes from place to place, by so little that Newton's method puts it right.
        point = self.ground.to_map(self.functions.inverse(wanted, heights + self._undulation))
        point[np.isnan(point[:, 2])] = np.nan
        point[:, 2] = heights
        miss = np.full_like(xy, np.nan)
        with np.errstate(all="ignore"):
            for _ in range(3):
                at, A = self._with_derivatives(point)
                miss = at - xy
                if not (np.abs(miss) > 1e-9).any():
                    break
                point[:, :2] -= solve2(A, miss)
            point[~(np.abs(miss) < _FOUND).all(axis=1)] = np.nan
        return point


#: Rounds of the weighting by the denominator; it stands still after three.
_ROUNDS = 6
#: Singular values below this part of the largest tell nothing: several quotients are then the same function. What
#: rounding leaves of them may put a pole into the volume; then the next is tried, which takes one with less of them.
_RANKS = (1e-13, 1e-11, 1e-9)
#: A denominator is to stay above this part of its value in the middle, as far out as polynomials are followed.
_POLE_RPC_FIT = 0.05
#: Image points along a side and heights at which a camera is fitted, and those between them at which it is checked.
_FIT, _CHECK = (21, 9), (18, 7)


@dataclass(frozen=True, eq=False)
class FittedRpc:
    """Rational polynomials, and how well they stand for the camera at places between those of the fit."""

    functions: RationalFunctions
    rms: tuple[float, float]
    """Root mean squares of column and row, pixels."""
    worst: float
    """Largest distance, pixels."""


def fitted_functions(geodetic: ArrayLike, xy: ArrayLike) -> RationalFunctions:
    """Rational polynomials through points.

    The equation v · den(n) = num(n) is linear in the coefficients; divided by the denominator of the round before its
    residuals are those in the image (Tao & Hu 2001, eq. 12–16).
    """
    ground, image = (np.array(values, float) for values in (geodetic, xy))
    if len(ground):
        ground[:, 0] = nearest_turn(ground[:, 0], ground[0, 0], 360.0)
    low, high = (f(np.concatenate([image, ground], axis=1), axis=0) for f in (np.min, np.max))
    offset, scale = (low + high) / 2, (high - low) / 2
    if len(ground) < 39 or not (np.isfinite(scale).all() and (scale > 0).all()):
        raise GeometryError(
            f"{len(ground)} points with extents {', '.join(f'{2 * s:.3g}' for s in scale)} (column, row, longitude, "
            "latitude, height); polynomials need 39 and more that are spread over a volume"
        )
    normalised = (ground - offset[2:]) / scale[2:]
    T, beyond = terms(normalised), terms(BOUND * normalised)
    quotients = [_without_pole(T, beyond, v) for v in ((image - offset[:2]) / scale[:2]).T]
    return RationalFunctions(
        image_offset=(float(offset[0]), float(offset[1])),
        image_scale=(float(scale[0]), float(scale[1])),
        ground_offset=(float(nearest_turn(offset[2], 0.0, 360.0)), float(offset[3]), float(offset[4])),
        ground_scale=(float(scale[2]), float(scale[3]), float(scale[4])),
        coefficients=np.concatenate(quotients),
    )


def fit_rpc(camera: Camera, ground: GeodeticGround, heights: tuple[float, float]) -> FittedRpc:
    """Rational polynomials for all that a camera sees between two heights of the ground."""
    XYZ = _seen(camera, heights, _FIT)
    functions = fitted_functions(ground(XYZ), project(camera, XYZ))
    between = _seen(camera, heights, _CHECK)
    miss = functions(ground(between)) - project(camera, between)
    if not np.isfinite(miss).all():
        raise GeometryError("polynomials that follow it have a pole in the image; there are none to write")
    rms = np.sqrt((miss**2).mean(axis=0))
    return FittedRpc(functions, (float(rms[0]), float(rms[1])), float(np.hypot(*miss.T).max()))


def _seen(camera: Camera, heights: tuple[float, float], count: tuple[int, int]) -> NDArray[np.float64]:
    """Ground points (n, 3) of a regular grid of image points at regular heights."""
    part = np.linspace(0.0, 1.0, count[0])
    xy = np.stack(np.meshgrid(part, part), axis=-1).reshape(-1, 2) * camera.size - 0.5
    planes = []
    for level in np.linspace(*heights, count[1]):
        origin, direction = camera.rays(xy, float(level))
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (level - origin[:, 2]) / direction[:, 2]
        points = origin + along[:, None] * direction
        if not (np.isfinite(points).all() and (along >= 0).all()):
            raise GeometryError(
                f"not all of the image looks down to the height {level:.0f} m; polynomials are for images that do"
            )
        planes.append(points)
    return np.concatenate(planes)


def _without_pole(T: NDArray[np.float64], beyond: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """The quotient of most terms whose denominator does not vanish; the last where all do."""
    for rank in _RANKS:
        found = _quotient(T, v, rank)
        if min((T @ found[1]).min(), (beyond @ found[1]).min()) > _POLE_RPC_FIT:
            break
    return found


def _quotient(T: NDArray[np.float64], v: NDArray[np.float64], rank: float) -> NDArray[np.float64]:
    """Numerator and denominator (2, 20), the first coefficient of which is 1, with v ≈ (T num) / (T den)."""
    weight: NDArray[np.float64] = np.ones(len(v))
    solution: NDArray[np.float64] = np.zeros(39)
    for _ in range(_ROUNDS):
        A = np.concatenate([T, -v[:, None] * T[:, 1:]], axis=1) * weight[:, None]
        solution = np.asarray(np.linalg.lstsq(A, v * weight, rcond=rank)[0], np.float64)
        weight = np.asarray(1.0 / (1.0 + T[:, 1:] @ solution[20:]), np.float64)
    return np.stack([solution[:20], np.concatenate([[1.0], solution[20:]])])
