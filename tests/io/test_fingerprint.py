"""Inputs are recognised, cheaply."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from photoplan.errors import InputError
from photoplan.io.files import fingerprint


def test_content_decides_not_time(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"abc" * 1000)
    before = fingerprint(path)
    assert fingerprint(path) == before
    os.utime(path, ns=(1, 1))
    assert fingerprint(path) == before
    path.write_bytes(b"abc" * 999 + b"abd")
    assert fingerprint(path) != before


@pytest.mark.parametrize("size", [0, 1, 65_536, 100_000, 3_000_001, 4 << 20])
def test_files_up_to_four_mebibytes_are_covered_whole(tmp_path: Path, size: int) -> None:
    path = tmp_path / "a"
    content = bytearray(os.urandom(size))
    path.write_bytes(content)
    before = fingerprint(path)
    assert before.size == size
    for position in {0, size // 3, size // 2, size - 1} if size else ():
        changed = bytearray(content)
        changed[position] ^= 1
        path.write_bytes(changed)
        assert fingerprint(path).digest != before.digest
    path.write_bytes(content + b"\0")
    assert fingerprint(path).digest != before.digest


def test_ten_gigabytes_take_no_time(tmp_path: Path) -> None:
    path = tmp_path / "a"
    with path.open("wb") as file:
        file.truncate(10 << 30)
    fingerprint(path)
    start = time.process_time()
    before = fingerprint(path)
    assert time.process_time() - start < 0.02
    with path.open("r+b") as file:
        file.seek((10 << 30) - 1)
        file.write(b"x")
    assert fingerprint(path) != before


def test_an_absent_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="absent: cannot be read"):
        fingerprint(tmp_path / "absent")


def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "objects.obj")
    with pytest.raises(InputError, match=r"objects\.obj: is a pipe"):
        fingerprint(tmp_path / "objects.obj")
