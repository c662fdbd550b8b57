"""A town of boxes, gable roofs and a bridge: heights, shadows and hits are known without any triangle."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely

from photoplan.io.vector_layer import VectorLayer, write_geopackage
from photoplan.surfaces.objects import Faces
from photoplan.surfaces.polygon_faces import cannot_be_used, filled


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


def triangles_of(polygons, names, where: str):
    """Corners of triangles and their polygons, all of which can be used."""
    corners, polygon, faults = filled(polygons, names)
    if faults:
        raise cannot_be_used(where, faults)
    return corners, polygon


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


def write_town(project: Path, middle: tuple[float, float], ground: float, crs: str) -> Path:
    """A project beside another one, with a house of 40 m, a deck in the air and a mast that only hides."""
    at = np.array([*middle, ground])
    house = House(at[0] + 40, at[1] + 25, 0.3, 50.0, 36.0, ground - 10, ground + 40, ground + 40)
    deck = np.array([(-110.0, -60, 40), (-20, -60, 40), (-20, -40, 46), (-110, -40, 46)]) + at
    mast = np.array([(0.0, -30, -10), (4, -30, -10), (4, -30, 60), (0, -30, 60)]) + at
    polygons = [*(rings[0] for rings in house.polygons), deck, mast]
    names = [*("house",) * len(house.polygons), "deck", "mast"]
    roles = [*("",) * (len(names) - 1), "occluder"]
    columns = {"name": np.array(names, object), "role": np.array(roles, object)}
    layer = VectorLayer("town", "Polygon Z", [shapely.Polygon(p) for p in polygons], columns)
    write_geopackage(project.with_name("town.gpkg"), [layer], crs)
    path = project.with_name("town.toml")
    path.write_text(project.read_text() + '\n[[objects]]\nfile = "town.gpkg"\nheight_system = "same"\n')
    return path
