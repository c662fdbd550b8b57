"""Ranges of heights that earlier runs found: read posts once, and believe no file that is of something else."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from rasterio.transform import from_origin

from photoplan.geometry.grid import Window
from photoplan.io.raster import TerrainReader
from photoplan.io.terrain import options as known_ranges
from photoplan.project.ground import open_terrain
from photoplan.surfaces import raster as grid_ranges
from photoplan.surfaces.base import Hits

COLUMNS, ROWS = 600, 450
WINDOWS = np.array([[0, 0, COLUMNS, ROWS], [10, 20, 140, 30], [400, 300, 401, 301], [130, 0, 250, 450]])


def hills(seed: int = 1) -> NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    waves = [rng.uniform(5, 60) * np.sin(rng.uniform(0, 6) + np.arange(n) / rng.uniform(8, 90))
             for n in (COLUMNS, ROWS) for _ in range(4)]  # fmt: skip
    return (500 + sum(waves[:4]) + sum(waves[4:])[:, None] + rng.uniform(0, 3, (ROWS, COLUMNS))).astype(np.float32)


def write(path: Path, heights: NDArray[np.float32], nodata: float | None = None) -> None:
    profile = {"driver": "GTiff", "width": COLUMNS, "height": ROWS, "count": 1, "dtype": "float32", "nodata": nodata}
    profile |= {"tiled": True, "blockxsize": 128, "blockysize": 128, "crs": "EPSG:32632"}
    with rasterio.open(path, "w", transform=from_origin(500_000, 5_200_000, 5, 5), **profile) as file:
        file.write(heights, 1)


@pytest.fixture
def terrain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A terrain that is worth keeping, in cells of 16 posts."""
    monkeypatch.setenv("PHOTOPLAN_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(known_ranges, "WORTH_KEEPING", 1)
    monkeypatch.setattr(grid_ranges, "MOST_CELLS", 1500)
    write(tmp_path / "dtm.tif", hills())
    return tmp_path / "dtm.tif"


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[Window]:
    """Blocks of terrain as they are read."""
    found: list[Window] = []
    load = TerrainReader._load

    def counted(self: TerrainReader, window: Window) -> NDArray[np.float32]:
        found.append(window)
        return load(self, window)

    monkeypatch.setattr(TerrainReader, "_load", counted)
    return found


def ranges(terrain: Path) -> NDArray[np.float64]:
    return open_terrain(terrain).surface._ranges.of(WINDOWS)


def kept(terrain: Path) -> Path:
    (file,) = (terrain.parent / "cache" / "terrain").iterdir()
    return file


def test_what_one_run_read_the_next_one_knows(terrain: Path, reads: list[Window]) -> None:
    first = ranges(terrain)
    assert len(reads) == 20
    np.testing.assert_array_equal(ranges(terrain), first)
    assert len(reads) == 20
    heights = hills()
    np.testing.assert_array_equal(first[0], [heights.min(), heights.max()])


def test_rays_meet_the_same_and_read_less(terrain: Path, reads: list[Window]) -> None:
    # Level rays over all of it from a corner: into its summits, or just above them.
    azimuth, height = np.meshgrid(np.linspace(0.1, 1.4, 60), hills().max() + np.linspace(-15, 20, 40))
    start = np.array([500_003.0, 5_197_760.0])
    end = start + 3700 * np.stack([np.sin(azimuth), np.cos(azimuth)], axis=-1)
    paths = np.stack([np.dstack([np.broadcast_to(start, end.shape), height]), np.dstack([end, height])], axis=-2)

    def hits() -> tuple[Hits, int]:
        before = len(reads)
        return open_terrain(terrain).surface.first_hit(paths.reshape(-1, 2, 3)), len(reads) - before

    (first, cost), (again, less) = hits(), hits()
    np.testing.assert_array_equal(first.XYZ, again.XYZ)
    assert 0.02 < np.isfinite(first.along).mean() < 0.9
    assert cost > 1.5 * less


@pytest.mark.parametrize("how", ["heights", "time", "void"])
def test_another_state_of_the_terrain_is_read_anew(terrain: Path, reads: list[Window], how: str) -> None:
    ranges(terrain)
    heights = hills()
    if how == "time":
        os.utime(terrain, ns=(1, 1))
    else:
        heights = hills(2) if how == "heights" else heights
        time = terrain.stat().st_mtime_ns
        void = float(heights.max()) if how == "void" else None
        write(terrain, heights, void)
        os.utime(terrain, ns=(time, time))
        heights[heights == void] = np.nan
    reads.clear()
    np.testing.assert_array_equal(ranges(terrain)[0], [np.nanmin(heights), np.nanmax(heights)])
    assert len(reads) == 20
    kept(terrain)


@pytest.mark.parametrize("place, lost", [(3, 20), (20, 20), (-1, 1), (60, 1), (900, 1)])
def test_damage_is_seen_and_mended(terrain: Path, reads: list[Window], place: int, lost: int) -> None:
    first = ranges(terrain)
    content = bytearray(kept(terrain).read_bytes())
    content[place] ^= 4
    kept(terrain).write_bytes(content)
    reads.clear()
    np.testing.assert_array_equal(ranges(terrain), first)
    assert len(reads) == lost
    np.testing.assert_array_equal(ranges(terrain), first)
    assert len(reads) == lost


@pytest.mark.parametrize("left, lost", [(0, 20), (30, 20), (700, 19), (-5, 1)])
def test_a_torn_file_is_mended(terrain: Path, reads: list[Window], left: int, lost: int) -> None:
    first = ranges(terrain)
    kept(terrain).write_bytes(kept(terrain).read_bytes()[:left])
    reads.clear()
    for _ in range(2):
        np.testing.assert_array_equal(ranges(terrain), first)
        assert len(reads) == lost


def test_a_run_that_began_before_the_terrain_changed_adds_nothing_wrong(terrain: Path, reads: list[Window]) -> None:
    old = open_terrain(terrain).surface._ranges
    old.of(WINDOWS[1:2])
    write(terrain, hills(2))
    new = open_terrain(terrain).surface._ranges
    new.of(WINDOWS[1:2])
    # What is appended now is of the old state.
    old.of(WINDOWS)
    heights = hills(2)
    np.testing.assert_array_equal(ranges(terrain)[0], [heights.min(), heights.max()])


def test_two_runs_add_to_one_file(terrain: Path, reads: list[Window]) -> None:
    one, other = (open_terrain(terrain).surface._ranges for _ in range(2))
    one.of(WINDOWS[2:3])
    other.of(WINDOWS[3:])
    one.of(WINDOWS[1:2])
    reads.clear()
    open_terrain(terrain).surface._ranges.of(WINDOWS[1:])
    assert not reads


def test_without_a_place_nothing_is_kept(terrain: Path, reads: list[Window], monkeypatch: pytest.MonkeyPatch) -> None:
    no_folder = terrain.parent / "file"
    no_folder.write_text("")
    monkeypatch.setenv("PHOTOPLAN_CACHE_DIR", str(no_folder))
    first = ranges(terrain)
    np.testing.assert_array_equal(ranges(terrain), first)
    assert len(reads) == 40
    assert no_folder.read_text() == ""


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes in folders")
def test_a_pipe_in_its_place_is_not_waited_for(terrain: Path, reads: list[Window]) -> None:
    first = ranges(terrain)
    path = kept(terrain)
    path.unlink()
    os.mkfifo(path)
    np.testing.assert_array_equal(ranges(terrain), first)
    assert path.is_file() and len(reads) == 40


def test_small_terrain_is_not_kept(terrain: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(known_ranges, "WORTH_KEEPING", COLUMNS * ROWS + 1)
    ranges(terrain)
    assert not (terrain.parent / "cache").exists()


def test_those_used_longest_ago_go(terrain: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(known_ranges, "MOST_FILES", 2)
    ranges(terrain)
    first = kept(terrain)
    os.utime(first, (1, 1))
    for name in ("b.tif", "c.tif"):
        write(terrain.with_name(name), hills())
        ranges(terrain.with_name(name))
    assert len([*first.parent.iterdir()]) == 2
    assert not first.exists()
