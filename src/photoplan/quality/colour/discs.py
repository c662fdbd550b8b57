"""Discs in an image located to a small part of a pixel: an ellipse with a blurred border fitted by least squares."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, special
from scipy.spatial import cKDTree

from photoplan.adjustment.iterate import Equations, levenberg
from photoplan.adjustment.linear import solve
from photoplan.errors import InputError
from photoplan.quality.colour.model import Displacements

_Array = NDArray[np.float64]
#: Half the side of the part of an image that a disc is fitted in, in radii.
_REACH = 1.7
#: Steps of a fit; those that have not settled by then are no discs.
_ROUNDS = 25
#: A disc is the same in all directions to within this ratio of its axes; anything longer is no disc of a chart.
_MOST_AXES = 2.5


#: Radii of what counts as a disc, pixels.
_RADII = (2.5, 500.0)
#: Times the noise of a pixel that the step at the border has at least.
_LEAST_CONTRAST = 8.0
#: Standard deviation of a coordinate, pixels; a centre known less well is left out.
_MOST_SIGMA = 0.1
#: More spots than this are no chart.
_MOST_SPOTS = 20_000


@dataclass(frozen=True)
class Disc:
    """A disc, located."""

    x: float
    """Column of the centre."""
    y: float
    """Row of the centre."""
    sigma_x: float
    """Standard deviation of the column, pixels."""
    sigma_y: float
    """Standard deviation of the row, pixels."""
    radius: float
    """Root of the product of both half axes, pixels."""
    blur: float
    """Standard deviation of the Gaussian across the border, pixels."""
    contrast: float
    """Ground minus disc, grey values; the largest of the planes of a mosaic."""
    noise: float
    """Standard deviation of the residuals, grey values."""


def find_discs(
    grey: NDArray[Any], saturation: float | None = None, planes: NDArray[np.int_] | None = None
) -> tuple[Disc, ...]:
    """Locate all discs that lie wholly in an image, dark on bright ground or bright on dark."""
    limit = saturation
    if limit is None:
        limit = float(np.iinfo(grey.dtype).max) if grey.dtype.kind in "iu" else float("inf")
    values = np.asarray(grey, np.float64)
    values = np.where(values >= limit, np.inf, values)
    numbers = np.zeros(values.shape, int) if planes is None else planes
    found: list[Disc] = []
    refused: dict[str, int] = {}
    for start in _spots(_even(values, numbers)):
        result = _located(values, numbers, start)
        if isinstance(result, Disc):
            found.append(result)
        else:
            refused[result] = refused.get(result, 0) + 1
    if not found:
        told = "; ".join(f"{count} spots: {why}" for why, count in refused.items()) or "no round spot at all"
        raise InputError(
            f"no disc was found in {values.shape[1]} × {values.shape[0]} pixels ({told}); needed are round, "
            f"unsaturated spots of {_RADII[0]:g} to {_RADII[1]:g} pixels radius on even ground"
        )
    return tuple(found)


def _even(values: _Array, planes: NDArray[np.int_]) -> _Array:
    """An image to look for spots in: the planes of a mosaic brought to one level, gaps filled by their neighbours."""
    out = np.full(values.shape, np.nan)
    for plane in np.unique(planes[planes >= 0]):
        mine = (planes == plane) & ~np.isnan(values)
        if mine.any():
            high = np.percentile(np.minimum(values[mine], 1e30), 95)
            out[mine] = np.minimum(values[mine], high) / high if high > 0.0 else 0.0
    known = np.isfinite(out)
    if not known.any():
        raise InputError("no pixel of the image has a value; there are no discs to be found")
    width = 1.0 if len(np.unique(planes[planes >= 0])) == 1 and (planes >= 0).all() else 1.2
    weight = ndimage.gaussian_filter(known.astype(float), width)
    smooth = ndimage.gaussian_filter(np.where(known, out, 0.0), width)
    return np.asarray(smooth / np.maximum(weight, 1e-9))


def _spots(even: _Array) -> Iterator[tuple[float, float, float]]:
    """Centre and radius of round spots: connected parts beyond the middle between ground and disc."""
    low, high = np.percentile(even, [1, 99])
    # Discs cover less of the image than the ground.
    picture = even if (even < (low + high) / 2.0).mean() < 0.5 else -even
    disc = np.percentile(picture, 1)
    side = max(16, min(picture.shape) // 4)
    ground = _blocks(picture, side)
    rows = np.minimum(np.arange(picture.shape[0]) // side, ground.shape[0] - 1)
    columns = np.minimum(np.arange(picture.shape[1]) // side, ground.shape[1] - 1)
    level = ndimage.uniform_filter(ground[rows[:, None], columns[None, :]], side)
    labels, count = ndimage.label(picture < (level + disc) / 2.0)
    if count > _MOST_SPOTS:
        raise InputError(f"{count} spots in the image; at most {_MOST_SPOTS} are a chart of discs: choose a part of it")
    for index, box in enumerate(ndimage.find_objects(labels), 1):
        area = labels[box] == index
        height, width = area.shape
        radius = float(np.sqrt(area.sum() / np.pi))
        inside = box[0].start > 0 and box[1].start > 0
        inside &= box[0].stop < even.shape[0] and box[1].stop < even.shape[1]
        long = max(height, width) / max(min(height, width), 1)
        full = area.sum() / (np.pi / 4.0 * height * width)
        if not inside or not _RADII[0] <= radius <= _RADII[1] or long > _MOST_AXES:
            continue
        if 0.8 < full < 1.2:
            y, x = ndimage.center_of_mass(area)
            yield x + box[1].start, y + box[0].start, radius


def _blocks(picture: _Array, side: int) -> _Array:
    """Level of the ground in blocks: what three quarters of the pixels stay below."""
    rows, columns = max(1, picture.shape[0] // side), max(1, picture.shape[1] // side)
    return np.array(
        [
            [np.percentile(part, 75) for part in np.array_split(strip, columns, 1)]
            for strip in np.array_split(picture, rows, 0)
        ]
    )


def _located(values: _Array, planes: NDArray[np.int_], start: tuple[float, float, float]) -> Disc | str:
    """The disc at a place, or why it is none."""
    x0, y0, radius = start
    reach = _REACH * radius + 2.0
    if any(at - radius < 2.0 or at + radius > side - 3.0 for at, side in zip((y0, x0), values.shape)):
        return "too near the border"
    part = tuple(
        slice(max(int(np.floor(at - reach)), 0), min(int(np.ceil(at + reach)) + 1, side))
        for at, side in zip((y0, x0), values.shape)
    )
    y, x = np.mgrid[part]
    near = (np.hypot(x - x0, y - y0) <= reach) & (planes[part] >= 0)
    grey, number = values[part][near], planes[part][near]
    if np.isinf(grey).any():
        return "saturated"
    if np.isnan(grey).any():
        return "pixels without value"
    used, index = np.unique(number, return_inverse=True)
    fit = _DiscFit(x[near] - x0, y[near] - y0, grey, index, used.size)
    return fit.run(start)


class _DiscFit:
    """Gauss-Newton of one disc.

    Unknown: centre, size, two of the shape, blur, and per plane the grey of the ground with its slopes and the step.
    """

    def __init__(self, x: _Array, y: _Array, grey: _Array, plane: NDArray[np.int_], planes: int) -> None:
        self.x, self.y, self.grey, self.plane, self.planes = x, y, grey, plane, planes
        self.share = np.stack([plane == k for k in range(planes)], 1).astype(float)

    def run(self, start: tuple[float, float, float]) -> Disc | str:
        """The disc, or why it is none."""
        first = np.array([0.0, 0.0, np.log(start[2]), 0.0, 0.0, np.log(0.08 * start[2] + 0.5)])
        found = levenberg(
            first, self._equations, lambda shape, step: shape + np.clip(step[:6], *_bounds(start[2])), _ROUNDS
        )
        return self._disc(found, start)

    def _cover(self, shape: _Array) -> _Array:
        """Share of the disc in each pixel: the normal distribution of the distance from the ellipse."""
        u, v = self.x - shape[0], self.y - shape[1]
        radius, p, q = np.exp(shape[2]), shape[3], shape[4]
        form = u * u * (1.0 + p) + v * v * (1.0 - p) + 2.0 * q * u * v
        length = np.sqrt(np.maximum(form, 1e-12))
        gradient = np.hypot(u * (1.0 + p) + q * v, v * (1.0 - p) + q * u)
        distance = (length - radius) * length / np.maximum(gradient, 1e-9)
        return np.asarray(special.ndtr(-distance / np.exp(shape[5])))

    def _basis(self, cover: _Array) -> _Array:
        """Columns of what enters linearly: ground, its slopes relative to it, and step, for every plane."""
        ground = self.share
        slopes = np.concatenate([ground * self.x[:, None], ground * self.y[:, None]], 1)
        # Light that falls unevenly is as uneven inside the disc; a share of a slope there is left to the noise.
        return np.concatenate([ground, slopes * (1.0 - cover)[:, None], ground * cover[:, None]], 1)

    def _equations(self, shape: _Array) -> tuple[_Array, _Array]:
        """Derivatives by the shape and by the grey values that fit best to it, and residuals."""
        basis = self._basis(self._cover(shape))
        fit = solve(basis, self.grey)
        columns = []
        for k in range(6):
            moved = shape.copy()
            moved[k] += 1e-5
            columns.append((self._basis(self._cover(moved)) - basis) @ fit.unknowns / 1e-5)
        return np.column_stack([*columns, basis]), fit.residuals

    def _disc(self, found: Equations[_Array], start: tuple[float, float, float]) -> Disc | str:
        shape, noise = found.state, found.sigma0
        if found.redundancy < 10:
            return "too few pixels"
        cofactors = found.cofactors()
        if cofactors is None:
            return "not determined"
        levels = solve(self._basis(self._cover(shape)), self.grey).unknowns
        sigma = noise * np.sqrt(np.maximum(np.diag(cofactors)[:2], 0.0))
        steps = -levels[-self.planes :]
        contrast = float(steps[np.argmax(np.abs(steps))])
        axes = np.sqrt(np.maximum(1.0 - shape[3] ** 2 - shape[4] ** 2, 1e-9))
        radius = float(np.exp(shape[2]) / np.sqrt(axes))
        # A curved border that is blurred has its half level further inside.
        radius += float(np.exp(2.0 * shape[5])) / (2.0 * radius)
        if not np.isfinite([*shape, *sigma]).all() or max(np.abs(shape[:2])) > 0.5 * start[2]:
            return "no disc"
        if not 0.5 * start[2] < radius < 2.0 * start[2] or np.exp(shape[5]) > 0.7 * radius:
            return "too blurred"
        if abs(contrast) < _LEAST_CONTRAST * max(noise, 1.0 / np.sqrt(12.0) if _whole(self.grey) else 0.0):
            return "too weak"
        if sigma.max() > _MOST_SIGMA:
            return "centre too uncertain"
        x, y = start[0] + float(shape[0]), start[1] + float(shape[1])
        return Disc(
            x=x,
            y=y,
            sigma_x=float(sigma[0]),
            sigma_y=float(sigma[1]),
            radius=radius,
            blur=float(np.exp(shape[5])),
            contrast=contrast,
            noise=noise,
        )


def _whole(grey: _Array) -> bool:
    return bool((grey == np.round(grey)).all())


def _bounds(radius: float) -> tuple[_Array, _Array]:
    """Steps that one round may go at most."""
    most = np.array([0.3 * radius, 0.3 * radius, 0.2, 0.2, 0.2, 0.5])
    return -most, most


#: A centre is not known better than this, whatever its fit says: print, lens and mosaic are not perfect, pixels.
_FLOOR = 0.002


def disc_displacements(reference: Sequence[Disc], band: Sequence[Disc]) -> Displacements:
    """Match discs of two bands, each with its nearest in the other, and difference their centres.

    Two can be the same up to a third of the distance of nearest neighbours in the chart, at most 30 pixels.
    """
    here = np.array([[d.x, d.y] for d in reference]).reshape(-1, 2)
    there = np.array([[d.x, d.y] for d in band]).reshape(-1, 2)
    farthest = 30.0
    if len(here) > 1:
        farthest = min(farthest, float(np.median(cKDTree(here).query(here, 2)[0][:, 1])) / 3.0)
    pairs = []
    if len(here) and len(there):
        apart, nearest = cKDTree(there).query(here)
        back = cKDTree(here).query(there)[1]
        pairs = [(i, int(k)) for i, k in enumerate(nearest) if back[k] == i and apart[i] <= farthest]
        pairs = [(i, k) for i, k in pairs if 0.7 < reference[i].radius / band[k].radius < 1.4]
    if len(pairs) < 4:
        raise InputError(
            f"{len(pairs)} discs are the same in both bands (of {len(here)} and {len(there)}, up to {farthest:.1f} "
            "pixels apart); at least 4 are needed"
        )
    both = [(reference[i], band[k]) for i, k in pairs]
    value = np.array([(b.x - a.x, b.y - a.y) for a, b in both])
    spreads = np.array([(np.hypot(a.sigma_x, b.sigma_x), np.hypot(a.sigma_y, b.sigma_y)) for a, b in both])
    n = len(pairs)
    return Displacements(
        place=np.repeat([(a.x, a.y) for a, _ in both], 2, axis=0),
        direction=np.tile(np.eye(2), (n, 1)),
        value=value.ravel(),
        sigma=np.hypot(spreads, _FLOOR).ravel(),
        group=np.repeat(np.arange(n), 2),
    )
