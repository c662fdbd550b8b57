"""The same image as an ordinary and as a true orthophoto: houses and a bridge over a road, seen from the side."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from photoplan.cameras.fiducials import Affine2D
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.lenses import Interior, NoLens
from photoplan.geometry.grid import MapGrid
from photoplan.geometry.pose import Pose
from photoplan.plan.ground import TileGround
from photoplan.plan.sources import hidden_pixels
from photoplan.products.rectify import rectify
from photoplan.surfaces.base import LevelSurface, Terrain
from photoplan.surfaces.objects import Faces, ObjectSurface
from photoplan.surfaces.polygon_faces import filled
from photoplan.targets.map import MapTarget

#: Middle, length, width, eaves and ridge of houses, metres.
HOUSES = ((30, 88, 34, 16, 17, 23), (92, 92, 26, 20, 30, 30), (34, 22, 24, 15, 12, 18), (100, 26, 30, 14, 15, 21))
DECK = np.array([(6.0, 50, 11), (134, 60, 13), (134, 70, 13), (6, 60, 11)])
SIZE = (620, 560)


def polygons() -> list[list[NDArray[np.float64]]]:
    """Roofs, gables and walls of the houses, and the deck of the bridge."""
    found = [[DECK]]
    for x, y, length, width, eaves, ridge in HOUSES:
        w, e, s, n = x - length / 2, x + length / 2, y - width / 2, y + width / 2
        faces = [
            [(w, s, eaves), (e, s, eaves), (e, y, ridge), (w, y, ridge)],
            [(w, n, eaves), (e, n, eaves), (e, y, ridge), (w, y, ridge)],
            [(w, s, 0), (w, n, 0), (w, n, eaves), (w, y, ridge), (w, s, eaves)],
            [(e, s, 0), (e, n, 0), (e, n, eaves), (e, y, ridge), (e, s, eaves)],
            [(w, s, 0), (e, s, 0), (e, s, eaves), (w, s, eaves)],
            [(w, n, 0), (e, n, 0), (e, n, eaves), (w, n, eaves)],
        ]
        found += [[np.array(face, float)] for face in faces]
    return found


def colours(XYZ: NDArray[np.float64], kind: NDArray[np.int64]) -> NDArray[np.float64]:
    """Colours (n, 3) of what is met: ground with a road from south to north, deck, roofs, walls."""
    x, y = XYZ[:, 0], XYZ[:, 1]
    grain = 10 * np.sin(x * 1.1) * np.sin(y * 1.3)
    out = np.stack([95 + grain, 135 + grain, 80 + grain], axis=-1)
    paving = ((x // 4 + y // 4) % 2) * 14
    out[(x % 70 > 14) & (x % 70 < 56)] = np.stack([150 + paving] * 3, axis=-1)[(x % 70 > 14) & (x % 70 < 56)]
    road = np.abs(x - 66) < 6
    out[road] = 85
    out[road & (np.abs(x - 66) < 0.4) & (y % 6 < 3)] = 240
    deck = kind == 0
    out[deck] = 170
    across = y - (50 + 10 * (x - 6) / 128)
    out[deck & (np.abs(across - 5) < 0.4) & (x % 6 < 3)] = 250
    out[deck & ((across < 1) | (across > 9))] = 120
    roof, wall = np.isin((kind - 1) % 6, (0, 1)) & (kind > 0), np.isin((kind - 1) % 6, (2, 3, 4, 5)) & (kind > 0)
    out[roof] = np.stack([175 + 12 * np.sin(6 * y), 85 + 8 * np.sin(6 * y), 65 + 0 * y], axis=-1)[roof]
    out[wall] = np.stack([215 + 0 * x, 205 + 0 * x, 175 + 20 * np.sin(2 * XYZ[:, 2])], axis=-1)[wall]
    return np.clip(out, 1, 255)


def photo(camera: FrameCamera, scene: ObjectSurface, polygon: NDArray[np.int64]) -> NDArray[np.uint8]:
    """The scene as the camera sees it, two by two rays a pixel; shape (3, height, width)."""
    total = np.zeros((3, SIZE[1], SIZE[0]))
    for shift in ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)):
        col, row = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
        origin, way = camera.rays(np.stack([col, row], axis=-1).reshape(-1, 2) + shift, 0.0)
        paths = np.stack([origin, origin + way * ((-1 - origin[:, 2:]) / way[:, 2:])], axis=1)
        hits = scene.first_hit(paths)
        along, _, face = scene.faces.first_hit(paths)
        kind = np.where(along == hits.along, polygon[face], -1)
        total += colours(hits.XYZ, kind).T.reshape(total.shape)
    return np.rint(total / 4).astype(np.uint8)


def draw_true(resolution: float = 0.25) -> Figure:
    """Ordinary and true orthophoto side by side, outlines of roofs and deck in red."""
    corners, polygon, _ = filled(polygons(), [str(k) for k in range(len(polygons()))])
    faces = Faces(corners, np.ones(len(corners), bool), polygon.astype(np.int32), ("",) * len(polygons()))
    scene = ObjectSurface(LevelSurface(0.0), faces)
    middle = Affine2D(1.0, 0.0, (SIZE[0] - 1) / 2, 0.0, -1.0, (SIZE[1] - 1) / 2)
    pose = Pose.from_angles((95.0, 20.0, 190.0), np.radians((11.0, 8.0, 4.0)))
    camera = FrameCamera(Interior(700.0, (0.0, 0.0), middle, SIZE), NoLens(), pose)
    image = photo(camera, scene, polygon)
    grid = MapGrid.covering((0, 0, 140, 116), resolution, "EPSG:32632")
    fig = Figure(figsize=(10, 4.3), dpi=130, layout="constrained")
    surfaces: tuple[tuple[str, Terrain], ...] = (("ordinary orthophoto", scene.ground), ("true orthophoto", scene))
    for axes, (title, surface) in zip(fig.subplots(1, 2), surfaces):
        made = rectify(image, camera, grid, surface)
        shown = np.moveaxis(made.values, 0, -1).copy()
        if surface is scene:
            target = MapTarget(grid)
            tile = TileGround.of(target, grid.window, scene.relief(target, grid.window))
            shown[hidden_pixels(camera, tile, scene)] = 0
        axes.imshow(shown, extent=(0, 140, 0, 116), interpolation="nearest")
        axes.set(title=title, xticks=(), yticks=())
        for x, y, length, width, *_ in HOUSES:
            box = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (length / 2, width / 2) + (x, y)
            axes.add_patch(Polygon(box, fill=False, color="#ee2222", lw=1))
        axes.add_patch(Polygon(DECK[:, :2], fill=False, color="#ee2222", lw=1))
    return fig
