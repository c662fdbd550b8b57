"""Results that are kept: values of every kind come back, and nothing that does anything is read."""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photoplan.errors import InputError, RunLocked
from photoplan.geometry.grid import Window
from photoplan.io.result_log import ResultLog
from photoplan.io.tile_log import TileLog


def log(tmp_path: Path, key: str = "k") -> ResultLog:
    return ResultLog(tmp_path / "kept", key, tmp_path / "lock")


@pytest.mark.parametrize(
    "value",
    [None, 1.5, "ü", (1, [2, {"a": np.float64(3.0)}]), Window(1, 2, 3, 4), np.arange(6, dtype="<f4").reshape(2, 3),
     np.asfortranarray(np.eye(3)), np.eye(4)[::2, 1:], np.array(["a", "bc"]), np.empty((0, 2))],
    ids=lambda value: type(value).__name__,
)  # fmt: skip
def test_values_come_back(tmp_path: Path, value: Any) -> None:
    with log(tmp_path) as kept:
        kept.append(kept.index(("a", 1)), value)
    with log(tmp_path) as kept:
        assert kept.finished == {kept.index(("a", 1))}
        found = kept[kept.index(("a", 1))]
    assert type(found) is type(value)
    np.testing.assert_equal(found, value)
    if isinstance(value, np.ndarray):
        # Kernels are compiled for the order of memory and for arrays that can be written.
        assert found.flags.writeable and found.flags.f_contiguous == value.flags.f_contiguous


def test_another_key_starts_afresh_and_an_empty_log_is_no_file(tmp_path: Path) -> None:
    with log(tmp_path) as kept:
        kept.append(1, "one")
    with log(tmp_path, "other") as kept:
        assert kept.finished == frozenset()
    assert list(tmp_path.iterdir()) == []


def test_a_removed_log_is_gone_and_a_second_run_is_refused(tmp_path: Path) -> None:
    with log(tmp_path) as kept:
        kept.append(1, "one")
        with pytest.raises(RunLocked), log(tmp_path):
            pass
        kept.remove()
    assert list(tmp_path.iterdir()) == []


class Command:
    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, ("made",)


@pytest.mark.parametrize("value", [Command(), np.testing.assert_equal, Path("a"), np.array([Path("a")])])
def test_a_planted_log_does_nothing(tmp_path: Path, value: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only data is read, whoever has written it."""
    monkeypatch.chdir(tmp_path)
    with TileLog(tmp_path / "kept", "k") as planted:
        planted.append(1, pickle.dumps(value))
    with log(tmp_path) as kept, pytest.raises(InputError, match="which is no data; delete the log"):
        kept[1]
    assert not (tmp_path / "made").exists()
