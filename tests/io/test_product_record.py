"""The run record: plain JSON, whole or not at all, without a word of the machine."""

from __future__ import annotations

import getpass
import json
import platform
import re
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.io.store import input_entry, peak_memory_bytes, record_path, versions, write_run_record


def test_values_of_every_kind(tmp_path: Path) -> None:
    record = {
        "window": Window(1, 2, 3, 4),
        "number": np.float32(0.5),
        "count": np.int64(7),
        "nothing": float("nan"),
        "array": np.array([[1, 2], [3, 4]]),
        "path": tmp_path / "a" / "ü.tif",
        "set": {3, 1, 2},
        "time": datetime(2020, 1, 2, tzinfo=UTC),
        5: (True, None, "ü"),
    }
    product = tmp_path / "a_ortho.tif"
    path = record_path(product)
    assert path == tmp_path / "a_ortho.run.json"
    write_run_record(product, key="old", inputs=(), run={})
    assert write_run_record(product, key="new", inputs=(), run={}, told=record) == path
    found = json.loads(path.read_text("utf-8"))
    assert (found["file"], found["key"]) == ("a_ortho.tif", "new")
    assert found["told"] == {
        "window": {"col": 1, "row": 2, "width": 3, "height": 4},
        "number": 0.5,
        "count": 7,
        "nothing": None,
        "array": [[1, 2], [3, 4]],
        "path": "a/ü.tif",
        "set": [1, 2, 3],
        "time": "2020-01-02T00:00:00+00:00",
        "5": [True, None, "ü"],
    }
    assert list(tmp_path.iterdir()) == [path]


def test_what_json_cannot_say_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"record\.a\.b\[1\] is a object"):
        write_run_record(tmp_path / "a.tif", key="k", inputs=(), run={}, a={"b": [1, object()]})
    assert not list(tmp_path.iterdir())


def test_inputs_are_named_with_size_and_digest(tmp_path: Path) -> None:
    (tmp_path / "in.csv").write_text("x,y\n")
    known = input_entry(tmp_path / "in.csv", "a digest")
    path = write_run_record(tmp_path / "a.tif", key="k", inputs=[tmp_path / "in.csv", known], run={})
    one, other = json.loads(path.read_text("utf-8"))["inputs"]
    assert (one["path"], one["size"], len(one["sampled_sha256"])) == ("in.csv", 4, 64)
    assert other["sampled_sha256"] == "a digest"


def test_a_raster_does_not_take_the_record_of_the_model_beside_it(tmp_path: Path) -> None:
    """`terrain.gpkg` and `terrain.tif` have a record each; that of a file that is gone is replaced."""
    for name, record in (("t.gpkg", "t.run.json"), ("t.tif", "t.tif.run.json"), ("t.gpkg", "t.run.json")):
        (tmp_path / name).touch()
        assert write_run_record(tmp_path / name, key=name, inputs=(), run={}) == tmp_path / record
    (tmp_path / "t.gpkg").unlink()
    assert write_run_record(tmp_path / "t.tif", key="k", inputs=(), run={}) == tmp_path / "t.run.json"


def test_versions_and_memory() -> None:
    found = versions()
    assert {"photoplan", "python", "numpy", "numba", "rasterio", "GDAL", "PROJ", "JPEG decoder"} <= set(found)
    assert re.fullmatch(r"(libjpeg.*|another) \([0-9a-f]{12}\)", found["JPEG decoder"])
    assert found["numpy"] == np.__version__
    text = json.dumps(found)
    assert platform.node() not in text or not platform.node()
    assert f'"{getpass.getuser()}"' not in text
    before = peak_memory_bytes()
    assert 20 << 20 < before < 1 << 40
    block = np.ones(60 << 20, np.uint8)
    assert peak_memory_bytes() >= before
    assert peak_memory_bytes() >= block.nbytes
