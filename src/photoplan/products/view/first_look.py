"""What a few rays tell of a view before it is made."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from photoplan.surfaces.seen import SeenSurface
from photoplan.targets.view import ViewTarget

#: Rays along the longer side of a picture that are looked at before it is made.
_FIRST_LOOK = 64


@dataclass(frozen=True)
class FirstLook:
    """What a few rays tell of a view."""

    ground: float
    """Share of pixels that show ground, 0 to 1."""
    nearest: float | None
    farthest: float | None
    """Distances of ground, metres; None: there is none."""
    lowest: float | None
    highest: float | None
    """Heights of ground, metres."""
    pixel: float | None
    """Median size of a pixel on the ground, across the line of sight, metres."""


def first_look(target: ViewTarget, surface: SeenSurface) -> FirstLook:
    """What some rays over the whole picture meet."""
    width, height = target.bundle.size
    step = max(1.0, max(width, height) / _FIRST_LOOK)
    u, v = (np.arange((side % step) / 2 if side > step else 0.0, side, step) for side in (width, height))
    uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    seen = surface.at(target, uv)
    there = seen.owner >= 0
    if not there.any():
        return FirstLook(ground=0.0, nearest=None, farthest=None, lowest=None, highest=None, pixel=None)
    away, Z = target.distance(seen.uvh[there]), seen.XYZ[there, 2]
    beside = target.bundle.directions(uv[there] + (1.0, 0.0)) - target.bundle.directions(uv[there])
    pixel = np.median(np.abs(seen.uvh[there, 2]) * np.linalg.norm(beside, axis=1))
    return FirstLook(
        ground=float(there.mean()),
        nearest=float(away.min()),
        farthest=float(away.max()),
        lowest=float(Z.min()),
        highest=float(Z.max()),
        pixel=float(pixel),
    )
