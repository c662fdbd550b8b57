"""`restore = FILTER` in a project: the pixels that `photoplan restore` writes, on the way into products."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.small_block import Block, texture, write_image
from tools.thinned import some

from photoplan.errors import InputError, UsageError
from photoplan.io.project.file import load_project, project_text
from photoplan.products.check import check_project
from photoplan.products.orthophoto.execution import Run, execute
from photoplan.products.orthophoto.plan import plan_orthophotos
from photoplan.products.restore import RestoreRequest, restore_images
from photoplan.project import scene as scenes
from photoplan.project.scene import input_files, open_scene
from photoplan.project.steps import save_filter
from photoplan.quality.restoration.restorer import FilterKernel, RestorationFilter


def sharpening(size: tuple[int, int] = (200, 150)) -> RestorationFilter:
    """Four kernels in the field, stronger towards the right."""
    kernels = []
    for col in (20.0, 180.0):
        for row in (10.0, 140.0):
            values = np.full((3, 5), -0.04 - col / 4000)
            values[1, 2] += 1 - values.sum()
            kernels.append(FilterKernel(values, (col, row)))
    return RestorationFilter(tuple(kernels), size, "sharper to the right")


@pytest.fixture
def filter_file(small: Block) -> Path:
    return save_filter(small.folder / "sharper.toml", sharpening())


def add_to_image(small: Block, entry: str, image: str = "one") -> None:
    text = small.project.read_text()
    line = f'name = "{image}"\n'
    assert text.count(line) == 1
    small.project.write_text(text.replace(line, line + entry + "\n"))


def add_to_camera(small: Block, entry: str) -> None:
    text = small.project.read_text()
    assert text.count("lens = ") == 1
    small.project.write_text(text.replace("lens = ", f"{entry}\nlens = "))


def ortho(small: Block, folder: Path, image: str = "one") -> Path:
    plan = plan_orthophotos(load_project(small.project), [image], resolution=1.5, tile=128)
    execute(plan, folder, Run(quicklook=False))
    return folder / f"{image}_ortho.tif"


def pixels_of(path: Path) -> tuple[bytes, bytes]:
    with rasterio.open(path) as file:
        return file.read().tobytes(), file.dataset_mask().tobytes()


def spoil(small: Block, kind: str) -> None:
    """Make the first image of another kind."""
    pixels = texture(seed=0)
    bad = np.zeros((150, 200), bool)
    bad[60:80, 90:130] = True
    if kind == "nodata":
        pixels[:, bad] = 0
        write_image(small.images[0], pixels, nodata=0)
    elif kind == "float32":
        values = pixels.astype(np.float32) / 255
        values[:, bad] = np.nan
        write_image(small.images[0], values)
    elif kind == "mask":
        write_image(small.images[0], pixels)
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(small.images[0], "r+") as file:
            file.write_mask(~bad)
    elif kind == "contrast":
        # Black beside white: the filter reaches the nodata value of the products, and beyond both ends.
        write_image(small.images[0], np.where(pixels > 127, 250, 0).astype(np.uint8), nodata=7)


@pytest.mark.parametrize(
    ("kind", "light"),
    some(
        [
            ("plain", "srgb"),
            ("nodata", "linear"),
            ("mask", "linear"),
            ("float32", "linear"),
            ("contrast", "linear"),
        ],
        0,
        4,
    ),
)
def test_an_orthophoto_with_the_entry_is_that_of_the_restored_image(
    small: Block, filter_file: Path, tmp_path: Path, kind: str, light: str
) -> None:
    """Byte for byte, whichever way the image says what is invalid."""
    spoil(small, kind)
    request = RestoreRequest((small.images[0],), filter_file, tmp_path / "restored", linearisation=light)
    restored = restore_images(request).images[0].path
    before = small.project.read_text()
    add_to_image(small, f'restore = {{ filter = "sharper.toml", linearisation = "{light}" }}')
    with_entry = ortho(small, tmp_path / "entry")
    small.project.write_text(before.replace("images/one.tif", str(restored)))
    of_restored = ortho(small, tmp_path / "file")
    assert pixels_of(with_entry) == pixels_of(of_restored)
    if kind == "plain":
        small.project.write_text(before)
        assert pixels_of(ortho(small, tmp_path / "plain")) != pixels_of(with_entry)


def test_the_entry_of_an_image_goes_before_that_of_its_camera(small: Block, filter_file: Path, tmp_path: Path) -> None:
    other = save_filter(small.folder / "other.toml", RestorationFilter((FilterKernel(np.full((1, 3), 1 / 3)),)))
    add_to_camera(small, 'restore = "sharper.toml"')
    add_to_image(small, 'restore = "other.toml"', "two")
    project = load_project(small.project)
    assert [project.restoration(image).filter for image in project.images] == [
        "other.toml" if image.name == "two" else "sharper.toml" for image in project.images
    ]
    assert {filter_file, other} < set(input_files(project))
    assert load_project_text(project, small) == project


def load_project_text(project, small: Block):
    """The project written as text and read again."""
    path = small.folder / "again.toml"
    path.write_text(project_text(project))
    return load_project(path)


def test_the_record_and_the_check_name_the_filter(small: Block, filter_file: Path, tmp_path: Path) -> None:
    add_to_image(small, 'restore = "sharper.toml"')
    path = ortho(small, tmp_path / "products")
    record = json.loads(path.with_name("one_ortho.run.json").read_text())
    assert filter_file.resolve() in [(path.parent / each["path"]).resolve() for each in record["inputs"]]
    assert "sharper to the right" in record["images"][0]["restored"]
    checked = {each.image: each.notes for each in check_project(load_project(small.project)).images}
    gain = sharpening().noise_gain
    assert f'restored with the filter "sharper to the right", 5 × 3; noise grows {gain:.3g} times' in checked["one"][0]
    assert checked["two"] == ()


def test_a_filter_that_changes_makes_another_product(small: Block, filter_file: Path) -> None:
    add_to_image(small, 'restore = "sharper.toml"')
    project = load_project(small.project)
    scene = open_scene(project, "one")
    before = scene.address.facts
    save_filter(filter_file, RestorationFilter((FilterKernel(np.full((1, 3), 1 / 3)),)), overwrite=True)
    # Another process, which has not opened it yet, would not take it.
    scenes._open.cache_clear()
    with pytest.raises(InputError, match=r"sharper.toml: has changed since the run was planned"):
        scene.address.open()
    assert open_scene(project, "one").address.facts != before


def test_a_product_does_not_replace_the_filter(small: Block, filter_file: Path, tmp_path: Path) -> None:
    add_to_image(small, 'restore = "sharper.toml"')
    folder = tmp_path / "products"
    folder.mkdir()
    (folder / "one_ortho.tif").symlink_to(filter_file)
    plan = plan_orthophotos(load_project(small.project), ["one"], resolution=1.0)
    with pytest.raises(UsageError, match="the output is an input of the project"):
        execute(plan, folder, Run(overwrite=True, quicklook=False))


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ('restore = "missing.toml"', "missing.toml"),
        ('restore = "dem.tif"', "dem.tif"),
        ('restore = "https://example.org/f.toml"', "https://example.org/f.toml"),
        ("restore = 3", "restore"),
        ('restore = { filter = "sharper.toml", linearisation = "gamma.txt" }', "gamma.txt"),
        ('restore = { filter = "sharper.toml", strength = 2 }', "strength"),
    ],
)
def test_an_entry_that_cannot_be_used(small: Block, filter_file: Path, entry: str, message: str) -> None:
    add_to_image(small, entry)
    with pytest.raises(InputError, match=message):
        open_scene(load_project(small.project), "one")


def test_a_filter_for_another_size_is_refused_with_the_images_name(small: Block, tmp_path: Path) -> None:
    save_filter(small.folder / "wide.toml", sharpening((4000, 3000)))
    add_to_image(small, 'restore = "wide.toml"')
    with pytest.raises(InputError, match=r"one\.tif: the filter has places in images of 4000 × 3000 pixels"):
        open_scene(load_project(small.project), "one")
