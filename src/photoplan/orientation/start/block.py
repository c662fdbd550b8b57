"""Start values of a whole block: poses and points from whatever is known, approximate orientation or none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.observed import GroundPoints, ImagePoints, ObservedPositions
from photoplan.cameras.plane import Affine2D, Bilinear2D
from photoplan.errors import GeometryError
from photoplan.geometry.pose import Pose
from photoplan.orientation.bundle.block import BlockCamera
from photoplan.orientation.resection.direct import resect_direct
from photoplan.orientation.start.model import FEWEST, Net, StartModel, free_model, grown, looseness, net_of
from photoplan.orientation.start.similarity import Similarity, robust_similarity

Array = NDArray[np.float64]

#: Control points from which an image is oriented by itself.
_CONTROL = 4


@dataclass(frozen=True, eq=False)
class StartImage:
    """An image of the block."""

    name: str
    camera: str
    plane_to_pixel: Affine2D | Bilinear2D
    """From the image plane (x right, y up) to pixels."""
    pose: Pose | None = None
    """Approximate exterior orientation, where it is known; it is kept."""


@dataclass(frozen=True, eq=False)
class Started:
    """Result of `start_block`."""

    poses: Mapping[str, Pose]
    """Of every image that could be oriented."""
    how: Mapping[str, str]
    """For each: "given", "control points" or "tie points"."""
    points: Mapping[str, tuple[float, float, float]]
    """Ground coordinates of the points whose rays meet."""
    left_out: tuple[tuple[str, str], ...]
    """Images that could not be oriented: name and reason; those of models that have no place first."""


def start_block(
    cameras: Mapping[str, BlockCamera],
    images: Sequence[StartImage],
    observations: ImagePoints,
    ground: GroundPoints,
    positions: ObservedPositions | None = None,
    sigma: float = 0.5,
) -> Started:
    """Orient as many images of a block as can be, in one Cartesian system.

    Given poses are kept. Images with four control points or more are resected. From these on, further images are
    resected from the points that two oriented images intersect. What is left forms models of its own: a pair by
    relative orientation, further images by resection, and a similarity transformation to control points, to observed
    positions or to points of the images oriented before. Gross errors are tolerated at every step; small ones are left
    to the adjustment, for which these are start values.

    Parameters
    ----------
    cameras : mapping of BlockCamera
        Interior orientation and lens of each camera.
    images : sequence of StartImage
    observations : ImagePoints
        Those of other images are not used.
    ground : GroundPoints
        Points with all three coordinates that are no check points serve as control.
    sigma : float
        Standard deviation of measurements that state none, pixels.
    """
    net = net_of(cameras, images, observations, ground, sigma)
    block = StartModel({}, net.control.copy())
    how: dict[int, str] = {}
    for k, image in enumerate(images):
        if image.pose is not None:
            block.poses[k] = image.pose
            how[k] = "given"
    loose = looseness(net, block)
    _resect_by_control(net, block, how)
    _grow(net, block, how, loose)
    reasons: dict[int, str] = {}
    tried: set[int] = set()
    while True:
        rest = [k for k in range(len(images)) if k not in block.poses and k not in tried]
        model = free_model(net, rest)
        if model is None:
            break
        tried.update(model.poses)
        try:
            placed = _placed(net, model, block, images, positions)
        except GeometryError as error:
            reasons |= dict.fromkeys(
                model.poses, f"one of {len(model.poses)} images that form a model of their own; {error}"
            )
            continue
        block.poses.update({k: placed.pose(p) for k, p in model.poses.items()})
        how |= dict.fromkeys(model.poses, "tie points")
        _grow(net, block, how, loose)
    return _result(net, images, block, how, reasons)


def _resect_by_control(net: Net, block: StartModel, how: dict[int, str]) -> None:
    known = np.isfinite(net.control[:, 0])
    for k in range(net.images):
        mine = net.of_image[k]
        mine = mine[known[net.point[mine]]]
        if k in block.poses or len(mine) < _CONTROL:
            continue
        try:
            found = resect_direct(net.tangents[mine], net.control[net.point[mine]], 2.0 * float(net.sigma[mine].mean()))
        except GeometryError:
            continue
        if found.inliers.sum() >= _CONTROL and found.scale < 20.0 * net.sigma[mine].mean():
            block.poses[k] = found.pose
            how[k] = "control points"


def _grow(net: Net, block: StartModel, how: dict[int, str], loose: float) -> None:
    new = grown(net, block, range(net.images), loose)
    how |= dict.fromkeys(new, "tie points")


def _placed(
    net: Net, model: StartModel, block: StartModel, images: Sequence[StartImage], positions: ObservedPositions | None
) -> Similarity:
    """Transformation of a free model into the ground system."""
    of_model = np.isfinite(model.XYZ[:, 0])
    control = of_model & np.isfinite(net.control[:, 0])
    tied = of_model & np.isfinite(block.XYZ[:, 0])
    source = [model.XYZ[tied]]
    target = [block.XYZ[tied]]
    kind = f"{int(control.sum())} control points"
    # Observed positions take part where points alone are too few.
    seen: list[tuple[Array, Array]] = []
    if positions is not None:
        at = {name: k for k, name in enumerate(positions.images)}
        seen = [(p.center, positions.XYZ[at[images[k].name]]) for k, p in model.poses.items() if images[k].name in at]
        kind += f" and {len(seen)} observed positions"
    if tied.sum() < 3 and seen:
        source.append(np.array([s for s, _ in seen]))
        target.append(np.array([t for _, t in seen]))
    try:
        a, b = np.concatenate(source), np.concatenate(target)
        return robust_similarity(a, b, 0.01 * float(np.ptp(b, axis=0).max()) if len(b) else 0.0)[0]
    except GeometryError as error:
        raise GeometryError(f"it has {kind}: {error}") from None


def _result(
    net: Net, images: Sequence[StartImage], block: StartModel, how: dict[int, str], reasons: dict[int, str]
) -> Started:
    left = []
    for k, image in enumerate(images):
        if k in block.poses:
            continue
        count = len(net.of_image[k])
        why = reasons.get(k)
        if why is None:
            seen = int(np.isfinite(block.XYZ[net.point[net.of_image[k]], 0]).sum())
            why = "no point is measured in it" if count == 0 else _apart(count, seen)
        left.append((image.name, why))
    # What is said of models tells more than what is said of single images.
    told = {images[k].name for k in reasons}
    left.sort(key=lambda item: item[0] not in told)
    known = np.isfinite(block.XYZ[:, 0])
    points = {net.points[k]: tuple(float(v) for v in block.XYZ[k]) for k in np.flatnonzero(known)}
    return Started(
        {images[k].name: block.poses[k] for k in sorted(block.poses)},
        {images[k].name: how[k] for k in sorted(how)},
        points,  # type: ignore[arg-type]
        tuple(left),
    )


def _apart(count: int, known: int) -> str:
    """Why an image with points has no orientation."""
    if known < FEWEST:
        return f"its {count} points do not connect it to other images"
    return (
        f"{known} of its {count} points are known from other images, but no orientation makes enough of them fit: "
        "are camera constant, lens and the names of its points right?"
    )
