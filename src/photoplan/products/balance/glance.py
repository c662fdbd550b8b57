"""Whether the images of a project differ in colour: a few windows of a few neighbours, in a moment."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.robust import spread
from photoplan.cameras.base import project as into_image
from photoplan.errors import PhotoplanError
from photoplan.geometry.grid import Window
from photoplan.io.project.model import Project
from photoplan.project.cameras import is_there
from photoplan.project.scene import Scene, map_order, open_scene

#: Pairs of neighbours that are looked at, places along both axes of what a pair may have in common, pixels of a window.
_PAIRS, _PLACES, _SIDE = 6, 5, 16
#: Places that a pair must have; the difference that is told, part of the range of grey values.
_LEAST, _TOLD = 5, 0.03
#: A median counts if it is larger than so many times what it may be by chance: its spread over the root of the places.
_SURE = 6.0


def colour_advice(project: Project, names: Sequence[str]) -> str | None:
    """A sentence if neighbouring images differ in colour and have no balance files; None if not, or if that cannot be
    seen from a few windows."""
    plain = [n for n in names if project.any_image(n).balance is None and is_there(_file(project, n))]
    if len(plain) < 2 or len(plain) < len(names):
        return None
    order = [plain[k] for k in map_order(project, plain)]
    at = np.unique(np.linspace(0, len(order) - 2, _PAIRS).astype(int))
    try:
        found = [_difference(open_scene(project, order[k]), open_scene(project, order[k + 1])) for k in at.tolist()]
    except PhotoplanError:
        return None  # What is wrong with a file is said elsewhere.
    known = [each for each in found if each is not None]
    if not known:
        return None
    worst, span = max(known, key=lambda each: each[0] / each[1])
    if worst <= _TOLD * span:
        return None
    return (
        f"colours differ by up to {worst:.0f} of {span:.0f} grey values between neighbours: "
        "`photoplan balance` evens them out before a mosaic"
    )


def _file(project: Project, name: str) -> Path:
    return project.resolve(project.any_image(name).file)


def _difference(one: Scene, other: Scene) -> tuple[float, float] | None:
    """Median difference of two images where they overlap, and the range of grey values; None: not known."""
    a, b = one.footprint.bounds, other.footprint.bounds
    if a is None or b is None or (one.reader.bands, one.reader.dtype) != (other.reader.bands, other.reader.dtype):
        return None
    low, high = np.maximum(a[:2], b[:2]), np.minimum(a[2:], b[2:])
    if not (low < high).all():
        return None
    X, Y = (low[k] + (high[k] - low[k]) * (np.arange(_PLACES) + 0.5) / _PLACES for k in (0, 1))
    XY = np.stack(np.meshgrid(X, Y), axis=-1).reshape(-1, 2)
    XYZ = np.concatenate([XY, one.surface.heights(XY)[:, None]], axis=1)
    first, second = _means(one, XYZ), _means(other, XYZ)
    both = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
    if both.sum() < _LEAST:
        return None
    every = np.concatenate([first[both], second[both]])
    span = 255.0 if one.reader.dtype == np.uint8 else float(np.ptp(every))
    # Of single places a difference may be a shadow or a car; what all of them have is exposure and haze.
    apart = first[both] - second[both]
    middle, chance = np.median(apart, axis=0), spread(apart, None)
    if chance > max(spread(first[both], None), _TOLD * span):
        return None  # The images do not show the same.
    sure = np.abs(middle) > _SURE * np.median(np.abs(apart - middle), axis=0) / np.sqrt(len(apart))
    return float(np.abs(middle * sure).max()), max(span, 1e-9)


def _means(scene: Scene, XYZ: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of each band around ground points (n, 3); NaN where the image does not show them."""
    size = np.array(scene.reader.size)
    out = np.full((len(XYZ), scene.reader.bands), np.nan)
    corners = np.rint(into_image(scene.camera, XYZ)) - _SIDE // 2
    for k in np.flatnonzero(((corners >= 0) & (corners + _SIDE <= size)).all(axis=1)):
        col, row = corners[k].astype(int).tolist()
        pixels, valid = scene.reader.read(Window(col, row, _SIDE, _SIDE))
        if valid is None or valid.all():
            out[k] = pixels.reshape(len(pixels), -1).mean(axis=1)
    return out
