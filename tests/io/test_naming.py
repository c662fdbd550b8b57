"""Files that get their names together: order, failures in between, files of an earlier run."""

from __future__ import annotations

from pathlib import Path

import pytest

from photoplan.errors import RunLocked, UsageError
from photoplan.io import store as naming
from photoplan.io.disk import FileLock, lock_of
from photoplan.io.store import is_unfinished, locked, standing, together, write_atomically


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_nothing_has_its_name_before_the_end(tmp_path: Path) -> None:
    done = []
    with together():
        write_atomically(tmp_path / "a", b"1")
        with together():
            write_atomically(tmp_path / "b", b"2")
        naming.when_named(lambda: done.append(names(tmp_path)))
        assert not (tmp_path / "a").exists() and standing(tmp_path / "a").read_bytes() == b"1"
    assert names(tmp_path) == ["a", "b"] and not is_unfinished(tmp_path / "a")
    assert {"a", "b"} <= set(done[0])


def test_a_lock_is_held_until_files_have_their_names(tmp_path: Path) -> None:
    seen = []
    with together():
        with locked(lock_of(tmp_path / "a")):
            write_atomically(tmp_path / "a", b"1")
        naming.when_named(lambda: seen.append((tmp_path / "a").exists()))
        with pytest.raises(RunLocked), FileLock(lock_of(tmp_path / "a")):
            pass
    with FileLock(lock_of(tmp_path / "a")):
        assert seen == [True]
    with pytest.raises(ZeroDivisionError), together(), locked(lock_of(tmp_path / "a")):
        1 / 0  # noqa: B018
    with locked(lock_of(tmp_path / "a")), pytest.raises(RunLocked), FileLock(lock_of(tmp_path / "a")):
        pass
    with FileLock(lock_of(tmp_path / "a")):
        pass


def test_an_error_leaves_what_was_there(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("old")
    with pytest.raises(ZeroDivisionError), together():
        write_atomically(tmp_path / "a", b"1")
        write_atomically(tmp_path / "b", b"2")
        1 / 0  # noqa: B018
    assert names(tmp_path) == ["a"] and (tmp_path / "a").read_text() == "old"


def test_a_file_that_appeared_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="another program made it meanwhile"), together():
        write_atomically(tmp_path / "a", b"1")
        write_atomically(tmp_path / "b", b"2")
        (tmp_path / "b").write_text("other")
    assert names(tmp_path) == ["b"] and (tmp_path / "b").read_text() == "other"


def test_an_unfinished_file_stays_one_whatever_the_next_run_ends_with(tmp_path: Path) -> None:
    """The first run dies after one name, the second one fails, and the third is not refused."""
    (tmp_path / "b").mkdir()
    with pytest.raises(UsageError), together():
        write_atomically(tmp_path / "a", b"1")
        write_atomically(tmp_path / "b", b"2")
    assert (tmp_path / "a").read_bytes() == b"1" and is_unfinished(tmp_path / "a")
    with pytest.raises(ZeroDivisionError), together():
        write_atomically(tmp_path / "a", b"3")
        1 / 0  # noqa: B018
    assert (tmp_path / "a").read_bytes() == b"1" and is_unfinished(tmp_path / "a")
    (tmp_path / "a").write_text("of other origin")
    assert not is_unfinished(tmp_path / "a")
    (tmp_path / "b").rmdir()
    with together():
        write_atomically(tmp_path / "a", b"4")
        write_atomically(tmp_path / "b", b"5")
    assert names(tmp_path) == ["a", "b"]
