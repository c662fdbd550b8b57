"""One way from values to JSON."""

from __future__ import annotations

import json
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photoplan.errors import UsageError
from photoplan.plain import json_text, pick, plain


class Kind(Enum):
    FLAT = "flat"


@dataclass(frozen=True, eq=False)
class Point:
    name: str
    xy: np.ndarray
    sigma: float
    file: Path
    kind: Kind = Kind.FLAT


@dataclass(frozen=True)
class Length:
    metres: float
    secret: object

    def json_fields(self) -> dict[str, Any]:
        return pick(self, length_m="metres")


def test_values_of_every_kind() -> None:
    """Data classes by field, NumPy, enumerations, paths, sets; what is not finite is null."""
    point = Point("a", np.array([1.5, np.nan]), float("inf"), Path("a/b.tif"))
    value = {"points": (point,), 3: {np.int64(2), 1}, "flag": np.bool_(True), "length": Length(2.5, object())}
    assert json.loads(json_text(value)) == {
        "points": [{"name": "a", "xy": [1.5, None], "sigma": None, "file": str(Path("a/b.tif")), "kind": "flat"}],
        "3": [1, 2],
        "flag": True,
        "length": {"length_m": 2.5},
    }
    assert "NaN" not in json_text(value) and "Infinity" not in json_text(value)


def test_what_json_cannot_say_is_named() -> None:
    with pytest.raises(UsageError, match=r"value\.a\[1\] is a complex"):
        plain({"a": [1, 2j]})
