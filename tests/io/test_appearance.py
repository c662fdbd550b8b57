"""Files that a reader does not know are named for what they look like."""

from __future__ import annotations

from pathlib import Path

import pytest

from photoplan.errors import InputError
from photoplan.io.files import decoded_text, format_hint, raster_driver
from photoplan.io.formats import read_cameras

KINDS = {
    "bundle.out": (b"# Bundle file v0.3\n1 0\n500 0 0\n", "Bundler's bundle.out"),
    "a.nvm": (b"NVM_V3\n\n1\na.jpg 500 1 0 0 0 0 0 0 0 0\n", "VisualSFM's NVM"),
    "a.json": (b'{"type": "FeatureCollection", "features": []}', "GeoJSON"),
    "b.json": (b'[{"a": 1}]', "JSON"),
    "a.txt": (b"LINE_OFF: 100\nSAMP_OFF: 3\n", "rational polynomials (RPC)"),
    "images.bin": (b"\x02" + bytes(63), "images.bin of COLMAP in binary"),
    "a.xml": (b'\xef\xbb\xbf<?xml version="1.0"?>\n<!-- <x> -->\n<BlockExchange>', "an XML document of <x>"),
    "b.xml": (b"<document><chunk/></document>", "an XML document of <document>"),
    "c.xml": (b'<LandXML xmlns="u">', "LandXML"),
    "a.html": (b"<!DOCTYPE html><html>", "a web page"),
    "a.dxf": (b"0\nSECTION\n2\n", "a DXF drawing"),
    "a.zip": (b"PK\x03\x04", "a ZIP archive"),
    "a.gpkg": (b"SQLite format 3\0", "a GeoPackage"),
}


@pytest.mark.parametrize("name", KINDS)
def test_files_are_named_for_what_they_look_like(tmp_path: Path, name: str) -> None:
    raw, kind = KINDS[name]
    path = tmp_path / name
    path.write_bytes(raw)
    assert format_hint(path).startswith(f"; it looks like {kind}")


@pytest.mark.parametrize("raw", [b"1 2 3\n4 5 6\n", b"name,x,y,z\n", b"", b"\x00\x01\x02", b"<" * 4096])
def test_nothing_is_said_of_others(tmp_path: Path, raw: bytes) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(raw)
    assert format_hint(path) == ""
    assert format_hint(tmp_path / "missing.csv") == ""


def test_refusals_say_it(tmp_path: Path) -> None:
    path = tmp_path / "a.geojson"
    path.write_bytes(KINDS["a.json"][0])
    for refused in (read_cameras, raster_driver):
        with pytest.raises(InputError, match="it looks like GeoJSON"):
            refused(path)
    with pytest.raises(InputError, match=r"a.geojson:3: holds a zero byte.*it looks like GeoJSON"):
        decoded_text(path, b"a\nb\nc\0", 1)
    with pytest.raises(InputError, match=r"a.geojson:8: not UTF-8 \(byte 0xff\)"):
        decoded_text(path, b"a\nb\xff", 7)
