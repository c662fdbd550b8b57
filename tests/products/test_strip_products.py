"""Mosaics, true orthophotos and single points of turbulent strips, by command: a house under two lines."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
import shapely
from tools.command import inside
from tools.shaken_strip import ShakenStrip
from tools.small_block import write_image
from tools.town import House

from photoplan.io.vector_layer import VectorLayer, write_geopackage

GROUND, ROOF, PIXEL = 100.0, 110.0, 0.29
CENTRE = np.array([600_000.0, 5_340_000.0])
#: Corners of the house, metres east and north of the middle.
LOW, HIGH = np.array([-6.0, -5.0]), np.array([5.0, 6.0])
#: A piece of lines of 12,000 columns, at the ends of which yaw is told.
YAW = 150 / 12_000
STRIP = ShakenStrip(
    columns=150,
    lines=200,
    waves=0.0005,
    vibration=(3.0, 0.4, 0.5 * YAW),
    events=(8.0, 5.0, 15.0 * YAW),
    event_lines=30.0,
)
#: Millimetres in the focal plane by which the lines look ahead: the wall to the west, and hidden ground to the east.
AHEAD = {"nadir": 0.0, "forward": 46.6}
WALL = -900.0


def inside_house(XY: np.ndarray, more: float = 0.0) -> np.ndarray:
    return np.asarray(((LOW - more < XY) & (HIGH + more > XY)).all(axis=-1))


def drawn(strip: ShakenStrip, ahead: float) -> np.ndarray:
    """Where each pixel sees ground or roof, metres from the middle, (lines, columns, 2); walls are `WALL`."""
    above, below = (strip.seen(height, ahead) - CENTRE for height in (ROOF, GROUND))
    out = np.where(inside_house(above)[..., None], above, below)
    way = np.linspace(0.0, 1.0, 41)[:, None, None, None]
    hits = inside_house(above + way * (below - above)).any(axis=0) & ~inside_house(above)
    out[hits] = WALL
    return out


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, np.ndarray]]:
    return written(tmp_path_factory.mktemp("town"))


def written(folder: Path) -> tuple[Path, dict[str, np.ndarray]]:
    """A project, and what its images show."""
    entries, seen = "", {}
    for number, (name, ahead) in enumerate(AHEAD.items()):
        # Far enough back that it sees the middle.
        off = np.mean(STRIP.seen(GROUND, ahead) - STRIP.origin, axis=(0, 1))
        strip = replace(STRIP, origin=tuple(CENTRE - off), seed=number)
        (folder / name).mkdir()
        strip.strip_file(folder / name)
        seen[name] = drawn(strip, ahead)
        write_image(folder / name / "strip.tif", np.moveaxis(seen[name], -1, 0).astype(np.float32))
        entries += f'[[images]]\nname = "{name}"\nfile = "{name}/strip.tif"\nline = "{name}/strip.toml"\n'
        entries += f'detectors = "{name}"\n'
    middle, size = CENTRE + (LOW + HIGH) / 2, HIGH - LOW
    house = House(*middle, 0.0, *size, GROUND - 1, ROOF, ROOF)
    shapes = [shapely.Polygon(rings[0], rings[1:]) for rings in house.polygons]
    names = {"name": np.array(["house"] * len(shapes), object)}
    write_geopackage(folder / "o.gpkg", [VectorLayer("objects", "Polygon Z", shapes, names)], STRIP.crs)
    (folder / "project.toml").write_text(
        f'format = 1\ncrs = "{STRIP.crs}"\n[terrain]\nheight = {GROUND}\nheight_system = "ellipsoidal"\n'
        f'{entries}[[objects]]\nfile = "o.gpkg"\nheight_system = "same"\n'
    )
    return folder / "project.toml", seen


def product(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which pixels show something, how far what they show lies beside them in pixels, and their places."""
    with rasterio.open(path) as file:
        values, valid, T = file.read().astype(float), file.read_masks(1) > 0, file.transform
    row, column = np.mgrid[: valid.shape[0], : valid.shape[1]] + 0.5
    XY = np.stack([T.c + T.a * column, T.f + T.e * row], axis=-1) - CENTRE
    return valid, np.linalg.norm(np.moveaxis(values, 0, -1) - XY, axis=-1) / PIXEL, XY


@pytest.mark.slow
def test_true_orthophotos_and_mosaics_of_strips(town: tuple[Path, dict[str, np.ndarray]]) -> None:
    """Roof and ground where they stand; what the house hides is empty, and the other line fills it."""
    path, _ = town
    words = (path, "--resolution", PIXEL, "--no-quicklook", "--tile", 128)
    said = inside("ortho", *words, "--true", "--json")
    assert said.code == 0, said.err
    hidden = {}
    for told in json.loads(said.out)["products"]:
        name = Path(told["path"]).name.split("_")[0]
        valid, error, XY = product(Path(told["path"]))
        near = ~inside_house(XY, -2.0) & inside_house(XY, 2.0)
        shade = XY - np.array([0.466 * (ROOF - GROUND), 0.0])
        east = (XY[..., 0] > HIGH[0]) & inside_house(shade, -1.0)
        roof, clear = inside_house(XY, -2.0), ~inside_house(XY, 2.0) & ~inside_house(shade, 2.0)
        hidden[name] = 1.0 - valid[east].mean()
        print(f"\n{name}: {error[valid & (roof | clear)].max():.3f} px worst; {hidden[name]:.0%} of the shade hidden")
        around = clear & (np.abs(XY) < 12.0).all(axis=-1)
        print(f"roof {valid[roof].mean():.1%}, ground around {valid[around].mean():.1%} covered")
        assert valid[roof].mean() > 0.99 and valid[around].mean() > 0.995
        inner = valid & (roof | clear) & (np.abs(XY) < 15.0).all(axis=-1)
        assert error[inner].max() < 0.3 and np.sqrt((error[inner] ** 2).mean()) < 0.05
        # Walls have no place in a true orthophoto, but for pixels that the kernel takes beside an edge.
        assert (error[valid & ~near] > 100).mean() < 0.002
    assert hidden["forward"] > 0.95 and hidden["nadir"] < 0.05
    said = inside("mosaic", *words, "--sources")
    assert said.code == 0, said.err
    valid, error, XY = product(path.parent / "products" / "mosaic.tif")
    middle = (np.abs(XY) < 12.0).all(axis=-1) & (inside_house(XY, -2.0) | ~inside_house(XY, 2.0))
    print(f"mosaic: {error[valid & middle].max():.3f} px worst, {valid[middle].mean():.1%} covered")
    assert valid[middle].mean() > 0.98 and error[valid & middle].max() < 0.3


def test_a_pixel_of_a_turbulent_strip_is_found_on_the_ground(
    town: tuple[Path, dict[str, np.ndarray]], tmp_path: Path
) -> None:
    path, seen = town
    bare = path.with_name("bare.toml")
    bare.write_text(path.read_text().split("[[objects]]")[0])
    (tmp_path / "points.csv").write_text("name,x,y\none,20,30\ntwo,131,170\n")
    said = inside("monoplot", bare, "forward", tmp_path / "points.csv", "-o", tmp_path / "ground.csv")
    assert said.code == 0, said.err
    rows = list(csv.DictReader((tmp_path / "ground.csv").open()))
    found = np.array([[float(row[k]) for k in "XYZ"] for row in rows])
    truth = seen["forward"][[30, 170], [20, 131]] + CENTRE
    assert np.abs(found[:, :2] - truth).max() < 1e-3 and np.abs(found[:, 2] - GROUND).max() < 1e-6
