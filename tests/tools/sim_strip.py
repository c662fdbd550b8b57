"""Simulated blocks with images that have no pose: three lines of one flight, satellites with polynomials."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import Camera, project
from photoplan.cameras.correctable import (
    TURNED,
    Correctable,
    CorrectableLine,
    CorrectableRpc,
    LineCorrection,
    TrackPriors,
)
from photoplan.cameras.observed import GroundPoints, ImagePoints
from photoplan.cameras.pushbroom import LineCamera
from photoplan.cameras.pushbroom_rays import LineLook, LineTrack
from photoplan.cameras.rpc import RpcCamera
from photoplan.geometry.local import EARTH_RADII, BodyGround, GeodeticGround
from photoplan.geometry.pose import between, continuous, cubic, quaternions, rotation_from_angles
from photoplan.orientation.bundle.model import Block, BlockProjection
from tools.rpc_images import functions

CRS = "EPSG:32633"
ORIGIN = np.array([600_000.0, 5_340_000.0])
FLYING, SPEED, LINE = 2500.0, 70.0, 0.004
COLUMNS, LINES = 6000, 15000
#: 80 mm, 6.5 µm, lines at ±25° (the DPA's).
FOCAL, PITCH = 80.0, 0.0065
AHEAD = {"forward": 37.3, "nadir": 0.0, "backward": -37.3}
_Floats = NDArray[np.float64]


def track() -> LineTrack:
    """A flight along grid east, rolled and pitched by slow waves, recorded at 500 Hz."""
    t = np.arange(-1.0, LINES * LINE + 1.0, 0.002)
    ground = BodyGround(CRS, "ellipsoidal", EARTH_RADII)
    places = np.stack([ORIGIN[0] + SPEED * t, np.full_like(t, ORIGIN[1]), np.full_like(t, FLYING)], axis=1)
    S, axes = ground(places), ground.jacobian(places)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    waves = np.stack([0.01 * np.sin(w * t + p) for w, p in ((0.9, 0.0), (0.7, 1.0), (0.4, 2.0))], axis=1)
    q = continuous(quaternions(axes @ rotation_from_angles(waves) @ TURNED))
    speed = np.gradient(S, t, axis=0)
    return LineTrack(
        lines=LINES,
        knots=np.zeros(1),
        moments=np.zeros(1),
        rates=np.array([LINE]),
        positions=lambda when: cubic(t, S, speed, when),
        attitudes=lambda when: between(t, q, when),
        known=(float(t[0]), float(t[-1])),
    )


def line_camera(ahead: float, flight: LineTrack) -> LineCamera:
    """One line of detectors, mm ahead in the focal plane."""

    def tangents(column: _Floats) -> _Floats:
        y = ((COLUMNS - 1) / 2 - column) * PITCH
        return np.stack([np.full_like(y, ahead), -y], axis=-1) / FOCAL

    return LineCamera(flight, LineLook.of(tangents, COLUMNS), BodyGround(CRS, "ellipsoidal", EARTH_RADII))


def lines(priors: TrackPriors) -> dict[str, CorrectableLine]:
    """Forward, nadir and backward line of one flight."""
    flight = track()
    return {
        name: CorrectableLine(line_camera(ahead, flight), "camera", "flight", priors, LineCorrection.none())
        for name, ahead in AHEAD.items()
    }


def satellites(form: str, count: int = 3, sigma: tuple[float, float] = (10.0, 2.0)) -> dict[str, CorrectableRpc]:
    """Images that look aslant by different angles."""
    out = {}
    for k in range(count):
        f = functions(k)
        coefficients = f.coefficients.copy()
        coefficients[2, 3] += 0.05 * (k - 1)
        coefficients[0, 3] += 0.02 * (k - 1)
        camera = RpcCamera(replace(f, coefficients=coefficients), GeodeticGround(CRS), (3000, 4400))
        out[f"sat{k}"] = CorrectableRpc(camera, f"sat{k}", form, sigma)
    return out


def projection(name: str, group: str, geometry: Correctable, height: float, away: float) -> BlockProjection:
    """As it takes part in a block, in map coordinates."""
    camera = geometry.camera({each.key: each.values for each in geometry.corrections})
    middle = (np.array([camera.size]) - 1.0) / 2.0
    J = camera.derivatives(camera.rays(middle, height)[0])[0]

    def sight(xy: _Floats) -> tuple[_Floats, _Floats]:
        at, tangent = camera.rays(xy, height)
        return at - away * tangent, tangent

    return BlockProjection(name, group, geometry, sight, float(1 / np.sqrt(abs(np.linalg.det(J[:, :2])))), away)


@dataclass(frozen=True, eq=False)
class SimulatedStrips:
    """A block with what is true."""

    block: Block
    true: dict[str, _Floats]
    """Values of the sets of corrections."""
    XYZ: dict[str, _Floats]


def drawn(geometries: Mapping[str, Correctable], rng: np.random.Generator) -> dict[str, _Floats]:
    """Corrections as they are known beforehand: every set from its own rows."""
    true = {}
    for each in {s.key: s for g in geometries.values() for s in g.corrections}.values():
        N = (each.known.T @ each.known).toarray()
        true[each.key] = np.linalg.solve(np.linalg.cholesky(N).T, rng.normal(size=len(N))).reshape(each.values.shape)
    return true


def seen_by(camera: Camera, XYZ: _Floats) -> NDArray[np.bool_]:
    """Which points (n, 3) lie in an image."""
    with np.errstate(invalid="ignore"):
        xy = project(camera, XYZ)
        return np.asarray(((xy >= 0) & (xy <= np.array(camera.size) - 1.0)).all(axis=1))


def simulated(
    projections: list[BlockProjection],
    places: _Floats,
    seed: int,
    sigma: float = 0.2,
    control: int = 6,
    true: dict[str, _Floats] | None = None,
) -> SimulatedStrips:
    """A block over places (n, 3), of which the first are control with 3 cm."""
    rng = np.random.default_rng(seed)
    true = drawn({p.name: p.geometry for p in projections}, rng) if true is None else true
    rows, xy = [], []
    for p in projections:
        camera = p.geometry.camera(true)
        there = np.flatnonzero(seen_by(camera, places))
        at = project(camera, places[there])
        rows += [(f"P{k}", p.name) for k in there]
        xy.append(at + rng.normal(0.0, sigma, at.shape))
    every = np.concatenate(xy)
    points = ImagePoints.from_rows([(n, i, x, y) for (n, i), (x, y) in zip(rows, every.tolist())], sigma)
    ground = GroundPoints(
        tuple(f"P{k}" for k in range(control)),
        places[:control] + rng.normal(0.0, 0.03, (control, 3)),
        np.full((control, 3), 0.03),
        np.zeros(control, bool),
    )
    block = Block(cameras={}, images=(), observations=points, ground=ground, projections=tuple(projections))
    return SimulatedStrips(block, true, {f"P{k}": place for k, place in enumerate(places)})


def places(count: int, seed: int = 0) -> _Floats:
    """Ground of the flight (n, 3), rough by 100 m, of which two lines see all; the first six lie around it."""
    rng = np.random.default_rng(seed)
    first = np.array([(-0.95, -0.9), (-0.95, 0.9), (0.95, -0.9), (0.95, 0.9), (0.0, -0.9), (0.0, 0.9)])
    uv = np.concatenate([first, rng.uniform(-1.0, 1.0, (max(count - 6, 0), 2))])[:count]
    XY = ORIGIN + np.array([SPEED * LINE * LINES / 2, 0.0]) + uv * (1950.0, 430.0)
    return np.column_stack([XY, rng.uniform(200.0, 300.0, len(XY))])
