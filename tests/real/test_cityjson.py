"""Models of real towns: every object is read, stands on its place, and hides what its triangles hide one by one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tools.pinhole import Pinhole
from tools.thinned import some

from photoplan.geometry.grid import MapGrid
from photoplan.geometry.pose import Pose
from photoplan.io.objects import read_objects
from photoplan.plan.ground import TileGround
from photoplan.plan.sources import hidden_pixels
from photoplan.surfaces.base import LevelSurface
from photoplan.surfaces.objects import Faces, ObjectSurface
from photoplan.targets.map import MapTarget


@pytest.mark.parametrize(
    ("name", "objects", "crs", "heights"),
    some(
        [
            ("zurich_subset_lod2.json", 161, "EPSG:2056", (395.0, 622.0)),
            ("delft.json", 163, "EPSG:28992", (-1.0, 60.0)),
            ("rotterdam_subset.json", 16, None, (-1.0, 19.0)),
            ("DH_01_subs.city.json", 9, None, (3.0, 30.0)),
        ],
        0,
        2,
        3,
    ),
)
def test_every_object_is_read(
    shared: Path, name: str, objects: int, crs: str | None, heights: tuple[float, float]
) -> None:
    found = read_objects(shared / "data" / "cityjson_lod2" / name)
    assert (len(found.names), found.crs) == (objects, crs) and not found.faults
    assert heights[0] < found.corners[..., 2].min() < found.corners[..., 2].max() < heights[1]
    assert set(found.owner) == set(range(objects))


def met(corners: np.ndarray, place: np.ndarray, center: np.ndarray) -> bool:
    """Whether a triangle is met on the way from a place to a centre, by linear equations; not at the place itself."""
    d = center - place
    edges = np.stack([np.broadcast_to(-d, (len(corners), 3)), corners[:, 1] - corners[:, 0]], axis=-1)
    edges = np.concatenate([edges, (corners[:, 2] - corners[:, 0])[..., None]], axis=-1)
    regular = np.abs(np.linalg.det(edges)) > 1e-9
    t, b, c = np.linalg.solve(edges[regular], (place - corners[regular, 0])[..., None])[..., 0].T
    inside = (b >= 0) & (c >= 0) & (b + c <= 1) & (t <= 1)
    return bool((inside & (t * np.linalg.norm(d) > 0.1)).any())


@pytest.mark.parametrize("name", some(["delft.json", "zurich_subset_lod2.json"], 1))
def test_a_real_town_hides_what_its_triangles_hide(shared: Path, name: str) -> None:
    """A window of 120 m at 0.5 m below an aerial camera, some hundred places of it."""
    own = read_objects(shared / "data" / "cityjson_lod2" / name)
    # Around the object that has most faces.
    middle = own.corners[own.owner == np.bincount(own.owner).argmax()].mean(axis=(0, 1))[:2]
    near = (np.abs(own.corners[..., :2] - middle) < 300).all(axis=(1, 2))
    corners = own.corners[near]
    ground = float(corners[..., 2].min())
    faces = Faces(corners, np.ones(len(corners), bool), own.owner[near], own.names)
    surface = ObjectSurface(LevelSurface(ground), faces)
    (x, y), side = middle, 60
    target = MapTarget(MapGrid.covering((x - side, y - side, x + side, y + side), 0.5, own.crs or ""))
    tile = TileGround.of(target, target.window, surface.relief(target, target.window))
    center = np.array((x - 250, y + 100, ground + 250))
    hidden = hidden_pixels(Pinhole(Pose.from_angles(center, (0, 0, 0)), 3000, (9000, 9000)), tile, surface)
    rng = np.random.default_rng(0)
    row, col = rng.integers(0, target.window.height, (2, 500))
    XY = target.grid.to_map(np.stack([col, row], axis=-1).astype(float))
    truth = np.array([met(corners, p, center) for p in np.c_[XY, tile.relief[row, col]]])
    assert truth.sum() > 10
    assert (hidden[row, col] != truth).sum() <= 1
