"""`simulate --scene`: images of a project's own terrain and objects, whose every pixel is known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
import shapely
from rasterio.transform import from_origin
from tools.command import Said, inside
from tools.rendered_block import (
    Flight,
    edge_shifts,
    judge,
    pixels_of,
    rendered_mosaic,
    seen,
    shifts,
    upper_edges,
    write_project,
)
from tools.small_block import CRS, X0, Y0, write_image
from tools.town import House

from photoplan.cameras.base import project
from photoplan.io.project.file import load_project
from photoplan.io.vector_layer import VectorLayer, write_geopackage
from photoplan.project.rendered import DrapedTexture, ProjectScene
from photoplan.quality.formation.scenes import RenderedScene, SolidTexture
from photoplan.surfaces.base import Hits, LevelSurface
from photoplan.surfaces.objects import ObjectSurface

GROUND, GRAIN = 100.0, 8.0
HOUSES = [
    House(X0 - 40, Y0 + 25, 0.3, 50.0, 36.0, GROUND - 2, GROUND + 30, GROUND + 42),
    House(X0 + 35, Y0 - 20, -0.2, 30.0, 44.0, GROUND - 2, GROUND + 40, GROUND + 40),
]
DECK = [np.add([(-90.0, -62, 18), (90, -48, 22), (89, -36, 22), (-91, -50, 18)], (X0, Y0, GROUND))]
BOUNDS = (X0 - 90, Y0 - 70, X0 + 90, Y0 + 70)
NAMES = ["i1", "i2", "i3", "i4"]


@dataclass(frozen=True)
class Town:
    path: Path

    def __call__(self, verb: str, *words: object) -> Said:
        words = ("--scene", self.path, *words) if verb == "simulate" else (self.path, *words)
        said = inside(verb, *words)
        assert said.code == 0, said.err
        return said


def write_town(folder: Path, size: tuple[int, int] = (200, 150)) -> Town:
    rings = [*(polygon for house in HOUSES for polygon in house.polygons), DECK]
    names = np.array([*(f"house {k}" for k in range(len(HOUSES)) for _ in range(6)), "bridge"], object)
    shapes = [shapely.Polygon(polygon[0], polygon[1:]) for polygon in rings]
    write_geopackage(folder / "objects.gpkg", [VectorLayer("objects", "Polygon Z", shapes, {"name": names})], CRS)
    objects = '\n[[objects]]\nfile = "objects.gpkg"\nheight_system = "same"\n'
    flight = Flight((X0, Y0), GROUND + 200, (60, 60), (2, 2), size, size[0] * 1.0)
    return Town(write_project(folder, CRS, f"height = {GROUND}", objects, flight))


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Town:
    town = write_town(tmp_path_factory.mktemp("town"))
    truth = ["--truth", "--resolution", 1, "--bounds", *BOUNDS, "--grain", GRAIN, "--workers", 1]
    town("simulate", *truth, "--oversampling", 3)
    return town


def truth_of(path: Path) -> np.ndarray:
    """X, Y, Z and object as GDAL's readers have them."""
    with rasterio.open(path) as file:
        assert file.descriptions == ("X", "Y", "Z", "object")
        return file.read() + np.array(file.offsets)[:, None, None]


def test_every_pixel_is_known(town: Town) -> None:
    """What a truth raster names projects back to its pixel, lies on the scene, and has the image's colour."""
    stated = load_project(town.path)
    scene = ProjectScene.of(stated, None, GRAIN, 0, 1)
    for name in NAMES[:2]:
        X, Y, Z, which = truth_of(town.path.parent / "rendered" / f"{name}_truth.tif")
        XYZ = np.stack([X, Y, Z], axis=-1)
        view = scene.seen_by(name)
        row, col = np.mgrid[: X.shape[0], : X.shape[1]]
        assert np.abs(project(view.camera, XYZ) - np.stack([col, row], axis=-1)).max() < 1e-3  # type: ignore[arg-type]
        # Polygons count from 1, the bridge is the last; heights of roofs come from a house that knows no triangle.
        assert {0, 1, 2, 7, 8, 13} <= set(np.unique(which)) <= set(range(14))
        ground = which == 0
        assert np.abs(Z[ground] - GROUND).max() < 1e-4
        above = np.max([house.roof(XYZ[..., :2]) for house in HOUSES], axis=0)
        assert (above[ground] < GROUND).mean() > 0.999
        roofs = ~ground & (which < 13) & (np.abs(Z - above) < 1e-3)
        assert roofs.sum() > 2000
        image, _ = pixels_of(town.path.parent / "rendered" / f"{name}.tif")
        hits = replace(view.hits(np.stack([col, row], axis=-1).reshape(-1, 2)), XYZ=XYZ.reshape(-1, 3))
        colour = SolidTexture(GRAIN)(hits).mean(axis=0).reshape(X.shape)
        inner = ground & (np.abs(np.gradient(Z)).max(axis=0) == 0)
        assert np.abs(image - colour)[inner].max() < 3 and image[inner].std() > 8


def test_a_mosaic_of_it_shows_what_is_there(town: Town) -> None:
    folder = town.path.parent
    images = rendered_mosaic(town.path, town.path, BOUNDS, 1)
    truth = seen(town.path, folder / "project" / "mosaic.tif")
    judged = judge(truth, folder / "project" / "mosaic.tif", images, NAMES)
    assert judged.visible > 20_000 and (~truth.visible).sum() > 30
    assert judged.right >= 0.998 and judged.wrong == judged.double == 0
    true, _ = pixels_of(folder / "rendered" / "true_orthophoto.tif")
    found = shifts(judged, true, truth)
    assert len(found) > 50 and np.sqrt((found**2).mean()) < 0.1 and np.abs(found).max() < 0.3
    surface = ProjectScene.of(load_project(town.path), None, GRAIN, 0, 1).ground.surface
    assert isinstance(surface, ObjectSurface)
    edges = edge_shifts(judged, true, truth, upper_edges(surface, truth.grid, 12.0))
    assert np.isfinite(edges).sum() >= 4 and np.nanmax(np.abs(edges)) < 0.5


def test_runs_go_on_and_nothing_is_replaced(tmp_path: Path) -> None:
    """Files that are there stay, those that lack are made; photographs of the project are never replaced."""
    town = write_town(tmp_path, (64, 48))
    first = town("simulate", "--images", "i1,i2", "--workers", 1).out.split()
    one, two = (tmp_path / "rendered" / f"{name}.tif" for name in NAMES[:2])
    assert first == [str(one), str(two)]
    again = inside("simulate", "--scene", town.path, "--images", "i1,i2")
    assert again.code == 2 and "exists already" in again.err and "--overwrite" in again.err
    before = one.read_bytes()
    one.unlink()
    assert town("simulate", "--images", "i1,i2", "--workers", 2).out.split() == [str(one)]
    assert one.read_bytes() == before
    other = inside("simulate", "--scene", town.path, "--images", "i1,i2", "--seed", 1)
    assert other.code == 2 and "exists already" in other.err
    photo = tmp_path / "rendered" / "i3.tif"
    write_image(photo, np.full((3, 48, 64), 7, np.uint8))
    refused = inside("simulate", "--scene", town.path, "--overwrite")
    assert refused.code == 2 and "was not rendered" in refused.err and photo.stat().st_size
    assert one.read_bytes() == before


def test_words_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    town = write_town(tmp_path, (64, 48))
    for words, said in (
        (["simulate"], "SCENE, a file or a pattern, or --scene is required"),
        (["simulate", "edge:5", "--scene", town.path], "SCENE, a file or a pattern, or --scene is required"),
        (["simulate", "edge:5", "--truth"], "--truth does not go with a file or pattern"),
        (["simulate", "--scene", town.path, "--levels", 0, 1], "--levels does not go with a project"),
        (["simulate", "--scene", town.path, "--bounds", 0, 0, 1, 1], "--resolution"),
        (["simulate", "--scene", town.path, "--grain", -1], "grain -1"),
        (["simulate", "--scene", town.path, "--resolution", 1], "--bounds"),
        (["simulate", "--scene", town.path, "--images", "nobody"], "'nobody' is not in the project"),
    ):
        refused = inside(*words)
        assert refused.code == 2 and said in refused.err, (words, refused.err)
    assert not (tmp_path / "rendered").exists()


def test_colours_of_a_raster_lie_on_the_ground(tmp_path: Path) -> None:
    """At its own pixels, and as means where rays lie further apart; objects keep theirs."""
    town = write_town(tmp_path, (100, 75))
    side = 1200
    x = np.arange(side) * 0.25
    fine = (
        100
        + 60 * np.sin(x / 10)[None] * np.cos(x / 14)[:, None]
        + 40 * (np.indices((side, side)).sum(axis=0) % 2 - 0.5)
    )
    place = {"crs": CRS, "transform": from_origin(X0 - 150, Y0 + 150, 0.25, 0.25)}
    write_image(tmp_path / "paint.tif", np.rint(fine)[None].astype(np.uint8), **place)
    town("simulate", "--images", "i1", "--texture", tmp_path / "paint.tif", "--truth", "--grain", GRAIN)
    X, Y, _, which = truth_of(tmp_path / "rendered" / "i1_truth.tif")
    with rasterio.open(tmp_path / "rendered" / "i1.tif") as file:
        assert file.count == 1
        image = file.read(1).astype(float)
    smooth = 100 + 60 * np.sin((X - X0 + 150) / 10) * np.cos((Y0 + 150 - Y) / 14)
    inner = (which == 0) & (np.abs(X - X0) < 140) & (np.abs(Y - Y0) < 140)
    for axis in (0, 1):
        for step in (-1, 1):
            inner &= np.roll(which, step, axis) == 0
    inner[[0, -1]] = inner[:, [0, -1]] = False
    # Pixels of 2 m: the chessboard of 0.25 m has vanished, it has not become a pattern of its own.
    assert np.sqrt(np.mean((image - smooth)[inner] ** 2)) < 4 and inner.sum() > 2000
    refused = inside("simulate", "--scene", town.path, "--texture", tmp_path / "rendered" / "i1.tif", "--overwrite")
    assert refused.code == 3 and "needs a place on the map" in refused.err


def test_a_camera_needs_rays_only() -> None:
    """Lines from places of their own, that look up and down: no centre, no projection."""

    class Lines:
        size = (40, 30)

        def rays(self, xy, height=None):  # type: ignore[no-untyped-def]
            x, y = np.moveaxis(np.asarray(xy, float), -1, 0)
            origin = np.stack([0 * y, -y * 2.0, 0 * y + 60.0], axis=-1)
            way = np.stack([(x - 19.5) / 40, 0 * x, np.where(x < 38.6, -1.0, 1.0)], axis=-1)
            return origin, way / np.linalg.norm(way, axis=-1, keepdims=True)

    scene = RenderedScene(Lines(), LevelSurface(10.0), SolidTexture(5.0), (10.0, 10.0))
    col, row = np.meshgrid(np.arange(40.0), np.arange(30.0))
    XYZ = scene.hits(np.stack([col, row], axis=-1).reshape(-1, 2)).XYZ.reshape(30, 40, 3)
    expected = np.stack([(col - 19.5) / 40 * 50, -row * 2.0, 10.0 + 0 * col], axis=-1)
    assert np.allclose(XYZ[:, :39], expected[:, :39], atol=1e-6) and np.isnan(XYZ[:, 39]).all()


@pytest.mark.parametrize("how", ["table", "names"])
def test_a_texture_of_classes_is_taken_by_the_nearest_pixel(tmp_path: Path, how: str) -> None:
    """Also where rays lie far apart, and over the border of the raster."""
    numbers = np.random.default_rng(3).integers(0, 4, (2100, 300)).astype(np.uint8)
    place = {"crs": CRS, "transform": from_origin(X0, Y0, 0.5, 0.5)}
    table = {0: (250, 10, 10), 1: (10, 240, 20), 2: (30, 20, 230), 3: (200, 200, 40)}
    file = write_image(tmp_path / "c.tif", numbers[None], **place)
    if how == "table":
        with rasterio.open(file, "r+") as opened:
            opened.write_colormap(1, table)
    else:
        names = "<CategoryNames><Category>wood</Category></CategoryNames>"
        text = f'<PAMDataset><PAMRasterBand band="1">{names}</PAMRasterBand></PAMDataset>'
        file.with_name("c.tif.aux.xml").write_text(text)
    X, Y = np.random.default_rng(4).uniform((X0 - 20, Y0 - 1070), (X0 + 170, Y0 + 20), (5000, 2)).T
    hits = replace(Hits.none(5000), XYZ=np.column_stack([X, Y, np.zeros(5000)]), owner=np.zeros(5000, np.int64))
    other = SolidTexture(5.0)
    texture = DrapedTexture.of(file, CRS, other)
    found = texture(hits)
    col, row = np.floor((X - X0) / 0.5).astype(int), np.floor((Y0 - Y) / 0.5).astype(int)
    inside_ = (col >= 0) & (col < 300) & (row >= 0) & (row < 2100)
    wanted = numbers[row[inside_], col[inside_]]
    colours = np.array([table[k] for k in range(4)])[wanted].T if how == "table" else wanted[None]
    np.testing.assert_array_equal(found[:, inside_], colours)
    np.testing.assert_array_equal(found[:, ~inside_], replace(other, bands=len(found))(hits)[:, ~inside_])
