"""`info` reads whatever a command takes or makes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.command import inside
from tools.format_examples import block_of, frame

from photoplan.io.formats import orientation_format, write_orientation

DXF = "0\nSECTION\n2\nENTITIES\n0\nPOINT\n8\nspot\n10\n1.0\n20\n2.0\n30\n3.0\n0\nENDSEC\n0\nEOF\n"
OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
GEOJSON = {
    "type": "FeatureCollection",
    "features": [
        {"type": "Feature", "properties": {"a": 1}, "geometry": {"type": "Point", "coordinates": [8.0, 47.0]}}
    ],
}
CAMERA = '[cameras.c]\ntype = "frame"\nsize = [600, 400]\nfocal_px = 500.0\n'
YAML = "c:\n  type: pinhole\n  im_size: [600, 400]\n  focal_len: 1.0\n  sensor_size: [1.2, 0.8]\n"
#: Content of a file by its name, and what the first line of `info` begins with.
FILES = {
    "k.txt": ("0 -0.38 0\n-0.38 2.52 -0.38\n0 -0.38 0\n", "filter"),
    "kernel.csv": ("# taps\n0.25, 0.5, 0.25\n", "filter"),
    "kernel": ("1;2;1\n2;4;2\n1;2;1\n", "filter"),
    "points.csv": ("point,image,x,y\n1,a.tif,10.5,20\n2,a.tif,30,40\n", "image points"),
    "control.txt": ("name x y z\nP1 500000 5300000 400\nP2 500100 5300000 410\n", "ground points"),
    "gcp_list.txt": (
        "EPSG:32632\n500000 5300000 400 10 20 a.tif 1\n500010 5300000 400 30 20 a.tif 2\n",
        "control list",
    ),
    "centres.csv": ("name,x,y,z,omega,phi,kappa\na,1,2,3,0,0,0\nb,2,2,3,0,0,0\n", "orientations"),
    "mtf.csv": ("cycles_per_px,modulation\n0.1,0.9\n0.2,0.7\n", "modulation transfer"),
    "cams.toml": (CAMERA, "cameras"),
    "cams.yaml": (YAML, "cameras"),
    "a.geojson": (json.dumps(GEOJSON), "vectors"),
    "a.dxf": (DXF, "vectors"),
    "a.obj": (OBJ, "objects"),
}


@pytest.mark.parametrize("name", FILES)
def test_inputs_of_other_commands_are_described(tmp_path: Path, name: str) -> None:
    text, kind = FILES[name]
    (tmp_path / name).write_text(text)
    said = inside("info", tmp_path / name)
    assert said.code == 0, said.err
    assert said.out.startswith(kind), said.out
    assert inside("info", tmp_path / name, "--json").code == 0


@pytest.mark.parametrize("name", ["csv", "toml", "opensfm", "inpho", "metashape", "opk", "colmap"])
def test_orientations_of_all_formats_are_described(tmp_path: Path, name: str) -> None:
    block = block_of({"x": frame("none")}, crs="EPSG:32632", height_system="ellipsoidal")
    files = write_orientation(block, tmp_path / f"o{orientation_format(name).suffix}", name)
    said = inside("info", files[0].parent if name == "colmap" else files[0])
    assert said.code == 0, said.err
    assert said.out.startswith("orientations")
    assert f"{len(block.table.images)}: DJI" in said.out


@pytest.mark.parametrize("path", sorted(Path("docs/templates").glob("*.toml")), ids=str)
def test_templates_of_the_documentation_are_described(path: Path) -> None:
    said = inside("info", path)
    assert said.code == 0, said.err


def test_records_are_readable(tmp_path: Path) -> None:
    with rasterio.open(tmp_path / "a.tif", "w", driver="GTiff", width=40, height=30, count=1, dtype="uint8") as file:
        file.write(np.random.default_rng(0).integers(0, 255, (1, 30, 40), dtype=np.uint8))
    (tmp_path / "k.txt").write_text(FILES["k.txt"][0])
    assert inside("restore", tmp_path / "a.tif", "--filter", tmp_path / "k.txt", "-o", tmp_path / "out").code == 0
    (record,) = (tmp_path / "out").glob("*.run.json")
    said = inside("info", record)
    assert said.code == 0
    assert said.out.startswith("run record")
    assert "{" not in said.out
    assert max(map(len, said.out.splitlines())) < 200


def test_what_is_no_kind_is_refused(tmp_path: Path) -> None:
    for name, text in (("a.toml", "x = 1\n"), ("a.txt", "hello\n"), ("a.json", "[1, 2]"), ("a.bin", "abc")):
        (tmp_path / name).write_text(text)
        assert inside("info", tmp_path / name).code == 3
    assert "TOML of no kind that is known, with the entries x" in inside("info", tmp_path / "a.toml").err


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.las", b"LASF" + b"\0" * 300, "a.las: "),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 99999999999\nend_header\n", "vert"),
        ("a.geojson", b'{"type": "FeatureCollection", "features": [', "GeoJSON"),
        ("a.city.jsonl", b'{"type": "CityJSON", "version": "1.1", "transform": 5}\n', "transform"),
        ("a.city.json", b'{"type": "CityJSON", "version": "1.1", "transform": 5, "vertices": []}', "transform"),
    ],
)
def test_a_damaged_file_is_refused_by_the_reader_of_its_kind(
    tmp_path: Path, name: str, content: bytes, says: str
) -> None:
    (tmp_path / name).write_bytes(content)
    said = inside("info", tmp_path / name)
    assert said.code == 3 and says in said.err and "not a raster" not in said.err and "no kind" not in said.err


def test_a_folder_of_nothing(tmp_path: Path) -> None:
    said = inside("info", tmp_path)
    assert said.code == 3 and "a folder without photographs (JPEG, TIFF) or a COLMAP model" in said.err
