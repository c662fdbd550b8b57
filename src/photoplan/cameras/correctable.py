"""Line cameras with corrections of a bundle adjustment: mount, drift, splines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy
from numpy.typing import NDArray

from photoplan.cameras.base import Camera, project
from photoplan.cameras.fiducials import Affine2D
from photoplan.cameras.pushbroom import ChippedLine, LineCamera, measured
from photoplan.cameras.pushbroom_rays import LineTrack
from photoplan.cameras.rpc import RpcCamera
from photoplan.errors import InputError
from photoplan.geometry.pose import Course, cubic_convolution, rotation_vector, rotations, skew, times

_Floats = NDArray[np.float64]
#: From the axes of frame images (x along the flight, y to the left, z up) to those of a line camera.
TURNED = np.diag([1.0, -1.0, -1.0])


def spline_weights(t: _Floats, first: float, step: float, knots: int) -> tuple[NDArray[np.int64], _Floats]:
    """The four coefficients of a uniform cubic spline that count at times (n,), and their weights; each (n, 4).

    Coefficients stand at `first`, `first + step` …; the spline is whole between the second and the last but one, and
    goes on as its ends are beyond.
    """
    at = np.clip((np.asarray(t, float) - first) / step, 1.0, knots - 2.0 - 1e-9)
    row = np.floor(at).astype(np.int64)
    u = at - row
    w = np.stack([(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3], axis=-1) / 6.0
    return row[..., None] + np.arange(-1, 3), np.asarray(w)


@dataclass(frozen=True, eq=False)
class TrackSpline:
    """Corrections that change with time: coefficients of uniform cubic splines."""

    first: float
    """Time of the first coefficient, seconds, as the track counts them."""
    step: float
    """From coefficient to coefficient, seconds."""
    coefficients: _Floats
    """East, north, up (metres), then small rotations about the camera's x, y, z (radians), (k, 6)."""

    def __post_init__(self) -> None:
        c = np.array(self.coefficients, float)
        if c.ndim != 2 or len(c) < 4 or c.shape[1] != 6 or not np.isfinite(c).all():
            raise InputError(f"corrections over time of shape {c.shape}; needed are 4 rows or more of 6 finite numbers")
        if not (np.isfinite([self.first, self.step]).all() and self.step > 0):
            raise InputError(f"corrections over time from {self.first:g} s on, every {self.step:g} s")

    @classmethod
    def over(cls, known: tuple[float, float], step: float) -> TrackSpline:
        """Return a correction of zero over a time."""
        count = max(1, int(np.ceil((known[1] - known[0]) / step - 1e-9)))
        return cls(known[0] - step, step, np.zeros((count + 3, 6)))

    @property
    def times(self) -> _Floats:
        """Return the times of the coefficients, (k,)."""
        return np.asarray(self.first + self.step * np.arange(len(self.coefficients)))

    def __call__(self, t: _Floats) -> _Floats:
        """Corrections (n, 6) at times (n,)."""
        columns, w = spline_weights(t, self.first, self.step, len(self.coefficients))
        return np.asarray(np.einsum("nj,njk->nk", w, self.coefficients[columns]))


@dataclass(frozen=True, eq=False)
class LineCorrection:
    """Correction of a trajectory; axes are those of frame images: x along the flight, y to the left, z up."""

    boresight: _Floats
    """Small rotations about the camera's x, y, z, (3,), radians."""
    lever_arm: _Floats
    """Added to the way from the recorded point to the projection centre, in the camera's axes, (3,), metres."""
    time_offset: float = 0.0
    """Added to the times of the trajectory, seconds."""
    spline: TrackSpline | None = None

    @classmethod
    def none(cls) -> LineCorrection:
        """Nothing is added."""
        return cls(np.zeros(3), np.zeros(3))

    def track(self, given: LineTrack) -> LineTrack:
        """The corrected trajectory."""
        late, known = self.time_offset, (given.known[0] + self.time_offset, given.known[1] + self.time_offset)
        boresight = _turns((TURNED @ self.boresight)[None])

        def positions(t: _Floats) -> _Floats:
            R = rotations(given.attitudes(t - late))
            return np.asarray(given.positions(t - late) + R @ (TURNED @ self.lever_arm))

        def attitudes(t: _Floats) -> _Floats:
            return times(given.attitudes(t - late), boresight)

        mounted = replace(given, positions=positions, attitudes=attitudes, known=known)
        return mounted if self.spline is None else displaced(mounted, self.spline, map_axes(given))


def displaced(given: LineTrack, course: Course, axes: _Floats) -> LineTrack:
    """A trajectory with something added: east, north, up (`axes`; metres), small rotations about x, y, z (radians)."""

    def positions(t: _Floats) -> _Floats:
        return np.asarray(given.positions(t) + course(t)[:, :3] @ axes.T)

    def attitudes(t: _Floats) -> _Floats:
        return times(given.attitudes(t), _turns(course(t)[:, 3:] @ TURNED))

    return replace(given, positions=positions, attitudes=attitudes)


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Accuracy of a trajectory: covariances of its poses over time."""

    times: _Floats
    """Growing, (k,), seconds as the track counts them; before and after them it is as at the ends."""
    covariance: _Floats
    """East, north, up (metres), then small rotations about the camera's x, y, z (radians), (k, 6, 6)."""

    @cached_property
    def _roots(self) -> _Floats:
        """Symmetric roots of the covariances: they change over time as smoothly as these."""
        scale = np.sqrt(np.maximum(np.diagonal(self.covariance, axis1=1, axis2=2), 1e-300))
        values, axes = np.linalg.eigh(self.covariance / (scale[:, :, None] * scale[:, None, :]))
        root = (axes * np.sqrt(np.maximum(values, 0.0))[:, None, :]) @ np.swapaxes(axes, 1, 2)
        return np.asarray(scale[:, :, None] * root)

    def course(self, change: _Floats) -> Course:
        """Return what one of six independent errors, or a part of some, (6,), does to poses at times (n,): (n, 6)."""
        moved = self._roots @ change
        return lambda t: np.stack([np.interp(t, self.times, column) for column in moved.T], axis=1)


def map_axes(track: LineTrack) -> _Floats:
    """East, north and up in the axes of the body, (3, 3), at the middle of a trajectory; up is away from the centre."""
    up = track.positions(np.array([np.mean(track.known)]))[0]
    up = up / np.linalg.norm(up)
    east = np.cross([0.0, 0.0, 1.0], up)
    east = east / max(float(np.linalg.norm(east)), 1e-12)
    return np.stack([east, np.cross(up, east), up], axis=1)


def _turns(v: _Floats) -> _Floats:
    """Quaternions (n, 4) of rotation vectors (n, 3)."""
    half = np.linalg.norm(v, axis=1, keepdims=True) / 2
    return np.concatenate([np.cos(half), v / 2 * np.sinc(half / np.pi)], axis=1)


@dataclass(frozen=True, eq=False)
class Corrections:
    """A set of parameters that one image has, or several share."""

    key: str
    """By which images share it; messages call it so."""
    owners: tuple[str, ...]
    """Owner of each row of the parameters: an image, moments of a flight."""
    parameters: tuple[str, ...]
    """Name in messages; {} stands for the owners: "row shift of {}"."""
    values: _Floats
    """Initial values of an adjustment, (owners, parameters); zero is as delivered."""
    known: scipy.sparse.csr_matrix
    """A priori knowledge: rows over the flattened values, each observed as zero with unit weight."""
    owner: str = ""
    """Kind of an owner: "image"."""


@dataclass(frozen=True, eq=False)
class ByCorrections:
    """Derivatives of image points by one set of parameters."""

    columns: NDArray[np.int64]
    """Which of the flattened values, (n, k)."""
    values: _Floats
    """∂(x, y) / ∂ these, (n, 2, k), pixels."""


class Correctable(Protocol):
    """The geometry of an image with its sets of parameters."""

    @property
    def corrections(self) -> tuple[Corrections, ...]:
        """The sets that it has, with what is known of them."""
        ...

    def camera(self, values: Mapping[str, _Floats]) -> Camera:
        """The camera with values (owners, parameters) of its sets, by their keys."""
        ...

    def seen(self, camera: Camera, XYZ: _Floats, xy: _Floats) -> _Floats:
        """Return where `camera` sees ground points (n, 3) that were measured at `xy` (n, 2); NaN where it does not."""
        ...

    def by_ground(self, camera: Camera, XYZ: _Floats, xy: _Floats) -> _Floats:
        """Derivatives of that by the ground points, (n, 2, 3)."""
        ...

    def by_corrections(self, camera: Camera, XYZ: _Floats, xy: _Floats) -> Mapping[str, ByCorrections]:
        """Derivatives of that by each set."""
        ...


def prior_rows(sigma: _Floats) -> scipy.sparse.csr_matrix:
    """Rows by which each value is known to be zero with a standard deviation, (n, n); infinite: not known at all."""
    known = np.flatnonzero(np.isfinite(sigma))
    weight = 1.0 / np.asarray(sigma, float)[known]
    return scipy.sparse.csr_matrix((weight, (np.arange(len(known)), known)), (len(known), len(sigma)))


#: Parameters of each form: column and row shift, then what changes by row, then what changes by column.
FORMS = {"shift": 1, "drift": 2, "affine": 3}
_NAMES = ("column shift of {}", "row shift of {}", "column drift of {}", "row drift of {}",
          "column stretch of {}", "row stretch of {}")  # fmt: skip


@dataclass(frozen=True, eq=False)
class CorrectableRpc:
    """An image with polynomials, whose correction is unknown.

    The parameters are pixels in the middle of the image, and pixels more at its last row and its last column: so all
    are of one size, and hardly correlated.
    """

    plain: RpcCamera
    """Without its correction."""
    name: str
    form: str
    """shift, drift or affine."""
    sigma: tuple[float, float]
    """Standard deviations known beforehand: of the shift, and of what changes until the border; pixels."""
    start: Affine2D | None = None
    """Where to begin."""

    @property
    def corrections(self) -> tuple[Corrections, ...]:
        """One set."""
        count = 2 * FORMS[self.form]
        sigma = np.repeat(np.array([self.sigma[0], self.sigma[1], self.sigma[1]]), 2)[:count]
        values = np.asarray(np.zeros(6) if self.start is None else np.linalg.solve(self.to_affine, _vector(self.start)))
        return (
            Corrections(
                key=self.key,
                owners=(self.name,),
                parameters=_NAMES[:count],
                values=values[None, :count],
                known=prior_rows(sigma),
                owner="image",
            ),
        )

    @property
    def key(self) -> str:
        """Return the key of the set."""
        return f"correction of {self.name!r}"

    @property
    def to_affine(self) -> _Floats:
        """From the parameters to shift at the first pixel (column, row) and drift (as projects state it), (6, 6)."""
        middle, half = (np.array(self.plain.size) - 1) / 2, np.maximum(np.array(self.plain.size) / 2, 1.0)
        T = np.zeros((6, 6))
        T[0, 0] = T[1, 1] = 1.0
        for k, (axis, first) in enumerate(((1, 2), (1, 3), (0, 4), (0, 5))):
            # A change by row or column that vanishes in the middle of the image.
            T[k % 2, first] = -middle[axis] / half[axis]
            T[2 + 2 * (k % 2) + axis, first] = 1.0 / half[axis]
        return T

    def affine(self, values: _Floats) -> tuple[float, ...]:
        """Shift and drift of parameters (k,), as projects state them: six numbers."""
        return tuple((self.to_affine[:, : len(values)] @ values).tolist())

    def camera(self, values: Mapping[str, _Floats]) -> Camera:
        """See `Correctable`."""
        x, y, xx, xy, yx, yy = self.affine(values[self.key][0])
        return replace(self.plain, correction=Affine2D(a1=1.0 + xx, a2=xy, a3=x, a4=yx, a5=1.0 + yy, a6=y))

    def seen(self, camera: Camera, XYZ: _Floats, xy: _Floats) -> _Floats:
        """See `Correctable`."""
        return project(camera, XYZ)

    def by_ground(self, camera: Camera, XYZ: _Floats, xy: _Floats) -> _Floats:
        """See `Correctable`."""
        return camera.derivatives(XYZ)

    def by_corrections(self, camera: Camera, XYZ: _Floats, xy: _Floats) -> Mapping[str, ByCorrections]:
        """See `Correctable`."""
        count = 2 * FORMS[self.form]
        before = self.plain.project_homogeneous(XYZ)[:, :2]
        middle, half = (np.array(self.plain.size) - 1) / 2, np.maximum(np.array(self.plain.size) / 2, 1.0)
        away = (before - middle) / half
        J = np.zeros((len(xy), 2, 6))
        J[:, 0, 0] = J[:, 1, 1] = 1.0
        J[:, 0, 2] = J[:, 1, 3] = away[:, 1]
        J[:, 0, 4] = J[:, 1, 5] = away[:, 0]
        columns = np.broadcast_to(np.arange(count), (len(xy), count))
        return {self.key: ByCorrections(columns, J[:, :, :count])}


def _vector(a: Affine2D) -> _Floats:
    return np.array([a.a3, a.a6, a.a1 - 1.0, a.a2, a.a4, a.a5 - 1.0])


#: Half the time over which the motion of a shaken flight is taken, lines.
_SHORT = 1e-3
#: Moments at which it is told how exactly a trajectory without splines is known.
_JUDGED = 33
#: Parameters of a mount, in their order.
MOUNT = ("boresight about x", "boresight about y", "boresight about z",
         "lever arm x", "lever arm y", "lever arm z", "time offset")  # fmt: skip
_SPLINE = ("position correction east of {}", "position correction north of {}", "height correction of {}",
           "attitude correction about x of {}", "attitude correction about y of {}",
           "attitude correction about z of {}")  # fmt: skip


@dataclass(frozen=True)
class TrackPriors:
    """A priori standard deviations of a trajectory; 0 if a parameter is held fixed."""

    boresight: float = 0.0
    """Radians, about each axis."""
    lever_arm: float = 0.0
    """Metres."""
    time_offset: float = 0.0
    """Seconds."""
    knots: float | None = None
    """Between knots of the splines, seconds; None: there are none."""
    position: float = 0.0
    """Standard deviation of each coefficient, metres."""
    attitude: float = 0.0
    """Radians."""
    smooth_position: float = np.inf
    """Standard deviation of second differences of coefficients, metres."""
    smooth_attitude: float = np.inf
    """Radians."""


@dataclass(frozen=True, eq=False)
class CorrectableLine:
    """An image of a line camera whose trajectory is corrected."""

    plain: LineCamera | ChippedLine
    """As delivered."""
    mount: str
    """Images of one mount share boresight, lever arm and clock."""
    flight: str
    """Images of one flight share the splines."""
    priors: TrackPriors
    start: LineCorrection
    """Where to begin."""

    @property
    def keys(self) -> tuple[str, str]:
        """Return the keys of the two sets."""
        return f"mount of {self.mount!r}", f"trajectory of {self.flight!r}"

    @property
    def spline(self) -> TrackSpline | None:
        """Its times, without corrections."""
        if self.priors.knots is None:
            return None
        track = self.plain.track
        ends = track.time(np.array([-0.5, track.lines - 0.5]))
        first, last = max(float(ends[0]), track.known[0]), min(float(ends[1]), track.known[1])
        return TrackSpline.over((first, last), self.priors.knots)

    @property
    def away(self) -> float:
        """Height of the flight over the ellipsoid, metres."""
        middle = np.array([[(self.plain.size[0] - 1) / 2, np.mean(self.plain.track.oriented)]])
        away = float(self.plain.ground.height(self.plain.body_rays(middle)[0])[0])
        if not away > 0:
            raise InputError("the trajectory lies below the ellipsoid; are its heights of the stated system?")
        return away

    @property
    def free(self) -> NDArray[np.int64]:
        """Which parameters of the mount are unknown."""
        p = self.priors
        return np.flatnonzero(np.repeat([p.boresight > 0, p.lever_arm > 0, p.time_offset > 0], [3, 3, 1]))

    @property
    def corrections(self) -> tuple[Corrections, ...]:
        """The sets that are unknown."""
        p, start = self.priors, self.start
        sets, free, spline = [], self.free, self.spline
        if len(free):
            sigma = np.repeat([p.boresight, p.lever_arm, p.time_offset], [3, 3, 1])[free]
            values = np.concatenate([start.boresight, start.lever_arm, [start.time_offset]])[free]
            names = tuple(f"{MOUNT[k]} of {{}}" for k in free)
            sets.append(
                Corrections(
                    key=self.keys[0],
                    owners=(self.mount,),
                    parameters=names,
                    values=values[None],
                    known=prior_rows(sigma),
                    owner="mount",
                )
            )
        if spline is not None:
            count = len(spline.coefficients)
            size = np.tile(np.repeat([p.position, p.attitude], 3), count)
            smooth = np.repeat([p.smooth_position, p.smooth_attitude], 3)
            second = scipy.sparse.diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(count - 2, count))
            known = np.flatnonzero(np.isfinite(smooth))
            pick = scipy.sparse.csr_matrix((1.0 / smooth[known], (np.arange(len(known)), known)), (len(known), 6))
            rows = scipy.sparse.vstack([prior_rows(size), scipy.sparse.kron(second, pick)]).tocsr()
            owners = tuple(f"{t:.3g} s of {self.flight}" for t in spline.times)
            began = start.spline
            same = began is not None and began.coefficients.shape == spline.coefficients.shape
            values = began.coefficients if began is not None and same else spline.coefficients
            sets.append(
                Corrections(
                    key=self.keys[1], owners=owners, parameters=_SPLINE, values=values, known=rows, owner="knot"
                )
            )
        return tuple(sets)

    def correction(self, values: Mapping[str, _Floats]) -> LineCorrection:
        """Return what values of the sets mean."""
        mount = np.concatenate([self.start.boresight, self.start.lever_arm, [self.start.time_offset]])
        if len(self.free):
            mount[self.free] = values[self.keys[0]][0]
        spline = self.spline
        spline = self.start.spline if spline is None else replace(spline, coefficients=values[self.keys[1]])
        return LineCorrection(mount[:3], mount[3:6], float(mount[6]), spline)

    def camera(self, values: Mapping[str, _Floats]) -> Camera:
        """See `Correctable`."""
        track = self.correction(values).track(self.plain.track)
        # Calm flights are as smooth between the lines as the record; poses of all lines would be made at every step.
        return self.plain.along(track if self._shaken else replace(track, per_line=False))

    @cached_property
    def _shaken(self) -> bool:
        plain = self.plain.chips[0] if isinstance(self.plain, ChippedLine) else self.plain
        return plain.breaks is not None

    def by_mount(self, track: LineTrack, rows: _Floats, axes: _Floats) -> _Floats:
        """Return what the parameters of the mount do to poses at rows (n,), as `TrackSpline` has them: (n, 6, 7).

        axes: east, north and up in those of the body.
        """
        speed, turning = _motion(track, rows)
        J = np.zeros((len(rows), 6, 7))
        J[:, 3:, :3] = np.eye(3)
        J[:, :3, 3:6] = axes.T @ track(rows)[1] @ TURNED
        # A later record: the camera is where it was before.
        J[:, :3, 6], J[:, 3:, 6] = -speed @ axes, -turning @ TURNED
        return J

    def pose_errors(
        self, correction: LineCorrection, mount: _Floats | None, joint: _Floats | None
    ) -> PoseErrors | None:
        """Return how exactly the poses are known that come of all corrections together; None: nothing is unknown.

        mount: covariance of what is unknown of it; joint: those of it and of four knots that follow each other.
        """
        track, axes = correction.track(self.plain.track), map_axes(self.plain.track)
        spline = self.spline
        count = _JUDGED if spline is None else 2 * len(spline.times)
        rows = np.linspace(*track.oriented, max(2, count))
        rows = rows[track.is_oriented(rows)]
        J = [self.by_mount(track, rows, axes)[:, :, self.free]]
        Q = mount
        if spline is not None and joint is not None:
            at, w = spline_weights(track.time(rows), spline.first, spline.step, len(spline.coefficients))
            J.append((w[:, None, :, None] * np.eye(6)[:, None]).reshape(len(rows), 6, 24))
            Q = joint[at[:, 0]]
        if Q is None:
            return None
        A = np.concatenate(J, axis=2)
        return PoseErrors(track.time(rows), A @ Q @ np.swapaxes(A, 1, 2))

    def seen(self, camera: Camera, XYZ: _Floats, xy: _Floats) -> _Floats:
        """See `Correctable`: the row that was measured tells the moment, see `line_measured`."""
        assert isinstance(camera, LineCamera | ChippedLine)
        return xy + measured(camera, self._steady(camera), XYZ, xy).miss

    def by_ground(self, camera: Camera, XYZ: _Floats, xy: _Floats) -> _Floats:
        """See `Correctable`."""
        assert isinstance(camera, LineCamera | ChippedLine)
        return measured(camera, self._steady(camera), XYZ, xy).by_place @ camera.ground.jacobian(XYZ)

    def by_corrections(self, camera: Camera, XYZ: _Floats, xy: _Floats) -> Mapping[str, ByCorrections]:
        """See `Correctable`; whatever moves the camera moves the ground the other way."""
        assert isinstance(camera, LineCamera | ChippedLine)
        track, rows = camera.track, xy[:, 1]
        by_place = measured(camera, self._steady(camera), XYZ, xy).by_place
        S, R = track(rows)
        # A turn δ of the camera about its own axes moves the ground by R (d × δ), seen from a camera that stays.
        by_turn = by_place @ R @ skew(np.einsum("nij,ni->nj", R, camera.ground(XYZ) - S))
        out: dict[str, ByCorrections] = {}
        n, free = len(xy), self.free
        if len(free):
            speed, turning = _motion(track, rows)
            # A later record: the camera is where it was before.
            late = by_place @ speed[:, :, None] - by_turn @ turning[:, :, None]
            J = np.concatenate([by_turn @ TURNED, -by_place @ R @ TURNED, late], axis=2)
            out[self.keys[0]] = ByCorrections(np.broadcast_to(np.arange(len(free)), (n, len(free))), J[:, :, free])
        spline = self.spline
        if spline is not None:
            at, w = spline_weights(track.time(rows), spline.first, spline.step, len(spline.coefficients))
            J = np.concatenate([-by_place @ map_axes(self.plain.track), by_turn @ TURNED], axis=2)
            columns = (6 * at[:, :, None] + np.arange(6)).reshape(n, 24)
            out[self.keys[1]] = ByCorrections(columns, (J[:, :, None, :] * w[:, None, :, None]).reshape(n, 2, 24))
        return out

    def _steady(self, camera: LineCamera | ChippedLine) -> LineCamera | ChippedLine:
        """By whose pace rows are measured."""
        return self._calm if self._shaken else camera

    @cached_property
    def _calm(self) -> LineCamera | ChippedLine:
        return self.plain.calm()


def _motion(track: LineTrack, rows: _Floats) -> tuple[_Floats, _Floats]:
    """Speed (n, 3), metres a second, and rate of rotation about the camera's own axes (n, 3), radians a second."""
    if not track.per_line:
        return _rates(track, rows, 0.5)
    # Between the lines a late clock moves what is interpolated there: the poses of the lines around.
    flown, row = replace(track, per_line=False), np.floor(rows)
    around = [_rates(flown, row + k, _SHORT) for k in (-1.0, 0.0, 1.0, 2.0)]
    weights = cubic_convolution(rows - row)
    speed, turning = (np.einsum("nk,knj->nj", weights, np.array(each)) for each in zip(*around))
    return speed, turning


def _rates(track: LineTrack, rows: _Floats, half: float) -> tuple[_Floats, _Floats]:
    """The same, over so many lines before and after."""
    ahead, behind = (track(rows + each) for each in (half, -half))
    seconds = (track.time(rows + half) - track.time(rows - half))[:, None]
    speed = (ahead[0] - behind[0]) / seconds
    return speed, rotation_vector(np.swapaxes(behind[1], 1, 2) @ ahead[1]) / seconds
