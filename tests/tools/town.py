"""A town of boxes, gable roofs and a bridge: heights, shadows and hits are known without any triangle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from photoplan.surfaces.faces import Faces
from photoplan.surfaces.polygon_faces import triangles_of


@dataclass(frozen=True)
class House:
    """A box, turned on the map, with a gable along its length; a ridge as high as the eaves is a flat roof."""

    x: float
    y: float
    angle: float
    length: float
    width: float
    foot: float
    eaves: float
    ridge: float

    def _corners(self, parts):
        c, s = np.cos(self.angle), np.sin(self.angle)
        p = np.array(parts, float) * (self.length / 2, self.width / 2)
        return p @ np.array([[c, s], [-s, c]]) + (self.x, self.y)

    @property
    def outline(self):
        """Corners on the map (4, 2), anticlockwise."""
        return self._corners([(-1, -1), (1, -1), (1, 1), (-1, 1)])

    @property
    def polygons(self):
        """Two roof planes, two gables of five corners, two walls: each one ring."""
        a, b, c, d = self.outline
        e, f = self._corners([(-1, 0), (1, 0)])

        def ring(*points):
            return [np.array([(*xy, z) for xy, z in points])]

        lo, up, top = self.foot, self.eaves, self.ridge
        return [
            ring((a, up), (b, up), (f, top), (e, top)),
            ring((c, up), (d, up), (e, top), (f, top)),
            ring((b, lo), (c, lo), (c, up), (f, top), (b, up)),
            ring((d, lo), (a, lo), (a, up), (e, top), (d, up)),
            ring((a, lo), (b, lo), (b, up), (a, up)),
            ring((c, lo), (d, lo), (d, up), (c, up)),
        ]

    def roof(self, XY):
        """Height of the roof above map points; −inf beside the house."""
        c, s = np.cos(self.angle), np.sin(self.angle)
        along, across = np.moveaxis((np.asarray(XY) - (self.x, self.y)) @ np.array([[c, -s], [s, c]]), -1, 0)
        inside = (np.abs(along) <= self.length / 2) & (np.abs(across) <= self.width / 2)
        height = self.ridge + (self.eaves - self.ridge) * np.abs(across) / (self.width / 2)
        return np.where(inside, height, -np.inf)


def houses(count: int, seed: int, side: float = 140.0, ground=None) -> list[House]:
    """Houses over a square of a map, some on top of each other; on a ground, where one is given."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        x, y = rng.uniform(0.1 * side, 0.9 * side, 2)
        foot = -1.0 if ground is None else float(ground((x, y))) - 1.0
        eaves = foot + rng.uniform(4, 20)
        ridge = eaves + rng.choice([0.0, 4.0])
        found.append(House(x, y, rng.uniform(0, np.pi), *rng.uniform(5, 25, 2), foot, eaves, ridge))
    return found


def faces_of(polygons, paints=True, names=None) -> Faces:
    """Polygons as faces of one object each."""
    names = tuple(names or (f"polygon {k}" for k in range(len(polygons))))
    corners, owner = triangles_of(polygons, names, "town")
    return Faces(corners, np.broadcast_to(paints, len(polygons))[owner].copy(), owner.astype(np.int32), names)


def town_faces(town: list[House], paints: bool = True) -> Faces:
    """All houses as faces."""
    return faces_of([polygon for house in town for polygon in house.polygons], paints)


DECK = [np.array([(20.0, 62.3, 9.0), (120.0, 72.7, 12.0), (120.0, 82.7, 12.0), (20.0, 72.3, 9.0)])]
"""A bridge deck, a plane that rises from west to east."""
