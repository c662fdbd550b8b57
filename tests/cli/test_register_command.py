"""`photoplan register`: what it writes, and what it refuses."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import rasterio
from numpy.typing import NDArray
from rasterio.transform import Affine, from_origin
from tools.command import Here

from photoplan.kernels.jit import COMPILED

pytestmark = pytest.mark.skipif(not COMPILED, reason="many patches")
MAP = {"crs": "EPSG:32633", "transform": from_origin(500_000.0, 5_300_000.0, 0.5, 0.5)}


def waves(x: NDArray, y: NDArray) -> NDArray:
    rng = np.random.default_rng(5)
    length, way, phase = rng.uniform(5, 30, 60), rng.uniform(0, 2 * np.pi, 60), rng.uniform(0, 2 * np.pi, 60)
    kx, ky = 2 * np.pi / length * np.cos(way), 2 * np.pi / length * np.sin(way)
    return sum(np.cos(a * x + b * y + p) for a, b, p in zip(kx, ky, phase)) / np.sqrt(30)


def write(path: Path, size: tuple[int, int] = (200, 150), at: tuple[float, float] = (0, 0), **more: object) -> Path:
    """A picture whose first pixel lies at `at` of the pattern."""
    x, y = np.meshgrid(np.arange(size[0]) + at[0], np.arange(size[1]) + at[1])
    dtype = str(more.pop("dtype", "uint8"))
    pixels = (2000 + 1000 * waves(x, y)) if dtype == "uint16" else 120 + 35 * waves(x, y)
    pixels = np.where(more.pop("black", False), 0 * pixels, pixels)
    profile = {"driver": "GTiff", "width": size[0], "height": size[1], "count": 1, "dtype": dtype, **more}
    with rasterio.open(path, "w", **profile) as file:
        file.write(np.clip(np.rint(pixels), 0, 65535).astype(dtype), 1)
    return path


@pytest.mark.drawn
def test_rasters_of_one_map_are_compared_where_both_are(photoplan: Here, tmp_path: Path) -> None:
    """8 and 16 bit, of different sizes and origins, half a pixel beside where the second says that it is."""
    first = write(tmp_path / "a.tif", **MAP)
    there = MAP["transform"] @ Affine.translation(50, 20)
    second = write(
        tmp_path / "b.tif", (120, 140), (50 - 0.5, 20 + 0.25), dtype="uint16", crs=MAP["crs"], transform=there
    )
    said = photoplan("register", first, second, "-o", tmp_path / "v.gpkg", "--json")
    assert said.code == 0, said.err
    told = json.loads(said.out)
    assert told["figures"]["median_px"] == pytest.approx([0.5, -0.25], abs=0.01)
    assert told["model"]["dx"]["d0"] == pytest.approx(0.5, abs=0.01) and told["pixel"] == pytest.approx(0.5)
    record = json.loads((tmp_path / "v.run.json").read_text())
    assert record["kind"] == "register" and len(record["inputs"]) == 2
    assert record["product"]["figures"] == told["figures"]
    layers = dict(pyogrio.list_layers(tmp_path / "v.gpkg"))
    assert layers == {"vectors": "LineString", "patches": "Point"}
    meta, _, _, fields = pyogrio.raw.read(tmp_path / "v.gpkg", layer="vectors")
    values = dict(zip(meta["fields"], fields))
    assert meta["crs"] == "EPSG:32633" and np.median(values["map_dx"]) == pytest.approx(0.25, abs=0.01)
    rows = list(csv.DictReader((tmp_path / "v.csv").open()))
    assert len(rows) == told["figures"]["patches"] == sum(told["figures"]["counts"].values())
    assert (tmp_path / "v.png").stat().st_size > 20_000
    assert not (tmp_path / ".v.gpkg.steps").exists()


def test_images_without_a_map_are_compared_pixel_by_pixel(photoplan: Here, tmp_path: Path) -> None:
    first, second = write(tmp_path / "a.tif"), write(tmp_path / "b.tif", at=(0.3, 0.0))
    words = ("register", first, second, "-o", tmp_path / "v.gpkg", "--no-picture")
    said = photoplan(*words, "--dry-run")
    assert said.code == 0 and "9 × 7 patches of 21 px" in said.out and not (tmp_path / "v.gpkg").exists()
    said = photoplan(*words, "--model", "shift")
    assert said.code == 0, said.err
    assert (
        "few patches" not in said.err
        and "dx -0.30" in said.out
        and "100.00%" in said.out
        and not (tmp_path / "v.png").exists()
    )
    assert photoplan(*words).code == 2  # exists
    one = (tmp_path / "v.csv").read_bytes()
    assert photoplan(*words, "--overwrite", "--workers", 2).code == 0
    assert (tmp_path / "v.csv").read_bytes() == one


@pytest.mark.parametrize(
    ("other", "words", "code", "message"),
    [
        ({"size": (180, 150)}, (), 3, "it is not known which pixels belong together"),
        ({"black": True}, (), 3, "no patch of"),
        ({"at": (500.0, 500.0)}, (), 3, "give a larger --search"),
        ({"nodata": 0, "black": True}, (), 3, "hardly a valid pixel in common"),
        ({}, ("--radius", "2"), 2, "--radius 2; allowed are 4 to 50"),
        ({}, ("--spacing", "0"), 2, "--spacing 0; allowed are"),
        ({}, ("--search", "nan"), 2, "--search is not a number"),
        ({}, ("--sigma", "1e300"), 2, "--sigma 1e+300; allowed are"),
        ({}, ("--model", "spline"), 2, "'spline' is not one of 'none', 'shift', 'affine'"),
        ({}, ("-o", "v.shp"), 2, "give it a name that ends with .gpkg"),
    ],
)
def test_what_makes_no_sense_is_refused(
    photoplan: Here, tmp_path: Path, other: dict[str, object], words: tuple[str, ...], code: int, message: str
) -> None:
    first, second = write(tmp_path / "a.tif"), write(tmp_path / "b.tif", **other)
    output = () if "-o" in words else ("-o", tmp_path / "v.gpkg")
    said = photoplan("register", first, second, *output, *words)
    assert said.code == code and message in said.err, said.err
    assert {p.name for p in tmp_path.iterdir() if not p.name.startswith(".")} == {"a.tif", "b.tif"}


def test_that_few_patches_were_found_is_told(photoplan: Here, tmp_path: Path) -> None:
    """Of nine columns of patches two show the same, the others something else."""
    shown = {"a": 0.0, "b": 0.0, "c": 900.0}
    first, second, other = (write(tmp_path / f"{name}.tif", at=(at, 0.0)) for name, at in shown.items())
    with rasterio.open(second, "r+") as file, rasterio.open(other) as beside:
        pixels = beside.read()
        pixels[..., :50] = file.read()[..., :50]
        file.write(pixels)
    words = ("register", first, second, "-o", tmp_path / "v.gpkg", "--no-picture")
    said = photoplan(*words)
    assert said.code == 0 and "few patches were found" in said.err and "give a larger --search (3 px now)" in said.err
    told = json.loads((tmp_path / "v.run.json").read_text())["product"]["notes"]
    assert len(told) == 1 and "most are unlike" in told[0]


def test_maps_that_do_not_meet_are_refused(photoplan: Here, tmp_path: Path) -> None:
    first = write(tmp_path / "a.tif", **MAP)
    far = write(tmp_path / "far.tif", crs=MAP["crs"], transform=from_origin(600_000.0, 5_300_000.0, 0.5, 0.5))
    other = write(tmp_path / "other.tif", crs="EPSG:25832", transform=MAP["transform"])
    flat = write(tmp_path / "flat.tif", crs=MAP["crs"], transform=rasterio.Affine(1.0, 1.0, 0.0, 1.0, 1.0, 0.0))
    coarse = write(tmp_path / "coarse.tif", crs=MAP["crs"], transform=from_origin(500_000.0, 5_300_000.0, 2.0, 2.0))
    for second, message in (
        (far, "nothing in common"),
        (other, "gdalwarp -t_srs"),
        (coarse, "0.25 times as large"),
        (first, "is the first image, too"),
        (flat, "flat.tif: transform"),
        (tmp_path / "none.tif", "none.tif"),
    ):
        said = photoplan("register", first, second, "-o", tmp_path / "v.gpkg")
        assert said.code in (2, 3) and message in said.err, said.err


def test_fault_32_absurdly_many_patches_are_refused(photoplan: Here, tmp_path: Path) -> None:
    for name in ("a.tif", "b.tif"):
        profile = {"driver": "GTiff", "width": 30_000, "height": 20_000, "count": 1, "dtype": "uint8"}
        with rasterio.open(tmp_path / name, "w", tiled=True, sparse_ok=True, compress="deflate", **profile):
            pass
    said = photoplan("register", tmp_path / "a.tif", tmp_path / "b.tif", "-o", tmp_path / "v.gpkg", "--spacing", 5)
    assert said.code == 2 and "choose a larger --spacing" in said.err, said.err


def test_images_smaller_than_a_patch_are_refused(photoplan: Here, tmp_path: Path) -> None:
    first, second = (write(tmp_path / name, (60, 20)) for name in ("a.tif", "b.tif"))
    said = photoplan("register", first, second, "-o", tmp_path / "v.gpkg")
    assert said.code == 3 and "60 × 20 pixels in common, a patch needs 23; give a smaller --radius" in said.err
