"""Run records: what all of them have in common."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path
from typing import Any


def recorded(path: Path, kind: str, *inputs: Path) -> dict[str, Any]:
    """The record that a command wrote, checked: it answers for its files, which were made from these inputs."""
    record = checked(json.loads(path.read_text("utf-8")))
    assert record["kind"] == kind and record["product"] and "overwrite" not in record["settings"]
    files = [path.parent / each for each in record["files"]]
    assert record["file"] == files[0].name and files[0].parent == path.parent and all(each.exists() for each in files)
    stated = [each["path"] for each in record["inputs"]]
    assert {each.resolve() for each in inputs} <= {(path.parent / each).resolve() for each in stated}
    assert not [each for each in (*stated, *record["files"]) if Path(each).is_absolute()]
    return record


def checked(record: dict[str, Any]) -> dict[str, Any]:
    """A record of the common form."""
    assert {"file", "product", "settings", "key", "inputs", "run", "versions", "peak_memory_bytes"} <= record.keys()
    assert record["inputs"] and all(each["size"] > 0 and len(each["sampled_sha256"]) == 64 for each in record["inputs"])
    assert len(record["key"]) == 64
    started, finished = (datetime.fromisoformat(record["run"][name]) for name in ("started", "finished"))
    assert started <= finished
    assert {"photoplan", "GDAL", "numpy", "numba"} <= record["versions"].keys()
    return record
