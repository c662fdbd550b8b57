"""Rasters computed by windows: what stands in the file, and what happens when something goes wrong."""

from __future__ import annotations

import json
import threading
from collections import namedtuple
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from tools.events import Told

from photoplan.errors import ResourceError, TilesFailed, UsageError
from photoplan.geometry.grid import MapGrid, Window
from photoplan.io import disk
from photoplan.products.dtm.rasters import GridOptions, write_grid

PARTS = (500_000.0, 5_200_000.0, 0.5, 700, 300, "EPSG:32633")
GRID = MapGrid(*PARTS)
PLACE = GRID.placement
Usage = namedtuple("Usage", "total used free")


def options_of(**how: Any) -> GridOptions:
    return GridOptions(**{"kind": "a ramp", "settings": {"rise": 1000}, "inputs": ()} | how)


def ramp(window: Window) -> np.ndarray:
    """Column + 1000 row as float32, NaN in the third tile."""
    x, y = np.meshgrid(np.arange(window.col, window.stop[0]), np.arange(window.row, window.stop[1]))
    values = (x + 1000.0 * y).astype(np.float32)
    values[(x >= 256) & (x < 384) & (y < 128)] = np.nan
    return values[None]


@pytest.mark.parametrize("workers", [1, 3])
def test_values_come_back_with_holes(tmp_path: Path, workers: int) -> None:
    told = Told()
    facts = write_grid(
        tmp_path / "a.tif",
        PLACE,
        "float32",
        1,
        "auto",
        ramp,
        options_of(tile=128, workers=workers, events=told, tags={"A": "b"}),
    )
    with rasterio.open(tmp_path / "a.tif") as file:
        np.testing.assert_array_equal(file.read(), ramp(GRID.window))
        assert np.isnan(file.nodata)
        assert file.tags()["A"] == "b"
        assert file.bounds == GRID.bounds
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.run.json", "a.tif"]
    record = json.loads((tmp_path / "a.run.json").read_text())
    assert (record["kind"], record["settings"], record["run"]["workers"]) == ("a ramp", {"rise": 1000}, workers)
    assert record["grid"]["size"] == [700, 300]
    assert (facts.tiles, facts.empty_tiles) == (18, 1)
    assert told.phases == [("a.tif", 18, "tiles")]
    assert (told.units["a.tif"], told.pixels) == (18, GRID.window.size)


def test_classes_keep_their_colours_and_are_not_averaged(tmp_path: Path) -> None:
    """Columns of classes 1 and 9: an average of overviews would invent class 5."""

    def classes(window: Window) -> np.ndarray:
        x = np.arange(window.col, window.stop[0])
        return np.broadcast_to(np.where(x % 2, 9, 1).astype(np.uint8), (1, window.height, window.width))

    colours = {0: (0, 0, 0), 1: (10, 20, 30), 9: (250, 240, 230)}
    options = options_of(tile=128, resampling="nearest", colours=colours, workers=2)
    write_grid(tmp_path / "a.tif", PLACE, "uint8", 1, "auto", classes, options)
    with rasterio.open(tmp_path / "a.tif") as file:
        table = file.colormap(1)
        assert [table[k][:3] for k in colours] == list(colours.values())
        assert file.colorinterp[0].name == "palette"
        reduced = file.read(1, out_shape=(75, 175))
    assert set(np.unique(reduced)) <= {1, 9}


def test_mask_and_validity(tmp_path: Path) -> None:
    """A picture of three bands that uses every value, zero too, has its validity in a mask."""

    def picture(window: Window) -> tuple[np.ndarray, np.ndarray] | None:
        if window.row >= 256:
            return None
        values = np.zeros((3, window.height, window.width), np.uint8)
        return values, np.ones((window.height, window.width), bool)

    write_grid(tmp_path / "a.tif", PLACE, "uint8", 3, "mask", picture, options_of(tile=128))
    with rasterio.open(tmp_path / "a.tif") as file:
        mask = file.dataset_mask()
    assert mask[:256].all()
    assert not mask[256:].any()


def _no_work(window: Window) -> np.ndarray:
    raise AssertionError("a window was computed")


def test_fault_13_an_existing_output_is_refused_before_any_work(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    path.write_bytes(b"old")
    with pytest.raises(UsageError, match="exists already"):
        write_grid(path, PLACE, "uint8", 1, "auto", _no_work, options_of())
    with pytest.raises(UsageError, match="is the input"):
        (tmp_path / "b.tif").symlink_to(path)
        write_grid(tmp_path / "b.tif", PLACE, "uint8", 1, "auto", _no_work, options_of(inputs=[path], overwrite=True))
    assert path.read_bytes() == b"old"


def test_fault_04_too_little_space_is_seen_before_any_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(disk.shutil, "disk_usage", lambda path: Usage(0, 0, 3_000_000))
    with pytest.raises(ResourceError, match=r"needs up to \d+ MB"):
        write_grid(tmp_path / "a.tif", PLACE, "float32", 1, "auto", _no_work, options_of())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("workers", [1, 2])
def test_a_failed_window_leaves_the_finished_ones_alone(tmp_path: Path, workers: int) -> None:
    done = threading.Event()

    def failing(window: Window) -> np.ndarray:
        if window.row == 128:
            done.set()
            raise RuntimeError("no luck")
        return ramp(window)

    with pytest.raises(
        TilesFailed, match=r"a\.tif: tiles .* could not be computed \(tile \d+: RuntimeError: no luck\)"
    ):
        write_grid(tmp_path / "a.tif", PLACE, "float32", 1, "auto", failing, options_of(tile=128, workers=workers))
    assert done.is_set()
    assert [p.name for p in tmp_path.iterdir()] == [".a.tif.tiles"]


@pytest.mark.parametrize("changed", ["nothing", "settings", "input", "place"])
def test_a_run_is_continued_with_the_same_inputs_settings_and_place(tmp_path: Path, changed: str) -> None:
    """Whatever else may decide a value, tiles of the other run are of no use."""
    computed: list[Window] = []

    def halfway(window: Window) -> np.ndarray:
        if window.row == 256:
            raise RuntimeError("killed")
        return ramp(window)

    def counting(window: Window) -> np.ndarray:
        computed.append(window)
        return ramp(window)

    source = tmp_path / "terrain"
    source.write_text("flat")
    with pytest.raises(TilesFailed):
        write_grid(tmp_path / "a.tif", PLACE, "float32", 1, "auto", halfway, options_of(tile=128, inputs=[source]))
    source.write_text("steep" if changed == "input" else "flat")
    more = {"settings": {"rise": 1}} if changed == "settings" else {}
    place = MapGrid(500_000.5, *PARTS[1:]).placement if changed == "place" else PLACE
    write_grid(tmp_path / "a.tif", place, "float32", 1, "auto", counting, options_of(tile=128, inputs=[source], **more))
    assert {w.row for w in computed} == ({256} if changed == "nothing" else {0, 128, 256})


@pytest.mark.parametrize(
    ("dtype", "bands", "options"),
    [
        ("int64", 1, {}),
        ("uint8", 3, {"colours": {1: (1, 2, 3)}}),
        ("uint8", 1, {"workers": 0}),
        ("uint8", 1, {"resampling": "cubic"}),
        ("uint8", 1, {"tile": 100}),
    ],
)
def test_wrong_use_is_refused(tmp_path: Path, dtype: str, bands: int, options: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        write_grid(tmp_path / "a.tif", PLACE, dtype, bands, "auto", _no_work, options_of(**options))
