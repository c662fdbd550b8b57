"""One run at a time."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from photoplan.errors import ResourceError, RunLocked, UsageError
from photoplan.io.disk import FileLock

HOLDER = """
import sys, time
from pathlib import Path
from photoplan.io.disk import FileLock
lock = FileLock(Path(sys.argv[1]))
lock.acquire()
print("held", flush=True)
time.sleep(60)
"""


def test_fault_26_the_second_is_refused_and_named(tmp_path: Path) -> None:
    path = tmp_path / ".a.tif.lock"
    with FileLock(path):
        with pytest.raises(RunLocked, match=rf"\.a\.tif\.lock: another run \(process {os.getpid()}\)") as error:
            FileLock(path).acquire()
        assert error.value.exit_code == 2
    assert not path.exists()
    with FileLock(path):
        pass


@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
def test_fault_26_death_releases_it(tmp_path: Path) -> None:
    path = tmp_path / ".a.tif.lock"
    process = subprocess.Popen([sys.executable, "-c", HOLDER, str(path)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    with pytest.raises(RunLocked, match=f"process {process.pid}"):
        FileLock(path).acquire()
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    assert path.exists()
    with FileLock(path):
        pass


def test_a_lock_file_removed_while_waiting_guards_nothing(tmp_path: Path) -> None:
    """Releasing removes the file; a new lock is always one on the file that has the name."""
    path = tmp_path / ".a.tif.lock"
    first = FileLock(path)
    first.acquire()
    path.unlink()
    with FileLock(path):
        first.release()
        with pytest.raises(RunLocked):
            FileLock(path).acquire()
    first.release()


def test_fault_29_no_such_folder(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"absent: no such folder; make it first"):
        FileLock(tmp_path / "absent" / ".a.lock").acquire()


def test_fault_04_a_disk_that_is_full_at_once_is_named_and_the_lock_given_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(descriptor: int, content: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    path = tmp_path / ".a.tif.lock"
    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        with pytest.raises(ResourceError, match=r"\.a\.tif\.lock: cannot be written"):
            FileLock(path).acquire()
    assert not path.exists()
    with FileLock(path):
        pass
