"""A mosaic of a rendered town: every pixel that an image sees shows the right surface, what none sees is empty."""

from __future__ import annotations

import json

import numpy as np
import pytest
import rasterio
import shapely
from tools.command import Here
from tools.pinhole import Pinhole
from tools.rendered import render
from tools.small_block import CRS, FOCAL, NAMES, SIZE, X0, Y0, Z0, Block, make_project, write_image, write_terrain
from tools.thinned import some
from tools.town import House, faces_of

from photoplan.geometry.pose import Pose
from photoplan.io.vector_layer import VectorLayer, write_geopackage
from photoplan.surfaces.base import LevelSurface
from photoplan.surfaces.objects import ObjectSurface

GROUND = 100.0
HOUSES = [
    House(X0 - 40, Y0 + 25, 0.3, 50.0, 36.0, GROUND - 2, GROUND + 45, GROUND + 45),
    House(X0 + 45, Y0 - 20, -0.2, 30.0, 44.0, GROUND - 2, GROUND + 60, GROUND + 60),
]
CENTRES = {"one": (X0 - 95, Y0 - 15, Z0), "two": (X0 + 5, Y0 + 45, Z0), "three": (X0 + 90, Y0 - 30, Z0)}
BOUNDS = (X0 - 110, Y0 - 80, X0 + 110, Y0 + 80)


def colour(XYZ: np.ndarray, on_face: np.ndarray) -> np.ndarray:
    """Slow waves of the ground along X + Y; what stands on it is bright, with waves across."""
    x, y = XYZ[:, 0] - X0, XYZ[:, 1] - Y0
    return np.where(on_face, 200 + 30 * np.sin((x - y) / 12), 90 + 40 * np.sin((x + y) / 14))


def scene() -> ObjectSurface:
    return ObjectSurface(LevelSurface(GROUND), faces_of([ring for house in HOUSES for ring in house.polygons]))


@pytest.fixture
def town(small: Block) -> Block:
    lines = ["name,x,y,z,omega,phi,kappa"]
    for name, path in zip(NAMES, small.images):
        camera = Pinhole(Pose.from_angles(CENTRES[name], (0, 0, 0)), FOCAL, SIZE)
        pixels = render(camera, scene(), colour, GROUND - 1)
        write_image(path, np.repeat(np.rint(pixels)[None], 3, axis=0).astype(np.uint8))
        lines.append(",".join([name, *(f"{v:.3f}" for v in CENTRES[name]), "0,0,0"]))
    small.orientation.write_text("\n".join(lines) + "\n")
    write_terrain(small.terrain, np.full((60, 64), GROUND))
    make_project(small)
    rings = [polygon for house in HOUSES for polygon in house.polygons]
    shapes = [shapely.Polygon(polygon[0], polygon[1:]) for polygon in rings]
    names = {"name": np.array([f"house {k}" for k in range(len(shapes))], object)}
    write_geopackage(small.folder / "objects.gpkg", [VectorLayer("objects", "Polygon Z", shapes, names)], CRS)
    small.project.write_text(
        small.project.read_text() + '\n[[objects]]\nfile = "objects.gpkg"\nheight_system = "same"\n'
    )
    return small


@pytest.mark.parametrize(("feather", "blend"), some([(0, "mean"), (30, "mean"), (30, "multiband")], 2))
def test_what_any_image_sees_is_there_once_and_where_it_stands(
    town: Block, capsys: pytest.CaptureFixture[str], feather: float, blend: str
) -> None:
    """Also if images pass into each other over 30 m: roofs lie 30 m away in an image that does not see beside them."""
    photoplan = Here(capsys)
    words = ["--bounds", *BOUNDS, "--resolution", 1, "--tile", 128, "--kernel", "bilinear", "--no-quicklook", "--json"]
    said = photoplan("mosaic", town.project, *words, "--sources", "--feather", feather, "--blend", blend)
    assert said.code == 0, said.err
    (told,) = json.loads(said.out)["products"]
    with rasterio.open(town.folder / "products" / "mosaic.tif") as file:
        pixels = file.read(1).astype(float)
        x, y = file.xy(*np.mgrid[: file.height, : file.width].reshape(2, -1))
    with rasterio.open(town.folder / "products" / "mosaic_sources.tif") as file:
        owner = file.read(1)
    points = shapely.points(np.stack([x, y], axis=-1)).reshape(pixels.shape)
    outlines = [shapely.Polygon(house.outline) for house in HOUSES]
    on = np.any([shapely.contains(outline, points) for outline in outlines], axis=0)
    border = np.min([shapely.distance(outline.boundary, points) for outline in outlines], axis=0)
    surface = scene()
    XYZ = np.stack([x, y, np.where(on.ravel(), surface.heights(np.stack([x, y], -1)), GROUND)], axis=-1)
    sees, inside = [], []
    for name in NAMES:
        centre = np.array(CENTRES[name])
        camera = Pinhole(Pose.from_angles(CENTRES[name], (0, 0, 0)), FOCAL, SIZE)
        ideal = camera.project_homogeneous(XYZ)
        xy = ideal[:, :2] / ideal[:, 2:]
        inside.append(((xy > 2.5) & (xy < np.array(SIZE) - 3.5)).all(axis=1).reshape(pixels.shape))
        way = XYZ - centre
        hits = surface.first_hit(np.stack([np.broadcast_to(centre, XYZ.shape), XYZ + 0.01 * way], axis=1))
        sees.append((np.linalg.norm(hits.XYZ - XYZ, axis=1) < 0.5).reshape(pixels.shape) & inside[-1])
    visible, clear = np.any(sees, axis=0), border > 1.5
    assert on.sum() > 2000 and (np.any(inside, axis=0) & ~visible).sum() > 100 and len(np.unique(owner)) == 4
    # 99.8 % of what an image sees is filled, and nothing is painted that its image does not see.
    filled = owner[visible & clear] > 0
    assert filled.mean() >= 0.998
    painted = (owner > 0) & clear
    order = [told["images"].index(name) for name in NAMES]
    mine = np.choose(np.maximum(owner, 1) - 1, [np.array(sees)[order.index(k)] for k in range(3)])
    assert mine[painted].mean() >= 0.998
    truth = colour(XYZ, on.ravel()).reshape(pixels.shape)
    error = np.abs(pixels - truth)[painted & mine & (border > 3)]
    assert np.sqrt(np.mean(error**2)) < 2.0 and np.mean(error > 25) <= 0.002
    hidden = np.any(inside, axis=0) & ~visible
    assert told["hidden_m2"] == pytest.approx(hidden.sum(), rel=0.1)
