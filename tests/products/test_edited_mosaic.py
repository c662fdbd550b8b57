"""A mosaic in one file that is made again computes the tiles that change, and no other."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest
import rasterio
from products.test_sheets import BOUNDS, regions
from tools.command import Here, inside
from tools.forked import Mishap, forked
from tools.small_block import Block

OPTIONS = ("--resolution", 1, "--tile", 128, "--no-quicklook", "--feather", 20, "--sources", "--bounds", *BOUNDS)


class Mosaic:
    """One command, in folders of its own."""

    def __init__(self, block: Block, capsys: pytest.CaptureFixture[str]) -> None:
        self.block, self._here, self.seams = block, Here(capsys), block.folder / "drawn.gpkg"

    def draw(self, right: float) -> None:
        self.seams.unlink(missing_ok=True)
        regions(self.seams, right)

    def resumed(self, folder: str, *more: object) -> int:
        """Tiles that were not computed, of six."""
        words = (*OPTIONS, "--seams", self.seams, "--output", self.block.folder / folder, "--json", *more)
        said = self._here("mosaic", self.block.project, *words)
        assert said.code == 0, said.err
        (made,) = json.loads(said.out)["products"]
        assert made["tiles"] == 6
        return int(made["resumed_tiles"])

    def files(self, folder: str) -> tuple[bytes, bytes]:
        """Picture and sources."""
        first, second = (self.block.folder / folder / name for name in ("mosaic.tif", "mosaic_sources.tif"))
        return first.read_bytes(), second.read_bytes()


def test_edited_region_computes_its_tiles(small: Block, capsys: pytest.CaptureFixture[str]) -> None:
    mosaic = Mosaic(small, capsys)
    mosaic.draw(500_380)
    assert mosaic.resumed("one") == 0
    first = mosaic.files("one")
    mosaic.draw(500_360)
    # Columns of tiles begin at 200, 328 and 456 m: the edge moves in the middle one, in both rows.
    assert mosaic.resumed("one", "--overwrite") == 4
    assert mosaic.resumed("fresh") == 0
    assert mosaic.files("one") == mosaic.files("fresh") != first
    # What changes nothing is no reason to compute, and to draw the same another time no change.
    mosaic.draw(500_360)
    assert mosaic.resumed("one", "--overwrite") == 6 and mosaic.files("one") == mosaic.files("fresh")


@pytest.mark.slow
def test_edit_is_felt_as_far_as_images_pass_into_each_other(small: Block, capsys: pytest.CaptureFixture[str]) -> None:
    mosaic = Mosaic(small, capsys)
    mosaic.draw(500_440)
    mosaic.resumed("one")
    mosaic.draw(500_450)
    assert mosaic.resumed("one", "--overwrite") == 2 and mosaic.resumed("fresh") == 0
    assert mosaic.files("one") == mosaic.files("fresh")


def test_moved_image_computes_what_it_can_paint(small: Block, capsys: pytest.CaptureFixture[str]) -> None:
    mosaic = Mosaic(small, capsys)
    mosaic.draw(500_380)
    mosaic.resumed("one")
    text = small.project.read_text()
    assert "500300.0" in text
    small.project.write_text(text.replace("500300.0", "500299.5", 1))
    kept = mosaic.resumed("one", "--overwrite")
    assert 0 <= kept < 6 and mosaic.resumed("fresh") == 0
    assert mosaic.files("one") == mosaic.files("fresh")


def test_file_that_somebody_changed_is_not_taken_over(small: Block, capsys: pytest.CaptureFixture[str]) -> None:
    mosaic = Mosaic(small, capsys)
    mosaic.draw(500_380)
    mosaic.resumed("one")
    first, path = mosaic.files("one"), small.folder / "one" / "mosaic.tif"
    with rasterio.open(path, "r+", IGNORE_COG_LAYOUT_BREAK="YES") as file:
        pixels = file.read(1)
        assert pixels[20, 20] > 0
        file.write(np.full((1, 1, 1), 255 - pixels[20, 20], np.uint8), [1], window=((20, 21), (20, 21)))
    assert mosaic.resumed("one", "--overwrite") == 5 and mosaic.files("one") == first
    record = small.folder / "one" / "mosaic.run.json"
    told = json.loads(record.read_text())
    for damaged in ("AAAA" + told["tiles"]["mosaic.tif"], "", 7):
        record.write_text(json.dumps({**told, "tiles": {**told["tiles"], "mosaic.tif": damaged}}))
        assert mosaic.resumed("one", "--overwrite") == 0 and mosaic.files("one") == first
    path.write_bytes(first[0][: len(first[0]) // 2])
    assert mosaic.resumed("one", "--overwrite") < 6 and mosaic.files("one") == first


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="needs fork and signals")
def test_fault_03_killed_while_an_edit_is_computed(small: Block, capsys: pytest.CaptureFixture[str]) -> None:
    """The older mosaic stays; the same command computes only what is left of the edit."""
    mosaic = Mosaic(small, capsys)
    mosaic.draw(500_380)
    mosaic.resumed("one")
    first = mosaic.files("one")
    mosaic.draw(500_360)
    out = small.folder / "one"
    words = ["mosaic", small.project, *OPTIONS, "--seams", mosaic.seams, "--output", out, "--overwrite", "--workers", 1]
    killed = forked(words, small.folder / "said", Mishap(end_at=1))
    assert killed.code == -9 and len(killed.tasks) == 1 and mosaic.files("one") == first
    again = forked(words, small.folder / "said")
    assert again.code == 0 and "5 of 6 tiles are finished already" in again.err, again.err
    assert len(again.tasks) == 1 and again.tasks != killed.tasks
    assert mosaic.resumed("fresh") == 0 and mosaic.files("one") == mosaic.files("fresh") != first
    assert not [path for path in out.iterdir() if path.name.startswith(".")]


@pytest.mark.slow
def test_masks_and_losses(small: Block, capsys: pytest.CaptureFixture[str]) -> None:
    """Pixels under a mask are the same again; those of JPEG are not, and are computed."""
    mosaic = Mosaic(small, capsys)
    mosaic.draw(500_380)
    for folder, kept, words in (("mask", 6, ("--nodata", "mask")), ("jpeg", 0, ("--compress", "jpeg"))):
        mosaic.resumed(folder, *words)
        first = mosaic.files(folder)
        assert mosaic.resumed(folder, "--overwrite", *words) == kept and mosaic.files(folder) == first


def test_keys_of_tiles_know_what_decides_them(small: Block) -> None:
    from photoplan import load_project, plan_mosaic
    from photoplan.products.orthophoto.plan import tile_keys
    from photoplan.requests.ortho import Choice

    def keys(**choice: object) -> list[str | None]:
        project, chosen = load_project(small.project), Choice(**choice)
        plan = plan_mosaic(project, resolution=1.0, tile=128, bounds=BOUNDS, choice=chosen)
        (product,) = plan.products
        found = tile_keys(product.address(plan.project), product.plan, plan.settings)
        return [found(index) for index in range(7)]

    usual = keys()
    assert usual[6] is None and len({each for each in usual[:6] if each}) == 6 - usual[:6].count(None)
    for other in ({"feather": 10.0}, {"prefer": ("two",)}):
        assert not set(keys(**other)) & {each for each in usual if each}
    assert keys(name="other") == usual


@pytest.mark.parametrize(("corner", "told"), [((0.0, 0.0), True), (BOUNDS[:2], False)])
def test_regions_of_another_place_are_told(small: Block, corner: tuple[float, float], told: bool) -> None:
    x, y = map(float, corner)
    place = [[x, y], [x + 90, y], [x + 90, y + 90], [x, y + 90], [x, y]]
    feature = {
        "type": "Feature",
        "properties": {"image": "one"},
        "geometry": {"type": "Polygon", "coordinates": [place]},
    }
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32633"}}
    drawn = small.folder / "drawn.geojson"
    drawn.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": [feature]}))
    said = inside("mosaic", small.project, "--resolution", 6, "--bounds", *BOUNDS, "--seams", drawn, "--dry-run", "-q")
    assert said.code == 0 and ("warning: " in said.err and "none of its regions lies in the mosaic" in said.err) == told
