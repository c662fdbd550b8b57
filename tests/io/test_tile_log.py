"""The store of finished tiles survives death at any byte."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from photoplan.errors import PhotoplanError, ResourceError, UsageError
from photoplan.io.store import TileLog

PAYLOADS = {4: b"four" * 50, 0: b"", 7: bytes(range(256)), 2: b"x"}


def filled(path: Path, key: str = "run") -> Path:
    with TileLog(path, key) as log:
        for index, payload in PAYLOADS.items():
            log.append(index, payload, (index + 1, len(payload)))
    return path


def test_what_was_appended_is_there_again(tmp_path: Path) -> None:
    path = filled(tmp_path / "log")
    with TileLog(path, "run") as log:
        assert log.finished == set(PAYLOADS)
        for index, payload in PAYLOADS.items():
            assert log.read(index) == payload
            assert log.notes(index) == (index + 1, len(payload))
            position, length = log.place(index)
            assert path.read_bytes()[position : position + length] == payload
        log.append(9, b"nine")
        log.append(4, b"again")
    with TileLog(path, "run") as log:
        assert (log.read(9), log.read(4), log.read(7)) == (b"nine", b"again", PAYLOADS[7])
        log.remove()
    assert not path.exists()


def test_another_key_starts_afresh(tmp_path: Path) -> None:
    path = filled(tmp_path / "log")
    with TileLog(path, "another run") as log:
        assert not log.finished
    with TileLog(path, "run") as log:
        assert not log.finished


def test_fault_03_cut_at_every_byte(tmp_path: Path) -> None:
    """Whatever was cut off: a prefix of the tiles is there, whole, and the log goes on from there."""
    path = filled(tmp_path / "log")
    raw = path.read_bytes()
    order = list(PAYLOADS)
    counts = []
    for end in range(len(raw) + 1):
        path.write_bytes(raw[:end])
        with TileLog(path, "run") as log:
            found = log.finished
            assert found == set(order[: len(found)])
            for index in found:
                assert log.read(index) == PAYLOADS[index]
            log.append(99, b"more")
        with TileLog(path, "run") as log:
            assert log.finished == found | {99}
            assert log.read(99) == b"more"
        counts.append(len(found))
    assert counts == sorted(counts)
    assert (counts[0], counts[-2], counts[-1]) == (0, 3, 4)


def test_fault_03_every_changed_byte_is_noticed(tmp_path: Path) -> None:
    """A changed record and all behind it are taken as never written."""
    path = filled(tmp_path / "log")
    raw = path.read_bytes()
    for position in range(0, len(raw), 3):
        changed = bytearray(raw)
        changed[position] ^= 0x10
        path.write_bytes(changed)
        if position < 7:
            # It is no longer known as ours: it may be anybody's file, and stays.
            with pytest.raises(UsageError, match="is not a log of finished tiles"):
                TileLog(path, "run")
            assert path.read_bytes() == changed
            continue
        with TileLog(path, "run") as log:
            assert len(log.finished) < len(PAYLOADS)
            assert all(log.read(index) == PAYLOADS[index] for index in log.finished)


def test_a_change_behind_its_back_is_noticed(tmp_path: Path) -> None:
    path = filled(tmp_path / "log")
    with TileLog(path, "run") as log:
        position, _ = log.place(7)
        with path.open("r+b") as file:
            file.seek(position + 5)
            file.write(b"?")
        with pytest.raises(PhotoplanError, match="tile 7 has changed"):
            log.read(7)


def test_threads_append_whole_records(tmp_path: Path) -> None:
    path = tmp_path / "log"
    with TileLog(path, "run") as log:

        def work(first: int) -> None:
            for index in range(first, first + 50):
                log.append(index, bytes([index % 256]) * (index + 1))

        threads = [threading.Thread(target=work, args=(50 * i,)) for i in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    with TileLog(path, "run") as log:
        assert log.finished == set(range(200))
        assert all(log.read(i) == bytes([i % 256]) * (i + 1) for i in range(200))


WRITER = """
import sys
from pathlib import Path
from photoplan.io.store import TileLog
log = TileLog(Path(sys.argv[1]), "run")
index = max(log.finished, default=-1) + 1
while True:
    log.append(index, bytes([index % 256]) * 200_000)
    print(index, flush=True)
    index += 1
"""


@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
def test_fault_03_killed_for_real(tmp_path: Path) -> None:
    path = tmp_path / "log"
    announced = -1
    for moment in (3, 17):
        process = subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        for _ in range(moment):
            announced = int(process.stdout.readline())
        process.send_signal(signal.SIGKILL)
        rest = process.communicate()[0].split()
        announced = int(rest[-1]) if rest else announced
        with TileLog(path, "run") as log:
            assert log.finished >= set(range(announced + 1))
            assert len(log.finished) <= announced + 2
            for index in log.finished:
                assert np.all(np.frombuffer(log.read(index), np.uint8) == index % 256)
    assert announced >= 19


LIMITED = """
import resource, signal, sys
from pathlib import Path
from photoplan.errors import ResourceError
from photoplan.io.store import TileLog
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
log = TileLog(Path(sys.argv[1]), "run")
try:
    for index in range(100):
        log.append(index, bytes(9_000))
except ResourceError as error:
    print(error, "|", len(log.finished))
"""


@pytest.mark.skipif(os.name != "posix", reason="needs resource limits")
def test_fault_04_no_more_room(tmp_path: Path) -> None:
    path = tmp_path / "log"
    run = subprocess.run([sys.executable, "-c", LIMITED, str(path)], capture_output=True, text=True, check=True)
    message, count = run.stdout.rsplit("|", 1)
    assert int(count) == 11
    assert str(path) in message
    assert "finished tiles are kept" in message
    size = path.stat().st_size
    with TileLog(path, "run") as log:
        assert log.finished == set(range(11))
    assert path.stat().st_size == size, "the torn record was removed at once, its room is free"


def test_fault_29_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match=r"file/log: cannot be made \(Not a directory\)"):
        TileLog(tmp_path / "file" / "log", "run")
    assert not issubclass(UsageError, ResourceError)
