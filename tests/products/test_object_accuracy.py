"""Accuracy of what shows an object: its own standard deviations count there, those of the terrain elsewhere."""

from __future__ import annotations

import json

import numpy as np
import pytest
import rasterio
import shapely
from products.test_object_products import BRIDGE, OPTIONS, pixels_of, rendered, town  # noqa: F401
from tools.command import Here, edit
from tools.pinhole import Pinhole
from tools.small_block import FOCAL, NAMES, SIZE, X0, Y0, Z0, Block
from tools.town import faces_of

from photoplan.errors import InputError
from photoplan.geometry.grid import MapGrid
from photoplan.geometry.pose import Pose
from photoplan.io.project.file import load_project
from photoplan.plan.accuracy import SourceErrors, tile_accuracy
from photoplan.project.error_model import object_errors
from photoplan.surfaces.base import LevelSurface
from photoplan.surfaces.hybrid import StatedHeightErrors
from photoplan.surfaces.objects import ObjectSurface
from photoplan.targets.map import MapTarget

TERRAIN, SIGMA = 0.6, (0.2, 0.05)


def stated(block: Block, sigma: str) -> None:
    edit(block.project, "[terrain]", f"[terrain]\nsigma = {TERRAIN}")
    for name in NAMES:
        edit(block.project, f'name = "{name}"',
             f'name = "{name}"\nsigma_center = [0.0, 0.0, 0.0]\nsigma_angles = [0.0, 0.0, 0.0]')  # fmt: skip
    text = f'\n[[objects]]\nfile = "town.gpkg"\nheight_system = "same"\n{sigma}\n'
    block.project.write_text(block.project.read_text() + text)


def test_a_roof_that_is_moved_as_a_whole_moves_what_is_seen_of_it(town: Block) -> None:  # noqa: F811
    """Drawn planes, rays of the pixels' own image places: rms by stated standard deviation is 1."""
    stated(town, f"sigma = {list(SIGMA)}")
    # Steep, and falling away from the camera or towards it.
    roof = np.array([(-90.0, -60, 110), (30, -60, 150), (30, -30, 170), (-90, -30, 130)]) + np.array([X0, Y0, 0])
    surface = ObjectSurface(LevelSurface(100.0), faces_of([[roof]]), entries=(0,))
    errors = object_errors(load_project(town.project), surface, StatedHeightErrors(TERRAIN))
    target = MapTarget(MapGrid.covering((X0 - 80, Y0 - 55, X0 + 20, Y0 - 35), 5.0, "EPSG:32633"))
    camera = Pinhole(Pose.from_angles((X0 - 30, Y0, Z0), (0, 0, 0)), FOCAL, SIZE)
    found = tile_accuracy(target, target.window, surface, errors, {0: SourceErrors(camera, ())})
    v, u = np.mgrid[: target.window.height, : target.window.width].astype(float)
    uvh = np.stack([u, v, surface.relief(target, target.window).astype(float)], axis=-1)
    XYZ = target.to_ground(uvh)
    normal = np.cross(roof[1] - roof[0], roof[2] - roof[0])
    centre, rng = camera.pose.center, np.random.default_rng(0)
    way, off = XYZ - centre, []
    for move in rng.normal(size=(4000, 3)) * (SIGMA[0], SIGMA[0], SIGMA[1]):
        t = ((roof[0] + move - centre) @ normal) / (way @ normal)
        off.append(centre + t[..., None] * way - XYZ)
    rms = np.sqrt(np.mean(np.square(off), axis=0))
    np.testing.assert_allclose(np.moveaxis(rms, -1, 0), found[:3], rtol=0.06, atol=1e-4)
    assert found[2].max() > 1.5 * SIGMA[1]


def test_where_an_object_is_shown_its_errors_count(town: Block, capsys) -> None:  # type: ignore[no-untyped-def]  # noqa: F811
    photoplan = Here(capsys)
    words = ("ortho", town.project, "--true", "--images", "two", *OPTIONS)
    stated(town, "")
    said = photoplan(*words, "--accuracy")
    assert said.code == 3 and "town.gpkg: state sigma = [HORIZONTAL, HEIGHT]" in said.err
    edit(town.project, '"town.gpkg"', f'"town.gpkg"\nsigma = {list(SIGMA)}')
    assert photoplan(*words, "--accuracy").code == 0
    folder = town.folder / "products"
    with rasterio.open(folder / "two_ortho_accuracy.tif") as file:
        radial = np.hypot(*file.read((1, 2)))
    _, valid, XY = pixels_of(folder / "two_ortho.tif")
    deck = shapely.contains(BRIDGE.buffer(-2), shapely.points(XY)) & valid
    ground = ~shapely.contains(shapely.box(X0 - 92, Y0 - 62, X0 + 100, Y0 + 60), shapely.points(XY)) & valid
    # A deck of little slope: its height moves what is shown by the tangent of the ray, and the kernel a little.
    tangent = np.hypot(XY[..., 0] - X0, XY[..., 1] - Y0)
    high = 43 + (XY[..., 0] - X0 + 30) * 0.05
    np.testing.assert_allclose(radial[deck], np.hypot(0.051 * tangent[deck] / (300 - high[deck]), 0.06), atol=0.02)
    np.testing.assert_allclose(radial[ground], np.hypot(TERRAIN * tangent[ground] / 300, 0.09), atol=0.03)
    key = json.loads((folder / "two_ortho.run.json").read_text())["key"]
    edit(town.project, f"sigma = {list(SIGMA)}", "sigma = [0.3, 0.05]")
    assert photoplan(*words, "--accuracy", "--overwrite").code == 0
    assert json.loads((folder / "two_ortho.run.json").read_text())["key"] != key
    # Alone, nothing else counts; without accuracy, no sigma moves a pixel.
    alone = ("object", town.project, town.folder / "town.gpkg", "--objects", "bridge", *OPTIONS)
    assert photoplan(*alone, "--accuracy", "--sigma", *SIGMA).code == 0
    with rasterio.open(folder / "bridge_object_accuracy.tif") as file:
        radial, known = np.hypot(*file.read((1, 2))), file.read_masks(1) > 0
    assert known.sum() > 0.98 * BRIDGE.area and radial[known].max() < 0.12


def test_a_sigma_moves_no_pixel(town: Block) -> None:  # noqa: F811
    from photoplan.products.orthophoto.plan import plan_orthophotos

    stated(town, "sigma = [0.2, 0.05]")
    before = plan_orthophotos(load_project(town.project), ["two"], resolution=1.0, true=True).products[0].key
    edit(town.project, "sigma = [0.2, 0.05]", "sigma = [0.3, 0.1]")
    assert plan_orthophotos(load_project(town.project), ["two"], resolution=1.0, true=True).products[0].key == before
    edit(town.project, "sigma = [0.3, 0.1]", "sigma = [-0.3, 0.1]")
    with pytest.raises(InputError, match="sigma"):
        load_project(town.project)
