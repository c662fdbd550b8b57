"""Rasters that no one means are refused before any work, with their pixels and tiles, by every command."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from tools.command import Here
from tools.small_block import write_terrain

from photoplan.surfaces.raster import RasterSurface

COMMANDS = {
    "shade": ("-o", "out.tif"),
    "slope": ("-o", "out.tif"),
    "tint": ("-o", "out.tif"),
    "export": ("-o", "out.tif"),
    "flow": ("-o", "out.tif"),
    "visible": ("-o", "out.tif", "--observers", "observers.csv"),
    "volume": ("dem.tif", "--height-system", "same", "--difference", "out.tif"),
}


@pytest.fixture
def terrain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "observers.csv").write_text("name,x,y\nA,500300,5300200\n")
    monkeypatch.chdir(tmp_path)

    def asked(*_: object) -> np.ndarray:
        raise AssertionError("heights are computed for a raster that is refused")

    monkeypatch.setattr(RasterSurface, "relief", asked)
    return write_terrain(tmp_path / "dem.tif")


@pytest.mark.parametrize("command", COMMANDS)
def test_size(photoplan: Here, terrain: Path, command: str) -> None:
    before = sorted(terrain.parent.iterdir())
    for resolution, words in (
        (1e-5, r"resolution 1e-05 m.* gives \S+ × \S+ pixels in \S+ tiles, more than 1000000; choose a larger --resol"),
        (1e-300, r"resolution \S+ m; pixels of maps have 1e-06 to 1e\+06 m"),
        (1e300, r"resolution \S+ m; pixels of maps have 1e-06 to 1e\+06 m"),
    ):
        said = photoplan("dtm", command, "dem.tif", *COMMANDS[command], "--resolution", resolution)
        assert said.code == 2, (resolution, said)
        assert re.search(words, said.err), said.err
    assert sorted(terrain.parent.iterdir()) == before


def test_bounds(photoplan: Here, terrain: Path) -> None:
    said = photoplan("dtm", "shade", "dem.tif", "-o", "out.tif", "--bounds", 0, 0, 1e305, 10)
    assert said.code == 2
    assert "beyond 1e+08 m there is no map" in said.err
