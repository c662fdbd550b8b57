"""A strip of a turbulent flight over a real orthophoto and terrain, drawn ray by ray, and its orthophoto."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import rasterio
from scipy import ndimage
from tools.command import inside
from tools.line_strip import pattern
from tools.shaken_strip import ShakenStrip, Vienna


def project_file(folder: Path, strip: ShakenStrip, vienna: Vienna, names: dict[str, float]) -> Path:
    """Images whose bands are X and Y of what each pixel sees, and the orthophoto there; their project."""
    strip.strip_file(folder)
    vienna.write_terrain(folder / "dtm.tif", strip.crs)
    entries = []
    profile = {"driver": "GTiff", "width": strip.columns, "height": strip.lines, "count": 3, "dtype": "float32"}
    for name, ahead in names.items():
        XYZ = strip.over(vienna.heights, ahead)
        bands = [XYZ[..., 0] - vienna.origin[0], XYZ[..., 1] - vienna.origin[1], vienna.grey(XYZ[..., :2])]
        with rasterio.open(folder / f"{name}.tif", "w", **profile) as file:
            file.write(np.stack(bands).astype(np.float32))
        entries.append(f'[[images]]\nname = "{name}"\nfile = "{name}.tif"\nline = "strip.toml"\ndetectors = "{name}"\n')
    path = folder / "project.toml"
    terrain = '[terrain]\nfile = "dtm.tif"\nheight_system = "ellipsoidal"\n'
    path.write_text(f'format = 1\ncrs = "{strip.crs}"\n{terrain}{"".join(entries)}')
    return path


def test_check_and_the_record_tell_how_turbulent_a_flight_is(tmp_path: Path) -> None:
    """A strip of pitch and roll over level ground: part of it is seen three times."""
    strip = ShakenStrip(columns=120, lines=300, vibration=(2.0, 1.2, 0.0), events=(10.0, 20.0, 0.0), event_lines=20.0)
    strip.strip_file(tmp_path)
    with rasterio.open(tmp_path / "a.tif", "w", driver="GTiff", width=120, height=300, count=1, dtype="uint8") as file:
        file.write(np.full((1, 300, 120), 99, np.uint8))
    path = tmp_path / "project.toml"
    terrain = '[terrain]\nheight = 300.0\nheight_system = "ellipsoidal"\n'
    image = '[[images]]\nname = "a"\nfile = "a.tif"\nline = "strip.toml"\ndetectors = "nadir"\n'
    path.write_text(f'format = 1\ncrs = "{strip.crs}"\n{terrain}{image}')
    told = inside("check", path)
    words = " ".join((told.out + told.err).split())
    found = re.search(
        r"turbulent flight: lines lie up to ([\d.]+) pixels beside, ([\d.]+) before or behind .*; ([\d.]+) %", words
    )
    assert found is not None, words
    assert 5 < float(found[1]) < 25 and 5 < float(found[2]) < 40 and 10 < float(found[3]) < 90
    assert "the first moment counts" in words
    product = inside("ortho", path, "--resolution", 0.3, "--no-quicklook", "--stack", "all").out.split()[0]
    assert (Path(product).parent / "all.vrt").exists()
    record = json.loads(Path(product).with_suffix(".run.json").read_text())
    assert record["images"][0]["tremor"] in words
    with rasterio.open(product) as file:
        assert (file.read(1)[file.read_masks(1) > 0] == 99).all() and (file.read_masks(1) > 0).mean() > 0.5


def test_the_direct_method_puts_the_pixels_of_a_strip_where_they_come_down(tmp_path: Path) -> None:
    """Each pixel of the product is the mean of those of the image, whose places come from other means."""
    strip = ShakenStrip(columns=120, lines=160, vibration=(3.0, 0.4, 0.5), events=(20.0, 5.0, 5.0), event_lines=20.0)
    strip.strip_file(tmp_path)
    XY = strip.seen(300.0)
    grey = pattern(XY).astype(np.float32)
    with rasterio.open(
        tmp_path / "a.tif", "w", driver="GTiff", width=120, height=160, count=1, dtype="float32"
    ) as file:
        file.write(grey, 1)
    path = tmp_path / "project.toml"
    terrain = '[terrain]\nheight = 300.0\nheight_system = "ellipsoidal"\n'
    image = '[[images]]\nname = "a"\nfile = "a.tif"\nline = "strip.toml"\ndetectors = "nadir"\n'
    path.write_text(f'format = 1\ncrs = "{strip.crs}"\n{terrain}{image}')
    said = inside("ortho", path, "--resolution", 1.0, "--method", "direct", "--no-quicklook")
    assert said.code == 0, said.err
    with rasterio.open(said.out.split()[0]) as product:
        values, valid, T = product.read(1), product.read_masks(1) > 0, product.transform
    at = np.stack([(XY[..., 1] - T.f) / T.e, (XY[..., 0] - T.c) / T.a])
    row, column = np.floor(at).astype(int)
    count, sums, edge = (np.zeros(values.shape) for _ in range(3))
    np.add.at(count, (row, column), 1)
    np.add.at(sums, (row, column), grey.astype(float))
    # Places within 0.1 mm of the border of a pixel may come down in the one beside it.
    np.add.at(edge, (row, column), np.abs(at - np.round(at)).min(axis=0) < 1e-4)
    sure = ~ndimage.binary_dilation(edge > 0, np.ones((3, 3)))
    assert (valid == (count > 0))[sure].all() and sure.mean() > 0.9 and (valid & sure).sum() > 1000
    assert np.abs(values - sums / np.maximum(count, 1))[valid & sure].max() < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize(("name", "ahead"), [("nadir", 0.0), ("forward", 46.6)])
def test_the_orthophoto_of_a_turbulent_strip_is_where_the_truth_is(
    shared: Path, tmp_path: Path, name: str, ahead: float
) -> None:
    """3 px of roll from line to line, events of 40 px: coordinates of each pixel, by command, against its own."""
    vienna = Vienna(shared / "data" / "vienna_ortho_dtm")
    strip = ShakenStrip(columns=500, lines=700, origin=(600_000.0 - 2966.0 * ahead / 100.0, 5_340_000.0))
    said = inside("ortho", project_file(tmp_path, strip, vienna, {name: ahead}), "--resolution", 0.3, "--no-quicklook")
    assert said.code == 0, said.err
    with rasterio.open(said.out.split()[0]) as product:
        values, valid, T = product.read().astype(float), product.read_masks(1) > 0, product.transform
    row, column = np.mgrid[: values.shape[1], : values.shape[2]] + 0.5
    X, Y = T.c + T.a * column, T.f + T.e * row
    error = np.hypot(values[0] + vienna.origin[0] - X, values[1] + vienna.origin[1] - Y) / 0.3
    # On banks as steep as the rays of the forward line a ray meets the ground more than once.
    ground = vienna.heights(np.stack([X, Y], axis=-1))
    steep = ndimage.binary_dilation(np.hypot(*np.gradient(ground, 0.3)) > 0.7, iterations=8)
    grey = values[2] - vienna.grey(np.stack([X, Y], axis=-1))
    for away in (0, 1, 2, 6):
        part = (ndimage.binary_erosion(valid, iterations=away) if away else valid) & ~steep
        told = f"rms {np.sqrt((error[part] ** 2).mean() / 2):.4f} px, worst {error[part].max():.3f} px"
        told += (
            f", {np.percentile(error[part], 99.9):.3f} px in all but a thousandth, {(error[part] > 0.3).sum()} over 0.3"
        )
        print(f"\n{name}, {away} pixels from the border: {told}; grey values {grey[part].std():.2f}")
    whole = ndimage.binary_erosion(valid, iterations=2) & ~steep
    assert valid.mean() > 0.5 and steep.mean() < 0.1
    # Lines end where they have been shifted to: the border is ragged by a few pixels, and rows are missing there.
    inner = ndimage.binary_erosion(valid, iterations=6) & ~steep
    assert np.sqrt((error[whole] ** 2).mean() / 2) < 0.01 and np.percentile(error[whole], 99.9) < 0.1
    assert error[inner].max() < (0.03 if ahead == 0.0 else 0.3)
    # Where one of the two rows beside a place has ended, nothing is shown: it would be extrapolated.
    assert error[whole].max() < 0.3
    # What cubic convolution makes of the picture; rows 3 px apart that are mixed at one column: 3.7.
    assert grey[inner].std() < 1.4
    # Along the border too: no saw teeth.
    rim = ndimage.binary_erosion(valid, iterations=1) & ~ndimage.binary_erosion(valid, iterations=4) & ~steep
    assert np.sqrt((error[rim] ** 2).mean() / 2) < 0.1


@pytest.mark.slow
def test_lines_of_one_camera_are_bands_on_the_same_ground(shared: Path, tmp_path: Path) -> None:
    """A line 1.5° ahead of the other sees the ground a second later, when all has moved: bands of one raster."""
    vienna = Vienna(shared / "data" / "vienna_ortho_dtm")
    strip = ShakenStrip(columns=400, lines=600)
    project = project_file(tmp_path, strip, vienna, {"nadir": 0.0, "forward": 2.6})
    toml = tmp_path / "strip.toml"
    toml.write_text(toml.read_text().replace("x_mm = [46.6]", "x_mm = [2.6]"))
    said = inside("ortho", project, "--resolution", 0.3, "--no-quicklook", "--stack", "colours")
    assert said.code == 0, said.err
    with rasterio.open(tmp_path / "products" / "colours.vrt") as file:
        assert file.descriptions == ("nadir 1", "nadir 2", "nadir 3", "forward 1", "forward 2", "forward 3")
        values = file.read(masked=True).astype(float)
    both = ndimage.binary_erosion(~np.ma.getmaskarray(values).any(axis=0), iterations=2)
    apart = np.hypot(values[0] - values[3], values[1] - values[4])[both] / 0.3
    print(
        f"\nbands: {np.sqrt((apart**2).mean() / 2):.4f} px rms, worst {apart.max():.3f} px; {both.mean():.0%} in both"
    )
    assert both.mean() > 0.25
    assert np.sqrt((apart**2).mean() / 2) < 0.1
    assert np.percentile(np.asarray(apart), 99.9) < 0.1
