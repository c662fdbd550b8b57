"""Observation and normal equations of a bundle adjustment."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import linalg, sparse
from scipy.sparse import identity
from scipy.sparse.linalg import ArpackError, LinearOperator, SuperLU, eigsh, splu

from photoplan.adjustment.blocks import Layout
from photoplan.arrays import Floats, Ints
from photoplan.cameras.base import Camera
from photoplan.cameras.lenses import Brown, OpenCV
from photoplan.errors import DatumDefect, GeometryError
from photoplan.geometry.pose import rotation_vector, skew
from photoplan.kernels.sparse_inverse import (
    SelectedInverse,
    SparseRows,
    align_factor,
    dense_inverse,
    fill_pattern,
    point_variances,
    row_variances,
    selected_inverse,
)
from photoplan.orientation.bundle.model import (
    BORESIGHT,
    COMMON,
    DRIFT,
    IMAGES,
    LEVER,
    BlockProjection,
    CameraState,
    Model,
    State,
)

_NONE = np.empty(0, np.int64)


@dataclass(frozen=True, eq=False)
class Residuals:
    """Computed minus observed, of every kind of observation."""

    image: Floats
    """(k, 2), pixels; NaN: the point lies behind the camera."""
    ground: Floats
    """(c,) whitened, in the order of the model's control rows."""
    position: Floats
    """(p, 3), metres."""
    attitude: Floats
    """(a, 3), radians."""
    prior: Floats
    """(q,) whitened: parameters and corrections that are known beforehand."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Linearised equations: whitened residual + A_global · step + A_points · step of points."""

    e: Floats
    """Whitened residuals, (rows,): image (x, y by turns), control, positions, attitudes, priors."""
    A_global: sparse.csr_matrix
    A_points: sparse.csr_matrix
    point: Ints
    """Point of each row, −1: none."""


@dataclass(frozen=True, eq=False)
class _Rays:
    """Intermediate results of image points."""

    p: Floats
    t: Floats
    real: Floats
    inner: Floats
    """∂ plane / ∂ t in units of the image plane, (k, 2, 2)."""
    outer: Floats
    """∂ pixel / ∂ plane, (k, 2, 2)."""
    px: Floats


def residuals_of(model: Model, state: State) -> Residuals:
    """Residuals of all observations at a state."""
    return _residuals(model, state, _project(model.posed, state, derivatives=False), _seen(model, state))


def residuals_of_all(model: Model, state: State) -> Floats:
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


def linearise(model: Model, state: State, weight: Floats) -> tuple[Rows, Residuals]:
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
        self.parts: list[tuple[Floats, Ints, Ints]] = []
        self._columns = columns

    def put(self, rows: Ints, key: str, block: Ints, values: Floats, skip: int = 0) -> None:
        """Derivatives `values` (n, r, u) on rows (n, r) by the unknowns of blocks (n,), from parameter `skip` on.

        Of a kind that is held fixed there are none.
        """
        kind = self._columns.get(key)
        if kind is None:
            return
        column = kind.at(block)[:, None, None] + skip + np.arange(values.shape[2])
        row, column = np.broadcast_arrays(rows[:, :, None], column)
        self.parts.append((values.ravel(), row.ravel(), column.ravel()))


def _image_rows(model: Model, state: State, rays: _Rays, seen: list[_Seen], entries: _Entries) -> Floats:
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
    mine: Ints
    camera: Camera
    XYZ: Floats
    """In the map, (n, 3)."""
    by_block: Floats
    """∂ map / ∂ block."""
    xy: Floats
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


def _on_map(model: Model, XYZ: Floats) -> tuple[Floats, Floats]:
    """Map points and their derivatives by block points."""
    if model.block.on_map is None:
        return XYZ, np.broadcast_to(np.eye(3), (len(XYZ), 3, 3))
    return model.block.on_map(XYZ)


def _posed_rows(model: Model, state: State, rays: _Rays, entries: _Entries, rows: Ints) -> Floats:
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


def whitened(model: Model, found: Residuals) -> Floats:
    """Residuals of all rows divided by their standard deviations, in the order of `Rows`."""
    parts = [(found.image / model.sigma).ravel(), found.ground]
    positions, attitudes = model.block.positions, model.block.attitudes
    if positions is not None:
        parts.append((found.position / positions.sigma[model.position_row]).ravel())
    if attitudes is not None:
        parts.append((found.attitude / attitudes.sigma[model.attitude_row]).ravel())
    return np.concatenate([*parts, found.prior])


def _matrix(parts: list[tuple[Floats, Ints, Ints]], weight: Floats, shape: tuple[int, int]) -> sparse.csr_matrix:
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


def _by_parameters(camera: CameraState, rays: _Rays, mine: Ints) -> Floats:
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


def by_coefficient(camera: CameraState, name: str, t: Floats, real: Floats) -> Floats:
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


def _known(model: Model, state: State) -> Floats:
    """Whitened residuals of what is known beforehand."""
    off = [(state.known(key).value(parameter) - value) / sigma for key, parameter, value, sigma in model.known]
    smooth = [each.known @ state.corrections(each.key).ravel() for each in model.sets]
    return np.concatenate([np.array(off, float), *smooth])


#: Part of what is known of a direction that comes from corrections being known beforehand, from which on it is all.
_PRIOR = 0.9
#: Part of a motion that has to lie in the directions.
_WHOLE = 0.95
#: More unknowns than this are not looked through.
_MANY = 600


class OfPoints(NamedTuple):
    """What takes steps of the other unknowns to those of the points."""

    V_inverse: Floats
    """Inverse normal matrices of the points, (m, 3, 3)."""
    N_pg: sparse.csr_matrix
    """Their normal matrix with the other unknowns, (3m, n)."""


def by_prior(model: Model, state: State, rows: Rows, points: OfPoints) -> tuple[str, ...]:
    """Motions of the block of which only what corrections are known to beforehand says anything."""
    count = model.columns.count
    if not model.sets or not 0 < count <= _MANY:
        return ()
    known = rows.A_global[model.parts.smooth]
    K = (known.T @ known).toarray()
    V_inverse, N_pg = points
    m = len(V_inverse)
    blocks = sparse.bsr_matrix((V_inverse, np.arange(m), np.arange(m + 1)), (3 * m, 3 * m))
    N = (rows.A_global.T @ rows.A_global - N_pg.T @ (blocks @ N_pg)).toarray()
    scale = 1.0 / np.sqrt(np.diag(N))
    values, vectors = linalg.eigh(K * np.outer(scale, scale), N * np.outer(scale, scale))
    return motions_of_points(state, points, vectors[:, values > _PRIOR] * scale[:, None])


def motions_of_points(state: State, points: OfPoints, directions: Floats) -> tuple[str, ...]:
    """Motions of all points as one (shifts, turns, scale) that lie in directions (n, q) of the other unknowns."""
    V_inverse, N_pg = points
    if not directions.shape[1] or len(V_inverse) < 3:
        return ()
    moved = -np.einsum("mij,mjq->miq", V_inverse, (N_pg @ directions).reshape(len(V_inverse), 3, -1))
    steps = moved.reshape(3 * len(V_inverse), -1)
    length = np.linalg.norm(steps, axis=0)
    U, s, _ = np.linalg.svd(steps / np.where(length > 0, length, 1.0), full_matrices=False)
    basis = U[:, s > 1e-6 * max(float(s[0]), 1e-300)]
    away = state.XYZ - state.XYZ.mean(axis=0)
    motions = {}
    for along, axis in zip(np.eye(3), "XYZ"):
        motions[f"position of the block in {axis}"] = np.tile(along, (len(away), 1))
        motions[f"rotation of the block about {axis}"] = np.cross(along, away)
    motions["scale of the block"] = away
    found = []
    for name, motion in motions.items():
        g = motion.ravel() / max(float(np.linalg.norm(motion)), 1e-300)
        if np.linalg.norm(basis.T @ g) > _WHOLE:
            found.append(name)
    return tuple(found)


#: Part of a point's normal matrix that is added to its diagonal: far below rounding of any point that is determined.
_RIDGE = 1e-13
#: Eigenvalues of the normal equations, scaled to a unit diagonal, below which their direction is not determined.
SINGULAR = 1e-11
#: Smallest eigenvalues that are looked at: a block without datum has seven that vanish.
_COUNT = 12


@dataclass(frozen=True, eq=False)
class Reduced:
    """Reduced normal equations S x = b of all unknowns but points (Schur complement)."""

    rows: Rows
    S: sparse.csc_matrix
    """Scaled to a unit diagonal: S = D N D."""
    scale: Floats
    """D."""
    b: Floats
    V_inverse: Floats
    """(points, 3, 3)."""
    N_pg: sparse.csr_matrix
    n_p: Floats
    """(points, 3)."""

    @property
    def of_points(self) -> OfPoints:
        """What takes steps of the other unknowns to those of the points."""
        return OfPoints(self.V_inverse, self.N_pg)

    def solved(self, model: Model, state: State) -> tuple[Floats, Floats]:
        """As `solve`; what is not determined is named."""
        try:
            return self.solve()
        except GeometryError:
            check_rank(model, state, self)
            raise

    @cached_property
    def factor(self) -> SuperLU:
        """Factorisation without pivoting."""
        try:
            return splu(self.S, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        except RuntimeError:
            raise GeometryError(
                "the normal equations are singular: the observations do not determine all unknowns"
            ) from None

    def solve(self) -> tuple[Floats, Floats]:
        """Step of all unknowns but points, and of the points (m, 3)."""
        x = self.scale * self.factor.solve(self.scale * -self.b)
        back = (-self.n_p - (self.N_pg @ x).reshape(-1, 3))[:, :, None]
        return x, (self.V_inverse @ back)[:, :, 0]


def reduce_normals(rows: Rows, points: int, damping: float = 0.0) -> Reduced:
    """Form the normal equations and eliminate the points."""
    at, P = _on_points(rows)
    V = np.empty((points, 3, 3))
    for k in range(3):
        for n in range(k, 3):
            V[:, k, n] = V[:, n, k] = np.bincount(at, P[:, k] * P[:, n], points)
    e = rows.e[: len(at)]
    n_p = np.stack([np.bincount(at, P[:, k] * e, points) for k in range(3)], axis=-1).astype(float)
    # A point whose measurements have lost their weight (all but one ray, or all) must not make the equations singular:
    # it then stays where it is.
    trace = np.trace(V, axis1=1, axis2=2)[:, None]
    V[:, range(3), range(3)] *= 1.0 + damping
    V[:, range(3), range(3)] += _RIDGE * trace + (trace == 0.0)
    # A point whose measurements have all lost their weight stays where it is.
    with np.errstate(invalid="ignore"):
        V[~(np.linalg.det(V) > 0.0)] = np.eye(3)
    V_inverse = np.asarray(np.linalg.inv(V), np.float64)
    N_gg = (rows.A_global.T @ rows.A_global).tocsc()
    N_pg = (rows.A_points.T @ rows.A_global).tocsr()
    blocks = sparse.bsr_matrix((V_inverse, np.arange(points), np.arange(points + 1)), (3 * points, 3 * points))
    C = (blocks.tocsr() @ N_pg).tocsr()
    S = (N_gg - N_pg.T @ C).tocsc()
    b = rows.A_global.T @ rows.e - C.T @ n_p.ravel()
    diagonal = S.diagonal()
    if damping:
        S = (S + sparse.diags(damping * N_gg.diagonal())).tocsc()
        diagonal = S.diagonal()
    scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    D = sparse.diags(scale)
    return Reduced(
        rows=rows, S=(D @ S @ D).tocsc(), scale=scale, b=np.asarray(b).ravel(), V_inverse=V_inverse, N_pg=N_pg, n_p=n_p
    )


def _on_points(rows: Rows) -> tuple[Ints, Floats]:
    """Point and coefficients (…, 3) of the rows that have a point; these come first."""
    count = int((rows.point >= 0).sum())
    return rows.point[:count], rows.A_points.data.reshape(-1, 3)


class Inverse:
    """Selected entries of the inverse of the reduced normal equations (cofactors, sigma0 = 1)."""

    def __init__(self, reduced: Reduced) -> None:
        factor = reduced.factor
        if not np.array_equal(factor.perm_r, factor.perm_c):
            raise GeometryError(
                "the normal equations are not positive definite: the unknowns are not determined. Are start "
                "orientations, positions, image points and control of the same block?"
            )
        order = factor.perm_c.astype(np.int64)
        pattern = _pattern(reduced, order)
        pointer, rows = fill_pattern(pattern.indptr.astype(np.int64), pattern.indices.astype(np.int64))
        L = factor.L.tocsc()
        values = align_factor(pointer, rows, L.indptr.astype(np.int64), L.indices.astype(np.int64), L.data)
        diagonal, lower = selected_inverse(pointer, rows, values, factor.U.diagonal())
        self._Q = SelectedInverse(pointer=pointer, rows=rows, diagonal=diagonal, lower=lower, order=order)
        self._reduced = reduced

    def block(self, columns: Ints) -> Floats:
        """Cofactors of unknowns that occur together in an equation (or belong to one image), shape (m, m)."""
        scale = self._reduced.scale[columns]
        dense = dense_inverse(self._Q, columns)
        return np.asarray(dense * scale[:, None] * scale[None, :])

    def variances(self) -> tuple[Floats, Floats]:
        """Cofactors of all points (m, 3, 3), and a Q aᵀ of all rows: 1 minus it is the redundancy number."""
        rows, reduced = self._reduced.rows, self._reduced
        at, P = _on_points(rows)
        scaled = (rows.A_global @ sparse.diags(reduced.scale)).tocsr()
        A = SparseRows(scaled.indptr.astype(np.int64), scaled.indices.astype(np.int64), scaled.data)
        order = np.argsort(at, kind="stable").astype(np.int64)
        pointer = np.searchsorted(at[order], np.arange(len(reduced.V_inverse) + 1)).astype(np.int64)
        covariance, with_point = point_variances(self._Q, A, P, pointer, order, reduced.V_inverse)
        others = np.arange(len(at), len(rows.e))
        return covariance, np.concatenate([with_point, row_variances(self._Q, A, others)])


def _pattern(reduced: Reduced, order: Ints) -> sparse.csc_matrix:
    """Strictly lower triangle, in the order of elimination, of everything that can occur in S.

    Entries that happen to cancel belong to the pattern too, so it is made from ones.
    """
    A = reduced.rows.A_global
    ones = sparse.csr_matrix((np.ones(len(A.data)), A.indices, A.indptr), A.shape)
    N = reduced.N_pg
    points = sparse.csr_matrix((np.ones(len(N.data)), N.indices, N.indptr), N.shape)
    pattern = (ones.T @ ones + points.T @ points).tocoo()
    row, column = order[pattern.row], order[pattern.col]
    lower = row > column
    shape = pattern.shape
    out = sparse.csc_matrix((np.ones(int(lower.sum())), (row[lower], column[lower])), shape)
    out.sort_indices()
    return out


def check_rank(model: Model, state: State, reduced: Reduced) -> None:
    """Refuse equations that leave unknowns undetermined."""
    wrong = ~np.isfinite(np.asarray(reduced.S.sum(axis=1)).ravel())
    if wrong.any():
        owners = dict.fromkeys(
            kind.owners[k]
            for kind in model.columns.kinds
            if kind.width
            for k in np.flatnonzero(wrong[kind.part].reshape(-1, kind.width).any(axis=1))
        )
        shown = ", ".join(map(repr, list(owners)[:3])) + (f" and {len(owners) - 3} more" if len(owners) > 3 else "")
        raise GeometryError(
            f"the equations of {shown} are no numbers any more: an image point or an orientation there is so far off "
            "that the iterations left the block; look for it among what was changed last, or leave the image out"
        )
    values, vectors = _smallest(reduced)
    null = values < SINGULAR
    if not null.any():
        return
    # Back from scaled unknowns to metres, radians and the cameras' units.
    directions = vectors[:, null] * reduced.scale[:, None]
    names = _datum(model, state, directions, reduced.scale)
    names = names or _one_motion(model, state, directions)
    names = names or list(motions_of_points(state, reduced.of_points, directions) if model.projections else ())
    error = DatumDefect if names else GeometryError
    names = names or [model.columns.spelled(d, reduced.scale) for d in vectors[:, null].T]
    raise error(
        f"the observations leave {int(null.sum())} direction{'s' if null.sum() > 1 else ''} of the unknowns free: "
        + "; ".join(dict.fromkeys(names))
        + ". Give control points or observed positions that fix them, or fewer free parameters"
    )


def _smallest(reduced: Reduced) -> tuple[Floats, Floats]:
    """Smallest eigenvalues of the scaled normal equations, with their vectors."""
    n = reduced.S.shape[0]
    if n <= 400:
        values, vectors = np.linalg.eigh(reduced.S.toarray())
        return values[:_COUNT], vectors[:, :_COUNT]
    shift = 1e-10
    factor = splu((reduced.S + shift * identity(n)).tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0)
    solve = LinearOperator((n, n), matvec=factor.solve, dtype=float)
    start = np.random.default_rng(0).normal(size=n)
    try:
        values, vectors = eigsh(reduced.S, k=_COUNT, sigma=-shift, OPinv=solve, which="LM", v0=start, tol=1e-4)
    except ArpackError:
        return np.ones(1), np.zeros((n, 1))
    return values, vectors


def _datum(model: Model, state: State, directions: Floats, reduced_scale: Floats) -> list[str]:
    """Names of the block's motions among the undetermined directions; empty if there are others."""
    size, motions = state.images.motions()
    kind = model.columns.get(IMAGES)
    if kind is None:
        return []
    images = kind.part
    unit = np.array([size] * 3 + [1.0] * 3)
    basis, _ = np.linalg.qr(directions[images] / np.tile(unit, len(state.images.centers))[:, None])
    # A direction in which a camera, a lever arm or a drift changes too is no motion of the block.
    if np.abs(directions[images.stop :] / reduced_scale[images.stop :, None]).max(initial=0.0) > 0.01:
        return []
    named = []
    for name, motion in motions.items():
        v = (motion / unit).ravel()
        length = np.linalg.norm(v)
        if length > 0 and np.linalg.norm(basis.T @ v) > 0.98 * length:
            named.append(name)
    return named if len(named) >= directions.shape[1] else []


def _one_motion(model: Model, state: State, directions: Floats) -> list[str]:
    """A turn of the whole block about a line, where the one undetermined direction is that; otherwise empty."""
    kind = model.columns.get(IMAGES)
    if directions.shape[1] != 1 or kind is None:
        return []
    size, motions = state.images.motions()
    images, unit = kind.part, np.array([size] * 3 + [1.0] * 3)
    v = (directions[images, 0].reshape(-1, 6) / unit).ravel()
    A = np.column_stack([(motion / unit).ravel() for motion in motions.values()])
    parts, *_ = np.linalg.lstsq(A, v, rcond=None)
    if np.linalg.norm(A @ parts - v) > 0.05 * np.linalg.norm(v):
        return []
    part = dict(zip(motions, parts))
    turn = np.array([part[f"rotation of the block about {axis}"] for axis in "XYZ"])
    shift = size * np.array([part[f"position of the block in {axis}"] for axis in "XYZ"])
    if np.linalg.norm(turn) < 10.0 * abs(part["scale of the block"]):
        return []
    turn_square = float(turn @ turn)
    on = state.images.centers.mean(axis=0) + np.cross(turn, shift) / turn_square
    along = turn / np.sqrt(turn_square)
    along = along if along[np.argmax(np.abs(along))] > 0 else -along
    return [
        "rotation of the block about the line through X {:.0f}, Y {:.0f}, Z {:.0f} ".format(*on)
        + "in the direction {:.2f}, {:.2f}, {:.2f}, on which all that places it lies".format(*along)
    ]


#: Standard deviation of a point along its rays, as part of its distance, above which the rays count as parallel.
PARALLEL = 0.25
#: Part of its longest ray below which another ray of a point is too short: the point has come into that projection
#: centre, where it is on the image's ray whatever was measured.
INSIDE = 1e-3
#: By how much a step may stretch the distance of a point at most.
_STRETCH = 100.0


def points_at_infinity(model: Model, state: State, rows: Rows) -> frozenset[str]:
    """Points whose distance their rays do not tell, by name; control that holds a point counts as well.

    Rays are parallel within their accuracy; or they have brought the point into a projection centre.
    """
    inverse = reduce_normals(rows, len(model.point_names)).V_inverse
    away = np.linalg.norm(state.XYZ - _middles(model, state), axis=1)
    rays = np.bincount(model.point, minlength=len(away))
    far = (np.linalg.eigvalsh(inverse)[:, 2] > (PARALLEL * away) ** 2) & (rays >= 2)
    length = np.linalg.norm(state.XYZ[model.point] - model.origins(state.images.centers), axis=1)
    longest = np.zeros(len(away))
    np.maximum.at(longest, model.point, length)
    far[model.point[length < INSIDE * longest[model.point]]] = True
    return frozenset(model.point_names[k] for k in np.flatnonzero(far))


def inverse_depth_step(model: Model, state: State, step: Floats) -> Floats:
    """Steps of points (m, 3) as steps of direction and inverse distance, in which image points are nearly linear.

    Small steps stay what they are. A point that has to go far away gets there in a few steps instead of by doubling its
    distance, and none passes through its cameras (Civera, Davison and Montiel 2008, IEEE Trans. Robotics 24).
    """
    at = state.XYZ - _middles(model, state)
    distance = np.linalg.norm(at, axis=1, keepdims=True)
    distance[distance == 0.0] = 1.0
    u = at / distance
    along = (u * step).sum(axis=1, keepdims=True)
    stretch = 1.0 / np.maximum(1.0 - along / distance, 1.0 / _STRETCH)
    across = step - u * along
    return np.asarray(stretch * (at + across) - at)


def _middles(model: Model, state: State) -> Floats:
    """Middle of the cameras that see each point, (m, 3)."""
    m = len(state.XYZ)
    rays = np.maximum(np.bincount(model.point, minlength=m), 1)
    centers = model.origins(state.images.centers)
    return np.stack([np.bincount(model.point, centers[:, k], m) / rays for k in range(3)], axis=-1)
