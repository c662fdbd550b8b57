"""Stereo pairs: two cameras side by side, and how their pictures become one."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import UsageError
from photoplan.geometry.rotation import dot
from photoplan.products.view.camera import CameraRequest, ViewCamera, map_axes
from photoplan.targets.view import FrameBundle

HOWS = ("side-by-side", "anaglyph")
#: Base by the distance of the nearest ground, where none is stated.
_USUAL = 1 / 30
_LUMINANCE = (0.299, 0.587, 0.114)


@dataclass(frozen=True)
class Stereo:
    """How a pair is made."""

    how: str
    """One of `HOWS`: left and right beside each other, or for red and cyan glasses."""
    base: float | None = None
    """Distance of both cameras, metres; None: a thirtieth of the distance of the nearest ground."""

    def __post_init__(self) -> None:
        if self.how not in HOWS:
            raise UsageError(f"`stereo` {self.how!r}; allowed are {', '.join(HOWS)}")
        if self.base is not None and not (math.isfinite(self.base) and self.base > 0):
            raise UsageError(f"`base` {self.base} m; a positive number is needed")

    @property
    def beside(self) -> bool:
        """Whether both pictures lie beside each other."""
        return self.how == "side-by-side"

    @property
    def metres(self) -> float:
        """The base, which must be stated."""
        assert self.base is not None
        return self.base

    def stated(self, nearest: float | None) -> Stereo:
        """With a number as base, rounded to two digits; `nearest`: distance of the nearest ground, metres."""
        if self.base is not None:
            return self
        if nearest is None:
            raise UsageError("no ground is seen from which a `base` would follow; state it")
        return replace(self, base=float(f"{nearest * _USUAL:.2g}"))


def eyes(camera: ViewCamera, base: float) -> tuple[CameraRequest, CameraRequest]:
    """The left and the right camera: moved by half the base along the rows of the picture, axes parallel."""
    request, target = camera.request, camera.target
    if not isinstance(target.bundle, FrameBundle):
        raise UsageError("a stereo pair needs a plane picture; panoramas have one place only")
    if request.image is not None:
        return replace(request, aside=-base / 2), replace(request, aside=base / 2)
    assert request.position is not None and request.altitude is not None
    right = map_axes(target.warps, target.center).T @ target.bundle.camera.pose.R_ground_camera[:, 0]
    at = np.array([*request.position, request.altitude])
    left, other = (at + side * base / 2 * right for side in (-1.0, 1.0))
    return _moved(request, left), _moved(request, other)


def _moved(request: CameraRequest, at: NDArray[np.float64]) -> CameraRequest:
    x, y, z = at.tolist()
    return replace(request, position=(x, y), altitude=z)


def anaglyph(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Two pictures (3, height, width) for red and cyan glasses: the brightness of the left one, green and blue of the
    right one."""
    out = right.copy()
    out[0] = np.rint(
        dot(np.moveaxis(left, 0, -1).astype(np.float64), np.broadcast_to(_LUMINANCE, (*left.shape[1:], 3)))
    )
    return out
