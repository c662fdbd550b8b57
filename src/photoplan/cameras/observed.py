"""Measurements that orient images: points in images, points on the ground, positions and attitudes of cameras."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import InputError


@dataclass(frozen=True, eq=False)
class ImagePoints:
    """Measured positions of points in images; one point may be measured in an image once."""

    images: tuple[str, ...]
    """Names of the images, each once."""
    points: tuple[str, ...]
    """Names of the points, each once."""
    image: NDArray[np.int64]
    """Image of each measurement, an index into `images`, shape (n,)."""
    point: NDArray[np.int64]
    """Point of each measurement, an index into `points`, shape (n,)."""
    xy: NDArray[np.float64]
    """Column and row, shape (n, 2), pixels; (0, 0) is the centre of the upper-left pixel."""
    sigma: NDArray[np.float64]
    """Standard deviation of column and row, shape (n, 2), pixels; NaN: not stated."""

    def __post_init__(self) -> None:
        _frozen(self, "image", self.image, (-1,), np.int64)
        n = len(self.image)
        _frozen(self, "point", self.point, (n,), np.int64)
        _frozen(self, "xy", self.xy, (n, 2))
        _frozen(self, "sigma", np.broadcast_to(self.sigma, (n, 2)), (n, 2))
        for what, names, index in (("image", self.images, self.image), ("point", self.points, self.point)):
            _unique(what, names)
            if n and not (index.min() >= 0 and index.max() < len(names)):
                raise InputError(f"image points refer to {what} number {index.max()}; there are {len(names)}")
        bad = ~np.isfinite(self.xy).all(axis=1) | (self.sigma <= 0).any(axis=1) | np.isinf(self.sigma).any(axis=1)
        if bad.any():
            k = int(np.flatnonzero(bad)[0])
            raise InputError(
                f"{self.label(k)}: position {self.xy[k].tolist()}, standard deviation {self.sigma[k].tolist()} px; "
                "finite positions and positive standard deviations are needed"
            )
        key = self.image * max(1, len(self.points)) + self.point
        _, first, count = np.unique(key, return_index=True, return_counts=True)
        if (count > 1).any():
            k = int(first[np.flatnonzero(count > 1)[0]])
            raise InputError(f"{self.label(k)} is measured twice; keep one of the measurements")

    @classmethod
    def from_rows(cls, rows: Iterable[tuple[str, str, float, float]], sigma: float = np.nan) -> ImagePoints:
        """Rows (point, image, column, row), in any order; images and points in the order of their first row."""
        table = list(rows)
        points = {name: k for k, name in enumerate(dict.fromkeys(r[0] for r in table))}
        images = {name: k for k, name in enumerate(dict.fromkeys(r[1] for r in table))}
        return cls(
            images=tuple(images),
            points=tuple(points),
            image=np.array([images[r[1]] for r in table], np.int64),
            point=np.array([points[r[0]] for r in table], np.int64),
            xy=np.array([r[2:4] for r in table], float).reshape(-1, 2),
            sigma=np.full((len(table), 2), sigma),
        )

    def __len__(self) -> int:
        return len(self.image)

    def label(self, k: int) -> str:
        """Return how a measurement is named in messages."""
        return f"point {self.points[self.point[k]]!r} in image {self.images[self.image[k]]!r}"

    def where(self, keep: ArrayLike) -> ImagePoints:
        """The measurements at `keep` (mask or indices); images and points that have none left are dropped."""
        keep = np.asarray(keep)
        image, point = self.image[keep], self.point[keep]
        used_images, image = np.unique(image, return_inverse=True)
        used_points, point = np.unique(point, return_inverse=True)
        return ImagePoints(
            images=tuple(self.images[k] for k in used_images),
            points=tuple(self.points[k] for k in used_points),
            image=image.reshape(-1),
            point=point.reshape(-1),
            xy=self.xy[keep],
            sigma=self.sigma[keep],
        )

    def of_images(self, names: Sequence[str]) -> ImagePoints:
        """The measurements in these images."""
        wanted = set(names)
        return self.where(np.array([n in wanted for n in self.images], bool)[self.image])

    @staticmethod
    def merged(parts: Sequence[ImagePoints]) -> ImagePoints:
        """All measurements of several sets; points and images of one name are the same."""
        images = {n: k for k, n in enumerate(dict.fromkeys(n for p in parts for n in p.images))}
        points = {n: k for k, n in enumerate(dict.fromkeys(n for p in parts for n in p.points))}
        none = np.empty(0, np.int64)
        return ImagePoints(
            images=tuple(images),
            points=tuple(points),
            image=np.concatenate([none, *(np.array([images[n] for n in p.images], np.int64)[p.image] for p in parts)]),
            point=np.concatenate([none, *(np.array([points[n] for n in p.points], np.int64)[p.point] for p in parts)]),
            xy=np.concatenate([np.empty((0, 2)), *(p.xy for p in parts)]),
            sigma=np.concatenate([np.empty((0, 2)), *(p.sigma for p in parts)]),
        )


@dataclass(frozen=True, eq=False)
class GroundPoints:
    """Points with known ground coordinates: control, which takes part in an adjustment, and check points."""

    names: tuple[str, ...]
    """Each once."""
    XYZ: NDArray[np.float64]
    """Shape (n, 3), metres; NaN where a coordinate is not known (height control, horizontal control)."""
    sigma: NDArray[np.float64]
    """Standard deviations, shape (n, 3), metres; NaN: not stated. 0: the coordinate is held fixed."""
    check: NDArray[np.bool_]
    """True: the point is only compared with the result, shape (n,)."""
    covariance: NDArray[np.float64] | None = None
    """Covariance of X, Y, Z of each point, (n, 3, 3), m², if it is known in full; `sigma` is then the root of its
    diagonal."""

    def __post_init__(self) -> None:
        n = len(self.names)
        _unique("ground point", self.names)
        _frozen(self, "XYZ", self.XYZ, (n, 3))
        _frozen(self, "sigma", np.broadcast_to(self.sigma, (n, 3)), (n, 3))
        _frozen(self, "check", np.broadcast_to(self.check, (n,)), (n,), np.bool_)
        if self.covariance is not None:
            _frozen(self, "covariance", self.covariance, (n, 3, 3))
        bad = np.isinf(self.XYZ).any(axis=1) | np.isinf(self.sigma).any(axis=1) | (self.sigma < 0).any(axis=1)
        if bad.any():
            k = int(np.flatnonzero(bad)[0])
            raise InputError(
                f"ground point {self.names[k]!r}: {self.XYZ[k].tolist()} m, standard deviations "
                f"{self.sigma[k].tolist()} m; finite coordinates and standard deviations of 0 or more are needed"
            )

    def __len__(self) -> int:
        return len(self.names)

    def where(self, keep: ArrayLike) -> GroundPoints:
        """The points at `keep` (mask or indices)."""
        index = np.arange(len(self))[np.asarray(keep)]
        covariance = None if self.covariance is None else self.covariance[index]
        names = tuple(self.names[k] for k in index)
        return GroundPoints(
            names=names, XYZ=self.XYZ[index], sigma=self.sigma[index], check=self.check[index], covariance=covariance
        )


@dataclass(frozen=True, eq=False)
class ObservedPositions:
    """Positions of the antenna (GNSS) at the exposures."""

    images: tuple[str, ...]
    """Names of the images, each once."""
    XYZ: NDArray[np.float64]
    """Shape (n, 3), metres, in the project's CRS and the orientation's height system."""
    sigma: NDArray[np.float64]
    """Standard deviations, shape (n, 3), metres."""
    strip: tuple[str, ...]
    """Name of each image's strip: images of one strip share their drift."""
    time: NDArray[np.float64]
    """Time of each exposure, shape (n,), seconds from any origin; drift is linear in it."""

    def __post_init__(self) -> None:
        n = len(self.images)
        _unique("observed position of image", self.images)
        _frozen(self, "XYZ", self.XYZ, (n, 3))
        _frozen(self, "sigma", np.broadcast_to(self.sigma, (n, 3)), (n, 3))
        _frozen(self, "time", self.time, (n,))
        _observed("position", self.images, self.XYZ, self.sigma, "m")


@dataclass(frozen=True, eq=False)
class ObservedAttitudes:
    """Attitudes of the camera (IMU, boresight angles applied or to be estimated) at the exposures."""

    images: tuple[str, ...]
    """Names of the images, each once."""
    R_ground_camera: NDArray[np.float64]
    """Rotation from camera axes to ground axes, shape (n, 3, 3)."""
    sigma: NDArray[np.float64]
    """Standard deviations of small rotations about the camera's x, y, z, shape (n, 3), radians."""

    def __post_init__(self) -> None:
        n = len(self.images)
        _unique("observed attitude of image", self.images)
        _frozen(self, "R_ground_camera", self.R_ground_camera, (n, 3, 3))
        _frozen(self, "sigma", np.broadcast_to(self.sigma, (n, 3)), (n, 3))
        _observed("attitude", self.images, self.R_ground_camera.reshape(n, 9), self.sigma, "rad")


def _observed(what: str, images: Sequence[str], values: NDArray[Any], sigma: NDArray[Any], unit: str) -> None:
    good = np.isfinite(values).all(axis=1) & np.isfinite(sigma).all(axis=1) & (sigma > 0).all(axis=1)
    if not good.all():
        k = int(np.flatnonzero(~good)[0])
        raise InputError(
            f"observed {what} of image {images[k]!r}: {values[k].tolist()}, standard deviations {sigma[k].tolist()} "
            f"{unit}; finite values and positive standard deviations are needed"
        )


def _unique(what: str, names: Sequence[str]) -> None:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise InputError(f"{what} {name!r} is given twice; keep one of them")
        seen.add(name)


def _frozen(value: Any, field: str, array: Any, shape: tuple[int, ...], dtype: Any = np.float64) -> None:
    out = np.array(array, dtype)
    expected = tuple(len(out) if s < 0 and out.ndim else s for s in shape)
    if out.shape != expected:
        kind = type(value).__name__
        raise InputError(f"{kind}.{field} has the shape {out.shape}; {expected} is needed")
    out.setflags(write=False)
    assert field in {f.name for f in dataclasses.fields(value)}
    object.__setattr__(value, field, out)
