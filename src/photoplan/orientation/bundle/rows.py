"""Observation equations of the bundle adjustment: residuals and derivatives of every row."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from photoplan.adjustment.blocks import Layout
from photoplan.cameras.base import Camera
from photoplan.cameras.lenses.brown import Brown
from photoplan.cameras.lenses.opencv import OpenCV
from photoplan.geometry.rotation import rotation_vector, skew
from photoplan.orientation.bundle.block import BlockProjection
from photoplan.orientation.bundle.model import Model
from photoplan.orientation.bundle.unknowns import BORESIGHT, COMMON, DRIFT, IMAGES, LEVER, CameraState, State

_Floats = NDArray[np.float64]
_Index = NDArray[np.int64]
_NONE = np.empty(0, np.int64)


@dataclass(frozen=True, eq=False)
class Residuals:
    """Computed minus observed, of every kind of observation."""

    image: _Floats
    """(k, 2), pixels; NaN: the point lies behind the camera."""
    ground: _Floats
    """(c,) whitened, in the order of the model's control rows."""
    position: _Floats
    """(p, 3), metres."""
    attitude: _Floats
    """(a, 3), radians."""
    prior: _Floats
    """(q,) whitened: parameters and corrections that are known beforehand."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Linearised equations: whitened residual + A_global · step + A_points · step of points."""

    e: _Floats
    """Whitened residuals, (rows,): image (x, y by turns), control, positions, attitudes, priors."""
    A_global: sparse.csr_matrix
    A_points: sparse.csr_matrix
    point: NDArray[np.int64]
    """Point of each row, −1: none."""


@dataclass(frozen=True, eq=False)
class _Rays:
    """Intermediate results of image points."""

    p: _Floats
    t: _Floats
    real: _Floats
    inner: _Floats
    """∂ plane / ∂ t in units of the image plane, (k, 2, 2)."""
    outer: _Floats
    """∂ pixel / ∂ plane, (k, 2, 2)."""
    px: _Floats


def residuals_of(model: Model, state: State) -> Residuals:
    """Residuals of all observations at a state."""
    return _residuals(model, state, _project(model.posed, state, derivatives=False), _seen(model, state))


def residuals_of_all(model: Model, state: State) -> _Floats:
    """Computed minus measured position of every measurement of the block, (k, 2); NaN: image or point takes no part."""
    seen = model.block.observations
    images = {name: k for k, name in enumerate(model.image_names)}
    points = {name: k for k, name in enumerate(model.point_names)}
    image = np.array([images.get(n, -1) for n in seen.images], np.int64)[seen.image]
    point = np.array([points.get(n, -1) for n in seen.points], np.int64)[seen.point]
    there = np.flatnonzero((image >= 0) & (point >= 0))
    every = replace(
        model, observation=there, image=image[there], point=point[there], xy=seen.xy[there], sigma=seen.sigma[there]
    )
    out = np.full((len(seen), 2), np.nan)
    out[there] = residuals_of(every, state).image
    return out


def _residuals(model: Model, state: State, rays: _Rays, seen: list[_Seen]) -> Residuals:
    block, framed = model.block, model.posed
    image = rays.px - framed.xy
    if block.bend is not None and len(framed.image):
        # The bend knows the images by their number in the block, of which some may not take part.
        poses = [b.pose for b in block.images]
        for row, pose in zip(model.image_rows, state.poses()):
            poses[row] = pose
        image = image + block.bend(framed.image_rows[framed.image], tuple(poses), state.XYZ[framed.point])
    if model.projections:
        every = np.empty((len(model.image), 2))
        every[model.framed] = image
        for each in seen:
            every[each.mine] = each.xy - model.xy[each.mine]
        image = every
    off = state.XYZ[model.ground_point] - np.nan_to_num(block.ground.XYZ[model.ground])
    ground = (model.ground_white * off).sum(axis=1)
    position, attitude = np.empty((0, 3)), np.empty((0, 3))
    if block.positions is not None:
        antenna = state.images.centers[model.position] + state.images.rotations[model.position] @ state.lever
        shift, rate = state.drift[model.strip_of, :3], state.drift[model.strip_of, 3:]
        drift = shift + rate * model.tau[:, None]
        position = antenna + drift + state.common - block.positions.XYZ[model.position_row]
    if block.attitudes is not None:
        observed = block.attitudes.R_ground_camera[model.attitude_row]
        turned = np.swapaxes(observed, 1, 2) @ state.images.rotations[model.attitude] @ state.boresight
        attitude = rotation_vector(turned)
    return Residuals(image=image, ground=ground, position=position, attitude=attitude, prior=_known(model, state))


def linearise(model: Model, state: State, weight: _Floats) -> tuple[Rows, Residuals]:
    """Equations at a state; `weight` (rows,) is the square root of each row's robust weight."""
    rays, seen = _project(model.posed, state, derivatives=True), _seen(model, state)
    found = _residuals(model, state, rays, seen)
    entries = _Entries(model.columns)
    on_points = _image_rows(model, state, rays, seen, entries)
    _direct_rows(model, state, found, entries)
    for at, (key, parameter, _, sigma) in enumerate(model.known, model.parts.known.start):
        entries.put(np.array([[at]]), key, np.zeros(1, np.int64), np.array([[[1.0 / sigma]]]), parameter)
    at = model.parts.smooth.start
    for each in model.sets:
        rows = at + np.arange(each.known.shape[0])
        coo = each.known.tocoo()
        entries.parts.append((coo.data, rows[coo.row], model.columns.columns_of(each.key)[coo.col]))
        at += len(rows)
    point = np.full(model.rows, -1, np.int64)
    point[model.parts.image] = np.repeat(model.point, 2)
    point[model.parts.ground] = model.ground_point
    e = whitened(model, found)
    e = np.where(weight > 0, e, 0.0) * weight
    A_global = _matrix(entries.parts, weight, (len(point), model.columns.count))
    on = model.parts.ground.stop
    row = np.repeat(np.arange(on), 3)
    column = (3 * point[:on, None] + np.arange(3)).ravel()
    values = np.concatenate([on_points, model.ground_white]).ravel()
    A_points = _matrix([(values, row, column)], weight, (len(point), 3 * len(model.point_names)))
    return Rows(e, A_global, A_points, point), found


class _Entries:
    """Entries of a sparse matrix while it is filled: values, rows, columns."""

    def __init__(self, columns: Layout) -> None:
        self.parts: list[tuple[_Floats, NDArray[np.int64], NDArray[np.int64]]] = []
        self._columns = columns

    def put(self, rows: _Index, key: str, block: _Index, values: _Floats, skip: int = 0) -> None:
        """Derivatives `values` (n, r, u) on rows (n, r) by the unknowns of blocks (n,), from parameter `skip` on.

        Of a kind that is held fixed there are none.
        """
        kind = self._columns.get(key)
        if kind is None:
            return
        column = kind.at(block)[:, None, None] + skip + np.arange(values.shape[2])
        row, column = np.broadcast_arrays(rows[:, :, None], column)
        self.parts.append((values.ravel(), row.ravel(), column.ravel()))


def _image_rows(model: Model, state: State, rays: _Rays, seen: list[_Seen], entries: _Entries) -> _Floats:
    """Rows of image points: entries of orientations and cameras; returned: the coefficients of the points, (2k, 3)."""
    every = np.arange(2 * len(model.image)).reshape(-1, 2)
    by_X = _posed_rows(model.posed, state, rays, entries, every[model.framed])
    if not model.projections:
        return by_X.reshape(-1, 3)
    out = np.zeros((len(model.image), 2, 3))
    out[model.framed] = by_X
    for each in seen:
        white = 1.0 / model.sigma[each.mine][:, :, None]
        geometry, there = each.projection.geometry, (each.camera, each.XYZ, model.xy[each.mine])
        out[each.mine] = geometry.by_ground(*there) @ each.by_block * white
        by_set = geometry.by_corrections(*there)
        for key, by in by_set.items():
            values = by.values * white
            column = model.columns.columns_of(key)[by.columns][:, None]
            row, column = np.broadcast_arrays(every[each.mine][:, :, None], column)
            entries.parts.append((values.ravel(), row.ravel(), column.ravel()))
    return np.nan_to_num(out).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class _Seen:
    """The measurements of a projection: where its camera sees their points."""

    projection: BlockProjection
    mine: _Index
    camera: Camera
    XYZ: _Floats
    """In the map, (n, 3)."""
    by_block: _Floats
    """∂ map / ∂ block."""
    xy: _Floats
    """(n, 2), pixels."""


def _seen(model: Model, state: State) -> list[_Seen]:
    out = []
    for projection, keys, mine in model.of_projections:
        geometry = projection.geometry
        camera = geometry.camera({key: state.corrections(key) for key in keys})
        XYZ, by_block = _on_map(model, state.XYZ[model.point[mine]])
        out.append(
            _Seen(
                projection=projection,
                mine=mine,
                camera=camera,
                XYZ=XYZ,
                by_block=by_block,
                xy=geometry.seen(camera, XYZ, model.xy[mine]),
            )
        )
    return out


def _on_map(model: Model, XYZ: _Floats) -> tuple[_Floats, _Floats]:
    """Map points and their derivatives by block points."""
    if model.block.on_map is None:
        return XYZ, np.broadcast_to(np.eye(3), (len(XYZ), 3, 3))
    return model.block.on_map(XYZ)


def _posed_rows(model: Model, state: State, rays: _Rays, entries: _Entries, rows: _Index) -> _Floats:
    """The same for measurements in images with poses, which have `rows` (k, 2); returned: (k, 2, 3)."""
    k = len(model.image)
    white = 1.0 / model.sigma[:, :, None]
    z = rays.p[:, 2]
    by_p = np.zeros((k, 2, 3))
    by_p[:, 0, 0] = by_p[:, 1, 1] = -1.0 / z
    by_p[:, :, 2] = -rays.t / z[:, None]
    by_p = rays.outer @ rays.inner @ by_p
    by_X = by_p @ np.swapaxes(state.images.rotations[model.image], 1, 2)
    entries.put(rows, IMAGES, model.image, np.concatenate([-by_X, by_p @ skew(rays.p)], axis=2) * white)
    for index, name in enumerate(model.camera_names):
        camera = state.camera(name)
        mine = np.flatnonzero(model.camera_of[model.image] == index) if camera.free else _NONE
        if len(mine):
            J = _by_parameters(camera, rays, mine) * white[mine]
            entries.put(rows[mine], f"camera {name}", np.zeros(len(mine), np.int64), J)
    return by_X * white


def _direct_rows(model: Model, state: State, found: Residuals, entries: _Entries) -> None:
    """Rows of observed positions and attitudes."""
    block, n = model.block, len(model.position)
    if block.positions is not None and n:
        rows = model.parts.position.start + np.arange(3 * n).reshape(n, 3)
        white = 1.0 / block.positions.sigma[model.position_row][:, :, None]
        R = state.images.rotations[model.position]
        eye = np.broadcast_to(np.eye(3), R.shape)
        entries.put(rows, IMAGES, model.position, np.concatenate([eye, -R @ skew(state.lever)], axis=2) * white)
        entries.put(rows, LEVER, np.zeros(n, np.int64), R * white)
        drift = eye if block.drift == "shift" else np.concatenate([eye, eye * model.tau[:, None, None]], axis=2)
        entries.put(rows, DRIFT, model.strip_of, drift * white)
        entries.put(rows, COMMON, np.zeros(n, np.int64), eye * white)
    n = len(model.attitude)
    if block.attitudes is not None and n:
        rows = model.parts.attitude.start + np.arange(3 * n).reshape(n, 3)
        white = 1.0 / block.attitudes.sigma[model.attitude_row][:, :, None]
        # log(exp(e) exp(δ)) = e + (1 + [e]× / 2) δ + …, and a rotation before the boresight is turned by it.
        by_turn = np.eye(3) + 0.5 * skew(found.attitude)
        entries.put(rows, IMAGES, model.attitude, by_turn @ state.boresight.T * white, 3)
        entries.put(rows, BORESIGHT, np.zeros(n, np.int64), by_turn * white)


def whitened(model: Model, found: Residuals) -> _Floats:
    """Residuals of all rows divided by their standard deviations, in the order of `Rows`."""
    parts = [(found.image / model.sigma).ravel(), found.ground]
    positions, attitudes = model.block.positions, model.block.attitudes
    if positions is not None:
        parts.append((found.position / positions.sigma[model.position_row]).ravel())
    if attitudes is not None:
        parts.append((found.attitude / attitudes.sigma[model.attitude_row]).ravel())
    return np.concatenate([*parts, found.prior])


def _matrix(
    parts: list[tuple[_Floats, NDArray[np.int64], NDArray[np.int64]]], weight: _Floats, shape: tuple[int, int]
) -> sparse.csr_matrix:
    value, row, column = (np.concatenate(p) for p in zip(*parts))
    # Points behind a camera have no derivatives, and no weight.
    weighted = np.where(weight[row] > 0, value, 0.0) * weight[row]
    return sparse.csr_matrix((weighted, (row, column)), shape)


def _project(model: Model, state: State, derivatives: bool) -> _Rays:
    """Image points of all measurements, with what their derivatives need."""
    p = state.XYZ[model.point] - state.images.centers[model.image]
    p = (p[:, None, :] @ state.images.rotations[model.image])[:, 0]
    depth = np.where(p[:, 2] < 0, -p[:, 2], np.nan)
    t = p[:, :2] / depth[:, None]
    plane, real = np.empty_like(t), np.empty_like(t)
    inner = np.empty((len(t), 2, 2)) if derivatives else np.empty((0, 2, 2))
    of = model.camera_of[model.image]
    for index, name in enumerate(model.camera_names):
        mine, camera = of == index, state.camera(name)
        real[mine] = camera.lens.distort(t[mine])
        plane[mine] = camera.c * real[mine] + (camera.x0, camera.y0)
        if derivatives:
            inner[mine] = camera.c * camera.lens.jacobian(t[mine])
    b = model.plane[model.image]
    x, y = plane[:, 0], plane[:, 1]
    px = np.stack(
        [b[:, 0] * x + (b[:, 1] + b[:, 2] * x) * y + b[:, 3], b[:, 4] * x + (b[:, 5] + b[:, 6] * x) * y + b[:, 7]],
        axis=-1,
    )
    outer = np.empty((len(t), 2, 2))
    outer[:, 0, 0], outer[:, 0, 1] = b[:, 0] + b[:, 2] * y, b[:, 1] + b[:, 2] * x
    outer[:, 1, 0], outer[:, 1, 1] = b[:, 4] + b[:, 6] * y, b[:, 5] + b[:, 6] * x
    return _Rays(p=p, t=t, real=real, inner=inner, outer=outer, px=px)


def _by_parameters(camera: CameraState, rays: _Rays, mine: _Index) -> _Floats:
    """∂ pixel / ∂ free parameters of a camera, (n, 2, k)."""
    t = rays.t[mine]
    J = np.zeros((len(mine), 2, len(camera.free)))
    for column, name in enumerate(camera.free):
        if name == "c":
            J[:, :, column] = rays.real[mine]
        elif name in ("x0", "y0"):
            J[:, int(name == "y0"), column] = 1.0
        else:
            J[:, :, column] = camera.c * by_coefficient(camera, name, t, rays.real[mine])
    return rays.outer[mine] @ J


def by_coefficient(camera: CameraState, name: str, t: _Floats, real: _Floats) -> _Floats:
    """∂ real tangent coordinates / ∂ a coefficient of the lens, (n, 2)."""
    lens = camera.lens
    x, y = t[:, 0], t[:, 1]
    r2 = x * x + y * y
    if name in ("b1", "b2"):
        assert isinstance(lens, Brown)
        # real x = xd (1 + b1) + yd b2, real y = yd.
        yd = real[:, 1]
        xd = (real[:, 0] - lens.b2 * yd) / (1.0 + lens.b1)
        return np.stack([xd if name == "b1" else yd, np.zeros(len(t))], axis=-1)
    if name in ("k1", "k2", "k3"):
        d = t * (r2 ** int(name[1]))[:, None]
        if isinstance(lens, OpenCV):
            d /= (1.0 + r2 * (lens.k4 + r2 * (lens.k5 + r2 * lens.k6)))[:, None]
    elif name == "p1":
        d = np.stack([r2 + 2.0 * x * x, 2.0 * x * y], axis=-1)
    else:
        d = np.stack([2.0 * x * y, r2 + 2.0 * y * y], axis=-1)
    if isinstance(lens, Brown):
        d[:, 0] = d[:, 0] * (1.0 + lens.b1) + d[:, 1] * lens.b2
    return d


def _known(model: Model, state: State) -> _Floats:
    """Whitened residuals of what is known beforehand."""
    off = [(state.known(key).value(parameter) - value) / sigma for key, parameter, value, sigma in model.known]
    smooth = [each.known @ state.corrections(each.key).ravel() for each in model.sets]
    return np.concatenate([np.array(off, float), *smooth])
