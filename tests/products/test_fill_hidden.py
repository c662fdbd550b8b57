"""Small hidden holes that a rough surface model leaves in products are filled, and marked; nothing else changes."""

from __future__ import annotations

import itertools
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import shapely
from rasterio.transform import from_origin
from scipy.ndimage import binary_dilation, find_objects, label
from tools.command import Here, edit
from tools.pinhole import Pinhole
from tools.small_block import (
    CRS,
    FOCAL,
    NAMES,
    SIZE,
    X0,
    Y0,
    Block,
    make_project,
    write_block,
    write_image,
    write_terrain,
)

from photoplan.errors import UsageError
from photoplan.geometry.pose import Pose
from photoplan.io.vector_layer import VectorLayer, write_geopackage
from photoplan.requests.ortho import OrthoSettings

GROUND, FROM_IMAGE, FROM_SURROUNDINGS = 100.0, 32768, 65535
CENTRES = {"one": (-48, -10, 200.0), "two": (-44, 15, 200.0), "three": (45, -8, 200.0)}
BOUNDS = (X0 - 30, Y0 - 26, X0 + 30, Y0 + 26)
OPTIONS = ("--resolution", "0.25", "--bounds", *BOUNDS, "--tile", "128", "--no-quicklook", "--json")
PX = 8


def grey(x: Any, y: Any) -> Any:
    """Waves on level ground."""
    x, y = x - X0, y - Y0
    return 120 + 40 * np.sin((x + y) / 1.2) + 30 * np.sin((x - 0.6 * y) / 4)


@pytest.fixture(scope="module")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Block:
    """Images of level ground; a surface model with noise of 1.2 m at every metre."""
    block = write_block(tmp_path_factory.mktemp("rough") / "block", project=False)
    lines = ["name,x,y,z,omega,phi,kappa"]
    for name, path in zip(NAMES, block.images):
        centre = np.add(CENTRES[name], (X0, Y0, 0))
        camera = Pinhole(Pose.from_angles(tuple(centre), (0, 0, 0)), FOCAL, SIZE)
        col, row = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
        total = np.zeros(col.size)
        for shift in itertools.product((-0.25, 0.25), repeat=2):
            origin, way = camera.rays(np.stack([col, row], axis=-1).reshape(-1, 2) + shift)
            ground = origin + way * ((GROUND - origin[:, 2:]) / way[:, 2:])
            total += grey(ground[:, 0], ground[:, 1])
        write_image(path, np.repeat(np.rint(total / 4).reshape(1, *col.shape), 3, axis=0).astype(np.uint8))
        lines.append(",".join([name, *(f"{c:.3f}" for c in centre), "0,0,0"]))
    block.orientation.write_text("\n".join(lines) + "\n")
    heights = GROUND + np.random.default_rng(0).normal(0, 1.2, (320, 320))
    # A pit that no image sees into, wider than what is filled.
    heights[146:150, 172:176] -= 25
    write_terrain(block.terrain, heights, transform=from_origin(X0 - 160, Y0 + 160, 1.0, 1.0))
    make_project(block)
    return block


@pytest.fixture
def rough(made_once: Block, tmp_path: Path) -> Block:
    return Block(Path(shutil.copytree(made_once.folder, tmp_path / "block")))


def made(photoplan: Here, block: Block, folder: str, *options: object, what: str = "mosaic") -> dict[str, Any]:
    """Record of a product in a folder of its own."""
    said = photoplan(what, block.project, *OPTIONS, "-o", block.folder / folder, *options)
    assert said.code == 0, said.err
    return json.loads(said.out)["products"][0]  # type: ignore[no-any-return]


def read(path: Path) -> np.ndarray:
    with rasterio.open(path) as file:
        return file.read()


def sources_of(folder: Path, stem: str = "mosaic") -> np.ndarray:
    return read(folder / f"{stem}_sources.tif")[0]


def truth_of(path: Path) -> np.ndarray:
    with rasterio.open(path) as file:
        x, y = file.xy(*np.mgrid[: file.height, : file.width].reshape(2, -1))
        return grey(np.array(x), np.array(y)).reshape(file.shape)


def test_holes_of_a_size_are_filled_and_marked_and_nothing_else(rough: Block, capsys) -> None:  # type: ignore[no-untyped-def]
    photoplan = Here(capsys)
    bare = made(photoplan, rough, "bare", "--sources")
    told = made(photoplan, rough, "filled", "--fill-hidden", PX)
    before, after = (read(rough.folder / name / "mosaic.tif") for name in ("bare", "filled"))
    unfilled, codes = sources_of(rough.folder / "bare"), sources_of(rough.folder / "filled")
    holes, _ = label(unfilled == 0, np.ones((3, 3)))
    small = [max(s.stop - s.start for s in box) <= PX for box in find_objects(holes)]
    wanted = np.array([False, *small])[holes]
    assert sum(small) > 50 and not all(small)
    np.testing.assert_array_equal(codes >= FROM_IMAGE, wanted)
    np.testing.assert_array_equal(after[:, ~wanted], before[:, ~wanted])
    np.testing.assert_array_equal(codes[~wanted], unfilled[~wanted])
    images, around = wanted & (codes < FROM_SURROUNDINGS), codes == FROM_SURROUNDINGS
    assert images.sum() > 100 and around.sum() > 100
    assert set(np.unique(codes[images]) - FROM_IMAGE) <= {1, 2, 3}
    # Figures: the hidden ground is the same, what is filled of it is told apart, images paint what they see.
    assert told["hidden_m2"] == bare["hidden_m2"] and "filled_m2" not in bare
    assert told["filled_m2"] == pytest.approx({"images": images.sum() / 16, "surroundings": around.sum() / 16})
    assert told["painted_m2"] == pytest.approx(bare["painted_m2"])
    record = json.loads((rough.folder / "filled" / "mosaic.run.json").read_text())
    assert record["product"]["filled_m2"] == told["filled_m2"] and record["settings"]["fill_hidden"] == PX
    # Grey values: nearer to the truth than the mean of the pixels beside the hole.
    truth, ring = truth_of(rough.folder / "filled" / "mosaic.tif"), np.zeros(codes.shape)
    for k in np.flatnonzero(small) + 1:
        beside = binary_dilation(holes == k, np.ones((3, 3))) & (unfilled > 0)
        ring[holes == k] = before[0][beside].mean()

    def rms(values: np.ndarray, at: np.ndarray) -> float:
        return float(np.sqrt(np.mean((values - truth)[at] ** 2)))

    assert rms(after[0], wanted) < 0.85 * rms(ring, wanted)
    assert rms(after[0], images) < rms(before[0], unfilled > 0)


def test_tiles_workers_and_sheets_leave_no_trace(rough: Block, capsys) -> None:  # type: ignore[no-untyped-def]
    photoplan = Here(capsys)
    option = ("--fill-hidden", PX)
    made(photoplan, rough, "one", *option, "--workers", "1")
    made(photoplan, rough, "four", *option, "--workers", "4")
    for name in ("mosaic.tif", "mosaic_sources.tif"):
        assert (rough.folder / "one" / name).read_bytes() == (rough.folder / "four" / name).read_bytes()
    made(photoplan, rough, "large", *option, "--tile", "256")
    codes = sources_of(rough.folder / "one")
    large = sources_of(rough.folder / "large")
    np.testing.assert_array_equal(codes >= FROM_IMAGE, large >= FROM_IMAGE)
    assert np.mean((codes != large)[codes >= FROM_IMAGE]) < 0.01
    same = codes == large
    off = np.abs(
        read(rough.folder / "one" / "mosaic.tif")[0].astype(int) - read(rough.folder / "large" / "mosaic.tif")[0]
    )
    assert off[same].max() <= 1
    # A line across the middle of holes: what lies beyond it decides, but is not painted.
    left, bottom, right, top = BOUNDS
    line = shapely.Polygon([(left, bottom), (right - 20.03, bottom), (left + 20.04, top), (left, top)])
    rest = shapely.box(*BOUNDS).difference(line)
    names = {"name": np.array(["a", "b"], object)}
    write_geopackage(rough.folder / "sheets.gpkg", [VectorLayer("sheets", "Polygon", [line, rest], names)], CRS)
    made(photoplan, rough, "drawn", *option, "--sheets", rough.folder / "sheets.gpkg")
    with rasterio.open(rough.folder / "one" / "mosaic_sources.tif") as whole:
        for name in "ab":
            with rasterio.open(rough.folder / "drawn" / f"mosaic_{name}_sources.tif") as sheet:
                got, at = sheet.read(1), whole.window(*sheet.bounds)
                want = whole.read(1, window=at)
            x, y = sheet.xy(*np.mgrid[: sheet.height, : sheet.width].reshape(2, -1))
            mine = shapely.contains_xy(line if name == "a" else rest, x, y).reshape(got.shape)
            np.testing.assert_array_equal((got >= FROM_IMAGE)[mine], (want >= FROM_IMAGE)[mine])
            assert np.mean((got != want)[mine & (want >= FROM_IMAGE)]) < 0.01 and not got[~mine].any()


def test_orthophotos_and_single_objects(rough: Block, capsys) -> None:  # type: ignore[no-untyped-def]
    photoplan = Here(capsys)
    ortho = ("--images", "two", "--true")
    bare = made(photoplan, rough, "bare", *ortho, what="ortho")
    told = made(photoplan, rough, "ortho", *ortho, "--fill-hidden", PX, what="ortho")
    codes = sources_of(rough.folder / "ortho", "two_ortho")
    before, after = (read(rough.folder / name / "two_ortho.tif")[0] for name in ("bare", "ortho"))
    filled = codes >= FROM_IMAGE
    assert filled.sum() > 1000 and set(np.unique(codes)) <= {0, 1, FROM_IMAGE + 1, FROM_SURROUNDINGS}
    np.testing.assert_array_equal(after[~filled], before[~filled])
    assert not before[filled].any() and after[filled].all()
    assert (
        sum(told["filled_m2"].values()) == pytest.approx(filled.sum() / 16) and told["hidden_m2"] == bare["hidden_m2"]
    )
    # A sheet of 20 m at the level of the ground: rough ground hides parts of it.
    corners = np.array([(-12, -12), (12, -12), (12, 12), (-12, 12)]) + np.array([X0, Y0])
    sheet = shapely.Polygon(np.c_[corners, np.full(4, GROUND)])
    names = {"name": np.array(["court"], object)}
    write_geopackage(rough.folder / "court.gpkg", [VectorLayer("court", "Polygon Z", [sheet], names)], CRS)
    said = photoplan("object", rough.project, rough.folder / "court.gpkg", "--height-system", "same", *OPTIONS,
                     "-o", rough.folder / "court", "--fill-hidden", PX)  # fmt: skip
    assert said.code == 0, said.err
    codes = sources_of(rough.folder / "court", "court_object")
    assert (codes >= FROM_IMAGE).sum() > 20
    assert sum(json.loads(said.out)["products"][0]["filled_m2"].values()) == (codes >= FROM_IMAGE).sum() / 16


def test_filled_pixels_have_no_accuracy_and_no_region(rough: Block, capsys) -> None:  # type: ignore[no-untyped-def]
    photoplan = Here(capsys)
    edit(rough.project, "[terrain]", "[terrain]\nsigma = 0.5")
    for name in NAMES:
        stated = f'name = "{name}"\nsigma_center = [0.05, 0.05, 0.05]\nsigma_angles = [0.0, 0.0, 0.0]'
        edit(rough.project, f'name = "{name}"', stated)
    told = made(photoplan, rough, "filled", "--fill-hidden", PX, "--accuracy")
    codes, sigma = sources_of(rough.folder / "filled"), read(rough.folder / "filled" / "mosaic_accuracy.tif")[0]
    painted = (codes > 0) & (codes < FROM_IMAGE)
    assert np.isnan(sigma[codes >= FROM_IMAGE]).all() and np.isfinite(sigma[painted]).mean() > 0.95
    regions = photoplan("info", rough.folder / "filled" / "mosaic_seams.gpkg")
    assert str(FROM_SURROUNDINGS) not in regions.out
    assert sum(told["painted_m2"].values()) == pytest.approx(painted.sum() / 16)


def test_plans_keys_and_texts_know_of_it(rough: Block, capsys) -> None:  # type: ignore[no-untyped-def]
    photoplan = Here(capsys)
    option = ("--fill-hidden", PX)
    direct = made(photoplan, rough, "direct", *option)
    plan = rough.folder / "plan.gpkg"
    shown = photoplan("mosaic", rough.project, *OPTIONS[:-1], *option, "--plan", plan, "-o", rough.folder / "planned")
    assert shown.code == 0 and f"hidden holes up to {PX} px filled" in shown.out
    ran = photoplan("run", plan, "--no-quicklook")
    assert ran.code == 0 and "m² from images and" in ran.err
    for name in ("mosaic.tif", "mosaic_sources.tif"):
        assert (rough.folder / "direct" / name).read_bytes() == (rough.folder / "planned" / name).read_bytes()
    # Tiles that were filled up to another size are of no use.
    again = made(photoplan, rough, "direct", "--fill-hidden", 3, "--overwrite")
    assert 0 < sum(again["filled_m2"].values()) < sum(direct["filled_m2"].values())
    fresh = made(photoplan, rough, "fresh", "--fill-hidden", 3)
    assert fresh["filled_m2"] == again["filled_m2"]
    kept = made(photoplan, rough, "fresh", "--fill-hidden", 3, "--overwrite")
    assert kept["filled_m2"] == fresh["filled_m2"] and kept["resumed_tiles"] > 0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"fill_hidden": 33, "hidden": "nodata"}, "0 to 32"),
        ({"fill_hidden": -1, "hidden": "nodata"}, "0 to 32"),
        ({"fill_hidden": 2.5, "hidden": "nodata"}, "whole number"),
        ({"fill_hidden": True, "hidden": "nodata"}, "whole number"),
        ({"fill_hidden": 4}, "requires `hidden` nodata"),
        ({"fill_hidden": 4, "hidden": "mark"}, "found mark"),
        ({"fill_hidden": 4, "method": "direct"}, "found direct"),
    ],
)
def test_what_cannot_be_filled_is_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        OrthoSettings(**settings)
