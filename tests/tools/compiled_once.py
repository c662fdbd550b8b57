"""Processes of tests do not compile one kernel side by side: the first does, the others wait and load what it kept."""

from __future__ import annotations

import sys
from typing import Any

from tools.kept import folder_of_cache, locked

_held: set[str] = set()
"""Locks of this process, to which a kernel that calls itself for other types would come again."""


def wait_for_each_other() -> None:
    """From now on, if numba is loaded."""
    module: Any = sys.modules.get("numba.core.dispatcher")
    if module is None or hasattr(module.Dispatcher.compile, "waits"):
        return
    compiling = sys.modules["numba.core.compiler_lock"].global_compiler_lock  # type: ignore[attr-defined]
    real = module.Dispatcher.compile
    folder = folder_of_cache()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:  # nowhere to wait
        return

    def compile(self: Any, sig: Any) -> Any:
        name = f"{self.py_func.__module__}.{self.py_func.__qualname__}"
        # Threads come first: one that held a file and waited for the other's compilation would never end.
        with compiling:
            if name in _held or not name.startswith("photoplan."):
                return real(self, sig)
            _held.add(name)
            try:
                with locked(folder / f"compiling-{name.replace('<', '').replace('>', '')}.lock"):
                    return real(self, sig)
            finally:
                _held.discard(name)

    compile.waits = True  # type: ignore[attr-defined]
    module.Dispatcher.compile = compile
