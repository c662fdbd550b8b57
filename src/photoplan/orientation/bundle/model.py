"""A block as arrays: what stays the same in all iterations of the bundle adjustment."""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.blocks import Layout
from photoplan.cameras.correctable import Corrections
from photoplan.cameras.lenses.brown import Brown
from photoplan.cameras.lenses.none import NoLens
from photoplan.cameras.lenses.opencv import OpenCV
from photoplan.cameras.plane import Affine2D, Bilinear2D
from photoplan.errors import InputError, UsageError
from photoplan.orientation.bundle.block import PARAMETERS, Block, BlockCamera, BlockProjection
from photoplan.orientation.bundle.unknowns import BORESIGHT, COMMON, LEVER, CameraState, layout_of

#: Standard deviation of coordinates that are held fixed, in units of an image point's on the ground: small against
#: anything that is measured, in any unit of length, and large enough for the arithmetic.
FIXED = 1e-5

_Index = NDArray[np.int64]
_Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RowParts:
    """Where the kinds of observations stand in the vector of rows."""

    image: slice
    ground: slice
    position: slice
    attitude: slice
    known: slice
    """What is known beforehand of unknowns."""
    smooth: slice
    """What is known beforehand of corrections, as linear functions of them."""


@dataclass(frozen=True, eq=False)
class Model:
    """The block's observations as arrays; points and images that cannot take part are already gone."""

    block: Block
    image_names: tuple[str, ...]
    """Those with poses first, then `projections`."""
    image_rows: _Index
    """Number of each image with a pose in `block.images`, (n,)."""
    projections: tuple[BlockProjection, ...]
    keys: tuple[tuple[str, ...], ...]
    """Of the sets of corrections of each projection."""
    sets: tuple[Corrections, ...]
    """All these sets, each once."""
    camera_names: tuple[str, ...]
    camera_of: _Index
    """Camera of each image with a pose, then the group of each projection: an index into `groups`."""
    groups: tuple[str, ...]
    """Cameras as messages call them, then the groups of the projections."""
    plane: NDArray[np.float64]
    """Bilinear coefficients b1 … b8 from image plane to pixels of each image, (n, 8)."""
    point_names: tuple[str, ...]
    observation: _Index
    """Number of each measurement in `block.observations`, (k,)."""
    image: _Index
    point: _Index
    xy: NDArray[np.float64]
    sigma: NDArray[np.float64]
    ground: _Index
    """Ground point of each control row, an index into `block.ground`, (c,)."""
    ground_axis: _Index
    """Coordinate of each control row: 0, 1, 2."""
    ground_point: _Index
    """Point of each control row, an index into `point_names`."""
    ground_white: NDArray[np.float64]
    """What the residuals of the three coordinates are multiplied with in a control row, (c, 3)."""
    position: _Index
    """Image of each observed position."""
    position_row: _Index
    """Its number in `block.positions`."""
    strip_of: _Index
    """Strip of each observed position, an index into `strip_names`."""
    strip_names: tuple[str, ...]
    tau: NDArray[np.float64]
    """Time of each observed position since its strip's epoch."""
    epochs: NDArray[np.float64]
    attitude: _Index
    attitude_row: _Index
    columns: Layout
    """The unknowns that are not points."""
    known: tuple[tuple[str, int, float, float], ...]
    """What is known beforehand: key and parameter of the unknown, value, standard deviation."""

    @cached_property
    def parts(self) -> RowParts:
        """Where the kinds of observations stand."""
        smooth = sum(each.known.shape[0] for each in self.sets)
        known = len(self.known), smooth
        sizes = (2 * len(self.image), len(self.ground), 3 * len(self.position), 3 * len(self.attitude), *known)
        ends = np.cumsum(sizes).tolist()
        return RowParts(*(slice(end - size, end) for end, size in zip(ends, sizes)))

    @property
    def rows(self) -> int:
        """Number of all rows."""
        return int(self.parts.smooth.stop)

    @cached_property
    def framed(self) -> _Index:
        """Measurements in images with poses."""
        return np.flatnonzero(self.image < len(self.image_rows))

    @cached_property
    def posed(self) -> Model:
        """The same model with these measurements only."""
        mine = self.framed
        if len(mine) == len(self.image):
            return self
        return replace(
            self,
            observation=self.observation[mine],
            image=self.image[mine],
            point=self.point[mine],
            xy=self.xy[mine],
            sigma=self.sigma[mine],
        )

    @cached_property
    def of_projections(self) -> tuple[tuple[BlockProjection, tuple[str, ...], _Index], ...]:
        """Each projection with the keys of its sets and its measurements."""
        first = len(self.image_rows)
        return tuple((p, self.keys[k], np.flatnonzero(self.image == first + k)) for k, p in enumerate(self.projections))

    @cached_property
    def seen_from(self) -> _Floats:
        """About where the measurements in projections are seen from, (k, 3); NaN for those in images with poses."""
        out = np.full((len(self.image), 3), np.nan)
        for projection, _, mine in self.of_projections:
            out[mine] = projection.sight(self.xy[mine])[0]
        return out

    def origins(self, centers: _Floats) -> _Floats:
        """Where every measurement is seen from, (k, 3), with projection centres (n, 3)."""
        if not self.projections:
            return np.asarray(centers[self.image])
        out = self.seen_from.copy()
        out[self.framed] = centers[self.image[self.framed]]
        return out

    @property
    def observed(self) -> int:
        """Rows of observations, without what is known beforehand."""
        return int(self.parts.attitude.stop)


def check_free(name: str, camera: BlockCamera) -> None:
    """Refuse parameters that a camera's lens does not have."""
    unknown = [p for p in camera.free if p not in PARAMETERS]
    if unknown:
        raise UsageError(f"camera {name!r}: parameter {unknown[0]!r}; allowed are {', '.join(PARAMETERS)}")
    coefficients = [p for p in camera.free if p not in ("c", "x0", "y0")]
    if not coefficients:
        return
    if isinstance(camera.lens, OpenCV):
        missing = [p for p in coefficients if p in ("b1", "b2")]
        if missing:
            raise UsageError(f"camera {name!r}: an OpenCV lens has no {', '.join(missing)}; a Brown lens has them")
    elif not isinstance(camera.lens, Brown | NoLens):
        raise UsageError(
            f"camera {name!r}: {', '.join(coefficients)} cannot be free with its lens ({type(camera.lens).__name__}); "
            "free c, x0, y0 only, or describe the lens by Brown's coefficients as distortion"
        )


def build_model(block: Block, images: list[int], measured: _Index, points: list[str]) -> Model:
    """Arrays of a block."""
    seen = block.observations
    chosen = [block.images[k] for k in images if k < len(block.images)]
    projections = tuple(block.projections[k - len(block.images)] for k in images if k >= len(block.images))
    of_each = [p.geometry.corrections for p in projections]
    sets = {each.key: each for own in of_each for each in own}
    image_index = {n: k for k, n in enumerate([*(b.name for b in chosen), *(p.name for p in projections)])}
    point_index = {name: k for k, name in enumerate(points)}
    camera_names = tuple(dict.fromkeys(b.camera for b in chosen))
    for name in camera_names:
        check_free(name, block.cameras[name])
    sigma = seen.sigma[measured]
    if not np.isfinite(sigma).all():
        raise InputError("image points without a standard deviation; every measurement needs one")
    ground = _ground_rows(block, point_index)
    position, position_row = _observed(block.positions.images if block.positions else (), image_index)
    strips, strip_of, tau, epochs = _strips(block, position_row)
    attitude, attitude_row = _observed(block.attitudes.images if block.attitudes else (), image_index)
    columns = layout_of(block, tuple(b.name for b in chosen), camera_names, strips, tuple(sets.values()))
    groups = tuple(dict.fromkeys(p.group for p in projections))
    of = [camera_names.index(b.camera) for b in chosen]
    of += [len(camera_names) + groups.index(p.group) for p in projections]
    return Model(
        block=block,
        image_names=tuple(image_index),
        image_rows=np.array(images[: len(chosen)], np.int64),
        projections=projections,
        keys=tuple(tuple(each.key for each in own) for own in of_each),
        sets=tuple(sets.values()),
        camera_names=camera_names,
        camera_of=np.array(of, np.int64),
        groups=(*(f"camera {name}" for name in camera_names), *groups),
        plane=np.array([_bilinear(b.plane_to_pixel) for b in chosen]).reshape(-1, 8),
        point_names=tuple(points),
        observation=measured,
        image=np.array([image_index.get(n, -1) for n in seen.images], np.int64)[seen.image[measured]],
        point=np.array([point_index.get(n, -1) for n in seen.points], np.int64)[seen.point[measured]],
        xy=seen.xy[measured],
        sigma=sigma,
        ground=ground[0],
        ground_axis=ground[1],
        ground_point=ground[2],
        ground_white=ground[3],
        position=position,
        position_row=position_row,
        strip_of=strip_of,
        strip_names=strips,
        tau=tau,
        epochs=epochs,
        attitude=attitude,
        attitude_row=attitude_row,
        columns=columns,
        known=_known(block, columns),
    )


def _bilinear(plane: Affine2D | Bilinear2D) -> tuple[float, ...]:
    if isinstance(plane, Affine2D):
        return (plane.a1, plane.a2, 0.0, plane.a3, plane.a4, plane.a5, 0.0, plane.a6)
    return astuple(plane)


def _observed(names: tuple[str, ...], image_index: dict[str, int]) -> tuple[_Index, _Index]:
    rows = [k for k, name in enumerate(names) if name in image_index]
    return np.array([image_index[names[k]] for k in rows], np.int64), np.array(rows, np.int64)


def _strips(block: Block, rows: _Index) -> tuple[tuple[str, ...], _Index, NDArray[np.float64], NDArray[np.float64]]:
    """Names of the strips, strip and time since its epoch of each observed position, and the epochs."""
    if block.positions is None:
        return (), np.empty(0, np.int64), np.empty(0), np.empty(0)
    names = [block.positions.strip[k] for k in rows]
    strips = tuple(dict.fromkeys(names))
    of = np.array([strips.index(n) for n in names], np.int64)
    time = block.positions.time[rows]
    epochs = np.array([time[of == s].mean() for s in range(len(strips))])
    return strips, of, time - epochs[of] if len(of) else np.empty(0), epochs


def _on_ground(block: Block) -> float:
    """About the standard deviation of an image point on the ground, from the start orientations; metres."""
    known = block.ground.XYZ[np.isfinite(block.ground.XYZ).all(axis=1)]
    if not len(known):
        return 1.0
    angles, away = [], []
    sigma = float(np.median(block.observations.sigma)) if len(block.observations) else 1.0
    for image in block.images:
        camera = block.cameras[image.camera]
        pixel = np.sqrt(abs(np.linalg.det(image.plane_to_pixel.derivative(np.array(camera.principal_point)))))
        angles.append(sigma / (camera.c * pixel))
        away.append(np.median(np.linalg.norm(known - image.pose.center, axis=1)))
    return float(np.median([*np.array(angles) * np.array(away), *(sigma * p.metres for p in block.projections)]))


def _ground_rows(block: Block, point_index: dict[str, int]) -> tuple[_Index, _Index, _Index, NDArray[np.float64]]:
    """Control rows: ground point, coordinate, point, and the whitening of their residuals."""
    ground = block.ground
    fixed = FIXED * _on_ground(block)
    rows: list[tuple[int, int, int]] = []
    white: list[NDArray[np.float64]] = []
    for k, name in enumerate(ground.names):
        if ground.check[k] or name not in point_index:
            continue
        known = np.flatnonzero(np.isfinite(ground.XYZ[k]))
        W = np.zeros((3, 3))
        if ground.covariance is not None and np.isfinite(ground.covariance[k][np.ix_(known, known)]).all():
            Q = ground.covariance[k][np.ix_(known, known)] + fixed**2 * np.eye(len(known))
            W[np.ix_(known, known)] = np.linalg.inv(np.linalg.cholesky(Q))
        else:
            sigma = np.maximum(ground.sigma[k][known], fixed)
            if not np.isfinite(sigma).all():
                raise InputError(f"control point {name!r} has no standard deviation; state one for each coordinate")
            W[known, known] = 1.0 / sigma
        for axis in known:
            rows.append((k, int(axis), point_index[name]))
            white.append(W[axis])
    table = np.array(rows, np.int64).reshape(-1, 3)
    return table[:, 0], table[:, 1], table[:, 2], np.array(white).reshape(-1, 3)


def _known(block: Block, columns: Layout) -> tuple[tuple[str, int, float, float], ...]:
    known: list[tuple[str, int, float, float]] = []
    for name, given in block.cameras.items():
        if columns.get(f"camera {name}") is not None:
            before = CameraState(given.c, *given.principal_point, given.lens)
            for k, what in enumerate(given.free):
                if what in given.prior_sigma:
                    known.append((f"camera {name}", k, before.parameter(what), given.prior_sigma[what]))
    if columns.get(LEVER) is not None:
        known += [(LEVER, k, block.lever_arm[k], block.lever_arm_sigma) for k in range(3)]
    if columns.get(COMMON) is not None and block.common is not None:
        known += [(COMMON, k, 0.0, block.common[k]) for k in range(3)]
    if columns.get(BORESIGHT) is not None and block.boresight_sigma > 0:
        known += [(BORESIGHT, k, 0.0, block.boresight_sigma) for k in range(3)]
    return tuple(known)
