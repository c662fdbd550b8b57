"""The unknowns of a bundle adjustment as values, and how a step changes them."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.lenses.base import Lens
from photoplan.cameras.lenses.brown import Brown
from photoplan.cameras.lenses.none import NoLens
from photoplan.cameras.lenses.opencv import OpenCV
from photoplan.geometry.pose import Pose
from photoplan.orientation.bundle.model import Model

_Floats = NDArray[np.float64]


@dataclass(frozen=True)
class CameraState:
    """Interior orientation as it is now."""

    c: float
    x0: float
    y0: float
    lens: Lens


@dataclass(frozen=True, eq=False)
class State:
    """Values of all unknowns."""

    centers: _Floats
    """(n, 3)."""
    rotations: _Floats
    """R_ground_camera, (n, 3, 3)."""
    cameras: tuple[CameraState, ...]
    lever: _Floats
    boresight: _Floats
    """Rotation from observed to true camera axes, (3, 3)."""
    shifts: _Floats
    """Of each strip, (s, 3)."""
    rates: _Floats
    XYZ: _Floats
    """(m, 3)."""

    def poses(self) -> tuple[Pose, ...]:
        """Exterior orientations as values."""
        return tuple(Pose(c, R) for c, R in zip(self.centers, self.rotations))

    def moved(self, model: Model, step: _Floats, points: _Floats) -> State:
        """The state after a step: `step` in the order of `model.columns`, `points` (m, 3)."""
        columns = model.columns
        of_images = step[: 6 * columns.images].reshape(-1, 6)
        cameras = []
        for name, camera, free in zip(model.camera_names, self.cameras, model.free):
            first = columns.cameras.get(name, 0)
            cameras.append(_changed(camera, free, step[first : first + len(free)]))
        lever = self.lever if columns.lever < 0 else self.lever + step[columns.lever : columns.lever + 3]
        boresight = self.boresight
        if columns.boresight >= 0:
            turn = step[columns.boresight : columns.boresight + 3]
            boresight = boresight @ small_rotations(turn[None])[0]
        shifts, rates = self.shifts.copy(), self.rates.copy()
        for s, name in enumerate(model.strip_names):
            first = columns.strips.get(name, -1)
            if first >= 0:
                shifts[s] += step[first : first + 3]
                if model.block.drift == "linear":
                    rates[s] += step[first + 3 : first + 6]
        return replace(
            self,
            centers=self.centers + of_images[:, :3],
            rotations=self.rotations @ small_rotations(of_images[:, 3:]),
            cameras=tuple(cameras),
            lever=lever,
            boresight=boresight,
            shifts=shifts,
            rates=rates,
            XYZ=self.XYZ + points,
        )

    def carried(self, model: Model, made: Model, poses: list[Pose], XYZ: _Floats) -> State:
        """The same values in the order of another model of the block."""
        cameras = dict(zip(model.camera_names, self.cameras))
        start = start_state(made, poses, XYZ)
        strips = {name: k for k, name in enumerate(model.strip_names)}
        shifts, rates = start.shifts.copy(), start.rates.copy()
        for k, name in enumerate(made.strip_names):
            if name in strips:
                shifts[k], rates[k] = self.shifts[strips[name]], self.rates[strips[name]]
        kept = tuple(cameras.get(name, camera) for name, camera in zip(made.camera_names, start.cameras))
        return replace(start, cameras=kept, lever=self.lever, boresight=self.boresight, shifts=shifts, rates=rates)


def start_state(model: Model, poses: list[Pose], XYZ: _Floats) -> State:
    """State of start values."""
    block = model.block
    cameras = []
    for name, free in zip(model.camera_names, model.free):
        given = block.cameras[name]
        lens = given.lens
        if isinstance(lens, NoLens) and any(p not in ("c", "x0", "y0") for p in free):
            lens = Brown()
        cameras.append(CameraState(given.c, *given.principal_point, lens))
    return State(
        np.array([p.center for p in poses]).reshape(-1, 3),
        np.array([p.R_ground_camera for p in poses]).reshape(-1, 3, 3),
        tuple(cameras),
        np.array(block.lever_arm, float),
        np.eye(3),
        np.zeros((len(model.strip_names), 3)),
        np.zeros((len(model.strip_names), 3)),
        XYZ,
    )


def parameter(camera: CameraState, name: str) -> float:
    """Value of a parameter by its name in `photoplan.orientation.bundle.block.PARAMETERS`."""
    if name in ("c", "x0", "y0"):
        return float(getattr(camera, name))
    lens = camera.lens
    if isinstance(lens, OpenCV):
        # OpenCV's y points down: its p2 is Brown's p1, and minus its p1 is Brown's p2.
        return {"p1": lens.p2, "p2": -lens.p1}.get(name, float(getattr(lens, name, 0.0)))
    return float(getattr(lens, name, 0.0))


def _changed(camera: CameraState, free: tuple[str, ...], step: _Floats) -> CameraState:
    values = {name: parameter(camera, name) + float(d) for name, d in zip(free, step)}
    own = {name: values.pop(name) for name in ("c", "x0", "y0") if name in values}
    lens = camera.lens
    if values and isinstance(lens, OpenCV):
        turned = {"p1": ("p2", 1.0), "p2": ("p1", -1.0)}
        values = {turned[n][0] if n in turned else n: v * turned.get(n, ("", 1.0))[1] for n, v in values.items()}
    if values and isinstance(lens, OpenCV):
        lens = OpenCV(**{**asdict(lens), **values})
    elif values and isinstance(lens, Brown):
        lens = Brown(**{**asdict(lens), **values})
    return replace(camera, **own, lens=lens)


def skew(v: _Floats) -> _Floats:
    """[v]× of vectors (..., 3), shape (..., 3, 3): [v]× w = v × w."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def small_rotations(vectors: _Floats) -> _Floats:
    """exp([δ]×) of rotation vectors (n, 3), shape (n, 3, 3) (Rodrigues' formula)."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    K = skew(vectors)
    safe = np.where(angle > 1e-9, angle, 1.0)
    first = np.where(angle > 1e-9, np.sin(safe) / safe, 1.0)
    second = np.where(angle > 1e-9, (1.0 - np.cos(safe)) / safe**2, 0.5)
    return np.asarray(np.eye(3) + first * K + second * (K @ K))


def rotation_vector(R: _Floats) -> _Floats:
    """Rotation vectors (..., 3) of rotation matrices (..., 3, 3) that are not near half a turn."""
    v = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1) / 2
    sine = np.linalg.norm(v, axis=-1, keepdims=True)
    cosine = ((np.trace(R, axis1=-2, axis2=-1) - 1.0) / 2.0)[..., None]
    factor = np.where(sine > 1e-9, np.arctan2(sine, cosine) / np.where(sine > 1e-9, sine, 1.0), 1.0)
    return np.asarray(v * factor)
