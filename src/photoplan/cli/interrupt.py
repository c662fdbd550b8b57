"""Ctrl-C and SIGTERM: the first signal stops the run cleanly; if that takes too long, the process ends at once.

Whatever is on the disk survives death at any moment, so that ending hard costs only the tiles under way.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from contextlib import suppress
from types import FrameType

CODE = 130
"""Exit code of an interrupted run."""
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
#: Seconds that unwinding may take; a library may be busy with a large file and not come back earlier.
_GRACE = 3.0


def catch_interrupts() -> None:
    """Turn both signals into `KeyboardInterrupt`; a signal that the caller has ignored (`nohup`) stays ignored."""
    for number in _SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _first)
    if os.name == "posix":
        reader, writer = os.pipe()
        os.set_blocking(writer, False)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        threading.Thread(target=_watch, args=(reader,), daemon=True).start()


def _first(signum: int, frame: FrameType | None) -> None:
    for number in _SIGNALS:
        signal.signal(number, _second)
    raise KeyboardInterrupt


def _second(signum: int, frame: FrameType | None) -> None:
    """Leave the unwinding alone, it is timed; where it is not, end at once."""
    if os.name != "posix":
        _end()


def _watch(reader: int) -> None:
    """End the process some seconds after the first signal, also if the main thread cannot be interrupted."""
    while os.read(reader, 1)[0] not in _SIGNALS:
        pass
    time.sleep(_GRACE)
    _end()


def _end() -> None:
    stop_children()
    with suppress(OSError):  # whoever read what is said may have gone before
        os.write(2, b"photoplan: stopped; the same command continues with the tiles that are finished\n")
    os._exit(CODE)


def stop_children() -> None:
    """Kill worker processes that this process has started."""
    if "multiprocessing" in sys.modules:
        for child in sys.modules["multiprocessing"].active_children():
            child.kill()
