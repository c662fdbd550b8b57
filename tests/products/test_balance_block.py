"""`photoplan balance` of a small block: tables are entered and applied by `ortho`; odd images are named."""

from __future__ import annotations

import json
import os
import signal
import tomllib
from pathlib import Path

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from rasterio.transform import from_origin
from scipy.ndimage import gaussian_filter, map_coordinates
from tools.command import Here
from tools.forked import Mishap, forked
from tools.small_block import CRS, NAMES, SIZE, X0, Y0, Z0, Block, make_project, write_image, write_terrain

from photoplan.io.disk import FileLock, lock_of
from photoplan.io.project.file import load_project
from photoplan.products.balance import BalanceRequest, balance_project

AWAY = (-60.0, 0.0, 60.0)
NOISE = gaussian_filter(np.random.default_rng(5).normal(size=(3, 420, 420)), (0, 6, 6))
GROUND = 120 + 35 * NOISE / NOISE.std()


def grey(name: str, light: NDArray[np.float64]) -> NDArray[np.float64]:
    """What an image makes of the ground (bands, rows, columns): exposure and haze, falling off to the corners."""
    col, row = np.meshgrid(np.arange(SIZE[0]) - (SIZE[0] - 1) / 2, np.arange(SIZE[1]) - (SIZE[1] - 1) / 2)
    fall = 1 - 0.25 * (col**2 + row**2) / (SIZE[0] ** 2 + SIZE[1] ** 2) * 4
    made = {"one": light, "two": 0.6 * light + 30, "three": 255 * (np.clip(light, 0, 255) / 255) ** 1.3}
    return np.asarray(made[name] * fall)


@pytest.fixture
def block(small: Block) -> Block:
    """Three vertical images of one level ground, each with its own colours."""
    col, row = np.meshgrid(np.arange(SIZE[0]) - (SIZE[0] - 1) / 2, np.arange(SIZE[1]) - (SIZE[1] - 1) / 2)
    for path, name, dx in zip(small.images, NAMES, AWAY):
        seen = np.stack([map_coordinates(band, [210 + row, 210 + col + dx / 1.5], order=3) for band in GROUND])
        write_image(path, np.clip(np.rint(grey(name, seen)), 1, 255).astype(np.uint8))
    lines = [f"{name},{X0 + dx},{Y0},{Z0},0,0,0" for name, dx in zip(NAMES, AWAY)]
    small.orientation.write_text("\n".join(["name,x,y,z,omega,phi,kappa", *lines, ""]))
    write_terrain(small.terrain, np.full((60, 64), 100.0))
    make_project(small)
    return small


def differences(block: Block, photoplan: Here, name: str) -> float:
    """Rms difference of orthophotos in their overlaps."""
    folder = block.folder / name
    words = ("ortho", block.project, "--resolution", 3, "--bounds", X0 - 60, Y0 - 90, X0 + 60, Y0 + 90)
    said = photoplan(*words, "--output", folder, "--no-quicklook")
    assert said.code == 0, said.err
    pixels = []
    for image in NAMES:
        with rasterio.open(folder / f"{image}_ortho.tif") as file:
            pixels.append(np.where(file.dataset_mask() > 0, file.read().astype(float), np.nan))
    return float(np.sqrt(np.nanmean((pixels[0] - pixels[1]) ** 2) + np.nanmean((pixels[2] - pixels[1]) ** 2)))


@pytest.mark.drawn
def test_tables_are_written_and_orthophotos_made_with_them(block: Block, capsys: pytest.CaptureFixture[str]) -> None:
    photoplan = Here(capsys)
    before = differences(block, photoplan, "before")
    dry = photoplan("balance", block.project, "--dry-run")
    assert dry.code == 0 and "3 images, compared on" in dry.out and not (block.folder / "balance").exists()
    said = photoplan("balance", block.project, "--resolution", 1.5)
    assert said.code == 0, said.err
    assert {path.name for path in (block.folder / "balance").iterdir()} == {
        *(f"{name}.toml" for name in NAMES), "overlaps.csv", "overlaps.run.json", "balance.png",
    }  # fmt: skip
    entries = {image.name: image.balance for image in load_project(block.project).images}
    assert entries == {name: f"balance/{name}.toml" for name in NAMES}
    after = differences(block, photoplan, "after")
    assert before > 20 and after < 3.5
    again = photoplan("balance", block.project, "--resolution", 1.5)
    assert again.code == 2 and "exists already" in again.err and "--overwrite" in again.err
    kept = {name: (block.folder / "balance" / f"{name}.toml").read_text() for name in NAMES}
    record = json.loads((block.folder / "balance" / "overlaps.run.json").read_text())
    assert np.mean(record["product"]["rms_after"]) < 3 < 15 < np.mean(record["product"]["rms_before"])
    said = photoplan("balance", block.project, "--resolution", 1.5, "--overwrite", "--json", "--no-picture")
    assert said.code == 0 and json.loads(said.out)["notes"] == []
    # Tables are found from the images as they are, not from what earlier tables made of them.
    assert kept == {name: (block.folder / "balance" / f"{name}.toml").read_text() for name in NAMES}
    other = block.folder / "balance" / "two.toml"
    other.write_text(kept["two"].replace("becomes = [", "becomes = [300, ", 1))
    broken = photoplan("ortho", block.project, "--resolution", 3, "--output", block.folder / "broken")
    assert broken.code == 3 and "two.toml" in broken.err


def test_the_reference_image_keeps_its_colours(block: Block) -> None:
    found = balance_project(BalanceRequest(block.project, reference_image="one", resolution=1.5))
    assert found.balanced is not None
    tone = found.balanced.tones[0][0]
    np.testing.assert_allclose(tone.becomes, tone.grey, atol=0.1)


def test_a_coarse_reference_gives_its_colours(block: Block, capsys: pytest.CaptureFixture[str]) -> None:
    """The ground itself, in means of 3 × 3 pixels: all images come near it."""
    photoplan, path = Here(capsys), block.folder / "mosaic.tif"
    coarse = np.rint(GROUND.reshape(3, 140, 3, 140, 3).mean(axis=(2, 4))).astype(np.uint8)
    left, top = X0 - 210.5 * 1.5, Y0 + 210.5 * 1.5
    write_image(path, coarse, crs=CRS, transform=from_origin(left, top, 4.5, 4.5))
    said = photoplan("balance", block.project, "--resolution", 1.5, "--reference", path, "--no-picture")
    assert said.code == 0, said.err
    differences(block, photoplan, "after")
    for image in NAMES:
        with rasterio.open(block.folder / "after" / f"{image}_ortho.tif") as file:
            grey = np.where(file.dataset_mask() > 0, file.read().astype(float), np.nan)
            col, row = np.meshgrid(np.arange(file.width), np.arange(file.height))
            X, Y = file.transform * (col + 0.5, row + 0.5)
        places = [210 - (Y - Y0) / 1.5, 210 + (X - X0) / 1.5]
        wanted = np.stack([map_coordinates(band, places, order=1) for band in GROUND])
        assert abs(np.nanmedian(grey - wanted)) < 1.5 and np.nanstd(grey - wanted) < 4
    wrong = write_image(block.folder / "grey.tif", coarse[:1], crs=CRS, transform=from_origin(left, top, 4.5, 4.5))
    said = photoplan("balance", block.project, "--reference", wrong, "--overwrite")
    assert said.code == 3 and "1 bands of uint8; a reference has those of the images, 3 of uint8" in said.err
    far = write_image(block.folder / "far.tif", coarse, crs=CRS, transform=from_origin(left + 9000, top, 4.5, 4.5))
    said = photoplan("balance", block.project, "--reference", far, "--overwrite")
    assert said.code == 3 and "shows nothing of the ground that the images show" in said.err
    said = photoplan("balance", block.project, "-o", path, "--overwrite")
    assert said.code == 2 and "give the name of a folder" in said.err
    both = photoplan("balance", block.project, "--reference", path, "--reference-image", "one", "--overwrite")
    assert both.code == 2 and "exclude each other; set one of them" in both.err


@pytest.mark.parametrize("dtype", [np.uint16, pytest.param(np.float32, marks=pytest.mark.slow)])
def test_types_with_more_than_bytes(block: Block, capsys: pytest.CaptureFixture[str], dtype: type) -> None:
    """The same images with grey values sixteen times as large: the same overlaps, sixteen times as large."""
    photoplan = Here(capsys)
    for path in block.images:
        with rasterio.open(path) as file:
            pixels = file.read()
        write_image(path, (pixels.astype(float) * 16).astype(dtype))
    before = differences(block, photoplan, "before")
    assert photoplan("balance", block.project, "--resolution", 1.5, "--no-picture").code == 0
    after = differences(block, photoplan, "after")
    assert before > 16 * 20 and after < 16 * 3.5
    with rasterio.open(block.folder / "after" / "one_ortho.tif") as file:
        assert file.dtypes[0] == np.dtype(dtype).name


def test_odd_images_are_named(block: Block, capsys: pytest.CaptureFixture[str]) -> None:
    photoplan = Here(capsys)
    write_image(block.images[2], np.zeros((3, *SIZE[::-1]), np.uint8))
    said = photoplan("balance", block.project, "--resolution", 1.5, "--no-picture")
    assert said.code == 0 and "left out: 'three' has the grey value 0 everywhere; look at its file" in said.err
    assert [image.balance is None for image in load_project(block.project).images] == [
        False,
        True,
        False,
    ]
    write_image(block.images[2], np.full((3, *SIZE[::-1]), 9, np.uint16))
    said = photoplan("balance", block.project, "--overwrite")
    assert said.code == 3 and "'three' has 3 bands of uint16" in said.err and "choose among them" in said.err


def test_an_image_without_overlap_is_named(block: Block, capsys: pytest.CaptureFixture[str]) -> None:
    text = block.project.read_text()
    far = text.replace(f"{X0 + AWAY[0]:.1f}", f"{X0 - 400:.1f}")
    assert far != text
    block.project.write_text(far)
    photoplan = Here(capsys)
    said = photoplan("balance", block.project, "--resolution", 1.5, "--no-picture")
    assert said.code == 0 and "no overlap with other images, so no tables: 'one'; they stay as they are" in said.err
    assert load_project(block.project).images[0].balance is None
    said = photoplan("balance", block.project, "--images", "one,two", "--overwrite")
    assert said.code == 3 and "no two of 2 images show enough of the same ground" in said.err
    said = photoplan("balance", block.project, "--reference-image", "one", "--overwrite", "--no-picture")
    assert said.code == 2 and "shows no ground that another image shows" in said.err


def tables(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("*.toml")}


def test_fault_26_more_workers_and_a_second_run(block: Block, capsys: pytest.CaptureFixture[str]) -> None:
    photoplan, words = Here(capsys), ("balance", block.project, "--resolution", 3, "--no-picture", "-q")
    folders = [block.folder / "one", block.folder / "more"]
    for folder, workers in zip(folders, (1, 3)):
        said = photoplan(*words, "--workers", workers, "-o", folder)
        assert said.code == 0, said.err
    assert tables(folders[0]) == tables(folders[1]) != {}
    project = block.project.read_bytes()
    with FileLock(lock_of(folders[0] / "overlaps.csv")):
        said = photoplan(*words, "-o", folders[0], "--overwrite")
    assert said.code == 2 and "another run" in said.err and block.project.read_bytes() == project


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize(("sign", "code"), [(signal.SIGKILL, -9), (signal.SIGINT, 130)])
def test_faults_03_25_a_run_that_ended_early_leaves_the_project(block: Block, sign: signal.Signals, code: int) -> None:
    words = ["balance", block.project, "--resolution", 3, "--no-picture", "--workers", 1]
    before = {path: path.read_bytes() for path in block.folder.rglob("*") if path.is_file()}
    said = forked(words, block.folder.parent / "said", Mishap(end_at=1, sign=sign))
    assert said.code == code, said.err
    after = {path: path.read_bytes() for path in block.folder.rglob("*") if path.is_file() and path.suffix != ".lock"}
    assert after == before


def test_fault_22_what_has_no_data_counts_nothing(block: Block, capsys: pytest.CaptureFixture[str]) -> None:
    """A third of an image is nodata, darker than all else: its tables are those of the rest."""
    photoplan, words = Here(capsys), ("balance", block.project, "--resolution", 3, "--no-picture", "-q")
    assert photoplan(*words, "-o", block.folder / "whole").code == 0
    with rasterio.open(block.images[1]) as file:
        values = file.read()
    values[:, SIZE[1] // 3 : SIZE[1] * 2 // 3] = 0
    write_image(block.images[1], values, nodata=0)
    assert photoplan(*words, "-o", block.folder / "part").code == 0
    becomes = []
    for folder in ("whole", "part"):
        found = tomllib.loads((block.folder / folder / "two.toml").read_text())
        becomes.append(np.array([band["becomes"] for band in found["bands"]]))
    # Grey values of the ground lie between 60 and 200; without nodata they move by 25.
    assert np.abs(becomes[0] - becomes[1])[:, 8:24].max() < 8


def test_check_says_that_colours_differ_until_they_are_balanced(
    block: Block, capsys: pytest.CaptureFixture[str]
) -> None:
    photoplan = Here(capsys)
    said = photoplan("check", block.project)
    assert said.code == 0 and "grey values between neighbours: `photoplan balance` evens them out" in said.out
    assert photoplan("balance", block.project, "--no-picture", "--factor").code == 0
    assert "photoplan balance" not in photoplan("check", block.project).out
    for path in block.images:
        write_image(path, np.full((3, *SIZE[::-1]), 99, np.uint8))
    block.project.write_text((block.folder / "project.previous.toml").read_text())
    assert "photoplan balance" not in photoplan("check", block.project).out
