"""Measurements of a block as arrays, and models that grow: images resected one after the other.

Each is resected from points that oriented images intersect.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.observed import GroundPoints, ImagePoints
from photoplan.cameras.plane import Affine2D, Bilinear2D
from photoplan.errors import GeometryError
from photoplan.geometry.pose import Pose
from photoplan.orientation.bundle.block import BlockCamera
from photoplan.orientation.intersection import MeasuredRays, intersect
from photoplan.orientation.resection.direct import polished_pose, reprojected, resect_direct
from photoplan.orientation.start.relative import RelativeOrientation, relate

Array = NDArray[np.float64]

#: Known points that an image needs to be resected.
FEWEST = 6
#: Part of them that must agree.
_SHARE = 0.4
#: Images with at least this part of the best image's points are added together.
_TOGETHER = 0.7
#: Pairs that are tried for the begin of a model.
_PAIRS = 12
#: Standard deviations of measurements are multiplied by this, as models are not adjusted while they grow.
_SLACK = 4.0
_SWEEPS = 2


@dataclass(frozen=True, eq=False)
class StartModel:
    """Poses and points in one system; both are filled while the model grows."""

    poses: dict[int, Pose]
    XYZ: Array
    """(p, 3); NaN: not known."""


def free_model(net: Net, images: Iterable[int]) -> StartModel | None:
    """A model of its own of as many of `images` as hang together; None where no pair does."""
    wanted = sorted(images)
    pair = _best_pair(net, wanted)
    if pair is None:
        return None
    first, second, found = pair
    model = StartModel({first: Pose(np.zeros(3), np.eye(3)), second: found.pose}, np.full((len(net.points), 3), np.nan))
    grown(net, model, wanted, 1.0, fixed=False)
    return model


def _best_pair(net: Net, images: list[int]) -> tuple[int, int, RelativeOrientation] | None:
    """The pair with the most common points that meet under a good angle."""
    shown = {k: set(net.point[net.of_image[k]].tolist()) for k in images}
    pairs = [
        (len(shown[a] & shown[b]), a, b) for i, a in enumerate(images) for b in images[i + 1 :] if shown[a] & shown[b]
    ]
    pairs.sort(key=lambda p: (-p[0], p[1], p[2]))
    best: tuple[float, int, int, RelativeOrientation] | None = None
    for count, a, b in pairs[:_PAIRS]:
        if best is not None and count < 0.5 * pairs[0][0]:
            break
        try:
            found = _related(net, a, b)
        except GeometryError:
            continue
        # More than 30° between rays gains nothing.
        worth = float(found.inliers.sum()) * min(found.angle, 0.52)
        if best is None or worth > best[0]:
            best = worth, a, b, found
    return None if best is None else best[1:]


def _related(net: Net, a: int, b: int) -> RelativeOrientation:
    one, two = net.of_image[a], net.of_image[b]
    _, i, j = np.intersect1d(net.point[one], net.point[two], return_indices=True)
    one, two = one[i], two[j]
    return relate(net.tangents[one], net.tangents[two], float(np.median(net.sigma[one])))


def grown(net: Net, model: StartModel, images: Iterable[int], loose: float, fixed: bool = True) -> list[int]:
    """Add images until none has enough known points; the numbers of those that were added."""
    waiting = [k for k in images if k not in model.poses]
    added: list[int] = []
    refused: dict[int, int] = {}
    while True:
        _intersected(net, model, loose, fixed)
        known = np.isfinite(model.XYZ[:, 0])
        counts = {k: int(known[net.point[net.of_image[k]]].sum()) for k in waiting}
        able = {k: n for k, n in counts.items() if n >= FEWEST and n > refused.get(k, 0)}
        if not able:
            return added
        enough = _TOGETHER * max(able.values())
        new = []
        for k in sorted(able, key=lambda k: (-able[k], k)):
            if able[k] < enough:
                break
            pose = _resected(net, model, k, loose)
            if pose is None:
                refused[k] = able[k]
                continue
            model.poses[k] = pose
            new.append(k)
        waiting = [k for k in waiting if k not in model.poses]
        added += new
        for _ in range(_SWEEPS if new else 0):
            _intersected(net, model, loose, fixed)
            for k in new:
                model.poses[k] = _polished(net, model, k, loose)


def looseness(net: Net, model: StartModel) -> float:
    """By how much the poses that the model has miss the measurements' standard deviation; at least 1."""
    numbers = sorted(model.poses)
    place = np.full(net.images, -1)
    place[numbers] = np.arange(len(numbers))
    rays = np.flatnonzero(place[net.image] >= 0)
    if len(numbers) < 2 or not len(rays):
        return 1.0
    image, point, sigma = place[net.image[rays]], net.point[rays], np.repeat(net.sigma[rays, None], 2, axis=1)
    poses = [model.poses[k] for k in numbers]
    XYZ = intersect(poses, MeasuredRays(image, point, net.tangents[rays], sigma), len(net.points), critical=np.inf).XYZ
    miss = np.full(len(rays), np.nan)
    for k, pose in enumerate(poses):
        mine = image == k
        t = reprojected(pose.R_ground_camera[None], pose.center[None], XYZ[point[mine]])[0]
        miss[mine] = np.linalg.norm(t - net.tangents[rays[mine]], axis=1) / net.sigma[rays[mine]]
    miss = miss[np.isfinite(miss)]
    # Residuals of two rays hold a quarter of the errors.
    return float(np.clip(2.0 * np.median(miss) / _SLACK, 1.0, 200.0)) if len(miss) else 1.0


def _intersected(net: Net, model: StartModel, loose: float, fixed: bool) -> None:
    """Points of all oriented images, anew."""
    numbers = sorted(model.poses)
    place = np.full(net.images, -1)
    place[numbers] = np.arange(len(numbers))
    rays = np.flatnonzero(place[net.image] >= 0)
    model.XYZ[:] = net.control if fixed else np.nan
    if len(numbers) < 2:
        return
    sigma = np.repeat(net.sigma[rays, None], 2, axis=1) * (_SLACK * loose)
    found = intersect(
        [model.poses[k] for k in numbers],
        MeasuredRays(place[net.image[rays]], net.point[rays], net.tangents[rays], sigma),
        len(net.points),
        min_angle=0.02,
    )
    free = ~np.isfinite(model.XYZ[:, 0])
    model.XYZ[free] = found.XYZ[free]


def _known(net: Net, model: StartModel, k: int) -> tuple[Array, Array, float]:
    mine = net.of_image[k]
    mine = mine[np.isfinite(model.XYZ[net.point[mine], 0])]
    return net.tangents[mine], model.XYZ[net.point[mine]], float(np.median(net.sigma[mine]))


def _resected(net: Net, model: StartModel, k: int, loose: float) -> Pose | None:
    """Pose of an image; None where too few of its known points agree."""
    t, X, sigma = _known(net, model, k)
    try:
        found = resect_direct(t, X, _SLACK * sigma)
    except GeometryError:
        return None
    good = found.inliers.sum() >= max(FEWEST, _SHARE * len(t)) and found.scale <= 5.0 * _SLACK * loose * sigma
    return found.pose if good else None


def _polished(net: Net, model: StartModel, k: int, loose: float) -> Pose:
    t, X, sigma = _known(net, model, k)
    pose = model.poses[k]
    r = np.linalg.norm(reprojected(pose.R_ground_camera[None], pose.center[None], X)[0] - t, axis=1)
    near = r < 4.0 * _SLACK * loose * sigma
    return polished_pose(pose, t, X, near) if near.sum() >= FEWEST else pose


class _NetImage(Protocol):
    @property
    def name(self) -> str: ...
    @property
    def camera(self) -> str: ...
    @property
    def plane_to_pixel(self) -> Affine2D | Bilinear2D: ...


@dataclass(frozen=True, eq=False)
class Net:
    """Measurements in tangent coordinates."""

    images: int
    """Number of images."""
    points: tuple[str, ...]
    """Names of the points, (p,)."""
    image: NDArray[np.int64]
    """(m,), an index into the images."""
    point: NDArray[np.int64]
    """(m,), an index into `points`."""
    tangents: Array
    """(m, 2)."""
    sigma: Array
    """Standard deviation of a tangent coordinate, (m,)."""
    control: Array
    """(p, 3); NaN where a point is no control point with three coordinates."""
    of_image: tuple[NDArray[np.int64], ...]
    """Measurements of each image."""


def net_of(
    cameras: Mapping[str, BlockCamera],
    images: Sequence[_NetImage],
    observations: ImagePoints,
    ground: GroundPoints,
    sigma: float,
) -> Net:
    """Measurements of the block's images; those for which a lens has no ray are dropped."""
    number = {image.name: k for k, image in enumerate(images)}
    of_block = np.array([number.get(name, -1) for name in observations.images], np.int64)
    image = of_block[observations.image] if len(observations) else np.empty(0, np.int64)
    tangents = np.full((len(image), 2), np.nan)
    scale = np.ones(len(image))
    for k, described in enumerate(images):
        mine = np.flatnonzero(image == k)
        camera = cameras[described.camera]
        plane = described.plane_to_pixel.inverse(observations.xy[mine])
        tangents[mine] = camera.lens.undistort((plane - camera.principal_point) / camera.c)
        J = described.plane_to_pixel.derivative(np.array(camera.principal_point))
        scale[mine] = camera.c * np.sqrt(abs(np.linalg.det(J)))
    stated = np.where(np.isfinite(observations.sigma), observations.sigma, sigma).mean(axis=1) if len(image) else scale
    keep = np.flatnonzero((image >= 0) & np.isfinite(tangents).all(axis=1))
    image, point = image[keep], observations.point[keep]
    control = np.full((len(observations.points), 3), np.nan)
    given = {name: k for k, name in enumerate(ground.names)}
    for p, name in enumerate(observations.points):
        g = given.get(name, -1)
        if g >= 0 and not ground.check[g] and np.isfinite(ground.XYZ[g]).all():
            control[p] = ground.XYZ[g]
    order = np.argsort(image, kind="stable")
    ends = np.searchsorted(image[order], np.arange(len(images) + 1))
    of_image = tuple(order[a:b] for a, b in pairwise(ends))
    return Net(
        images=len(images),
        points=observations.points,
        image=image,
        point=point,
        tangents=tangents[keep],
        sigma=(stated / scale)[keep],
        control=control,
        of_image=of_image,
    )
