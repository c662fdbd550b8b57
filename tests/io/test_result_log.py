"""Results that are kept: values of every kind come back, and nothing that does anything is read."""

from __future__ import annotations

import os
import pickle
import re
import tracemalloc
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import photoplan
from photoplan.codec import NotData, decode, encode
from photoplan.errors import InputError, RunLocked
from photoplan.geometry.grid import Window
from photoplan.io.store import _FORM, ResultLog, TileLog


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


def planted(path: Path, *contents: bytes) -> None:
    """A log of the right key whose results somebody else has made."""
    with TileLog(path / "kept", f"{_FORM} k") as tiles:
        for index, content in enumerate(contents, 1):
            tiles.append(index, content)


@pytest.mark.parametrize("value", [Command(), np.testing.assert_equal, Path("a"), np.array([Path("a")])])
def test_a_planted_log_does_nothing(tmp_path: Path, value: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only data is read, whoever has written it."""
    monkeypatch.chdir(tmp_path)
    planted(tmp_path, pickle.dumps(value))
    with log(tmp_path) as kept, pytest.raises(InputError, match=r"not what this version writes .*; delete the file"):
        kept[1]
    assert not (tmp_path / "made").exists()


def test_the_work_of_another_user_is_not_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever prepares a log knows its key, but not the secret of the user who receives it."""
    for user, finished in (("one", 0), ("two", 0), ("two", 1), ("one", 0)):
        monkeypatch.setenv("PHOTOPLAN_CACHE_DIR", str(tmp_path / user))
        with log(tmp_path) as kept:
            assert len(kept.finished) == finished
            kept.append(1, np.zeros(3))
    assert {p.stat().st_size for p in tmp_path.glob("*/own")} == {32}
    assert os.name != "posix" or {p.stat().st_mode & 0o77 for p in tmp_path.glob("*/own")} == {0}


def test_without_a_cache_folder_work_is_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("PHOTOPLAN_CACHE_DIR", str(tmp_path / "file" / "cache"))
    for finished in (0, 1):
        with log(tmp_path) as kept:
            assert len(kept.finished) == finished
            kept.append(1, None)


def test_logs_of_versions_that_pickled_start_afresh(tmp_path: Path) -> None:
    with TileLog(tmp_path / "kept", "k") as old:
        old.append(1, pickle.dumps(Command()))
    with log(tmp_path) as kept:
        assert not kept.finished


HOSTILE = [
    '["class", "photoplan.engine.execute.RenderJob", {}]',
    '["class", "os.system", {"command": "mkdir made"}]',
    '["class", "photoplan.geometry.grid.Window", {"col": 1, "row": 2, "width": "3", "height": 4}]',
    '["class", "photoplan.geometry.grid.Window", {"col": 1, "row": 2, "width": 3, "height": 4, "__class__": 5}]',
    '["class", "photoplan.geometry.grid.Window", {"__setstate__": 1}]',
    '["class", ["a"], {}]',
    '["enum", "photoplan.geometry.grid.Window", "col"]',
    '["array", "|O8", [1], "C"]',
    '["array", "<f8", [1000000000000], "C"]',
    '["array", "<f8", [-1], "C"]',
    '["array", "<f8", [4294967296, 4294967296, 4294967296], "C"]',
    '["array", [["a", "<f8"], ["b", "|O8"]], [1], "C"]',
    '["object", [1]]',
    '["array", "object", [2], [["class"], 1]]',
    '["eval", "1"]',
    '{"a": 1}',
    "[" * 100_000,
    '["list", ' * 5_000 + "1" + "]" * 5_000,
    "1" * 10_000,
    "[]",
    "",
]


@pytest.mark.parametrize("text", HOSTILE, ids=range(len(HOSTILE)))
def test_prepared_values_are_refused_by_name(text: str) -> None:
    content = b"PPDATA01" + len(text).to_bytes(8, "little") + text.encode()
    with pytest.raises(NotData):
        decode(content + bytes(8))


def test_every_cut_and_changed_byte_is_a_value_or_refused() -> None:
    whole = encode((Window(1, 2, 3, 4), np.arange(4.0), {"a": [None, "b", 1.5]}, np.array(["x", None], object)))
    for at in range(len(whole)):
        with pytest.raises(NotData):
            decode(whole[:at])
        for change in (0x01, 0x20, 0x80):
            other = bytearray(whole)
            other[at] ^= change
            with suppress(NotData):
                decode(bytes(other))


def test_sizes_are_compared_before_memory_is_taken() -> None:
    """A promise of 8 TB costs nothing."""
    tracemalloc.start()
    text = b'["array", "<f8", [1099511627776], "C"]'
    with pytest.raises(NotData):
        decode(b"PPDATA01" + len(text).to_bytes(8, "little") + text)
    assert tracemalloc.get_traced_memory()[1] < 1 << 20
    tracemalloc.stop()


def test_no_module_reads_what_can_run_code() -> None:
    """`pickle`, `marshal`, `shelve`, `joblib`, unsafe YAML and `np.load` with objects stand nowhere in the package."""
    top = Path(photoplan.__file__).parent
    bad = re.compile(
        r"^\s*(?:import|from)\s+(?:pickle|_pickle|cPickle|cloudpickle|dill|marshal|shelve|joblib|jsonpickle|runpy|dbm)\b"
        r"|import_module\(\W*(?:pickle|marshal|shelve|dill|cloudpickle|joblib)\b"
        r"|\bUnpickler\b|\bread_pickle\b|allow_pickle\s*=\s*(?!False\b)|\byaml\.(?:load|load_all|full_load|unsafe_load)\b"
        r"|\byaml\.(?:Unsafe|Full)?Loader\b|\bnp\.(?:load|fromregex|genfromtxt)\((?!.*allow_pickle=False)"
        r"|(?<![\w.])(?:eval|exec|compile|__import__)\(|\bos\.(?:system|popen|exec\w*|spawn\w*)\(|shell\s*=\s*True",
        re.MULTILINE,
    )
    found = {
        path.relative_to(top).as_posix(): hit[0] for path in top.rglob("*.py") if (hit := bad.search(path.read_text()))
    }
    assert not found
