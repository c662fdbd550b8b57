"""What is kept is made once, and anew when code or inputs change."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tools import kept as keeping
from tools.kept import closure, kept


@pytest.fixture
def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    monkeypatch.setenv("PHOTOPLAN_TEST_CACHE", str(tmp_path / "cache"))
    return []


def test_made_once_and_anew_when_an_input_changes(made: list[Path], tmp_path: Path) -> None:
    given = tmp_path / "given.txt"
    given.write_text("one")

    def make(folder: Path) -> None:
        (folder / "copy.txt").write_text(given.read_text())
        made.append(folder)

    with ThreadPoolExecutor(4) as pool:
        folders = set(pool.map(lambda _: kept("copy", make, ["photoplan.errors"], [given]), range(8)))
    assert len(folders) == len(made) == 1
    given.write_text("two")
    assert (kept("copy", make, ["photoplan.errors"], [tmp_path / "given.txt"]) / "copy.txt").read_text() == "two"
    assert len(made) == 2


def test_what_fails_is_not_kept(made: list[Path], tmp_path: Path) -> None:
    def fail(folder: Path) -> None:
        made.append(folder)
        raise ValueError("not this time")

    for _ in range(2):
        with pytest.raises(ValueError, match="not this time"):
            kept("never", fail, [])
    assert len(made) == 2
    assert [path.name for path in (tmp_path / "cache").iterdir()] == ["never.lock"]


def test_code_that_is_imported_counts_and_other_code_does_not(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = closure(["photoplan.products.film"])
    assert {"photoplan.errors", "photoplan.geometry.pose", "photoplan.products.film"} <= found
    assert "photoplan.products.restore" not in found and "photoplan.cli.verb" not in found
    root = tmp_path / "photoplan"
    (root / "one").mkdir(parents=True)
    (root / "one" / "__init__.py").write_text("")
    (root / "one" / "a.py").write_text("def f():\n    from photoplan.one.b import g\n")
    (root / "one" / "b.py").write_text("TABLE = {'c': 'photoplan.one.c'}\n")
    (root / "one" / "c.py").write_text("import numpy\n")
    (root / "one" / "d.py").write_text("")
    monkeypatch.setitem(keeping._ROOTS, "photoplan", root)
    for cached in (keeping._source, keeping._imports):
        cached.cache_clear()
        monkeypatch.setattr(keeping, cached.__name__, cached.__wrapped__)
    names = {f"photoplan.one.{name}" for name in "abc"}
    assert closure(["photoplan.one.a"]) == names | {"photoplan.one"}
    before = keeping._key(Path(__file__), ["photoplan.one.a"], [])
    (root / "one" / "d.py").write_text("# another")
    assert keeping._key(Path(__file__), ["photoplan.one.a"], []) == before
    (root / "one" / "c.py").write_text("import numba\n")
    assert keeping._key(Path(__file__), ["photoplan.one.a"], []) != before
