"""Bad inputs of images with rational polynomials: what must happen, by the numbers of the list of faults."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.command import inside
from tools.effort import at_most
from tools.rpc_files import as_text, tagged
from tools.rpc_images import CRS, functions

from photoplan.cameras.rpc import RationalFunctions

SIZE = (60, 80)
LEVEL = '[terrain]\nheight = 300.0\nheight_system = "ellipsoidal"\n'
PIXEL = 250.0


def small() -> RationalFunctions:
    """Polynomials of an image of few pixels of 250 m, with the smoothness of real ones."""
    full = functions()
    coefficients = full.coefficients.copy()
    coefficients[:, 4:] *= 0.1
    middle = ((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
    return replace(full, coefficients=coefficients, image_scale=(SIZE[0] / 2, SIZE[1] / 2), image_offset=middle)


def written(
    folder: Path, values: np.ndarray | None = None, terrain: str = LEVEL, crs: str = CRS, **form: object
) -> Path:
    """An image with a text file of its polynomials, and their project."""
    values = np.full((1, SIZE[1], SIZE[0]), 99, np.uint8) if values is None else values
    count, height, width = values.shape
    about = {"driver": "GTiff", "width": width, "height": height, "count": count, "dtype": values.dtype} | form
    with rasterio.open(folder / "a.tif", "w", **about) as file:
        file.write(values)
    (folder / "rpc.txt").write_text(as_text(small()))
    path = folder / "project.toml"
    path.write_text(f'format = 1\ncrs = "{crs}"\n{terrain}[[images]]\nname = "a"\nfile = "a.tif"\nrpc = "rpc.txt"\n')
    return path


def refused(*words: object) -> str:
    said = inside(*words)
    assert (said.code, said.out) == (3, ""), (said.code, said.out, said.err)
    return " ".join(said.err.split())


def edited(path: Path, before: str, after: str) -> Path:
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after))
    return path


def product_of(project: Path, *more: object) -> tuple[np.ndarray, np.ndarray]:
    """Values and validity of its orthophoto."""
    said = inside("ortho", project, "--resolution", PIXEL, "--no-quicklook", *more)
    assert said.code == 0, said.err
    with rasterio.open(said.out.split()[0]) as file:
        return file.read(), file.read_masks(1) > 0


def test_fault_01_the_grid_of_the_heights_is_missing(tmp_path: Path) -> None:
    """Polynomials want heights above the ellipsoid; those of the terrain are above a geoid that is not here."""
    told = refused("check", written(tmp_path, terrain=LEVEL.replace("ellipsoidal", "EPSG:3855")))
    assert "us_nga_egm08_25.tif" in told and "pyproj sync" in told


def test_fault_07_what_has_no_end_is_refused_by_its_size(tmp_path: Path) -> None:
    """The text of polynomials, and an image that is next to nothing on the disk."""
    project = written(tmp_path)
    os.truncate(tmp_path / "rpc.txt", 10**11)
    with at_most(seconds=2.0):
        assert "rpc.txt" in refused("check", project)


@pytest.mark.parametrize("place", ["/vsicurl/http://example.org/a.txt", "https://example.org/a.xml", "/vsimem/a.rpb"])
def test_fault_09_no_name_leads_out_to_the_network(tmp_path: Path, place: str) -> None:
    assert place in refused("check", edited(written(tmp_path), '"rpc.txt"', f'"{place}"'))


def test_fault_09_a_virtual_raster_named_as_the_image(tmp_path: Path) -> None:
    project = written(tmp_path)
    (tmp_path / "a.tif").write_text(
        f'<VRTDataset rasterXSize="{SIZE[0]}" rasterYSize="{SIZE[1]}"><VRTRasterBand dataType="Byte" band="1">'
        "<SimpleSource><SourceFilename>/etc/hostname</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>"
    )
    assert "a.tif" in refused("ortho", project, "--resolution", PIXEL)


def test_fault_14_a_scale_that_is_a_thousand_times_too_small(tmp_path: Path) -> None:
    """Pixels would be needles, and their mean size on the ground would say nothing of it."""
    project = written(tmp_path)
    lines = (tmp_path / "rpc.txt").read_text().split("\n")
    scale = next(float(line.split()[1]) for line in lines if line.startswith("LONG_SCALE"))
    lines = [f"LONG_SCALE: {scale / 1000!r}" if line.startswith("LONG_SCALE") else line for line in lines]
    (tmp_path / "rpc.txt").write_text("\n".join(lines))
    said = inside("check", project)
    assert said.code == 3 and "times longer than wide" in said.out
    # They have none that could be read in another way.
    assert "angles" not in said.err and "whether geometry and image belong together" in said.err


def test_fault_14_a_tile_of_a_product_with_the_polynomials_of_the_whole(tmp_path: Path) -> None:
    """They count from the first tile; of that one, of a tile with its own, and where it begins, nothing is wrong."""
    project = written(tmp_path)
    for name in ("IMG_P_R1C2.tif", "IMG_P_R1C1.tif"):
        (tmp_path / name).write_bytes((tmp_path / "a.tif").read_bytes())
    told = refused("check", edited(project, '"a.tif"', '"IMG_P_R1C2.tif"'))
    assert "a tile of a product" in told and "shift = [-COLUMN, -ROW]" in told
    (tmp_path / "IMG_P_R1C2_RPC.TXT").write_bytes((tmp_path / "rpc.txt").read_bytes())
    assert "all plausible" in inside("check", edited(project, '"rpc.txt"', '"IMG_P_R1C2_RPC.TXT"')).out
    edited(project, '"IMG_P_R1C2_RPC.TXT"', '"rpc.txt"\nshift = [0, 0]')
    assert "all plausible" in inside("check", project).out
    edited(edited(project, "R1C2", "R1C1"), "\nshift = [0, 0]", "")
    assert "all plausible" in inside("check", project).out


def test_fault_14_longitude_and_latitude_exchanged(tmp_path: Path) -> None:
    """Nothing of the image is where the project is: said by name, and nothing is made."""
    project = written(tmp_path)
    text = (tmp_path / "rpc.txt").read_text().replace("LAT_", "X_").replace("LONG_", "LAT_").replace("X_", "LONG_")
    (tmp_path / "rpc.txt").write_text(text)
    said = inside("ortho", project, "--resolution", PIXEL, "--no-quicklook")
    assert said.code == 3 and "a" in said.err and not list(tmp_path.glob("products/*.tif"))


@pytest.mark.parametrize(
    ("by", "told"),
    [
        (lambda t: t.replace("\n", "\r\n"), None),
        (lambda t: "\ufeff" + t, None),
        (lambda t: t.split("\n")[0] + "\n", "LINE_SCALE"),
        (lambda t: t.replace(".", ","), "SAMP_OFF: '29,5'"),
        (lambda t: "", "LINE_OFF"),
    ],
)
def test_fault_18_text_of_polynomials(tmp_path: Path, by: object, told: str | None) -> None:
    project = written(tmp_path)
    file = tmp_path / "rpc.txt"
    file.write_bytes(by(file.read_text()).encode())  # type: ignore[operator]
    if told is None:
        assert inside("check", project).code == 0
    else:
        assert told in refused("check", project)


@pytest.mark.parametrize(("crs", "told"), [("EPSG:2263", "metre"), ("EPSG:4326", "geographic"), ("", "crs")])
def test_fault_20_a_map_in_feet_or_degrees(tmp_path: Path, crs: str, told: str) -> None:
    assert told in refused("check", written(tmp_path, crs=crs))


@pytest.mark.parametrize("by", ["nodata", "mask"])
def test_fault_22_nodata_leaves_no_dark_fringes(tmp_path: Path, by: str) -> None:
    """A hole in a bright image: what is valid is as bright as all the rest."""
    values = np.full((1, SIZE[1], SIZE[0]), 200, np.uint8)
    values[0, 30:50, 20:40] = 0
    project = written(tmp_path, values, **({"nodata": 0} if by == "nodata" else {}))
    if by == "mask":
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(tmp_path / "a.tif", "r+") as file:
            file.write_mask(values[0])
    got, valid = product_of(project)
    assert (got[0][valid] == 200).all()
    middle = valid[valid.shape[0] // 2 - 3 : valid.shape[0] // 2 + 3, valid.shape[1] // 2 - 3 : valid.shape[1] // 2 + 3]
    assert 0.4 < valid.mean() < 0.95 and not middle.all()


def test_fault_23_ground_beyond_the_polynomials_is_not_made_up(tmp_path: Path) -> None:
    """Heights a kilometre above all that they were made for: no position, said so, no picture."""
    project = written(tmp_path, terrain=LEVEL.replace("300.0", "2500.0"))
    told = inside("ortho", project, "--resolution", PIXEL, "--no-quicklook")
    assert told.code == 3 and "height" in told.err, told.err


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["uint16", "float32", "int16"])
def test_fault_24_types_are_kept(tmp_path: Path, dtype: str) -> None:
    low, high = (-1234, 3210) if dtype == "int16" else (17, 51234)
    values = np.full((2, SIZE[1], SIZE[0]), low, dtype)
    values[1] = high
    got, valid = product_of(written(tmp_path, values))
    assert got.dtype == dtype and (got[0][valid] == low).all() and (got[1][valid] == high).all()


def test_fault_24_a_palette_becomes_colours(tmp_path: Path) -> None:
    project = written(tmp_path)
    with rasterio.open(tmp_path / "a.tif", "r+") as file:
        file.write_colormap(1, {k: (k, 255 - k, 7, 255) for k in range(256)})
    got, valid = product_of(project)
    assert (got[:, valid] == np.array([99, 156, 7])[:, None]).all()


@pytest.mark.parametrize(
    ("before", "after"),
    [("LINE_OFF: ", "LINE_OFF: 1e300 #"), ("HEIGHT_SCALE: ", "HEIGHT_SCALE: 1e300 #"), ("LAT_OFF: ", "LAT_OFF: 200 #")],
)
def test_fault_30_finite_nonsense(tmp_path: Path, before: str, after: str) -> None:
    project = written(tmp_path)
    text = (tmp_path / "rpc.txt").read_text()
    assert before in text
    lines = [after.replace(" #", "") if line.startswith(before) else line for line in text.split("\n")]
    (tmp_path / "rpc.txt").write_text("\n".join(lines))
    said = inside("ortho", project, "--resolution", PIXEL, "--no-quicklook")
    assert said.code == 3 and not list(tmp_path.glob("products/*.tif")), said.err


def test_fault_31_a_damaged_image_is_named(tmp_path: Path) -> None:
    project = written(tmp_path)
    tagged(tmp_path / "a.tif", small(), np.full((1, SIZE[1], SIZE[0]), 99, np.uint8))
    with (tmp_path / "a.tif").open("r+b") as file:
        file.truncate(300)
    assert "a.tif" in refused("ortho", project, "--resolution", PIXEL)
