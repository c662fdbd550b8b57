"""Measurements of a block as arrays, for the search of start values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.observed import GroundPoints, ImagePoints
from photoplan.cameras.plane import Affine2D, Bilinear2D
from photoplan.orientation.bundle.block import BlockCamera

Array = NDArray[np.float64]


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
    """Measurements of the block's images; those for which a lens has no ray are dropped.

    Parameters
    ----------
    cameras : mapping of str to BlockCamera
    images : sequence
        With name, camera and transformation from image plane to pixels.
    observations : ImagePoints
    ground : GroundPoints
        Check points and points without all three coordinates are no control here.
    sigma : float
        Standard deviation of a measurement that states none, pixels.
    """
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
