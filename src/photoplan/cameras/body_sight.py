"""Where rays in the axes of a body meet its ground, for all cameras that are oriented there."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import Vantage
from photoplan.cameras.line_sight import to_sphere
from photoplan.errors import InputError
from photoplan.geometry.body import BodyGround

_Floats = NDArray[np.float64]
#: Heights of any ground, metres: of the earth, and of other bodies, where they are at most this part of the radius.
_EARTH, _ELSEWHERE, _PART = (-500.0, 9_000.0), (-10_000.0, 25_000.0), 0.1
#: Heights above the ellipsoid are at most this much more than those above a geoid, metres.
_HIGHEST_GEOID = 110.0
#: Heights are met when they were missed by less than this before the last step, metres.
_CLOSE = 1e-8


def heights_of(ground: BodyGround) -> tuple[float, float]:
    """Between which heights all ground of the body lies, metres."""
    low, high = _EARTH if ground.on_earth else _ELSEWHERE
    room = _PART * ground.radii[1]
    return max(low, -room), min(high, room)


def radius_below(ground: BodyGround, S: _Floats) -> _Floats:
    """Radius of the body below points (n, 3), metres."""
    return np.asarray(np.linalg.norm(S, axis=1) - ground.height(S))


def meet(ground: BodyGround, S: _Floats, d: _Floats, heights: _Floats) -> tuple[_Floats, _Floats]:
    """Rays from points (n, 3) with unit directions (n, 3), in the axes of the body, at heights (n,)."""
    with np.errstate(all="ignore"):
        # The ellipsoid at these heights, nearly, is the unit sphere in units of its semi-axes.
        axes = np.stack([ground.ellipsoid.a + heights] * 2 + [ground.ellipsoid.b + heights], axis=1)
        way = np.linalg.norm(d / axes, axis=1)
        r = to_sphere(S / axes, d / axes / way[:, None], 1.0) / way
        for _ in range(12):
            at = S + r[:, None] * d
            point = ground.to_map(at)
            miss = point[:, 2] - heights
            r = r - miss / np.einsum("ni,ni->n", ground.ellipsoid.up(at), d)
            # The step that was taken gains three digits and more.
            if not (np.abs(miss) > _CLOSE).any():
                break
        at = S + r[:, None] * d
        point = ground.to_map(at)
        # Places far away from the body are rounded.
        point[~((np.abs(point[:, 2] - heights) < 1e-6 + 1e-14 * r) & (r > 0))] = np.nan
        point[:, 2] = np.where(np.isnan(point[:, 0]), np.nan, heights)
        half = ground.reach / 2 * d
        tangent = ground.to_map(at + half) - ground.to_map(at - half)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return point, tangent


def vantage_over(ground: BodyGround, centers: _Floats, seen: Callable[[float], _Floats]) -> Vantage:
    """Above the middle of what a camera sees: the highest ground there is, but not above the camera."""
    low, high = heights_of(ground)
    flying = ground.to_map(centers)[:, 2]
    if np.isnan(flying).all():
        # A satellite may stand beside the grid of the heights of what it shows.
        flying = ground.height(centers) - _HIGHEST_GEOID
    high = min(high, float(np.nanmin(flying)) - 1.0)
    feet = np.concatenate([seen(level)[:, :2] for level in (min(low, high - 1.0), high)])
    if np.isnan(feet).all():
        raise InputError(
            "the image does not show the ground of the project where its heights are known; is its CRS that of the "
            "right body, and does the grid of its height system reach as far?"
        )
    middle = (np.nanmin(feet, axis=0) + np.nanmax(feet, axis=0)) / 2
    reach = 1.1 * float(np.nanmax(np.linalg.norm(feet - middle, axis=1)))
    return Vantage(np.array([*middle, high]), low, reach)
