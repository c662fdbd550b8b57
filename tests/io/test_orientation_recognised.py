"""Files of today's programs are recognised by their content, each by one format only."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from tools.format_examples import assert_same, block_of, frame

from photoplan.io.formats import FORMATS, choose_format, orientation_format, read_orientation_block, write_orientation
from photoplan.io.orientation.block import TableFormat


@pytest.mark.parametrize("name", ["metashape", "opk", "pix4d", "opensfm", "odm", "colmap", "toml"])
def test_a_written_file_is_recognised(tmp_path: Path, name: str) -> None:
    square = frame("opencv", focal_px=3100.0)
    block = block_of({"a": square}, crs="EPSG:32632", height_system="ellipsoidal")
    # A name that says nothing; only the suffix is the format's.
    path = tmp_path / f"a{orientation_format(name).suffix}"
    write_orientation(block, path, name)
    assert choose_format(path, TableFormat()).name == name


def test_every_format_is_called_as_in_the_registry() -> None:
    for name in FORMATS:
        made = orientation_format(name)
        assert made.name == name and made.title


@pytest.mark.parametrize("via", [("metashape", "pix4d", "opensfm"), ("pix4d", "opk", "odm"), ("odm", "opk", "pix4d")])
def test_a_chain_of_formats_keeps_the_poses(tmp_path: Path, via: tuple[str, ...]) -> None:
    """Map to map, through the formats of four programs: what remains is rounding."""
    from photoplan.products.convert import ConvertRequest, convert_orientation, read_block

    start = block_of({"a": frame("opencv", focal_px=3100.0)}, crs="EPSG:32632", height_system="ellipsoidal")
    path = tmp_path / "start.toml"
    write_orientation(start, path, "toml")
    for step, name in enumerate(via):
        camera = None if read_orientation_block(path).cameras else tmp_path / "start.toml"
        output = tmp_path / f"{step}{orientation_format(name).suffix}"
        request = ConvertRequest(path, name, output, camera=camera, crs="EPSG:32632", drop_lens=True)
        path = convert_orientation(request).files[0]
    last = convert_orientation(ConvertRequest(path, "csv", tmp_path / "end.csv", crs="EPSG:32632")).files[0]
    _, end = read_block(last, TableFormat(), None)
    assert_same(start, replace(end, cameras={}), position=2e-8, angle=1e-9)
