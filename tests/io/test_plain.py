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
from photoplan.plain import advised, json_text, pick, plain


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


@pytest.mark.parametrize("figures", [1, 2, 3])
def test_an_advised_number_passes_the_check_that_it_answers(figures: int) -> None:
    bounds = np.random.default_rng(4).uniform(-7, 7, 500)
    for least in [*(10.0**bounds).tolist(), 0.03301, 0.0334, 0.1, 0.3, 1.0, 99.96, 0.5]:
        text = advised(least, figures)
        assert least * (1 - 1e-9) <= float(text) <= least * (1 + 10.0 ** (1 - figures))
    assert advised(0.0334) == "0.034" and advised(0.5) == "0.5" and advised(592.01, 3) == "593"
