"""What a run record says of its tiles is believed as far as it goes."""

from __future__ import annotations

import base64
import json
import zlib
from pathlib import Path

import pytest

from photoplan.io import store as kept_tiles
from photoplan.io.store import KeptTiles


def test_a_record_that_unpacks_without_end_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Blanks after a list are JSON, too: read as a whole, the record would be a good one of any size."""
    record = tmp_path / "m.run.json"
    found = json.dumps([(3, "key", 7, 0, 4, {})]) + " " * 100_000
    packed = base64.b64encode(zlib.compress(found.encode())).decode()
    record.write_text(json.dumps({"tiles": {"m.tif": packed}}))
    tiles = KeptTiles(record, lambda index: "key")
    assert list(tiles._recorded("m.tif")) == [(3, "key", 7, 0, 4, {})]
    monkeypatch.setattr(kept_tiles, "_MOST", 20)
    assert list(tiles._recorded("m.tif")) == []
