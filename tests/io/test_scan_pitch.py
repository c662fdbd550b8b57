"""How finely a scan was sampled, from its header or from a word."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import rasterio

from photoplan.errors import InputError, UsageError
from photoplan.io.raster_info import parse_pitch, read_pitch


def image(path: Path, driver: str = "GTiff", **tags: object) -> Path:
    with rasterio.open(path, "w", driver=driver, width=32, height=32, count=1, dtype="uint8") as file:
        file.write(np.zeros((1, 32, 32), np.uint8))
        file.update_tags(**tags)
    return path


@pytest.mark.parametrize(
    ("tags", "millimetres"),
    [
        ({"TIFFTAG_XRESOLUTION": 1200, "TIFFTAG_YRESOLUTION": 1200, "TIFFTAG_RESOLUTIONUNIT": 2}, (25.4 / 1200,) * 2),
        ({"TIFFTAG_XRESOLUTION": 500, "TIFFTAG_YRESOLUTION": 400, "TIFFTAG_RESOLUTIONUNIT": 3}, (0.02, 0.025)),
        ({"TIFFTAG_XRESOLUTION": 4, "TIFFTAG_YRESOLUTION": 3, "TIFFTAG_RESOLUTIONUNIT": 1}, None),
        ({}, None),
    ],
)
def test_tiff_tags(tmp_path: Path, tags: dict[str, object], millimetres: tuple[float, float] | None) -> None:
    found = read_pitch(image(tmp_path / "scan.tif", **tags))
    assert found == (None if millimetres is None else pytest.approx(millimetres))


@pytest.mark.parametrize(
    ("unit", "density", "millimetres"),
    [(1, (400, 300), (0.0635, 25.4 / 300)), (2, (500, 500), (0.02, 0.02)), (0, (1, 1), None), (1, (0, 300), None)],
)
def test_jfif_header(
    tmp_path: Path, unit: int, density: tuple[int, int], millimetres: tuple[float, float] | None
) -> None:
    path = image(tmp_path / "scan.jpg", "JPEG")
    content = bytearray(path.read_bytes())
    assert content[6:11] == b"JFIF\0"
    content[13:18] = struct.pack(">BHH", unit, *density)
    path.write_bytes(content)
    found = read_pitch(path)
    assert found == (None if millimetres is None else pytest.approx(millimetres))


def test_real_scans_state_what_they_were_scanned_with(shared: Path) -> None:
    scans = sorted((shared / "data" / "film_act_canberra").glob("*.jpg"))
    assert len(scans) == 4
    for path in scans:
        dpi = float(path.stem.split("_")[-1].removesuffix("dpi"))
        assert read_pitch(path) == pytest.approx((25.4 / dpi,) * 2)


def test_fault_08_a_file_that_is_no_raster(tmp_path: Path) -> None:
    path = tmp_path / "scan.tif"
    path.write_bytes(b"II*\0" + bytes(40))
    with pytest.raises(InputError, match=r"scan\.tif"):
        read_pitch(path)


@pytest.mark.parametrize(
    ("text", "millimetres"),
    [
        ("1200dpi", (25.4 / 1200,) * 2),
        ("1200 DPI", (25.4 / 1200,) * 2),
        ("21um", (0.021, 0.021)),
        ("21.5µm", (0.0215, 0.0215)),
        ("21, 20.8um", (0.021, 0.0208)),
    ],
)
def test_words(text: str, millimetres: tuple[float, float]) -> None:
    assert parse_pitch(text) == pytest.approx(millimetres)


@pytest.mark.parametrize("text", ["1200", "0dpi", "-5um", "1.2.3um", "1,2,3um", "fine", "", "nanum", "20mm"])
def test_words_that_are_no_resolution(text: str) -> None:
    with pytest.raises(UsageError, match="1200dpi or 21um"):
        parse_pitch(text)
