"""True orthophotos of rendered scenes: objects where they stand, no ground twice, hidden ground empty."""

from __future__ import annotations

import json

import numpy as np
import pytest
import rasterio
import shapely
from tools.command import Here
from tools.pinhole import Pinhole
from tools.rendered import render
from tools.small_block import CRS, FOCAL, SIZE, X0, Y0, Z0, Block, make_project, write_image, write_terrain
from tools.town import House, faces_of

from photoplan.geometry.pose import Pose
from photoplan.io.vector_layer import VectorLayer, write_geopackage
from photoplan.surfaces.base import LevelSurface
from photoplan.surfaces.objects import ObjectSurface

GROUND = 100.0
HOUSE = House(X0 + 60, Y0 + 30, 0.3, 50.0, 36.0, GROUND - 2, GROUND + 50, GROUND + 50)
DECK = np.array([(-110.0, -60, 40), (-20, -60, 40), (-20, -40, 40), (-110, -40, 40)]) + np.array([X0, Y0, GROUND])
POLYGONS = [*HOUSE.polygons, [DECK]]
NAMES = [*("house",) * 6, "bridge"]


def colour(XYZ: np.ndarray, on_face: np.ndarray) -> np.ndarray:
    """Stripes of the ground along X + Y; roofs and the bridge are bright, each with stripes of its own."""
    x, y = XYZ[:, 0] - X0, XYZ[:, 1] - Y0
    return np.where(on_face, 200 + 30 * np.sin((x - y) / 6), 90 + 50 * np.sin((x + y) / 8))


def photo() -> Pinhole:
    return Pinhole(Pose.from_angles((X0, Y0, Z0), (0, 0, 0)), FOCAL, SIZE)


@pytest.fixture
def town(small: Block) -> Block:
    for other in small.images[1:]:
        other.unlink(missing_ok=True)
    scene = ObjectSurface(LevelSurface(GROUND), faces_of(POLYGONS))
    pixels = render(photo(), scene, colour, GROUND - 1)
    write_image(small.images[0], np.repeat(np.rint(pixels)[None], 3, axis=0).astype(np.uint8))
    small.orientation.write_text(f"name,x,y,z,omega,phi,kappa\none,{X0},{Y0},{Z0},0,0,0\n")
    write_terrain(small.terrain, np.full((60, 64), GROUND))
    make_project(small)
    write_objects(small)
    state(small, 'file = "objects.gpkg"\nheight_system = "same"')
    return small


def write_objects(block: Block, polygons=POLYGONS, names=NAMES, **more) -> None:  # type: ignore[no-untyped-def]
    shapes = [shapely.Polygon(rings[0], rings[1:]) for rings in polygons]
    columns = {"name": np.array(names, object), **more}
    write_geopackage(block.folder / "objects.gpkg", [VectorLayer("objects", "Polygon Z", shapes, columns)], CRS)


def state(block: Block, entries: str) -> None:
    text = block.project.read_text().split("\n[[objects]]")[0]
    block.project.write_text(f"{text}\n[[objects]]\n{entries}\n")


def product(block: Block, photoplan: Here, folder: str, *options: str):  # type: ignore[no-untyped-def]
    said = photoplan("ortho", block.project, "--resolution", "1", "--tile", "128", "--kernel", "bilinear", "--output",
                     block.folder / folder, "--no-quicklook", "--json", *options)  # fmt: skip
    assert said.code == 0, said.err
    with rasterio.open(block.folder / folder / "one_ortho.tif") as file:
        pixels, valid = file.read(1).astype(float), file.read_masks(1) > 0
        x, y = file.xy(*np.mgrid[: file.height, : file.width].reshape(2, -1))
    XY = np.stack([x, y], axis=-1).reshape(*pixels.shape, 2)
    return pixels, valid, XY, json.loads(said.out)["products"][0]


def shadow_on_ground(ring: np.ndarray) -> shapely.Polygon:
    centre = np.array((X0, Y0, Z0))
    return shapely.Polygon((centre + (ring - centre) * ((Z0 - GROUND) / (Z0 - ring[:, 2:])))[:, :2])


ROOF = np.c_[HOUSE.outline, np.full(4, GROUND + 50)]


def parts(XY: np.ndarray, border: float) -> dict[str, np.ndarray]:
    """Pixels by what is there, without those near a border."""
    outlines = {
        "roof": shapely.Polygon(ROOF), "deck": shapely.Polygon(DECK[:, :2]), "lean": shadow_on_ground(ROOF),
        "under": shadow_on_ground(DECK),
    }  # fmt: skip
    points = shapely.points(XY)
    inside = {k: shapely.contains(v, points) for k, v in outlines.items()}
    clear = np.all([shapely.distance(v.boundary, points) > border for v in outlines.values()], axis=0)
    wall = shapely.union_all([outlines["roof"], outlines["lean"]]).convex_hull
    clear &= shapely.distance(wall.boundary, points) > border
    on = inside["roof"] | inside["deck"]
    hidden = (shapely.contains(wall, points) | inside["under"]) & ~on
    return {"on": on & clear, "hidden": hidden & clear, "ground": ~on & ~hidden & clear}


def test_objects_are_where_they_stand_and_no_ground_is_there_twice(town: Block, capsys) -> None:  # type: ignore[no-untyped-def]
    photoplan = Here(capsys)
    pixels, valid, XY, told = product(town, photoplan, "true", "--true")
    part = parts(XY, 3.0)
    inside = valid.copy()
    assert min(p.sum() for p in part.values()) > 400
    assert not valid[part["hidden"]].any()
    flat = XY.reshape(-1, 2)
    on_face = part["on"].ravel()
    truth = colour(np.c_[flat, np.zeros(len(flat))], on_face).reshape(pixels.shape)
    for what in ("on", "ground"):
        error = (pixels - truth)[part[what] & inside]
        assert error.size > 400 and np.sqrt(np.mean(error**2)) < 6, what
    assert told["hidden_m2"] == pytest.approx(parts(XY, 0.0)["hidden"].sum(), rel=0.05)


def test_ordinary_orthophotos_show_the_ground_and_know_what_objects_hide(town: Block, capsys) -> None:  # type: ignore[no-untyped-def]
    photoplan = Here(capsys)
    shown, _, XY, _ = product(town, photoplan, "ground")
    bare, _, _, told = product(town, photoplan, "bare", "--hidden", "nodata")
    state(town, 'file = "objects.gpkg"\nheight_system = "same"\nrole = "occluder"')
    occluded, _, _, _ = product(town, photoplan, "occluded", "--true")
    np.testing.assert_array_equal(occluded, bare)
    under = shadow_on_ground(DECK)
    # What the deck hides of the road is the deck's place in the picture, and empty if that is asked.
    hidden = shapely.contains(under.buffer(-2), shapely.points(XY))
    assert (shown[hidden] > 150).mean() > 0.95 and not bare[hidden].any() and told["hidden_m2"] > under.area
    town.project.write_text(town.project.read_text().split("\n[[objects]]")[0])
    without, *_ = product(town, photoplan, "without")
    np.testing.assert_array_equal(shown, without)


def test_a_bridge_that_only_hides_leaves_the_road_and_the_house_is_shown(town: Block, capsys) -> None:  # type: ignore[no-untyped-def]
    photoplan = Here(capsys)
    write_objects(town, role=np.array([*("paint",) * 6, "occluder"], object))
    pixels, valid, XY, _ = product(town, photoplan, "road", "--true")
    points = shapely.points(XY)
    under = shapely.contains(shadow_on_ground(DECK).buffer(-2), points)
    assert not valid[under].any()
    # Of the ground below the deck the camera sees what the deck's picture does not cover.
    seen = shapely.contains(
        shapely.Polygon(DECK[:, :2]).buffer(-2).difference(shadow_on_ground(DECK).buffer(2)), points
    )
    truth = colour(np.c_[XY[seen], np.zeros(seen.sum())], np.zeros(seen.sum(), bool))
    assert seen.sum() > 100 and np.sqrt(np.mean((pixels[seen] - truth) ** 2)) < 6
    assert valid[shapely.contains(shapely.Polygon(ROOF).buffer(-2), points)].all()


def test_objects_that_change_are_other_products(town: Block, capsys) -> None:  # type: ignore[no-untyped-def]
    photoplan = Here(capsys)
    plan = town.folder / "plan.gpkg"
    assert photoplan("ortho", town.project, "--resolution", "1", "--true", "--plan", plan).code == 0
    assert photoplan("run", plan, "--no-quicklook").code == 0
    write_objects(town, [*HOUSE.polygons], NAMES[:6])
    again = photoplan("run", plan, "--no-quicklook", "--overwrite")
    assert again.code != 0 and "changed" in again.err
    replaced = photoplan("ortho", town.project, "--output", town.folder, "--true", "--true")
    assert replaced.code == 0


COMMANDS = {"ortho": ("ortho", "--true"), "hidden": ("ortho", "--hidden", "nodata"), "mosaic": ("mosaic",)}


@pytest.mark.parametrize("command", COMMANDS)
def test_fault_19_objects_that_cannot_be_are_named_one_by_one(town: Block, capsys, command: str) -> None:  # type: ignore[no-untyped-def]
    photoplan = Here(capsys)
    verb, *options = COMMANDS[command]
    bow = DECK[[0, 2, 1, 3]]
    flat = np.full((4, 3), np.nan)
    flat[:, :2] = DECK[:, :2]
    deep = DECK - (0, 0, 60)
    write_objects(town, [*POLYGONS, [bow], [flat]], [*NAMES, "bow", "flat"])
    said = photoplan(verb, town.project, *options)
    assert said.code == 3 and "2 polygons" in said.err
    assert "'bow' crosses itself" in said.err and "'flat' has vertices without a height" in said.err
    high, highest = (DECK - (0, 0, -z) for z in (2500, 1e300))
    given = [*POLYGONS, [deep], [deep - (0, 0, 5)], [high], [highest]]
    write_objects(town, given, [*NAMES, "deep", "deeper", "high", "highest"])
    said = photoplan(verb, town.project, *options)
    assert said.code == 3 and "4 polygons" in said.err
    assert "'high' rises to 25" in said.err and "m above the ground; are its heights in metres?" in said.err
    assert "'highest' rises to 1e+300 m above" in said.err
    assert "'deep' lies below the ground, by 20.0 m" in said.err
    assert "'deeper' lies below the ground, by 25.0 m" in said.err
    assert not (town.folder / "products").exists()


@pytest.mark.parametrize("command", COMMANDS)
def test_fault_02_objects_with_heights_in_feet_are_refused(town: Block, capsys, command: str) -> None:  # type: ignore[no-untyped-def]
    """Heights in feet put roofs above the aircraft: nothing was hidden, nothing said."""
    photoplan = Here(capsys)
    verb, *options = COMMANDS[command]
    write_objects(town, [*POLYGONS, [(DECK - (0, 0, 17)) * (1, 1, 1 / 0.3048)]], [*NAMES, "feet"])
    said = photoplan(verb, town.project, *options, "--resolution", "1")
    assert said.code == 3 and "object 'feet' rises to" in said.err and "in feet" in said.err
    assert not (town.folder / "products").exists()
    assert "in feet" in photoplan("check", town.project).out
    assert photoplan(verb, town.project, *options, "--resolution", "1", "--force", "--dry-run").code == 0


@pytest.mark.parametrize("command", COMMANDS)
def test_fault_02_objects_without_heights_or_crs_declared_are_refused(town: Block, capsys, command: str) -> None:  # type: ignore[no-untyped-def]
    photoplan = Here(capsys)
    words = (COMMANDS[command][0], town.project, *COMMANDS[command][1:])
    state(town, 'file = "objects.gpkg"')
    said = photoplan(*words)
    assert said.code == 3 and "height_system" in said.err
    state(town, 'file = "objects.gpkg"\nheight_system = "same"\nrole = "paints"')
    said = photoplan(*words)
    assert said.code != 0 and "occluder" in said.err
    state(town, 'file = "objects.gpkg"\nheight_system = "same"\noffset = [0.0, 0.0, -200.0]')
    said = photoplan(*words)
    assert said.code == 3 and "'house' lies below the ground, by" in said.err
    state(town, 'file = "objects.gpkg"\nheight_system = "same"\noffset = [90000.0, 0.0, 0.0]')
    said = photoplan(*words)
    assert said.code == 3 and "do not meet the terrain" in said.err
