"""Products of single objects: what is inside an outline, from the images that see it, and nothing else."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyogrio.raw
import pytest
import rasterio
import shapely
from products.test_true_ortho import GROUND, HOUSE, colour, shadow_on_ground
from tools.command import Here
from tools.pinhole import Pinhole
from tools.rendered import render
from tools.small_block import CRS, FOCAL, NAMES, SIZE, X0, Y0, Z0, Block, make_project, write_image, write_terrain
from tools.town import faces_of

from photoplan.geometry.pose import Pose
from photoplan.surfaces.base import LevelSurface
from photoplan.surfaces.objects import ObjectSurface

AWAY = (-60.0, 0.0, 60.0)
"""Of the projection centres, metres east."""
PLACE = np.array([X0, Y0, GROUND])
OUTER = np.array([(-90.0, -60, 40), (30, -60, 46), (30, -30, 46), (-90, -30, 40)]) + PLACE
HOLE = np.array([(-60.0, -52, 41.5), (-30, -52, 43), (-30, -38, 43), (-60, -38, 41.5)]) + PLACE
BRIDGE = shapely.Polygon(OUTER, [HOLE])
OPTIONS = ("--resolution", 1, "--tile", 128, "--kernel", "bilinear", "--no-quicklook")


@pytest.fixture(scope="module")
def rendered() -> list[np.ndarray]:
    scene = ObjectSurface(LevelSurface(GROUND), faces_of([*HOUSE.polygons, [OUTER, HOLE]]))
    cameras = (Pinhole(Pose.from_angles((X0 + dx, Y0, Z0), (0, 0, 0)), FOCAL, SIZE) for dx in AWAY)
    return [np.rint(render(camera, scene, colour, GROUND - 1)).astype(np.uint8) for camera in cameras]


@pytest.fixture
def town(small: Block, rendered: list[np.ndarray]) -> Block:
    for path, pixels in zip(small.images, rendered):
        write_image(path, pixels[None])
    lines = [f"{name},{X0 + dx},{Y0},{Z0},0,0,0" for name, dx in zip(NAMES, AWAY)]
    small.orientation.write_text("\n".join(["name,x,y,z,omega,phi,kappa", *lines, ""]))
    write_terrain(small.terrain, np.full((60, 64), GROUND))
    make_project(small)
    house = [shapely.Polygon(rings[0]) for rings in HOUSE.polygons]
    write(small.folder / "town.gpkg", [*house, BRIDGE], [*("house",) * 6, "bridge"])
    return small


def write(path: Path, shapes: list[object], names: list[str], **how: object) -> Path:
    columns, driver = [np.array(names, object)], str(how.get("driver", "GPKG"))
    layer = "objects" if driver == "GPKG" else path.stem
    pyogrio.raw.write(path, shapely.to_wkb(np.array(shapes), flavor="iso"), columns, ["name"], layer=layer,
                      driver=driver, geometry_type="Polygon Z", crs=CRS)  # fmt: skip
    return path


def product(block: Block, photoplan: Here, *options: object, file: str = "town.gpkg") -> list[dict]:  # type: ignore[type-arg]
    said = photoplan("object", block.project, block.folder / file, "--height-system", "same", *OPTIONS, "--json",
                     *options)  # fmt: skip
    assert said.code == 0, said.err
    return json.loads(said.out)["products"]


def pixels_of(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    with rasterio.open(path) as file:
        pixels, valid = file.read(1).astype(float), file.read_masks(1) > 0
        x, y = file.xy(*np.mgrid[: file.height, : file.width].reshape(2, -1))
    return pixels, valid, np.stack([x, y], axis=-1).reshape(*pixels.shape, 2)


def test_a_bridge_alone_with_its_hole_and_the_road_below_it(town: Block, capsys) -> None:  # type: ignore[no-untyped-def]
    photoplan = Here(capsys)
    told = {Path(made["path"]).stem: made for made in product(town, photoplan, "--below")}
    assert set(told) == {"house_object", "house_below", "bridge_object", "bridge_below"}
    assert told["bridge_object"]["images"] == sorted(NAMES) and told["bridge_object"]["outside_m2"] == 0
    folder = town.folder / "products"
    deck, valid, XY = pixels_of(folder / "bridge_object.tif")
    points = shapely.points(XY)
    np.testing.assert_array_equal(valid, shapely.contains(BRIDGE, points))
    inner = shapely.contains(BRIDGE.buffer(-3), points)
    truth = colour(np.c_[XY[inner], np.zeros(inner.sum())], np.ones(inner.sum(), bool))
    assert inner.sum() > 1000 and np.sqrt(np.mean((deck[inner] - truth) ** 2)) < 6
    road, seen, XY = pixels_of(folder / "bridge_below.tif")
    # What at least one image sees below the deck; three metres away from where borders are seen.
    hides = [shadow_from(OUTER, dx).difference(shadow_from(HOLE, dx)) for dx in AWAY]
    hidden = shapely.contains(shapely.intersection_all(hides).buffer(-2), shapely.points(XY))
    clear = ~np.any([shapely.dwithin(h.boundary, shapely.points(XY), 3.0) for h in hides], axis=0)
    assert hidden.sum() > 100 and not seen[hidden].any()
    shown = seen & clear
    truth = colour(np.c_[XY[shown], np.zeros(shown.sum())], np.zeros(shown.sum(), bool))
    assert shown.sum() > 500 and np.sqrt(np.mean((road[shown] - truth) ** 2)) < 6
    _, valid, XY = pixels_of(folder / "house_object.tif")
    np.testing.assert_array_equal(valid, shapely.contains(shapely.Polygon(HOUSE.outline), shapely.points(XY)))


def shadow_from(ring: np.ndarray, dx: float) -> shapely.Polygon:
    """What a ring hides of the ground from a centre that lies east of the first."""
    return shapely.transform(shadow_on_ground(ring - (dx, 0, 0)), lambda xy: xy + np.array([dx, 0]))


def test_it_is_laid_over_the_orthophoto_of_the_ground_pixel_by_pixel(town: Block, capsys) -> None:  # type: ignore[no-untyped-def]
    """Behr's last step: ground without what the bridge hides, and the bridge over it, are the true orthophoto."""
    photoplan = Here(capsys)
    product(town, photoplan, "--objects", "bridge", "--images", "two")
    entry = '\n[[objects]]\nfile = "town.gpkg"\nheight_system = "same"\n'
    town.project.write_text(town.project.read_text() + entry)
    for folder, words in (("true", ("--true",)), ("ground", ("--hidden", "nodata"))):
        said = photoplan("ortho", town.project, "--images", "two", *OPTIONS, *words, "--output", town.folder / folder)
        assert said.code == 0, said.err
    whole, valid, at = pixels_of(town.folder / "true" / "two_ortho.tif")
    under, lit, _ = pixels_of(town.folder / "ground" / "two_ortho.tif")
    over, opaque, mine = pixels_of(town.folder / "products" / "bridge_object.tif")
    col, row = (round(abs(d)) for d in mine[0, 0] - at[0, 0])
    here = np.s_[row : row + over.shape[0], col : col + over.shape[1]]
    pixels, there = np.where(lit, under, 0.0), lit.copy()
    pixels[here] = np.where(opaque, over, pixels[here])
    there[here] |= opaque
    # Where the house leans, and on the very border of the image.
    off = shapely.contains(shapely.Polygon(HOUSE.outline).buffer(50), shapely.points(at))
    off |= (np.abs(at - (X0, Y0)) > (148, 111)).any(axis=-1)
    np.testing.assert_array_equal(there[~off], valid[~off])
    assert np.abs(pixels - np.where(valid, whole, 0))[~off].max() <= 1 and opaque.sum() > 2000


def test_fault_19_what_cannot_be_used_is_named_one_by_one(town: Block, capsys) -> None:  # type: ignore[no-untyped-def]
    photoplan = Here(capsys)
    bow = np.array([(0.0, 0, 20), (40, 40, 20), (40, 0, 20), (0, 40, 20)]) + PLACE
    deep = OUTER - (0, 0, 80)
    flat = OUTER.copy()
    flat[2, 2] = np.nan
    shapes = [shapely.Polygon(ring) for ring in (bow, deep, flat, OUTER)]
    write(town.folder / "bad.gpkg", shapes, ["bow", "deep", "flat", "good"])
    said = photoplan("object", town.project, town.folder / "bad.gpkg", "--height-system", "same", *OPTIONS)
    lines = [line.strip() for line in said.err.splitlines()]
    assert said.code == 3 and "3 polygons cannot be used" in said.err and "'good'" not in said.err
    for start in ("'bow' crosses itself", "'deep' lies below the ground, by 34.0 m", "'flat' has vertices without a"):
        assert any(line.startswith(start) for line in lines), said.err
    wall = np.array([(0.0, 0, 0), (40, 0, 0), (40, 0, 20), (0, 0, 20)]) + PLACE
    far = OUTER + np.array([200, 250, 0])
    write(town.folder / "odd.gpkg", [shapely.Polygon(ring) for ring in (wall, far, OUTER)], ["wall", "far", "good"])
    said = photoplan("object", town.project, town.folder / "odd.gpkg", "--height-system", "same", *OPTIONS)
    assert said.code == 0 and "object 'wall' stands upright" in said.err and "object 'far' lies in no image" in said.err
    assert [path.name for path in (town.folder / "products").glob("*.tif")] == ["good_object.tif"]
    for words, text in (
        (("--objects", "tower"), "object 'tower' is not in the file"),
        (("--bounds", 0, 0, 10, 10), "the bounds are 0 0 10 10"),
        (("--images", "nine"), "'nine' is not in the project"),
    ):
        said = photoplan("object", town.project, town.folder / "town.gpkg", "--height-system", "same", *OPTIONS, *words)
        assert said.code != 0 and text in said.err, said.err
    said = photoplan("object", town.project, town.folder / "town.gpkg", *OPTIONS)
    assert said.code == 3 and "--height-system" in said.err


FORMATS = [("a.geojson", "GeoJSON"), ("a.shp", "ESRI Shapefile"), ("a.fgb", "FlatGeobuf")]


@pytest.mark.parametrize(("name", "driver"), FORMATS)
def test_other_formats_give_the_same(town: Block, capsys, name: str, driver: str) -> None:  # type: ignore[no-untyped-def]
    photoplan = Here(capsys)
    product(town, photoplan, "--objects", "bridge")
    write(town.folder / name, [BRIDGE], ["bridge"], driver=driver)
    product(town, photoplan, "--output", town.folder / "other", file=name)
    a, b = (pixels_of(town.folder / f / "bridge_object.tif")[0] for f in ("products", "other"))
    np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_a_plan_gives_the_same_bytes_and_another_object_is_another_product(town: Block, capsys) -> None:  # type: ignore[no-untyped-def]
    photoplan = Here(capsys)
    town.project.write_text(town.project.read_text() + '\n[[objects]]\nfile = "town.gpkg"\nheight_system = "same"\n')
    words = ("object", town.project, town.folder / "town.gpkg", *OPTIONS, "--below", "--sources", "--objects", "bri*")
    assert photoplan(*words).code == 0
    made = {path.name: path.read_bytes() for path in (town.folder / "products").glob("*.tif")}
    assert len(made) == 4
    keys = [json.loads(path.read_text())["key"] for path in (town.folder / "products").glob("*.run.json")]
    assert len(set(keys)) == len(keys) == 2
    assert photoplan(*words).code == 2
    said = photoplan(*words, "--plan", town.folder / "plan.gpkg")
    assert said.code == 0 and "2 products of single objects" in said.out
    assert photoplan("run", town.folder / "plan.gpkg", "--output", town.folder / "again", "--no-quicklook").code == 0
    assert {path.name: path.read_bytes() for path in (town.folder / "again").glob("*.tif")} == made


@pytest.mark.drawn
def test_the_quadtree_is_a_layer_of_the_plan_with_its_counts(town: Block, capsys) -> None:  # type: ignore[no-untyped-def]
    """Behr, section 6.2.2: squares that are inside stay, others are divided until they are no larger than a pixel."""
    photoplan = Here(capsys)
    words = ("object", town.project, town.folder / "town.gpkg", "--height-system", "same", *OPTIONS)
    plan = town.folder / "plan.gpkg"
    said = photoplan(*words, "--objects", "bridge", "--plan", plan, "--show-quadtree", "--json")
    assert said.code == 0, said.err
    (told,) = json.loads(said.out)["quadtree"]
    meta, _, wkb, values = pyogrio.raw.read(plan, layer="quadtree")
    squares, columns = shapely.from_wkb(wkb), dict(zip(meta["fields"], values))
    assert told["object"] == "bridge" and told["squares"] == len(squares) == sum(told["of_level"])
    np.testing.assert_array_equal(told["of_level"], np.bincount(columns["level"], minlength=8))
    np.testing.assert_allclose(columns["side"], 128.0 / 2.0 ** columns["level"])
    inside = shapely.contains_properly(BRIDGE, squares)
    assert inside.any() and (columns["level"][~inside & ~shapely.within(squares, BRIDGE)] == 7).all()
    assert shapely.union_all(squares).symmetric_difference(BRIDGE).area < 0.5 * BRIDGE.length
    assert shapely.area(squares).sum() == pytest.approx(shapely.union_all(squares).area)
    x = shapely.get_x(shapely.centroid(squares))
    np.testing.assert_allclose(columns["height"], GROUND + 43 + (x - X0 + 30) * 0.05, atol=1e-6)
    assert photoplan("run", plan, "--no-quicklook").code == 0
    said = photoplan(*words, "--show-quadtree")
    assert said.code == 2 and "--plan" in said.err
    bare = photoplan("mosaic", town.project, *OPTIONS, "--dry-run", "--show-quadtree")
    assert bare.code == 2 and "no product of the plan shows an object" in bare.err
    town.project.write_text(town.project.read_text() + '\n[[objects]]\nfile = "town.gpkg"\nheight_system = "same"\n')
    said = photoplan("mosaic", town.project, "--resolution", 1, "--plan", town.folder / "b.gpkg", "--show-quadtree")
    assert (town.folder / "b_quadtree.png").stat().st_size > 5000
    assert said.code == 0 and "mosaic: bridge: " in said.out and "mosaic: house: " in said.out
