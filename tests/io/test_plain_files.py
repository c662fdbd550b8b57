"""Text files of any origin: never more is read than is allowed."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from photoplan.errors import InputError
from photoplan.io.files import read_text


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_that_never_ends_is_refused(tmp_path: Path):
    """It states a size of zero bytes, as devices do."""
    pipe = tmp_path / "endless.toml"
    os.mkfifo(pipe)
    written = []

    def write() -> None:
        try:
            with pipe.open("wb", buffering=0) as file:
                while len(written) < 1000:
                    written.append(file.write(b"a" * 4096))
        except BrokenPipeError:
            pass

    writer = threading.Thread(target=write)
    writer.start()
    with pytest.raises(InputError, match="more than 100000 bytes"):
        read_text(pipe, 100_000)
    writer.join(10)
    assert sum(written) < 1_000_000
