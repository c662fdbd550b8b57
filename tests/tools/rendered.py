"""Images of a scene whose surface and colours are known: one ray for each part of a pixel."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from photoplan.surfaces.objects import ObjectSurface


def render(camera, surface: ObjectSurface, colour: Callable, low: float, finer: int = 2) -> np.ndarray:
    """An image (height, width): the mean over finer × finer rays of what they meet first.

    Parameters
    ----------
    camera : Pinhole
    surface : ObjectSurface
    colour : callable
        Takes X, Y, Z of what is met (n, 3), and whether it is a face, to grey values (n,).
    low : float
        Height that no ground is lower than.
    """
    width, height = camera.size
    total = np.zeros((height, width))
    col, row = np.meshgrid(np.arange(width), np.arange(height))
    for j in range(finer):
        for i in range(finer):
            shift = (np.array([i, j]) + 0.5) / finer - 0.5
            xy = np.stack([col, row], axis=-1).reshape(-1, 2) + shift
            origin, way = camera.rays(xy)
            end = origin + way * ((low - origin[:, 2:]) / way[:, 2:])
            paths = np.stack([origin, end], axis=1)
            hits = surface.first_hit(paths)
            on_face = surface.faces.first_hit(paths)[0] == hits.along
            total += colour(hits.XYZ, on_face).reshape(height, width)
    return total / finer**2
