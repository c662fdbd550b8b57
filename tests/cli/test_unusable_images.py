"""Blocks in which files of some images cannot be used: these are left out and listed, the rest is made, exit code 4."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import rasterio
from tools.command import Here
from tools.small_block import Block, texture, write_image

#: What makes a file unusable when it is opened, and when its pixels are read.
OPENED = {"text": b"no image at all\n", "empty": b"", "header": b"II*\0 cut off", "gone": None}
FAULTS = [*OPENED, "half", "pixels", "jpeg"]


def spoil(path: Path, how: str) -> None:
    """Make an image of a block unusable."""
    if how == "gone":
        path.unlink()
    elif how in OPENED:
        path.write_bytes(OPENED[how] or b"")
    elif how == "half":
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    elif how == "pixels":
        write_image(path, texture(), tiled=True, blockxsize=64, blockysize=64, compress="deflate", interleave="band")
        content = bytearray(path.read_bytes())
        with rasterio.open(path) as file:
            offset = int(file.get_tag_item("BLOCK_OFFSET_1_1", "TIFF", bidx=2))
        content[offset : offset + 8] = b"\xff" * 8
        path.write_bytes(content)
    else:
        made = path.with_suffix(".jpg")
        with (
            rasterio.open(path) as file,
            rasterio.open(
                made, "w", driver="JPEG", width=file.width, height=file.height, count=3, dtype="uint8"
            ) as out,
        ):
            out.write(file.read())
        raw = made.read_bytes()
        made.unlink()
        path.write_bytes(raw[: len(raw) * 2 // 3])


COMMANDS = {
    "ortho": ("ortho", "--resolution", 3),
    "mosaic": ("mosaic", "--resolution", 3, "--sources"),
    "balance": ("balance",),
    "seams": ("seams",),
    "surface": ("surface", "--start", 100, "--resolution", 12, "--force"),
    "check": ("check",),
}


@pytest.mark.parametrize(
    ("verb", "how"),
    [
        *(("ortho", how) for how in FAULTS),
        *(("mosaic", how) for how in ("text", "pixels")),
        *((verb, how) for verb in ("balance", "seams") for how in ("gone", "pixels")),
        ("surface", "half"),
        ("check", "empty"),
        *(
            pytest.param(verb, how, marks=pytest.mark.slow)
            for verb in ("mosaic", "balance", "seams", "surface")
            for how in FAULTS
        ),
    ],
)
def test_fault_08_one_unusable_image_of_many(photoplan: Here, small: Block, verb: str, how: str) -> None:
    spoil(small.images[1], how)
    words = COMMANDS[verb]
    said = photoplan(words[0], small.project, *words[1:])
    assert said.code == 4, said
    assert "finished, but 1 of 3 images cannot be used and are left out:\n  two: cannot be used: " in said.err
    assert str(small.images[1]) in said.err
    if verb != "check":
        assert re.search(r"left out: two: cannot be used", said.err), said.err
    made = {path.name for path in small.folder.rglob("*") if path.is_file()}
    wanted = {
        "ortho": {"one_ortho.tif", "three_ortho.tif", "one_ortho.run.json", "ortho_overview.png"},
        "mosaic": {"mosaic.tif", "mosaic_seams.gpkg"},
        "balance": {"one.toml", "three.toml", "overlaps.csv"},
        "seams": {"seams.gpkg"},
        "surface": {"surface.tif", "surface_sigma.tif"},
        "check": set(),
    }[verb]
    assert wanted <= made
    assert not [name for name in made if name.startswith(".")], made
    if verb == "ortho":
        assert "two_ortho.tif" not in made
        assert len(said.out.splitlines()) == 2, "each product is printed once"
        again = photoplan(words[0], small.project, *words[1:])
        if how in ("pixels", "jpeg"):
            assert (again.code, again.out) == (4, said.out), again
        else:
            assert again.code == 2 and "exist" in again.err, again
    if verb == "mosaic":
        record = json.loads((small.folder / "products" / "mosaic.run.json").read_text())
        assert record["product"]["images"] == ["one", "three"]


def test_fault_08_no_image_can_be_used(photoplan: Here, small: Block) -> None:
    for image, how in zip(small.images, ("text", "half", "gone"), strict=False):
        spoil(image, how)
    for verb, words in COMMANDS.items():
        if verb != "check":
            said = photoplan(words[0], small.project, *words[1:])
            assert said.code == 3, said
            assert str(small.images[0].parent) in said.err
    assert not (small.folder / "products").exists() or not list((small.folder / "products").glob("*.*"))


def test_fault_08_an_unusable_image_that_is_asked_for_alone(photoplan: Here, small: Block) -> None:
    spoil(small.images[1], "pixels")
    for verb in ("ortho", "mosaic"):
        said = photoplan(verb, small.project, "--resolution", 3, "--images", "two")
        assert said.code == 3 and str(small.images[1]) in said.err, said
    said = photoplan("ortho", small.project, "--resolution", 3, "--images", "one,three", "--json")
    assert said.code == 0 and len(json.loads(said.out)["products"]) == 2


def test_fault_08_what_all_images_share_is_no_fault_of_one(photoplan: Here, small: Block) -> None:
    small.terrain.write_bytes(b"no heights")
    said = photoplan("ortho", small.project, "--resolution", 3)
    assert said.code == 3 and str(small.terrain) in said.err, said
    assert "left out" not in said.err


def test_check_lists_what_it_leaves_out(photoplan: Here, small: Block) -> None:
    spoil(small.images[1], "text")
    said = photoplan("check", small.project)
    assert said.code == 4 and "1 of 3 images cannot be used" in said.out and "left out: two: cannot be used" in said.out
    found = json.loads(photoplan("check", small.project, "--json").out)
    assert list(found["unusable"]) == ["two"] and [image["image"] for image in found["images"]] == ["one", "three"]
