"""The run record: plain JSON, whole or not at all, without a word of the machine."""

from __future__ import annotations

import getpass
import json
import platform
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.io.run_record import peak_memory_bytes, record_path, versions, write_run_record


def test_values_of_every_kind(tmp_path: Path) -> None:
    record = {
        "window": Window(1, 2, 3, 4),
        "number": np.float32(0.5),
        "count": np.int64(7),
        "nothing": float("nan"),
        "array": np.array([[1, 2], [3, 4]]),
        "path": Path("a/ü.tif"),
        "set": {3, 1, 2},
        "time": datetime(2020, 1, 2, tzinfo=UTC),
        5: (True, None, "ü"),
    }
    path = record_path(tmp_path / "a_ortho.tif")
    assert path == tmp_path / "a_ortho.run.json"
    write_run_record(path, {"old": 1})
    write_run_record(path, record)
    assert json.loads(path.read_text("utf-8")) == {
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
        write_run_record(tmp_path / "a.run.json", {"a": {"b": [1, object()]}})
    assert not list(tmp_path.iterdir())


def test_versions_and_memory() -> None:
    found = versions()
    assert {"photoplan", "python", "numpy", "numba", "rasterio", "GDAL", "PROJ"} <= set(found)
    assert found["numpy"] == np.__version__
    text = json.dumps(found)
    assert platform.node() not in text or not platform.node()
    assert f'"{getpass.getuser()}"' not in text
    before = peak_memory_bytes()
    assert 20 << 20 < before < 1 << 40
    block = np.ones(60 << 20, np.uint8)
    assert peak_memory_bytes() >= before
    assert peak_memory_bytes() >= block.nbytes
