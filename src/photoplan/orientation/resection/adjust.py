"""Space resection: exterior orientation of a single image from points with known ground coordinates.

`resect` needs no start values: `photoplan.orientation.resection.direct` gives the pose, here it is adjusted by least
squares with control points as weighted observations, gross errors are named, and what the points do not
determine is refused.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.iterate import levenberg
from photoplan.adjustment.robust import spread
from photoplan.cameras.base import project
from photoplan.cameras.build import oriented_camera
from photoplan.cameras.interior import Interior
from photoplan.cameras.lenses.base import Lens
from photoplan.cameras.lenses.brown import Brown
from photoplan.cameras.lenses.field import field_limited
from photoplan.cameras.lenses.none import NoLens
from photoplan.errors import GeometryError, InputError
from photoplan.geometry.pose import Pose
from photoplan.orientation.bundle.rows import by_coefficient
from photoplan.orientation.bundle.unknowns import CameraState
from photoplan.orientation.resection.direct import DirectPose, moved, resect_direct, tangent_derivatives
from photoplan.orientation.resection.model import (
    CameraOf,
    MeasuredPoints,
    Resected,
    ResectionUnknowns,
    ResectSettings,
    refuse_undetermined,
)

Array = NDArray[np.float64]

#: Camera constants that are tried where it is not known, in units of the image's longer side.
_SCAN = np.geomspace(0.3, 10.0, 48)
_ITERATIONS = 60
#: Part of a point's variance that residuals must keep, or it is not controlled by the others.
_UNCONTROLLED = 1e-6


def tangents_of(interior: Interior, lens: Lens, xy: Array) -> Array:
    """Ideal tangent coordinates (n, 2) of measured positions in pixels; NaN where the lens has no solution."""
    return field_limited(lens, interior).undistort(interior.tangent_to_pixel.inverse(xy))


@dataclass(frozen=True, eq=False)
class _Task:
    """What stays the same while adjusting."""

    points: MeasuredPoints
    lens: Lens
    settings: ResectSettings
    camera_of: CameraOf | None
    name: str


@dataclass(frozen=True, eq=False)
class _State:
    """What changes."""

    pose: Pose
    interior: Interior
    lens: Lens


@dataclass(frozen=True, eq=False)
class _Equations:
    """Whitened observation equations at a state: v = A·step + misclosure."""

    A: Array
    """(n, 2, u)."""
    v: Array
    """Whitened residuals (n, 2)."""
    root: Array
    """Cholesky factors of the covariances of the measurements, control included, (n, 2, 2)."""
    residuals: Array
    """In pixels, (n, 2)."""
    units: Array
    """Natural size of each unknown, (u,): distance, radian, camera constant."""
    sound: bool = field(default=True)
    """Whether all points lie in front of the camera."""


def resect(
    points: MeasuredPoints,
    interior: Interior,
    lens: Lens,
    settings: ResectSettings | None = None,
    *,
    camera_of: CameraOf | None = None,
    near: Pose | None = None,
    name: str = "image",
) -> Resected:
    """Orient one image.

    Control points are observations too: with the covariances of image and ground points, every point gives two
    equations with the covariance Σ = Σ_image + (∂x/∂X) Σ_ground (∂x/∂X)ᵀ, the same
    adjustment (Ecker 1991, §4.5).

    Parameters
    ----------
    interior, lens
        Interior orientation, approximate for free parameters.
    camera_of : callable, optional
        The camera that a pose makes where central projection in the given coordinates is not all: earth curvature,
        refraction. What it adds to central projection is taken off the measurements, again at every step. The
        result is the pose with which this camera reproduces the points.
    near : Pose, optional
        Approximate pose, which decides only where points leave several poses possible.
    name : str
        How the image is called in messages.

    Raises
    ------
    GeometryError
        The points do not determine the unknowns; the message names these.
    """
    settings = settings or ResectSettings()
    if isinstance(lens, NoLens) and set(settings.free) - {"c", "x0", "y0"}:
        lens = Brown()
    task = _Task(points=points, lens=lens, settings=settings, camera_of=camera_of, name=name)
    unknowns = 6 + len(settings.free)
    if 2 * len(points) < unknowns or len(points) < 3:
        raise GeometryError(
            f"image {name!r}: {len(points)} control point{'s' * (len(points) != 1)} for {unknowns} unknowns (pose"
            f"{', ' + ', '.join(settings.free) if settings.free else ''}); at least {max(3, -(-unknowns // 2))} are "
            "needed, one more to check them"
        )
    try:
        state, inliers = _start(task, interior, near)
    except GeometryError as error:
        raise GeometryError(f"image {name!r}: {error}") from None
    if inliers.sum() < max(3, -(-unknowns // 2)):
        inliers[:] = True
    return _cleaned(task, state, inliers)


def _start(task: _Task, interior: Interior, near: Pose | None) -> tuple[_State, NDArray[np.bool_]]:
    """State and inliers of the direct solution."""
    if task.settings.camera_constant_known:
        found = _direct(task, interior, near)
        return _State(found.pose, interior, task.lens), found.inliers.copy()
    width = max(interior.size) / _pixels_per_unit(interior)
    best: tuple[float, Interior, DirectPose] | None = None
    reason = ""
    for factor in _SCAN:
        tried = replace(interior, c=float(factor * width))
        try:
            found = _direct(task, tried, near)
        except InputError as error:  # a lens may fold back within the wide field of a short camera constant
            reason = str(error)
            continue
        r = _pixels(task, _State(found.pose, tried, task.lens))
        size = np.sort(np.where(np.isfinite(r).all(axis=1), np.linalg.norm(r, axis=1), np.inf))
        cost = float(size[: len(size) // 2 + 2].sum())
        if best is None or cost < best[0]:
            best = cost, tried, found
    if best is None:
        raise GeometryError(f"no camera constant from 0.3 to 10 image widths fits; {reason}")
    return _State(best[2].pose, best[1], task.lens), best[2].inliers.copy()


def _direct(task: _Task, interior: Interior, near: Pose | None) -> DirectPose:
    t = tangents_of(interior, task.lens, task.points.xy)
    lost = ~np.isfinite(t).all(axis=1)
    if lost.any():
        raise GeometryError(
            f"point {task.points.names[int(lost.argmax())]!r} lies where the lens has no ray; is it measured in this "
            "image?"
        )
    f = interior.c * _pixels_per_unit(interior)
    X = task.points.XYZ
    # What control adds to the noise, at a distance that is not known yet but of the order of the points' extent.
    extent = max(float(np.linalg.norm(X - X.mean(axis=0), axis=1).max()), 1e-9)
    control = np.sqrt(np.trace(task.points.covariance, axis1=1, axis2=2) / 3.0) / extent
    sigma = float(np.median(np.hypot(task.points.sigma.mean(axis=1) / f, control)))
    return resect_direct(t, X, sigma, near)


def _pixels_per_unit(interior: Interior) -> float:
    """Pixels in one unit of the image plane."""
    J = interior.plane_to_pixel.derivative(np.array(interior.principal_point))
    return float(np.sqrt(abs(np.linalg.det(J))))


def _pixels(task: _Task, state: _State) -> Array:
    """Residuals without covariances: computed minus measured, (n, 2)."""
    frame = oriented_camera(state.interior, state.lens, state.pose)
    camera = frame if task.camera_of is None else task.camera_of(state.interior, state.lens, state.pose)
    return project(camera, task.points.XYZ) - task.points.xy


def _equations(task: _Task, state: _State) -> _Equations:
    """Observation equations at a state; derivatives are those of central projection."""
    points, interior = task.points, state.interior
    free = task.settings.free
    lens = field_limited(state.lens, interior)
    camera = _camera_state(task, state)
    t, by_pose, by_X, depth = tangent_derivatives(state.pose, points.XYZ)
    real = lens.distort(t)
    plane = interior.c * real + interior.principal_point
    to_pixel = interior.plane_to_pixel.derivative(plane)
    by_t = interior.c * to_pixel @ lens.jacobian(t)
    columns = [by_t @ by_pose]
    for name in free:
        if name in ("x0", "y0"):
            columns.append(to_pixel[..., :, [("x0", "y0").index(name)]])
        else:
            moves = real if name == "c" else interior.c * by_coefficient(camera, name, t, real)
            columns.append(to_pixel @ moves[..., None])
    A = np.concatenate(columns, axis=2)
    to_ground = by_t @ by_X
    S = to_ground @ points.covariance @ np.swapaxes(to_ground, 1, 2)
    S[:, 0, 0] += points.sigma[:, 0] ** 2
    S[:, 1, 1] += points.sigma[:, 1] ** 2
    residuals = _pixels(task, state)
    sound = bool((depth > 0).all() and np.isfinite(residuals).all())
    if not np.isfinite(S).all() or not np.isfinite(A).all():
        S, A, sound = np.broadcast_to(np.eye(2), S.shape), np.zeros_like(A), False
    root = np.asarray(np.linalg.cholesky(S), float)
    v = np.linalg.solve(root, residuals[..., None])[..., 0]
    distance = float(np.linalg.norm(points.XYZ - state.pose.center, axis=1).mean())
    # A coefficient's natural size moves the outermost point by its distance from the principal point.
    radius = max(float(np.nanmax(np.linalg.norm(t, axis=1), initial=0.0)), 1e-9)
    power = {"k1": 2, "k2": 4, "k3": 6, "p1": 1, "p2": 1, "b1": 0, "b2": 0}
    own = [interior.c if name in ("c", "x0", "y0") else radius ** -power[name] for name in free]
    units = np.array([distance] * 3 + [1.0] * 3 + own)
    return _Equations(
        A=np.asarray(np.linalg.solve(root, A), float), v=v, root=root, residuals=residuals, units=units, sound=sound
    )


def _adjusted(task: _Task, state: _State, use: NDArray[np.bool_]) -> tuple[_State, _Equations]:
    """Least squares over the points `use`."""

    def equations(state: _State) -> tuple[Array, Array]:
        found = _equations(task, state)
        return found.A[use].reshape(-1, found.A.shape[2]), found.v[use].ravel()

    state = levenberg(state, equations, lambda state, step: _stepped(task, state, step), _ITERATIONS).state
    return state, _equations(task, state)


def _stepped(task: _Task, state: _State, step: Array) -> _State | None:
    """The state after a step; None if it makes no camera."""
    interior, lens = state.interior, state.lens
    if task.settings.free:
        try:
            camera = _camera_state(task, state).moved(step[None, 6:])
        except InputError:
            return None
        if not 0.05 < camera.c / interior.c < 20.0:
            return None
        interior, lens = replace(interior, c=camera.c, principal_point=(camera.x0, camera.y0)), camera.lens
    return _State(moved(state.pose, step), interior, lens)


def _camera_state(task: _Task, state: _State) -> CameraState:
    """The camera of a state as a block knows it."""
    interior = state.interior
    return CameraState(interior.c, *interior.principal_point, state.lens, task.settings.free)


def _cleaned(task: _Task, state: _State, use: NDArray[np.bool_]) -> Resected:
    """Adjustment with data snooping: points leave one by one, and come back when they fit."""
    u = 6 + len(task.settings.free)
    seen: set[bytes] = set()
    while True:
        state, equations = _adjusted(task, state, use)
        if not np.isfinite(equations.v[use]).all():
            raise GeometryError(f"image {task.name!r}: {_why_not(task, state, use)}")
        tests = _tested(task, equations, use)
        largest = np.nan_to_num(np.abs(tests.normalised), nan=0.0).max(axis=1)
        limit = task.settings.critical * tests.scale
        worst = int(np.where(use, largest, 0.0).argmax())
        back = np.where(use, np.inf, largest)
        seen.add(use.tobytes())
        changed = use.copy()
        if largest[worst] > limit and 2 * (use.sum() - 1) > u:
            changed[worst] = False
        elif back.min() < limit:
            changed[int(back.argmin())] = True
        if changed.tobytes() in seen:
            break
        use = changed
    return _result(task, state, equations, use, tests)


def _why_not(task: _Task, state: _State, use: NDArray[np.bool_]) -> str:
    """Why an adjustment ended with points that have no image."""
    lost = use & ~np.isfinite(_pixels(task, state)).all(axis=1)
    central = project(oriented_camera(state.interior, task.lens, state.pose), task.points.XYZ)
    if task.camera_of is not None and np.isfinite(central[lost]).all():
        names = ", ".join(task.points.names[k] for k in np.flatnonzero(lost)[:5])
        return (
            f"{int(lost.sum())} points ({names}) have no image with the earth curvature that is asked for: as a "
            "correction it is not defined for points above the camera; ask for strict"
        )
    return (
        f"the adjustment of its {len(use)} control points does not converge with all points in front of the camera; "
        "check point names and the camera constant"
    )


@dataclass(frozen=True, eq=False)
class _Tests:
    """What residuals say about the observations."""

    cofactor: Array
    """Inverse normal equations (u, u)."""
    normalised: Array
    redundancies: Array
    scale: float
    """Robust standard deviation of unit weight, at least 1."""
    sigma0: float


def _tested(task: _Task, equations: _Equations, use: NDArray[np.bool_]) -> _Tests:
    """Normalised residuals of all points; those that are not used are compared with their prediction."""
    A = equations.A * equations.units
    u = A.shape[2]
    used = A[use].reshape(-1, u)
    redundancy = len(used) - u
    sigma0 = float(np.sqrt((equations.v[use] ** 2).sum() / redundancy)) if redundancy > 0 else 1.0
    cofactor = refuse_undetermined(used, sigma0 if redundancy > 3 else 1.0, _unknowns(task, equations))
    fitted = A @ cofactor @ np.swapaxes(A, 1, 2)
    sign = np.where(use, -1.0, 1.0)[:, None, None]
    of_v = equations.root @ (np.eye(2) + sign * fitted) @ np.swapaxes(equations.root, 1, 2)
    before = equations.root @ np.swapaxes(equations.root, 1, 2)
    variance = np.diagonal(of_v, axis1=1, axis2=2)
    part = variance / np.diagonal(before, axis1=1, axis2=2)
    with np.errstate(all="ignore"):
        normalised = np.where(part > _UNCONTROLLED, equations.residuals / np.sqrt(variance), np.nan)
    # A point that cannot be predicted (behind the camera) does not fit.
    normalised[~use & ~np.isfinite(equations.residuals).all(axis=1)] = np.inf
    numbers = np.where(use[:, None], np.diagonal(np.eye(2) - fitted, axis1=1, axis2=2), np.nan)
    scale = spread(normalised[use]) if redundancy > 2 else sigma0
    units = equations.units
    return _Tests(
        cofactor=cofactor * units[:, None] * units,
        normalised=normalised,
        redundancies=numbers,
        scale=float(np.nanmax([1.0, scale])),
        sigma0=sigma0,
    )


def _unknowns(task: _Task, equations: _Equations) -> ResectionUnknowns:
    where = f"image {task.name!r}: its {len(task.points)} control points"
    return ResectionUnknowns(where, equations.units, task.settings.free, float(np.median(task.points.sigma)))


def _result(task: _Task, state: _State, equations: _Equations, use: NDArray[np.bool_], tests: _Tests) -> Resected:
    redundancy = 2 * int(use.sum()) - len(equations.units)
    notes = []
    largest = np.nan_to_num(np.abs(tests.normalised[use]), nan=0.0).max(initial=0.0)
    if redundancy <= 0:
        notes.append("no redundancy: nothing checks these points, and gross errors stay unseen")
    elif redundancy <= 3 and largest > task.settings.critical:
        notes.append(
            f"sigma0 {tests.sigma0:.3g} shows a gross error or too small standard deviations, but {int(use.sum())} "
            "points do not tell which; measure another one"
        )
    return Resected(
        pose=state.pose,
        interior=state.interior,
        lens=state.lens,
        covariance=tests.cofactor * tests.sigma0**2,
        free=task.settings.free,
        residuals=equations.residuals,
        redundancies=tests.redundancies,
        normalised=tests.normalised,
        rejected=~use,
        sigma0=tests.sigma0,
        redundancy=redundancy,
        notes=tuple(notes),
    )
