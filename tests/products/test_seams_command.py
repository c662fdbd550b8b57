"""`photoplan seams` of a small block: regions that `mosaic --seams` takes, kept ones, messages."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
import rasterio
import rasterio.features
import shapely
from scipy.ndimage import gaussian_filter, map_coordinates
from tools.command import Here
from tools.small_block import CRS, NAMES, SIZE, X0, Y0, Z0, Block, make_project, write_image, write_terrain

from photoplan.io.disk import FileLock, lock_of
from photoplan.products import seams as run
from photoplan.products.balance import shown

AWAY = (-60.0, 0.0, 60.0)
NOISE = gaussian_filter(np.random.default_rng(5).normal(size=(3, 420, 420)), (0, 3, 3))
GROUND = 120 + 35 * NOISE / NOISE.std()


@pytest.fixture
def block(small: Block) -> Block:
    """Three vertical images of one level ground, of different brightness."""
    col, row = np.meshgrid(np.arange(SIZE[0]) - (SIZE[0] - 1) / 2, np.arange(SIZE[1]) - (SIZE[1] - 1) / 2)
    for path, gain, dx in zip(small.images, (1.0, 0.7, 1.2), AWAY):
        seen = np.stack([map_coordinates(band, [210 + row, 210 + col + dx / 1.5], order=3) for band in GROUND])
        write_image(path, np.clip(np.rint(gain * seen), 1, 255).astype(np.uint8))
    lines = [f"{name},{X0 + dx},{Y0},{Z0},0,0,0" for name, dx in zip(NAMES, AWAY)]
    small.orientation.write_text("\n".join(["name,x,y,z,omega,phi,kappa", *lines, ""]))
    write_terrain(small.terrain, np.full((60, 64), 100.0))
    make_project(small)
    return small


@pytest.mark.drawn
def test_regions_are_what_the_mosaic_paints(block: Block, capsys: pytest.CaptureFixture[str]) -> None:
    photoplan = Here(capsys)
    said = photoplan("seams", block.project, "--resolution", 3, "--json", "-q")
    assert said.code == 0, said.err
    found = json.loads(said.out)
    assert found["resolution"] == 3 and found["found"] <= found["halfway"]
    path = block.folder / "products" / "seams.gpkg"
    assert path.is_file() and path.with_suffix(".png").is_file() and path.with_suffix(".run.json").is_file()
    meta, _, geometry, columns = pyogrio.raw.read(path)
    regions = dict(zip(columns[meta["fields"].tolist().index("image")], shapely.from_wkb(geometry)))
    assert len(regions) > 1 and set(regions) <= set(NAMES)
    said = photoplan("mosaic", block.project, "--resolution", 3, "--seams", path, "--sources", "--no-quicklook")
    assert said.code == 0, said.err
    with rasterio.open(block.folder / "products" / "mosaic_sources.tif") as file:
        sources, T = file.read(1), file.transform
    record = json.loads((block.folder / "products" / "mosaic.run.json").read_text())
    order = [each["name"] for each in record["images"]]
    wanted = [(region, order.index(name) + 1) for name, region in regions.items()]
    drawn = rasterio.features.rasterize(wanted, sources.shape, transform=T, dtype="uint16")
    both = (drawn > 0) & (sources > 0)
    # Kernels keep images three pixels away from their borders.
    assert both.mean() > 0.5 and (drawn == sources)[both].mean() > 0.97


def test_kept_regions_stay(block: Block, capsys: pytest.CaptureFixture[str]) -> None:
    photoplan = Here(capsys)
    mine = shapely.box(X0 - 20, Y0 - 20, X0 + 20, Y0 + 20)
    kept = block.folder / "mine.geojson"
    shape = {"type": "Feature", "properties": {"image": NAMES[0]}, "geometry": json.loads(shapely.to_geojson(mine))}
    crs = {"type": "name", "properties": {"name": CRS}}
    kept.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": [shape]}))
    said = photoplan("seams", block.project, "--resolution", 4, "--keep", kept, "--no-picture", "-q")
    assert said.code == 0, said.err
    meta, _, geometry, columns = pyogrio.raw.read(block.folder / "products" / "seams.gpkg")
    regions = dict(zip(columns[meta["fields"].tolist().index("image")], shapely.from_wkb(geometry)))
    assert regions[NAMES[0]].buffer(0.01).contains(mine.buffer(-4))


def test_dry_run_existing_files_and_single_images(block: Block, capsys: pytest.CaptureFixture[str]) -> None:
    photoplan = Here(capsys)
    said = photoplan("seams", block.project, "--dry-run")
    assert said.code == 0 and "3 images on" in said.out
    path = block.folder / "products" / "seams.gpkg"
    assert not path.exists()
    assert photoplan("seams", block.project, "--resolution", 6, "--no-picture", "-q").code == 0
    before = path.read_bytes()
    said = photoplan("seams", block.project, "--resolution", 6, "-q")
    assert said.code == 2 and "exists already" in said.err and path.read_bytes() == before
    said = photoplan("seams", block.project, "--images", NAMES[0], "-o", block.folder / "one.gpkg")
    assert said.code == 3 and "two at least" in said.err
    there = sorted(block.folder.rglob("*"))
    said = photoplan("seams", block.project, "-o", block.folder / "seams.tif", "--dry-run")
    assert said.code == 2 and ".gpkg" in said.err and sorted(block.folder.rglob("*")) == there


def regions_of(path: Path) -> dict[str, bytes]:
    meta, _, geometry, columns = pyogrio.raw.read(path)
    return dict(zip(columns[meta["fields"].tolist().index("image")], geometry))


def test_odd_images_are_named(block: Block, capsys: pytest.CaptureFixture[str]) -> None:
    photoplan = Here(capsys)
    words = ("seams", block.project, "--resolution", 4, "--no-picture")
    write_image(block.images[2], np.zeros((3, *SIZE[::-1]), np.uint8))
    said = photoplan(*words)
    assert said.code == 0 and "left out: 'three' has the grey value 0 everywhere; look at its file" in said.err
    assert set(regions_of(block.folder / "products" / "seams.gpkg")) == {"one", "two"}
    text = block.project.read_text()
    block.project.write_text(text.replace(f"{X0 + AWAY[0]:.1f}", f"{X0 - 400:.1f}"))
    said = photoplan(*words, "--overwrite")
    assert said.code == 0 and "no overlap with other images: 'one'; if it should have one" in said.err
    assert "2 of 3 images joined at 4 m · no seams" in said.out
    write_image(block.images[2], np.full((3, *SIZE[::-1]), 9, np.uint16))
    for verb in ("seams", "mosaic"):
        said = photoplan(verb, *words[1:4], "--overwrite")
        assert said.code == 3 and "'three' has 3 bands of uint16" in said.err and "choose among them" in said.err


def test_fault_22_an_image_owns_nothing_where_it_has_no_data(block: Block, capsys: pytest.CaptureFixture[str]) -> None:
    """A hole of nodata in the middle of an image: another is there."""
    photoplan = Here(capsys)
    middle = shapely.box(X0 - 66, Y0 - 6, X0 - 54, Y0 + 6)
    with rasterio.open(block.images[0]) as file:
        values = file.read()
    values[:, SIZE[1] // 2 - 8 : SIZE[1] // 2 + 8, SIZE[0] // 2 - 8 : SIZE[0] // 2 + 8] = 0
    write_image(block.images[0], values, nodata=0)
    said = photoplan("seams", block.project, "--resolution", 3, "--no-picture", "-q")
    assert said.code == 0, said.err
    kept = regions_of(block.folder / "products" / "seams.gpkg")
    found = {name: shapely.from_wkb(each) for name, each in kept.items()}
    assert not found["one"].intersects(middle) and shapely.union_all(list(found.values())).contains(middle)


@pytest.mark.slow
def test_fault_26_more_workers_and_a_second_run(block: Block, capsys: pytest.CaptureFixture[str]) -> None:
    photoplan, words = Here(capsys), ("seams", block.project, "--resolution", 4, "--no-picture", "-q")
    one, more = block.folder / "one.gpkg", block.folder / "more.gpkg"
    assert photoplan(*words, "-o", one, "--workers", 1).code == photoplan(*words, "-o", more, "--workers", 3).code == 0
    assert regions_of(one) == regions_of(more)
    with FileLock(lock_of(block.folder / "third.gpkg")):
        said = photoplan(*words, "-o", block.folder / "third.gpkg")
    assert said.code == 2 and "another run" in said.err and not (block.folder / "third.gpkg").exists()


def test_fault_05_an_image_that_cannot_be_read(
    block: Block, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once: tried again; always: exit 4 with a reason, no file, nothing left beside."""
    photoplan, words = Here(capsys), ("seams", block.project, "--resolution", 4, "--no-picture", "-q")
    fails = [2]

    def broken(*given: Any) -> Any:
        fails[0] -= 1
        if fails[0] == 0 or fails[0] < -100:
            raise OSError("the disk has gone")
        return shown(*given)

    monkeypatch.setattr(run, "shown", broken)
    assert photoplan(*words).code == 0
    path, fails[0] = block.folder / "always.gpkg", -200
    said = photoplan(*words, "-o", path)
    assert said.code == 4 and "the disk has gone" in said.err and "nothing is written" in said.err
    assert not path.exists() and not list(block.folder.glob(".*"))
