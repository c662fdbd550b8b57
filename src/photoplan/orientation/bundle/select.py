"""What can take part in a bundle adjustment, and where its points begin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.robust import geman_mcclure
from photoplan.orientation.bundle.block import Active, Block
from photoplan.orientation.bundle.far import PARALLEL

_Floats = NDArray[np.float64]
_Index = NDArray[np.int64]

#: Angle between rays below which a point waits until orientations are better, radians; points that every image keeps.
_NARROW, _ENOUGH = 0.02, 8
#: Control that is so many times farther from where its rays meet than the median of all control was given wrongly.
_ASTRAY = 10.0


@dataclass(frozen=True, eq=False)
class Selection:
    """Images, measurements and points that can take part."""

    images: list[int]
    """Indices into `block.images`, and beyond these into `block.projections`."""
    measured: _Index
    """Indices into `block.observations`."""
    points: list[str]
    left_out: tuple[tuple[str, str], ...]
    """Name and reason of what cannot."""


def select(block: Block, active: Active, undetermined: frozenset[str] = frozenset()) -> Selection:
    """Choose images and points with enough measurements."""
    seen = block.observations
    names = [*(b.name for b in block.images), *(p.name for p in block.projections)]
    index = {name: k for k, name in enumerate(names)}
    # A projection needs no more than a point: what is known of its corrections beforehand does the rest.
    least = np.repeat([3, 1], [len(block.images), len(block.projections)])
    image_of = np.array([index.get(n, -1) for n in seen.images], np.int64)[seen.image]
    known = _known(block, active.ground)
    keep = active.image & (image_of >= 0)
    keep &= ~np.array([n in undetermined for n in seen.points], bool)[seen.point]
    direct = _direct(block, active.position)
    images_out: dict[str, str] = {}
    while True:
        rays = np.bincount(seen.point[keep], minlength=len(seen.points))
        # One ray and a height determine a point too, but check nothing.
        enough = (rays >= 2) | ((rays == 1) & (known == 3))
        keep_points = keep & enough[seen.point]
        per_image = np.bincount(image_of[keep_points], minlength=len(names))
        poor = [k for k in range(len(names)) if per_image[k] < least[k] and k not in direct]
        poor = [k for k in poor if names[k] not in images_out]
        if not poor:
            break
        for k in poor:
            images_out[names[k]] = f"image with {per_image[k]} points that can be used; {least[k]} are needed"
        keep = keep_points & ~np.isin(image_of, poor)
    used = np.flatnonzero(enough)
    left = list(images_out.items())
    parallel = "point whose rays are parallel within their accuracy, or put it into a projection centre: not determined"
    left += [(n, parallel) for n in seen.points if n in undetermined]
    few = np.flatnonzero(~enough)
    left += [(seen.points[k], _reason(int(rays[k]))) for k in few if seen.points[k] not in undetermined]
    images = [k for k in range(len(names)) if names[k] not in images_out]
    return Selection(images, np.flatnonzero(keep_points), [seen.points[k] for k in used], tuple(left))


def _reason(rays: int) -> str:
    return "point seen in one image only" if rays == 1 else "point without measurements that can be used"


def _known(block: Block, active: NDArray[np.bool_]) -> _Index:
    """Control coordinates that take part, of each point of the observations."""
    coordinates = {
        name: int((np.isfinite(block.ground.XYZ[k]) & active[k]).sum())
        for k, name in enumerate(block.ground.names)
        if not block.ground.check[k]
    }
    return np.array([coordinates.get(n, 0) for n in block.observations.points], np.int64)


def _direct(block: Block, active: NDArray[np.bool_]) -> set[int]:
    """Images whose orientation is observed directly."""
    if block.positions is None or block.attitudes is None:
        return set()
    both = {n for n, used in zip(block.positions.images, active) if used} & set(block.attitudes.images)
    return {k for k, b in enumerate(block.images) if b.name in both}


def start_points(block: Block, selection: Selection, wait: bool = False) -> tuple[_Floats, frozenset[str]]:
    """Start values of the selected points (m, 3), and the points whose rays are parallel.

    With `wait`, points of narrow rays count as such, unless an image has too few others: while orientations are only
    about right, they would fly off and take the adjustment with them.
    """
    seen = block.observations
    point_index = {n: k for k, n in enumerate(selection.points)}
    point = np.array([point_index.get(n, -1) for n in seen.points], np.int64)[seen.point[selection.measured]]
    image, centers, directions, sigma = _rays(block, selection)
    XYZ, angle = intersect(centers, directions, point, len(point_index))
    count = np.maximum(np.bincount(point, minlength=len(point_index)), 1)
    usual = np.bincount(point, sigma, len(point_index)) / count
    # An angle between rays that is found with this accuracy tells the distance to the same part; errors of many rays
    # alone make an angle too. Rays that come from a point behind their cameras are parallel as well.
    behind = ((XYZ[point] - centers) * directions).sum(axis=1) < 0
    turned = (np.bincount(point, behind, len(point_index)) > 0.5 * count) & (angle < _NARROW)
    least = usual * np.sqrt(1.0 + 0.5 * PARALLEL**2 * count) / PARALLEL
    determined = np.isfinite(XYZ).all(axis=1) & (angle > np.maximum(least, 1e-7)) & ~turned
    if wait:
        wide = determined & (angle > _NARROW)
        kept = np.bincount(image[wide[point]], minlength=len(selection.images))
        if (kept >= np.minimum(_ENOUGH, np.bincount(image, minlength=len(selection.images)))).all():
            determined = wide
    control = [
        (point_index[name], block.ground.XYZ[k])
        for k, name in enumerate(block.ground.names)
        if name in point_index and not block.ground.check[k]
    ]
    off = np.array([np.linalg.norm(XYZ[at] - given) if determined[at] else np.nan for at, given in control])
    far = _ASTRAY * np.nanmedian(off) if np.isfinite(off).any() else np.inf
    for (at, given), distance in zip(control, off):
        if np.isfinite(given).all():
            # A point that was exchanged with another one begins where its rays meet: from where it is not, the first
            # step would tear the block apart.
            if not distance > far:
                XYZ[at], determined[at] = given, True
        elif not determined[at]:
            XYZ[at] = _on_ray(centers[point == at][0], directions[point == at][0], given)
            determined[at] = np.isfinite(XYZ[at]).all()
    for name, start in block.start_points.items():
        if name in point_index:
            XYZ[point_index[name]] = start
            determined[point_index[name]] = True
    return XYZ, frozenset(selection.points[k] for k in np.flatnonzero(~determined))


def _rays(block: Block, selection: Selection) -> tuple[_Index, _Floats, _Floats, _Floats]:
    """Of all measurements that were selected: number of the image, origin and direction (k, 3) of its ray, and the
    standard deviation of that, radians."""
    seen = block.observations
    chosen = [block.images[k] for k in selection.images if k < len(block.images)]
    projections = [block.projections[k - len(block.images)] for k in selection.images if k >= len(block.images)]
    numbers = {n: k for k, n in enumerate([*(b.name for b in chosen), *(p.name for p in projections)])}
    image = np.array([numbers.get(n, -1) for n in seen.images], np.int64)[seen.image[selection.measured]]
    xy, spread = seen.xy[selection.measured], seen.sigma[selection.measured].mean(axis=1)
    directions, centers = np.empty((len(image), 3)), np.empty((len(image), 3))
    sigma = np.empty(len(image))
    order = np.argsort(image, kind="stable")
    ends = np.searchsorted(image[order], np.arange(len(numbers) + 1))
    for k, b in enumerate(chosen):
        mine = order[ends[k] : ends[k + 1]]
        camera = block.cameras[b.camera]
        t = camera.lens.undistort((b.plane_to_pixel.inverse(xy[mine]) - camera.principal_point) / camera.c)
        d = np.column_stack([t, -np.ones(len(t))]) @ b.pose.R_ground_camera.T
        directions[mine] = d / np.linalg.norm(d, axis=1, keepdims=True)
        pixel = np.sqrt(abs(np.linalg.det(b.plane_to_pixel.derivative(np.array(camera.principal_point)))))
        sigma[mine] = spread[mine] / (camera.c * pixel)
        centers[mine] = b.pose.center
    for k, p in enumerate(projections, len(chosen)):
        mine = order[ends[k] : ends[k + 1]]
        centers[mine], directions[mine] = p.sight(xy[mine])
        # An angle that is as large as the point's size seen from there.
        sigma[mine] = spread[mine] * p.metres / p.away
    return image, centers, directions, sigma


def _on_ray(center: _Floats, direction: _Floats, given: _Floats) -> _Floats:
    """Point of a ray at a known height; NaN without one."""
    if not (np.isfinite(given[2]) and abs(direction[2]) > 1e-6):
        return np.full(3, np.nan)
    return np.asarray(center + direction * ((given[2] - center[2]) / direction[2]))


def intersect(
    centers: _Floats, directions: _Floats, point: _Index, count: int, rounds: int = 6
) -> tuple[_Floats, _Floats]:
    """Points nearest to their rays, in the robust mean, and the angle at which two such rays would meet, radians.

    Parameters
    ----------
    centers, directions : ndarray, shape (k, 3)
        Origins and unit directions of rays.
    point : ndarray, shape (k,)
        Point of each ray.
    count : int
        Number of points.
    """
    weight = np.ones(len(point))
    good_rays = np.asarray(np.isfinite(directions).all(axis=1))
    directions = np.where(good_rays[:, None], directions, 0.0)
    projector = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    XYZ = np.full((count, 3), np.nan)
    meeting = np.zeros(count)
    for turn in range(rounds):
        w = weight * good_rays
        N = np.empty((count, 3, 3))
        for i in range(3):
            for j in range(3):
                N[:, i, j] = np.bincount(point, w * projector[:, i, j], count)
        from_center = (projector @ centers[:, :, None])[:, :, 0]
        b = np.stack([np.bincount(point, w * from_center[:, i], count) for i in range(3)], axis=-1)
        values = np.linalg.eigvalsh(N)
        if turn == 0:
            # Two rays at the angle a have the eigenvalues 1 − cos a and 2.
            meeting = np.sqrt(np.maximum(2.0 * values[:, 0], 0.0))
        solvable = values[:, 0] > 1e-14 * np.maximum(values[:, 2], 1e-300)
        N[~solvable] = np.eye(3)
        XYZ = np.where(solvable[:, None], np.linalg.solve(N, b[:, :, None])[:, :, 0], np.nan)
        to = XYZ[point] - centers
        distance = np.linalg.norm(to, axis=1)
        across = np.linalg.norm((projector @ to[:, :, None])[:, :, 0], axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            angle = np.where(distance > 0, across / distance, 0.0)
        scale = max(float(np.nanmedian(angle[good_rays])) if good_rays.any() else 0.0, 1e-12)
        # Far rays count less, as their error across is larger; gross errors hardly count.
        weight = np.nan_to_num(geman_mcclure(angle, 3.0 * scale) / np.maximum(distance, 1e-9) ** 2)
    return XYZ, meeting
